"""The pages that speak of verbs and variables say what parser and code say."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from fuzz_words import verbs
from places import ROOT
from verbs_page import MORE, PAGE, page

from su3d_bench.baselines.command.method import PLACEHOLDERS, variable_of
from su3d_bench.cli.main import build_parser

ENVIRONMENT = ROOT / "docs" / "running" / "environment.md"
VARIABLE = re.compile(r"SU3D_[A-Z]+(?:_[A-Z]+)*")
CODE = ("su3d_bench", "datasets", "baselines", "reports")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
MADE_UP = {"SU3D_TEST_KEY"}  # by a test, for itself


def test_the_page_of_verbs_is_what_the_parser_says() -> None:
    assert PAGE.read_text() == page(), "run make architecture"


def test_what_is_said_beside_the_help_is_of_verbs_that_exist() -> None:
    assert set(MORE) <= {" ".join(words) for words, _ in verbs()}


def test_links_of_the_page_lead_somewhere() -> None:
    text = PAGE.read_text()
    headings = {heading.replace(" ", "-") for heading in re.findall(r"^## (.*)$", text, re.MULTILINE)}
    for target in re.findall(r"\]\(([^)]+)\)", text):
        place, _, heading = target.partition("#")
        assert (PAGE.parent / place).exists() if place else heading in headings, target


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("file", PAGES, ids=str)
def test_every_command_of_a_page_is_one_that_the_parser_takes(file: Path) -> None:
    text = file.read_text().replace("\\\n", " ")
    for line in re.findall(r"^(?:! |SU3D_\w+=\S+ )?su3d-bench (.*)$", text, re.MULTILINE):
        if not re.search(r"VERB| \.\.\.|\||>", line):
            build_parser().parse_args(shlex.split(line, comments=True))


def table_of_variables() -> set[str]:
    rows = re.findall(r"^\| `(SU3D_\w+)`", ENVIRONMENT.read_text(), re.MULTILINE)
    assert len(rows) == len(set(rows))
    return set(rows)


def test_one_table_has_every_variable_of_the_code_and_no_other() -> None:
    read = set().union(*map(variables_in, CODE)) | {variable_of(name) for name in PLACEHOLDERS}
    of_tests = variables_in("tests") | variables_in("benchmarks")
    assert table_of_variables() == (read | of_tests) - MADE_UP


def variables_in(folder: str) -> set[str]:
    files = [path for path in (ROOT / folder).rglob("*.py") if "__pycache__" not in path.parts]
    return {name for path in files for name in VARIABLE.findall(path.read_text())}


def test_the_pages_name_no_variable_that_is_not() -> None:
    for file in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "action.yml"]:
        assert set(VARIABLE.findall(file.read_text())) <= table_of_variables(), file


@pytest.mark.parametrize("file", PAGES, ids=str)
def test_a_page_has_one_heading_pictures_with_words_and_links_that_lead_somewhere(file: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", file.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert len(re.findall(r"^# ", text, re.MULTILINE)) == 1
    assert "![](" not in text
    for target in LINK.findall(text):
        assert (file.parent / target).is_file(), target
