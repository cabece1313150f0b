"""The page of ``evaluate`` names every format that is read, with its files and a command."""

from __future__ import annotations

import re
import shlex

import pytest
from places import ROOT

from su3d_bench.cli.main import build_parser
from su3d_bench.metrics.protocols.loading import protocol_names
from su3d_bench.predictions.formats import READERS

PAGE = (ROOT / "docs/evaluate.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### `([^`]+)`\n(.*?)(?=^### |\Z)", PAGE, re.DOTALL | re.MULTILINE))


def test_the_page_has_a_section_of_each_format_and_of_no_other() -> None:
    assert list(SECTIONS) == list(READERS)


@pytest.mark.parametrize("name", READERS)
def test_a_format_has_its_files_and_a_command(name: str) -> None:
    assert "```text\n" in SECTIONS[name] and "```sh\nsu3d-bench evaluate " in SECTIONS[name]
    suffixes = getattr(READERS[name], "suffixes", ())
    assert any(suffix in SECTIONS[name] for suffix in suffixes) or not suffixes


def test_the_commands_of_the_page_are_taken_and_their_protocols_known() -> None:
    commands = re.findall(r"^su3d-bench (evaluate .*)$", PAGE, re.MULTILINE)
    for command in commands:
        arguments = build_parser().parse_args(shlex.split(command))
        assert set(arguments.protocols) <= set(protocol_names()), command
    assert len(commands) > len(READERS)
