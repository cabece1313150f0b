"""No option of any command names an output that is an input, lies in an input or a run, or is another output."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import pytest
from fuzz_words import verbs

from su3d_bench.cli.main import main
from su3d_bench.cli.paths import TEXTS, check_outputs, is_output
from su3d_bench.core.errors import ConfigError

VERBS = {" ".join(words): parser for words, parser in verbs()}
WRITTEN = ("--out", "--json", "--markdown", "--junit", "--bundle")


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", "data")
    for name in ("in/scene.txt", "data/scans/a/a.json", "runs/demo/run.toml", "runs/demo/scenes/a/x/done.json"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("kept")
    Path("link").symlink_to("in")
    os.link("in/scene.txt", "hard.json")


def name_of(action: argparse.Action) -> str:
    return action.option_strings[0] if action.option_strings else str(action.metavar)


def with_paths(verb: str, values: dict[str, Any]) -> argparse.Namespace:
    """The arguments of a command, with ``values`` by the name of the option."""
    parser = VERBS[verb]
    found = {action.dest: values.get(name_of(action)) for action in parser._actions}
    return argparse.Namespace(**{**found, "json_file": values.get("--json"), "verb": verb.split()[0]})


@pytest.mark.parametrize("verb", VERBS)
def test_output_is_rejected_in_every_input_and_every_run(verb: str) -> None:
    parser = VERBS[verb]
    outputs = [name_of(one) for one in parser._actions if is_output(one)]
    inputs = [one for one in parser._actions if not is_output(one) and (one.type is Path or one.metavar in TEXTS)]
    assert set(WRITTEN) & set(parser._option_string_actions) <= set(outputs)
    for output in outputs:
        for place in ("runs/demo/x.json", "runs/demo/scenes/a/x/done.json", "data/scans/a/a.json"):
            with pytest.raises(ConfigError, match=r"the run folder|a file of the data root"):
                check_outputs(parser, with_paths(verb, {output: Path(place)}))
        for one in inputs:
            text = "a=in" if "=" in str(one.metavar) else "in"
            value: Any = Path("in") if one.type is Path else text
            for place in ("in", "in/new.json", "in/deep/er.json", "link/scene.txt", "in/../link/new.json"):
                with pytest.raises(ConfigError, match="input"):
                    check_outputs(parser, with_paths(verb, {name_of(one): value, output: Path(place)}))
            check_outputs(parser, with_paths(verb, {name_of(one): value, output: Path("out.json")}))


ATTACKS = {
    "reference": ("check runs/demo --against hard.json --junit hard.json", "--junit hard.json: is an input"),
    "its hard link": ("check runs/demo --against in/scene.txt --markdown hard.json", "is an input"),
    "two outputs": ("check runs/demo --against hard.json --junit a --markdown ./a", "is also written by --markdown"),
    "ground truth": ("evaluate link --ground-truth in --json in/scene.json", "--json in/scene.json: lies in"),
    "method's file": ("run --methods in/scene.txt:Class --json hard.json", "is an input"),
    "compared run": ("compare runs/demo:a,runs/demo b --json runs/demo/new.json", "lies in"),
    "run as folder of sheets": ("sheets make runs/other --kinds retrieval --out runs/demo", "is the run folder"),
    "run as data root": ("datasets make rooms --out runs/demo", "is the run folder"),
    "run in a run": ("run rooms/living0 --out runs/demo/again", "lies in the run folder"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_command_that_would_replace_an_input_is_rejected(attack: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, reason = ATTACKS[attack]
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert {path.read_text() for path in Path().rglob("*") if path.is_file()} == {"kept"}


@pytest.mark.parametrize(
    "words",
    ["runs list LONG", "compare LONG LONG", "methods new LONG.py", "run --methods LONG.py:X", "report leaderboard LONG",
     "evaluate LONG --ground-truth LONG", "sheets score --key LONG", "query text rooms/a x --run LONG"],
)  # fmt: skip
def test_name_that_the_system_rejects_is_an_input_error(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.replace("LONG", "n" * 300).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "File name too long; choose another file or folder" in line
