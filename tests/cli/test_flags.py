"""Options that several verbs have, and what ``--json`` and ``--out`` do in every verb."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest
from fuzz_words import verbs

from su3d_bench.cli.main import build_parser, main
from su3d_bench.cli.options import SHARED
from su3d_bench.cli.output import answer_either
from su3d_bench.core.errors import ConfigError


def test_every_verb_has_json_quiet_debug_and_two_examples() -> None:
    for words, parser in verbs():
        flags = {name for action in parser._actions for name in action.option_strings}
        assert {"--json", "--quiet", "--debug"} <= flags, words
        assert not {"--workers", "--threads", "--output"} & flags, words
        assert len((parser.epilog or "").splitlines()) == 3, words


def test_an_option_that_verbs_share_has_one_help_text() -> None:
    for name in ("--jobs", "--device", "--set", "--run", "--executor"):
        texts = {one.help for _, parser in verbs() for one in parser._actions if name in one.option_strings}
        assert texts == {SHARED[name]["help"]}, name


@pytest.mark.parametrize(
    ("words", "is_printed", "file"),
    [
        (["compare", "a", "b"], False, None),
        (["compare", "a", "b", "--json"], True, None),
        (["compare", "a", "b", "--json", "new.json"], False, "new.json"),
        (["compare", "a", "b", "--json=new.json", "--per-class"], False, "new.json"),
    ],
)
def test_json_is_a_switch_or_names_a_file(words: list[str], is_printed: bool, file: str | None) -> None:
    arguments = build_parser().parse_args(words)
    assert (arguments.json, arguments.json_file) == (is_printed, None if file is None else Path(file))


def test_json_takes_no_other_file_for_its_own() -> None:
    with pytest.raises(ConfigError, match=r"report verify: --json paper\.tex: a file for JSON ends in \.json"):
        build_parser().parse_args(["report", "verify", "--json", "paper.tex"])


def test_json_in_a_file_stands_beside_the_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "answers" / "rules.json"
    assert main(["protocols", "show", "rooms-semantic", "--json", str(file)]) == 0
    assert not capsys.readouterr().out.startswith("{")
    assert main(["protocols", "show", "rooms-semantic", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(file.read_text())


@pytest.mark.parametrize("name", ["run.json", "metrics.json", "run.toml", "scenes/rooms.living0/opensu3d/done.json"])
def test_files_of_a_run_are_never_replaced_by_an_answer(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = Path("runs/demo", name)
    file.parent.mkdir(parents=True)
    Path("runs/demo/run.toml").write_text("seed = 0\n")
    file.write_text("{}")
    for words in (
        ["query", "text", "rooms/living0", "plant", "--out", str(file)],
        ["report", "tables", "runs/demo", "--out", str(file)],
        ["check", "--learn", "runs/demo", "--out", str(file)],
        *([["protocols", "list", "--json", str(file)]] if file.suffix == ".json" else []),
    ):
        assert main(words) == 2
        assert "is a file of the run itself" in capsys.readouterr().err
        assert file.read_text() == "{}"


def test_a_number_that_is_none_is_null_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = argparse.Namespace(json=True, json_file=None)
    answer_either(arguments, {"x": [float("nan"), (float("inf"), 1.5)]}, "words")
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"x": [None, [None, 1.5]]}
