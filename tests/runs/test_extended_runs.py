"""A folder belongs to one request: another one extends it, replaces it or is rejected."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import frame_loop as scene_feeding
from su3d_bench.runs import scene as scene_run
from su3d_bench.store.run_folder import JobFolder, RunFolder

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
REST = ["--no-pictures", "--jobs", "1", "--quiet"]


pytestmark = pytest.mark.usefixtures("painted_place")


def run(scenes: str, *more: str, methods: tuple[str, ...] = (COLLECTOR,), out: str = "out") -> int:
    return main(["run", f"{PAINTED}/{scenes}", "--methods", *methods, "--protocols", "rooms-semantic", *REST,
                 "--out", out, *more])  # fmt: skip


def extend(*more: str, out: str = "out") -> int:
    return main(["run", *more, "--extend", *REST, "--out", out])


def record(name: str, out: str = "out") -> Any:
    return json.loads(Path(out, name).read_text())


def test_extending_merges_requests_and_runs_no_finished_job_again(monkeypatch: pytest.MonkeyPatch) -> None:
    dropping = f"{COLLECTOR}@drop=1"
    assert run("[ab]", "--set", "collector.noise_m=0.02") == 0
    made = {path: path.stat().st_mtime_ns for path in Path("out").rglob("prediction.npz")}
    assert extend(f"{PAINTED}/c") == 0
    assert extend("--methods", dropping) == 0
    assert extend("--protocols", "rooms-instance") == 0
    assert {path: path.stat().st_mtime_ns for path in made} == made
    whole = ["--protocols", "rooms-semantic", "rooms-instance", "--set", "collector.noise_m=0.02"]
    assert run("[abc]", *whole, methods=(COLLECTOR, dropping), out="whole") == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()
    for name in ("status", "scenes", "methods", "protocols", "data_digests"):
        assert record("run.json")[name] == record("run.json", "whole")[name]
    text = Path("out/run.toml").read_text()
    assert f'scenes = ["{PAINTED}/[ab]", "{PAINTED}/c"]  # --scenes\n' in text
    assert "noise_m = 0.02  # --set collector.noise_m\n" in text and "drop = 0  # default\n" in text
    monkeypatch.setattr(scene_feeding, "write_prediction", None)
    assert main(["run", "--config", "out/run.toml", *REST, "--out", "out"]) == 0  # the same request


CANNOT_JOIN = {
    "--seed 1": "seed was 0, now 1",
    "--limit 1": "limit was none, now 1",
    "--stride 2": "stride was 1, now 2",
    "--set collector.drop=1": "method.collector.drop was 0, now 1",
    "--set painted.n_frames=3": "dataset.painted.n_frames was 6, now 3",
    "--set perception.naming.temperature=0.5": "perception.naming.temperature was 0.05, now 0.5",
    "--profile oracle": 'profile was "auto", now "oracle"',
    "--anytime 0.5": "anytime was [], now [0.5]",
    "--anytime-every 2": "anytime_every was 0, now 2",
    "--seen-so-far": "seen_so_far was false, now true",
}


def test_extending_with_different_settings_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("a") == 0
    capsys.readouterr()
    for more, clause in CANNOT_JOIN.items():
        assert extend(f"{PAINTED}/b", *more.split()) == 2
        assert f"out: cannot be extended by this request ({clause})" in capsys.readouterr().err
        assert [path.name for path in Path("out/scenes").iterdir()] == ["painted.a"]


def test_unfinished_run_is_as_protected_as_a_finished_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(scene_run._Scene, "_score", stop)
        assert run("[ab]") == 130
    assert record("run.json")["status"] == "interrupted"
    before = Path("out/run.json").read_bytes(), Path("out/run.toml").read_bytes()
    capsys.readouterr()
    assert run("a") == 2
    assert "contains a different run (scene painted/b is not requested now); --extend adds" in capsys.readouterr().err
    assert (Path("out/run.json").read_bytes(), Path("out/run.toml").read_bytes()) == before
    assert extend(f"{PAINTED}/c") == 0
    assert run("[abc]", out="whole") == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()


def test_replacing_a_run_keeps_maps_that_are_requested_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("[abc]") == 0
    kept = RunFolder(Path("out")).job("painted/a", "collector").prediction
    made = kept.stat().st_mtime_ns
    capsys.readouterr()
    assert main(["run", f"{PAINTED}/a", "--methods", COLLECTOR, "--protocols", "rooms-semantic", "--no-pictures",
                 "--jobs", "1", "--replace", "--out", "out"]) == 0  # fmt: skip
    went = "--replace: 4 of the 6 maps in out will be removed: painted/b, painted/c by collector, oracle\n"
    assert capsys.readouterr().err.startswith(went)
    assert run("a", out="whole") == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()
    assert [path.name for path in Path("out/scenes").iterdir()] == ["painted.a"]
    assert kept.stat().st_mtime_ns == made
    assert run("a", "--seed", "3", "--set", "collector.noise_m=0.1", "--replace") == 0
    assert record("metrics.json")["seed"] == 3 and kept.stat().st_mtime_ns != made


def test_map_of_other_data_is_only_computed_again_with_replace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("a") == 0
    before = {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}
    other = colour_perception()
    other.digest = "colours-2"
    monkeypatch.setattr(scene_run, "build_perception", lambda *_, **__: other)
    capsys.readouterr()
    assert run("a") == 2
    assert "(perception was colours-1, now colours-2); --replace overwrites it" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before
    assert run("a", "--replace") == 0
    assert (
        RunFolder(Path("out")).job("painted/a", "collector").completion_records()["predict"].key["perception"]
        == "colours-2"
    )


def test_replacing_a_run_does_not_remove_foreign_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("[ab]") == 0
    Path("out/notes.txt").write_text("mine")
    notes = Path("out/scenes/painted.b/collector/notes.txt")
    notes.write_text("mine")
    capsys.readouterr()
    assert run("a", "--replace") == 2
    assert "notes.txt: does not belong to a run, but --replace would remove it; move it" in capsys.readouterr().err
    assert len(record("run.json")["scenes"]) == 2
    notes.unlink()
    assert run("a", "--replace") == 0
    assert Path("out/notes.txt").read_text() == "mine"


def test_killed_replacement_is_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("[abc]") == 0
    removed = 0

    def stop_after_one(self: Any) -> None:
        nonlocal removed
        removed += 1
        if removed == 2:
            signal.raise_signal(signal.SIGINT)
        remove(self)

    remove = JobFolder.remove
    with monkeypatch.context() as patch:
        patch.setattr(JobFolder, "remove", stop_after_one)
        assert run("a", "--seed", "1", "--replace") == 130
    assert not Path("out/metrics.json").exists()
    assert run("a", "--seed", "1", "--replace") == 0
    assert run("a", "--seed", "1", out="whole") == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()
    assert not list(Path("out").rglob("*.unfinished"))


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut within a line": lambda content: content[: content.index(b"[method") + 3],
    "cut between lines": lambda content: content[: content.index(b"[method")],
    "empty": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "zeros at the end": lambda content: content[:100] + bytes(len(content) - 100),
    "written in by hand": lambda content: content.replace(b"seed = 0", b"seed = 1"),
}


@pytest.mark.parametrize(
    ("damage", "has_record"), [*((damage, known) for damage in DAMAGE for known in (True, False)), ("missing", True)]
)
def test_run_with_a_damaged_request_is_only_resumed_by_the_same_command(
    damage: str, has_record: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("a") == 0
    request, numbers = Path("out/run.toml"), Path("out/metrics.json")
    whole = request.read_bytes(), numbers.read_bytes()
    request.unlink() if damage == "missing" else request.write_bytes(DAMAGE[damage](whole[0]))
    if not has_record:
        os.unlink("out/run.json")
    assert run("a", "--seed", "1") == 2  # its maps belong to another request
    if has_record:
        assert run("b") == 2
        assert "contains a different run (scene painted/a is not requested now" in capsys.readouterr().err
        assert numbers.read_bytes() == whole[1]
    assert run("a") == 0
    assert (request.read_bytes(), numbers.read_bytes()) == whole
    assert record("run.json")["status"] == "complete"
