"""The one rule of flags, in every parser: plural where several are taken, ``--jobs``, ``--out``, ``--json``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest
from fuzz_words import verbs

from su3d_bench.cli.main import build_parser, main
from su3d_bench.cli.parser import OTHER_SPELLING, SPELLINGS, Parser
from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import ConfigError

EVERY = [pytest.param(parser, id=" ".join(words)) for words, parser in verbs()]
SEVERAL = ("+", "*", 2)
WHAT_OUT_IS = {"FILE", "DIR", "PATH", "PNG"}


def flags_of(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    return {name: action for action in parser._actions for name in action.option_strings}


@pytest.mark.parametrize("parser", EVERY)
def test_every_verb_has_json_quiet_and_debug(parser: argparse.ArgumentParser) -> None:
    flags = flags_of(parser)
    assert {"--json", "--quiet", "--debug"} <= flags.keys()
    assert (flags["--json"].nargs, flags["--json"].metavar) == ("?", "FILE.json")


@pytest.mark.parametrize("parser", EVERY)
def test_a_flag_is_plural_exactly_where_it_takes_several(parser: argparse.ArgumentParser) -> None:
    flags = flags_of(parser)
    for plural, singular in SPELLINGS.items():
        if plural == "--jobs":
            continue
        assert not {plural, singular} <= flags.keys(), "one spelling is shown, the other understood"
        assert plural not in flags or flags[plural].nargs in SEVERAL
        assert singular not in flags or flags[singular].nargs is None


@pytest.mark.parametrize("parser", EVERY)
def test_how_many_processes_is_jobs_and_the_place_of_what_is_written_is_out(parser: argparse.ArgumentParser) -> None:
    flags = flags_of(parser)
    assert not {"--workers", "--threads", "--processes", "--output", "-o"} & flags.keys()
    if "--jobs" in flags:
        assert (flags["--jobs"].type, flags["--jobs"].metavar) == (int, "N")
    if "--out" in flags:
        assert flags["--out"].metavar in WHAT_OUT_IS


def test_the_other_spelling_of_each_flag_is_understood_and_not_shown() -> None:
    n_tried = 0
    for _, parser in verbs():
        for name, action in flags_of(parser).items():
            other = OTHER_SPELLING.get(name)
            if other is None:
                continue
            n_values = action.nargs if isinstance(action.nargs, int) else 1
            value = "1" if action.type is int else "x"
            assert isinstance(parser, Parser)
            assert parser._in_own_words([other, *[value] * n_values], takes_file=True)[0][0] == name
            n_tried += 1
    assert n_tried > 15


@pytest.mark.parametrize(
    ("words", "dest", "value"),
    [
        (["datasets", "make", "rooms", "--workers", "3"], "jobs", 3),
        (["evaluate", "p", "--protocol", "a", "--protocol=b"], "protocols", ["a", "b"]),
        (["compare", "a", "b", "--protocol", "x"], "protocols", ["x"]),
        (["run", "--method", "oracle", "--scene", "rooms/*"], "methods", ["oracle"]),
        (["query", "text", "rooms/living0", "x", "--methods", "oracle"], "method", "oracle"),
        (["run", "--proto", "x"], "protocols", ["x"]),
    ],
)
def test_published_spellings_go_on_working(words: list[str], dest: str, value: Any) -> None:
    assert getattr(build_parser().parse_args(words), dest) == value


@pytest.mark.parametrize(
    ("words", "is_printed", "file"),
    [
        (["compare", "a", "b"], False, None),
        (["compare", "a", "b", "--json"], True, None),
        (["compare", "--json", "a", "b"], True, None),
        (["compare", "a", "b", "--json", "new.json"], False, "new.json"),
        (["compare", "a", "b", "--json=new"], False, "new"),
        (["compare", "a", "b", "--js", "new.json"], False, "new.json"),
        (["compare", "--json", "A.json", "B.json"], True, None),
        (["compare", "A.json", "--json", "B.json"], True, None),
        (["compare", "--json", "new.json", "A.json", "B.json"], False, "new.json"),
        (["compare", "A.json", "B.json", "--json", "--per-class"], True, None),
        (["compare", "--json", "--", "A.json", "B.json"], True, None),
        (["report", "tables", "r", "--json", "new.json"], False, "new.json"),
    ],
)
def test_json_is_a_switch_or_names_a_file(
    words: list[str], is_printed: bool, file: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("A.json", "B.json"):
        Path(name).write_text('{"protocols": {}}')
    arguments = build_parser().parse_args(words)
    assert (arguments.json, arguments.json_file) == (is_printed, None if file is None else Path(file))


def test_a_word_that_is_missing_is_still_what_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="the following arguments are required: B"):
        build_parser().parse_args(["compare", "A", "--json", "new.json"])
    with pytest.raises(
        ConfigError, match="compare: 'numbers' is no word of it; a file for --json is written --json=numb"
    ):
        build_parser().parse_args(["compare", "A", "B", "--json", "numbers"])
    Path("old.json").write_text("{}")
    with pytest.raises(ConfigError, match="unknown argument '--per-klass'"):
        build_parser().parse_args(["compare", "A", "B", "--json", "old.json", "--per-klass"])


def test_an_earlier_answer_is_replaced_and_another_file_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["protocols", "show", "rooms-semantic", "--json"]
    for _ in range(2):
        assert main([*words, "answers/rules.json"]) == 0
        answer = capsys.readouterr()
        assert answer.out.count("rooms-semantic") and not answer.out.startswith("{")
        assert answer.err == "written: answers/rules.json\n"
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(Path("answers/rules.json").read_text())
    for content in ('{"protocols": {"x": 1}}', "[1]", "no JSON", '"text"'):
        Path("mine.json").write_text(content)
        assert main([*words, "mine.json"]) == 2
        answer = capsys.readouterr()
        assert Path("mine.json").read_text() == content
        assert json.loads(answer.out)["name"] == "rooms-semantic", "no answer is lost"
        assert answer.err.startswith("su3d-bench: mine.json: is there and no earlier answer of this command")
    assert main([*words[:-1], "--json=mine.json"]) == 0
    assert json.loads(Path("mine.json").read_text())["name"] == "rooms-semantic"


@pytest.mark.parametrize("name", ["run.json", "metrics.json", "run.toml", "scenes/rooms.living0/opensu3d/done.json"])
def test_what_a_run_has_written_is_never_the_place_of_an_answer(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = Path("runs/demo", name)
    file.parent.mkdir(parents=True)
    Path("runs/demo/run.toml").write_text("seed = 0\n")
    content = "seed = 0\n" if name == "run.toml" else "{}"
    file.write_text(content)
    for words in (
        ["protocols", "list", f"--json={file}"],
        ["protocols", "list", "--json", str(file)],
        ["query", "text", "rooms/living0", "plant", "--out", str(file)],
        ["query", "ask", "rooms/living0", "Which?", "--out", str(file)],
        ["query", "make", "--scenes", "rooms/living0", "--out", str(file)],
        ["report", "tables", "runs/demo", "--out", str(file)],
        ["report", "html", "runs/demo", "--out", str(file)],
        ["report", "attribution", "runs/demo", "--out", str(file)],
        ["check", "--learn", "runs/demo", "--out", str(file)],
    ):
        assert main(words) == 2
        err = capsys.readouterr().err
        assert "is a file of the run itself" in err or words[-2] == "--json"
        assert file.read_text() == content


def test_a_verb_has_nothing_to_do_for_its_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    parser = Parser(prog="x")
    verb = add_verb(parser.add_subparsers(), "tell", "Tell.", ("x tell", "x tell --json"), lambda arguments: 0)
    assert verb.format_help().count("--json [FILE.json]") == 2
    file = tmp_path / "told.json"
    answer_either(parser.parse_args(["tell", "--json", str(file)]), {"told": 1}, "told")
    assert (capsys.readouterr().out, json.loads(file.read_text())) == ("told\n", {"told": 1})


def test_a_number_that_is_none_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    answer_either(argparse.Namespace(json=True, json_file=None), {"x": [float("nan"), (float("inf"), 1.5)]}, "words")
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"x": [None, [None, 1.5]]}
