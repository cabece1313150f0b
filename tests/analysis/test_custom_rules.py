"""Runs under user-defined protocols store their rules: all commands read them after the protocol files are deleted."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from painted_runs import COLLECTOR, painted_run, see_painted

from su3d_bench.analysis.leaderboard import leaderboard
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names, read_rules
from su3d_bench.runs.finished import read_run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs under two user-defined protocols, whose files are deleted."""
    folder = tmp_path_factory.mktemp("own")
    rules = []
    for name in ("semantic", "instance"):
        rules.append(folder / f"mine-{name}.toml")
        lines = [f'extends = "rooms-{name}"', f'name = "mine-{name}"', "version = 4", 'prompt = "my {}"']
        rules[-1].write_text("\n".join(lines))
    for name in ("first", "second"):
        methods = (COLLECTOR, f"{COLLECTOR}@drop=1")
        painted_run(folder / "runs" / name, "--protocols", *map(str, rules), methods=methods)
    for file in rules:
        file.unlink()
    return folder / "runs"


VERBS = {
    "attribute": ["report", "attribution", "{first}", "--method", "collector"],
    "compare": ["compare", "{first}:collector", "{second}:collector@drop=1", "--per-class"],
    "page": ["report", "html", "{first}", "--out", "{out}/page.html"],
    "learn": ["check", "--build-from", "{first}", "{second}", "--out", "{out}/reference.json"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_commands_find_user_defined_rules_by_name(
    verb: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    see_painted(monkeypatch)
    places = {"first": made / "first", "second": made / "second", "out": tmp_path}
    assert main([word.format(**places) for word in VERBS[verb]]) == 0, capsys.readouterr().err
    written = "".join(file.read_text() for file in tmp_path.iterdir() if file.is_file())
    assert "mine-instance" in capsys.readouterr().out + written
    assert "those that scored the run" not in written


def test_user_defined_protocols_with_the_same_name_are_ranked_separately(made: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    shutil.copytree(made, runs)
    found = leaderboard(runs)
    assert not found.refused
    assert [len(board) for board in found.boards] == [4, 4]
    record = json.loads((runs / "second/run.json").read_text())
    for rules in record["protocols"]:
        rules["rules"]["summary"], before = "of another project", rules["digest"]
        rules["digest"] = read_rules(rules["rules"], "here").digest
        for done in (runs / "second").rglob("done.json"):
            done.write_text(done.read_text().replace(before, rules["digest"]))
    (runs / "second/run.json").write_text(json.dumps(record))
    assert [len(board) for board in leaderboard(runs).boards] == [2, 2, 2, 2]
    assert main(["report", "leaderboard", str(runs)]) == 0


def test_run_json_stores_the_rules_that_scored_the_run(made: Path) -> None:
    run = read_run(made / "first")
    for name, kept in run.protocols.items():
        assert run.rules(name, to_the_letter=True).digest == kept.digest
    builtin = [load_protocol(name) for name in protocol_names()]
    assert all(read_rules(rules.as_json, "here") == rules for rules in builtin)
    assert json.loads(json.dumps([rules.as_json for rules in builtin])) == [rules.as_json for rules in builtin]


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "other rules": (lambda kept: kept["rules"].update(min_region_size=7), "are not those that scored it"),
    "no rules": (lambda kept: kept["rules"].update(kind="wishes"), "are not as a run writes them"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changed_rules_in_run_json_are_an_error(change: str, made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "first", tmp_path / "run")
    record = json.loads((tmp_path / "run/run.json").read_text())
    make, printed = CHANGES[change]
    make(record["protocols"][1])
    (tmp_path / "run/run.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=printed):
        read_run(tmp_path / "run").rules("mine-instance")
