"""The action for GitHub: its form, and that each of its commands is one that the program takes."""

from __future__ import annotations

import re
import shlex
import subprocess
from typing import Any

import pytest
from places import ROOT

from su3d_bench.cli.main import build_parser

yaml = pytest.importorskip("yaml", reason="PyYAML comes with transformers and ray")
FILE = ROOT / "action.yml"
PINNED = re.compile(r"actions/(setup-python@v5|cache@v4|upload-artifact@v4)")


@pytest.fixture(scope="module")
def action() -> Any:
    return yaml.safe_load(FILE.read_text())


def test_each_step_runs_in_bash_or_uses_an_action_of_a_known_version(action: Any) -> None:
    for step in action["runs"]["steps"]:
        assert ("run" in step) != ("uses" in step)
        assert step.get("shell") == "bash" if "run" in step else PINNED.fullmatch(step["uses"])


def test_scripts_are_whole_and_no_input_is_text_of_one(action: Any) -> None:
    scripts = [step["run"] for step in action["runs"]["steps"] if "run" in step]
    assert scripts and not [script for script in scripts if "${{" in script]
    for script in scripts:
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_every_input_is_of_use_and_documented_where_it_is_new(action: Any) -> None:
    steps = str(action["runs"]["steps"])
    assert all(f"inputs.{name}" in steps for name in action["inputs"])
    page = (ROOT / "docs" / "running" / "ci-gate.md").read_text()
    assert all(f"`{name}" in page for name in ("cache", "artifact", "table", "artifact-url"))


def test_every_command_is_one_that_the_parser_takes(action: Any) -> None:
    text = "\n".join(step.get("run", "") for step in action["runs"]["steps"]).replace("\\\n", " ")
    commands = re.findall(r"su3d-bench (.*?)(?: \|\| .*)?$", text, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        build_parser().parse_args(shlex.split(command))
