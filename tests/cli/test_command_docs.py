"""Documentation pages, tutorials and the GitHub action match the parser and the code."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
from argparse import SUPPRESS, ArgumentParser
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_pages import COMMON_OPTIONS, MORE, command_pages, place_of_command
from fuzz_words import verbs
from places import ROOT

from su3d_bench.baselines.command.placeholders import PLACEHOLDERS, variable_of
from su3d_bench.cli.main import build_parser
from su3d_bench.core.config import read_assignments, resolve
from su3d_bench.metrics.instance.average_precision import ap_columns
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.perception.profiles import PerceptionConfig
from su3d_bench.reproducing.recipe import load_recipe

ENVIRONMENT = ROOT / "docs" / "running" / "environment.md"
VARIABLE = re.compile(r"SU3D_[A-Z]+(?:_[A-Z]+)*")
CODE = ("su3d_bench", "datasets", "baselines", "reports")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
MADE_UP = {"SU3D_TEST_KEY"}  # only used in a test


def test_every_command_has_a_page_with_every_option() -> None:
    pages = command_pages()
    assert len(pages) == 1 + len(list(verbs()))
    for words, parser in verbs():
        page = pages[place_of_command(" ".join(words))]
        assert page.startswith(f"# su3d-bench {' '.join(words)}\n")
        shown = {option for action in parser._actions if action.help != SUPPRESS for option in action.option_strings}
        assert shown - COMMON_OPTIONS - {"-h"} <= set(re.findall(r"(?<=[` ])--[\w-]+", page))


def test_additional_help_is_only_for_existing_commands() -> None:
    assert set(MORE) <= {" ".join(words) for words, _ in verbs()}


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.fixture(scope="module")
def parser() -> ArgumentParser:
    return build_parser()


@pytest.mark.parametrize("file", PAGES, ids=str)
def test_parser_accepts_every_command_of_a_page(file: Path, parser: ArgumentParser) -> None:
    text = file.read_text().replace("\\\n", " ")
    for line in re.findall(r"^(?:! |SU3D_\w+=\S+ )?su3d-bench (.*)$", text, re.MULTILINE):
        if not re.search(r"VERB| \.\.\.|\||>", line):
            parser.parse_args(shlex.split(line, comments=True))


def table_of_variables() -> set[str]:
    rows = re.findall(r"^\| `(SU3D_\w+)`", ENVIRONMENT.read_text(), re.MULTILINE)
    assert len(rows) == len(set(rows))
    return set(rows)


def test_table_of_variables_matches_the_code() -> None:
    read = set().union(*map(variables_in, CODE)) | {variable_of(name) for name in PLACEHOLDERS}
    of_tests = variables_in("tests") | variables_in("benchmarks")
    assert table_of_variables() == (read | of_tests) - MADE_UP


def variables_in(folder: str) -> set[str]:
    files = [path for path in (ROOT / folder).rglob("*.py") if "__pycache__" not in path.parts]
    return {name for path in files for name in VARIABLE.findall(path.read_text())}


def test_pages_only_name_existing_variables() -> None:
    for file in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "action.yml"]:
        assert set(VARIABLE.findall(file.read_text())) <= table_of_variables(), file


@pytest.mark.parametrize("file", PAGES, ids=str)
def test_page_has_one_heading_alt_texts_and_valid_links(file: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", file.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert len(re.findall(r"^# ", text, re.MULTILINE)) == 1
    assert "![](" not in text
    for target in LINK.findall(text):
        assert (file.parent / target).is_file(), target


# the tutorials, which .ci/tutorials.py runs

PROGRAM = runpy.run_path(str(ROOT / ".ci" / "tutorials.py"))
TUTORIALS: dict[str, Path] = PROGRAM["PAGES"]


def steps(name: str) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = PROGRAM["steps_of"](TUTORIALS[name].read_text(encoding="utf-8"))
    return found


def not_printed(shown: str, printed: str) -> Any:
    return PROGRAM["not_printed"](shown, printed)


@pytest.mark.parametrize("name", TUTORIALS)
def test_every_output_block_of_a_tutorial_is_checked(name: str) -> None:
    text = TUTORIALS[name].read_text(encoding="utf-8")
    assert text.count("```text\n") == sum(bool(shown) for _, shown in steps(name))


@pytest.mark.parametrize("name", TUTORIALS)
def test_tutorial_output_may_differ_in_numbers_but_not_in_words(name: str) -> None:
    for _, shown in steps(name):
        assert not_printed(shown, shown.replace("5", "6").replace("1", "2")) == []
        telling = [line for line in shown.splitlines() if any(letter.isalpha() for letter in line)]
        assert len(not_printed(shown, "something else\n")) >= len(telling)


def test_line_with_another_word_or_column_does_not_match() -> None:
    assert not_printed("| method | AP |\n3 scenes", "| method | AP | AP50 |\n3 rooms") == [
        "| method | AP |",
        "3 scenes",
    ]


# the GitHub action

ACTION = ROOT / "action.yml"
PINNED = re.compile(r"actions/(setup-python@v5|cache@v4|upload-artifact@v4)")


@pytest.fixture(scope="module")
def action() -> Any:
    return yaml.safe_load(ACTION.read_text())


def test_each_step_runs_in_bash_or_uses_a_pinned_action(action: Any) -> None:
    for step in action["runs"]["steps"]:
        assert ("run" in step) != ("uses" in step)
        assert step.get("shell") == "bash" if "run" in step else PINNED.fullmatch(step["uses"])


def test_scripts_are_valid_and_contain_no_inputs(action: Any) -> None:
    scripts = [step["run"] for step in action["runs"]["steps"] if "run" in step]
    assert scripts and not [script for script in scripts if "${{" in script]
    for script in scripts:
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_every_input_is_used_and_new_ones_are_documented(action: Any) -> None:
    steps = str(action["runs"]["steps"])
    assert all(f"inputs.{name}" in steps for name in action["inputs"])
    page = (ROOT / "docs" / "running" / "regression-check.md").read_text()
    assert all(f"`{name}" in page for name in ("cache", "artifact", "table", "artifact-url"))


def test_parser_accepts_every_command_of_the_action(action: Any) -> None:
    text = "\n".join(step.get("run", "") for step in action["runs"]["steps"]).replace("\\\n", " ")
    commands = re.findall(r"su3d-bench (.*?)(?: \|\| .*)?$", text, re.MULTILINE)
    assert len(commands) == 5
    for command in commands:
        build_parser().parse_args(shlex.split(command))


# the page of the paper's statements

STATEMENTS = (ROOT / "docs" / "methods" / "paper-statements.md").read_text(encoding="utf-8")
OPTIONS = re.findall(r"`([^`]+)`", "\n".join(re.findall(r"^\| I.*\|([^|]+)\|$", STATEMENTS, re.MULTILINE)))
IN_TEXT = re.findall(r"`((?:su3d-bench )?(?:sheets|report|runs) [^`]+)`", STATEMENTS)


@pytest.mark.parametrize("option", sorted({*OPTIONS, *IN_TEXT}))
def test_every_option_of_the_statements_is_accepted_and_not_the_default(option: str, parser: ArgumentParser) -> None:
    name, _, preset = option.partition("@")
    if preset:
        option = ".".join((name, "=".join(*OpenSU3D.presets[preset].items())))
    if "=" in option:
        settings = read_assignments([option], ["opensu3d"], ())
        if option.startswith("perception."):
            assert resolve(settings, ("perception",), PerceptionConfig) != PerceptionConfig()
        else:
            assert resolve(settings, ("method", "opensu3d"), OpenSU3DConfig) != OpenSU3DConfig()
    else:
        words = shlex.split(option.removeprefix("su3d-bench "))
        words += ["--out", "sheets"] if words[0] == "sheets" else []
        given = parser.parse_args(words)
        for experiment in getattr(given, "tables", None) or []:
            assert experiment in [one.name for one in load_recipe(given.recipe).experiments]
        assert set(getattr(given, "protocols", None) or []) <= set(protocol_names())


def test_statements_name_some_options_of_each_form() -> None:
    assert len(OPTIONS) >= 20
    assert {"run", "report", "reproduce", "runs", "sheets"} <= {option.split(" ")[0] for option in OPTIONS}


def test_protocol_with_the_printed_values_is_scored_over_ten_thresholds(tmp_path: Path) -> None:
    (block,) = re.findall(r"```toml\n(.*?)```", STATEMENTS, re.DOTALL)
    (tmp_path / "printed.toml").write_text(block)
    printed, original = load_protocol(str(tmp_path / "printed.toml")), load_protocol("replica-openmask3d")
    assert printed.texts_of("chair") == ("an chair in a scene",) != original.texts_of("chair")
    assert len(ap_columns(printed.thresholds)) == 10 == len(ap_columns(original.thresholds)) + 1
    assert (printed.transfer.evaluation_voxel_m, original.transfer.evaluation_voxel_m) == (0.0025, 0.025)


RECORDER = '#!/bin/sh\nprintf "%s\\n" "$(basename "$0") $*" >> "$LOG"\n'
NEVER = 'a b/$(touch never) `touch never`; touch never " touch never'


def commands_of_the_action(action: Any, folder: Path, inputs: dict[str, str]) -> tuple[list[str], list[int]]:
    """The commands that the action's scripts start with these inputs, by programs that only record them; exit codes."""
    (folder / "bin").mkdir()
    for name in ("su3d-bench", "python"):
        (folder / "bin" / name).write_text(RECORDER)
        (folder / "bin" / name).chmod(0o755)
    values = {name: str(one.get("default", "")) for name, one in action["inputs"].items()} | inputs
    of_runner = {
        "GITHUB_ACTION_PATH": str(ROOT),
        "RUNNER_TEMP": str(folder),
        "RUNNER_OS": "Linux",
        "RUNNER_ARCH": "X64",
    }
    outputs = {name: str(folder / name) for name in ("LOG", "GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    path = {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}"}
    codes = []
    for step in action["runs"]["steps"]:
        if "run" in step:
            given = {
                name: re.sub(r"\$\{\{ inputs\.([\w-]+) \}\}", lambda found: values[found[1]], text)
                for name, text in step.get("env", {}).items()
            }
            env = {**of_runner, **outputs, **path, **given}
            command = ["bash", "-eo", "pipefail", "-c", step["run"]]
            codes.append(subprocess.run(command, env=env, cwd=folder, check=False).returncode)
    return (folder / "LOG").read_text().replace(str(folder), "TMP").replace(str(ROOT), "/action").splitlines(), codes


@pytest.mark.parametrize(
    ("inputs", "scored", "checked"),
    [
        ({"scenes": "rooms/*", "arguments": "--stride 9"}, "run --scenes rooms/* --methods opensu3d --stride 9", ""),
        ({"predictions": "pred", "arguments": "--dataset replica"}, "evaluate pred --dataset replica", ""),
        ({"run": NEVER}, None, NEVER),
        ({"package": NEVER, "reference": NEVER}, "run --scenes homes/tuning0 homes/tuning1 --methods opensu3d", ""),
    ],
)
def test_action_checks_new_and_finished_runs_and_predictions(
    action: Any, tmp_path: Path, inputs: dict[str, str], scored: str | None, checked: str
) -> None:
    commands, codes = commands_of_the_action(action, tmp_path, {"reference": "ref.json", **inputs})
    run = checked or "TMP/su3d-run"
    made = [f"su3d-bench {scored} --quiet --out TMP/su3d-run"] if scored else []
    package = inputs.get("package", "/action")  # its own checkout, nothing from a registry
    assert f"python -m pip install --quiet --constraint /action/constraints.txt {package}" in commands
    of_program = [" ".join(line.split()) for line in commands if line.startswith("su3d-bench")]
    assert [line for line in of_program if line.startswith(("su3d-bench run", "su3d-bench evaluate"))] == made
    check = f"su3d-bench check {run} --against {inputs.get('reference', 'ref.json')} "
    assert any(line.startswith(check) for line in of_program)
    assert set(codes) == {0} and not (tmp_path / "never").exists()


def test_action_with_both_run_and_predictions_fails(action: Any, tmp_path: Path) -> None:
    commands, codes = commands_of_the_action(action, tmp_path, {"run": "a", "predictions": "b", "reference": "c"})
    assert 2 in codes and not [line for line in commands if "su3d-bench evaluate" in line or "su3d-bench run" in line]
