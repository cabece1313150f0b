"""The commands ``runs list``, ``runs show`` and ``runs remove``."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from painted_runs import see_painted
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.store.run_folder import RunFolder

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
WORDS = ["--methods", COLLECTOR, "--protocols", "rooms-semantic", "--no-pictures", "--jobs", "1", "--quiet"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        patch.chdir(folder)
        assert main(["run", f"{PAINTED}/a", *WORDS, "--out", "runs/one"]) == 0
        assert main(["run", f"{PAINTED}/[ab]", *WORDS, "--limit", "2", "--seed", "3", "--out", "runs/two"]) == 0
    return folder


@pytest.fixture(autouse=True)
def _place(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(whole, tmp_path / "place", copy_function=shutil.copy2)
    monkeypatch.chdir(tmp_path / "place")


def test_runs_are_listed_with_their_state_and_first_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    Path("runs/two/scenes").rename("runs/two/gone")
    Path("runs/killed").mkdir()
    shutil.copy("runs/one/run.toml", "runs/killed")
    Path("runs/killed/run.json").write_text(json.dumps({"status": "running", "scenes": ["x/y"], "methods": ["m"]}))
    Path("runs/broken").mkdir()
    Path("runs/broken/run.json").write_text("{")
    assert main(["runs", "list", "--json"]) == 0
    found = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    states = {name: entry["state"] for name, entry in found.items()}
    assert states == {
        "one": "complete",
        "two": "complete, first 2 frames only",
        "killed": "not finished",
        "broken": "run.json is damaged",
    }
    (number,) = found["one"]["headlines"]
    assert number == {"method": "collector", "protocol": "rooms-semantic", "metric": "mAcc", "value": 1.0}
    with RunFolder(Path("runs/one")).locked():
        assert main(["runs", "list"]) == 0
    table = capsys.readouterr().out
    assert "| running now " in table and "rooms-semantic mAcc 100.0" in table


def test_runs_show_prints_the_request_and_a_command_that_resumes_the_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["runs", "show", "runs/two"]) == 0
    text = capsys.readouterr().out
    assert "runs/two: complete, first 2 frames only, written 2" in text
    assert "\n  limit = 2\n" in text and "\n  seed = 3\n" in text and "stride" not in text
    assert main(["runs", "show", "runs/two", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["asked"]["limit"] == "2"
    before = Path("runs/two/run.json").read_bytes()
    see_painted(monkeypatch)
    assert main([*shown["command"].split()[1:], "--jobs", "1"]) == 0
    assert Path("runs/two/run.json").read_bytes() == before


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("reply", "is_there"), [("n\n", True), ("\n", True), ("", True), ("y\n", False)])
def test_remove_asks_for_confirmation_on_a_terminal(
    reply: str, is_there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(reply))
    assert main(["runs", "remove", "runs/one"]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("runs/one: complete, 0.")
    assert "MB, painted/a by collector\nremove permanently?" in printed.err
    assert printed.out.startswith("nothing was removed" if is_there else "removed runs/one: complete")
    assert Path("runs/one").exists() == is_there
    assert sorted(os.listdir("runs")) == (["one", "two"] if is_there else ["two"])


def test_folders_that_are_not_exactly_a_run_are_not_removed(capsys: pytest.CaptureFixture[str]) -> None:
    os.symlink("runs/one", "link")
    shutil.copytree("runs/one", "notes")
    Path("notes/thesis.tex").write_text("years of work")
    shutil.copytree("runs/one", "deep")
    Path("deep/scenes/painted.a/collector/photo.png").write_bytes(b"")
    shutil.copytree("runs/one", "linked")
    os.symlink("/etc", "linked/scenes/painted.a/collector/pictures")
    cases = {
        "link": "link: is a link; name the folder that it points to, or remove the link yourself",
        "runs": "runs: is not a run folder; nothing was removed",
        "notes": "notes: contains 'thesis.tex', which no run wrote; move it elsewhere first",
        "deep": "deep: contains 'scenes/painted.a/collector/photo.png', which no run wrote; move it elsewhere first",
        "linked": "linked: contains 'scenes/painted.a/collector/pictures', which no run wrote; move it elsewhere first",
    }
    for place, line in cases.items():
        assert main(["runs", "remove", "runs/two", place, "--yes"]) == 2
        assert capsys.readouterr().err == f"su3d-bench: {line}\n"
    with RunFolder(Path("runs/one")).locked():
        assert main(["runs", "remove", "runs/two", "runs/one", "--yes"]) == 2
    assert capsys.readouterr().err == "su3d-bench: runs/one: a run is writing here; stop it or wait until it finishes\n"
    assert Path("runs/two").is_dir()
    Path("runs/two/.cache").mkdir()
    Path("runs/two/.cache/page").write_text("")
    assert main(["runs", "remove", "runs/two", "--yes", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"removed": ["runs/two"]}
    assert os.listdir("runs") == ["one"]
