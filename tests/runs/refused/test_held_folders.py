"""Folders that a run refuses: of another run, of a run that is under way, of somebody else; and things of one name."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from painted import colour_perception
from painted_runs import COLLECTOR, PAINTED, in_process, run, words
from places import SCENES
from waiting import wait_until

from su3d_bench.cli.main import main
from su3d_bench.runs import resume as finished_scenes
from su3d_bench.runs import scene as scene_run


@pytest.fixture(autouse=True)
def _painted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for module in (scene_run, finished_scenes):
        monkeypatch.setattr(module, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("more", "field"),
    [
        (["--set", "collector.drop=1"], "method.collector.drop was 0, now 1"),
        (["--set", "painted.n_frames=4"], "dataset.painted.n_frames was 6, now 4"),
        (["--stride", "3"], "stride was 1, now 3"),
        (["--limit", "2"], "limit was none, now 2"),
        (["--seed", "5"], "seed was 0, now 5"),
        (["--set", "perception.naming.temperature=0.5"], "perception.naming.temperature was 0.05, now 0.5"),
    ],
)
def test_another_key_in_the_same_folder_is_refused_by_name(
    more: list[str], field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scenes="a") == 0
    before = Path("out/metrics.json").read_bytes()
    capsys.readouterr()
    assert run(*more, scenes="a") == 2
    line = (
        f"out: holds another run ({field}); --replace puts this one in its place, or choose another folder with --out"
    )
    assert capsys.readouterr().err == f"su3d-bench: {line}\n"
    assert Path("out/metrics.json").read_bytes() == before


def test_changed_perception_is_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scenes="a") == 0
    other = colour_perception()
    other.digest = "colours-2"
    for module in (scene_run, finished_scenes):
        monkeypatch.setattr(module, "build_perception", lambda *_, **__: other)
    assert run(scenes="a") == 2
    assert "perception was colours-1, now colours-2" in capsys.readouterr().err


def test_the_second_of_two_runs_on_one_folder_is_refused() -> None:
    process = subprocess.Popen(in_process("--set", "painted.frame_ms=200"), stdout=subprocess.DEVNULL)
    wait_until(Path("out/run.json").exists)
    assert run("--set", "painted.frame_ms=200") == 2
    process.kill()
    process.wait()


def test_a_folder_of_somebody_else_is_refused_and_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/.notes.tmp").write_text("theirs")
    assert run() == 2
    assert capsys.readouterr().err == (
        "su3d-bench: out: holds '.notes.tmp' and is no folder of a run; choose a new folder with --out\n"
    )
    assert [path.name for path in Path("out").iterdir()] == [".notes.tmp"]


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (["--methods", f"{SCENES}/twins.py:SlashCollector"], "'../elsewhere' cannot be the name of a folder"),
        (["--methods", COLLECTOR, f"{SCENES}/./painted.py:Collector"], "different ones are called 'collector'"),
        (
            ["--scenes", f"{PAINTED}/a", f"{SCENES}/./painted.py:Painted/b"],
            "two different ones are called 'pai",
        ),
        (["--protocols", "one/mine.toml", "two/mine.toml"], "two different ones are called 'mine'"),
    ],
)
def test_two_things_of_one_name_are_refused_before_any_work(
    more: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, voxel in (("one", "0.05"), ("two", "0.06")):
        Path(folder).mkdir()
        text = f'extends = "rooms-semantic"\nname = "mine"\n[transfer]\nevaluation_voxel_m = {voxel}\n'
        Path(folder, "mine.toml").write_text(text)
    assert main([*words(), *more]) == 2
    assert line in capsys.readouterr().err
    assert not Path("out").exists()
