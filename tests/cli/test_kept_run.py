"""A finished run let loose on: whatever is typed at it, wrong or right, its files stay byte for byte as they are."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
WHAT = ["--methods", COLLECTOR, "--protocols", "rooms-semantic", "rooms-instance", "--no-pictures"]
INTO = ["--out", "runs/demo"]
SAME = ["run", f"{PAINTED}/[ab]", *WHAT, *INTO]
OTHER = "su3d-bench: runs/demo: holds another run ("

# What is typed, its exit code, and the line or the beginning of the line that it ends with.
SLIPS: dict[str, tuple[list[str], int, str]] = {
    "one scene of two": (["run", "--scenes", f"{PAINTED}/a", *WHAT, *INTO], 2, f"{OTHER}scene painted/b is not asked"),
    "another scene": (
        ["run", f"{PAINTED}/c", *WHAT, *INTO], 2,
        f"{OTHER}scenes painted/a, painted/b are not asked for",
    ),
    "more scenes": (["run", f"{PAINTED}/*", *WHAT, *INTO], 2, f"{OTHER}scenes painted/c, painted/d are new); --extend"),
    "the defaults": (["run", *INTO], 2, OTHER),
    "another method": (
        [*SAME, "--methods", "oracle"], 2,
        f"{OTHER}method collector is not asked for now, method oracle",
    ),
    "another seed": ([*SAME, "--seed", "1"], 2, f"{OTHER}seed was 0, now 1); --replace"),
    "another setting": ([*SAME, "--set", "collector.drop=1"], 2, f"{OTHER}method.collector.drop was 0, now 1)"),
    "a setting of perception": ([*SAME, "--set", "perception.naming.temperature=0.5"], 2, f"{OTHER}perception.naming"),
    "the same with fewer processes": ([*SAME, "--jobs", "1"], 0, "run folder: runs/demo"),
    "the same in another order": (["run", f"{PAINTED}/b", f"{PAINTED}/a", *WHAT, *INTO], 0, "run folder: runs/demo"),
    "the same from its own file": (["run", "--config", "runs/demo/run.toml", *INTO], 0, "run folder: runs/demo"),
    "a plan": ([*SAME, "--dry-run"], 0, ""),
    "no cluster": ([*SAME, "--executor", "slurm"], 2, "su3d-bench: "),
    "weights that are not here": ([*SAME, "--profile", "paper"], 2, "su3d-bench: "),
    "extended by nothing": (["run", "--extend", *INTO], 0, "run folder: runs/demo"),
    "extended by what is there": (["run", f"{PAINTED}/a", "--extend", *INTO], 0, "run folder: runs/demo"),
    "extended by another seed": (
        ["run", "--extend", "--seed", "1", *INTO], 2,
        "su3d-bench: runs/demo: cannot be extended",
    ),
    "extended by no scene": (["run", f"{PAINTED}/z", "--extend", *INTO], 2, "su3d-bench: no scene matches"),
    "a plan of an extension": (["run", f"{PAINTED}/c", "--extend", "--dry-run", *INTO], 0, ""),
    "a plan of a replacement": (["run", f"{PAINTED}/c", *WHAT, "--replace", "--dry-run", *INTO], 0, ""),
    "replaced by itself": ([*SAME, "--replace"], 0, "run folder: runs/demo"),
    "both at once": ([*SAME, "--replace", "--extend"], 2, "su3d-bench: run: argument --extend: not allowed with"),
    "a sweep": (
        ["ablate", f"{PAINTED}/[ab]", "--method", COLLECTOR, "--vary", "drop=0,1", *INTO, *WHAT[2:4]],
        2,
        f"{OTHER}method collector@drop=1 is new, protocol rooms-instance is not asked for now)",
    ),
    "another map": (
        ["query", "text", f"{PAINTED}/c", "a cup", "--run", "runs/demo"], 2,
        "su3d-bench: runs/demo: holds no map of",
    ),
    "words first": (
        ["query", "text", "a cup", "rooms/living0", "--run", "runs/demo"], 2,
        "su3d-bench: 'a cup' is no scene: the",
    ),
    "removed without a word": (["runs", "remove", "runs/demo"], 2, "su3d-bench: runs remove: nobody is there to be"),
    "removed through a link": (["runs", "remove", "link", "--yes"], 2, "su3d-bench: link: is a link; name the folder"),
    "its parent removed": (
        ["runs", "remove", "runs", "--yes"], 2,
        "su3d-bench: runs: is no folder of a run, so nothing",
    ),
    "listed": (["runs", "list"], 0, ""),
    "shown": (["runs", "show", "runs/demo"], 0, ""),
    "compared with itself": (
        ["compare", "runs/demo", "runs/demo"], 2,
        "su3d-bench: runs/demo: both sides are the same",
    ),
    "a table": (["report", "tables", "runs/demo"], 0, ""),
    "a table over its record": (
        ["report", "tables", "runs/demo", "--out", "runs/demo/metrics.json"],
        2,
        "su3d-bench: runs/demo/metrics.json: is a file of the run itself, and stays as it is; choose another name",
    ),
    "a board": (["report", "leaderboard", "runs"], 0, "2 entries in 2 rankings, 0 left out"),
    "a page": (["report", "html", "runs/demo", "--out", "page.html"], 0, ""),
    "timing": (["report", "timing", "runs/demo", "--out", "timing"], 0, ""),
    "a reference": (["check", "--learn", "runs/demo", "--out", "reference.json"], 0, ""),
    "the gate": (["check", "runs/demo", "--against", "reference.json"], 0, ""),
    "errors": (["report", "attribution", "runs/demo", "--method", "collector"], 2, ""),
    "exported": (
        ["runs", "export", "runs/demo", "--to", "openlex3d", "--method", "collector", "--out", "exported"], 0, "",
    ),
    "its predictions scored": (["evaluate", "runs/demo/scenes/painted.a", "--protocol", "rooms-instance"], 2, ""),
}  # fmt: skip


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run of two scenes, pictures drawn, in ``runs/demo``."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.chdir(folder)
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        assert main([*SAME, "--jobs", "1", "--quiet"]) == 0
    os.symlink("runs/demo", folder / "link")
    return folder


@pytest.fixture(autouse=True)
def _painted(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.chdir(kept)
    monkeypatch.setenv("SU3D_CACHE", str(kept / "cache"))
    monkeypatch.setenv("SU3D_MODELS", str(kept / "no-models"))
    monkeypatch.setenv("SU3D_DATA", str(kept / "no-data"))


def files_of(run: str) -> dict[str, str]:
    """The digest of every file of a run but those of its cache, by name."""
    files = [path for path in Path(run).rglob("*") if path.is_file()]
    names = {path.relative_to(run).as_posix(): path for path in files}
    return {name: digest_file(path) for name, path in names.items() if not name.startswith(".cache/")}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_finished_run_stays_as_it_is(slip: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, code, line = SLIPS[slip]
    before = files_of("runs/demo")
    assert len(before) > 10
    assert main(words) == code, capsys.readouterr().err
    said = capsys.readouterr().err.splitlines()
    assert files_of("runs/demo") == before
    assert not line or any(each.startswith(line) for each in (said if code == 0 else said[-1:])), said
    assert code != 2 or len(said) == 1, said


def test_an_extension_that_is_stopped_leaves_the_run_finished_and_is_taken_up_again(
    kept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree("runs/demo", "stopped")
    before = files_of("stopped")
    words = ["run", f"{PAINTED}/[cd]", "--extend", "--out", "stopped", "--jobs", "1"]
    n_scenes = 0

    def stop_at_the_second(*arguments: Any) -> Any:
        nonlocal n_scenes
        n_scenes += 1
        if n_scenes == 2:
            raise KeyboardInterrupt
        return score(*arguments)

    score = scene_run._Scene._score
    with monkeypatch.context() as patch:
        patch.setattr(scene_run._Scene, "_score", stop_at_the_second)
        assert main(words) == 130
    after = files_of("stopped")
    assert before.items() <= after.items()
    assert main(["compare", "stopped", "runs/demo"]) == 0
    assert main(words) == 0
    assert main(["run", f"{PAINTED}/[abcd]", *WHAT, "--jobs", "1", "--out", "whole"]) == 0
    assert Path("stopped/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()
    made = {name: digest for name, digest in before.items() if name.startswith("scenes/")}
    assert made.items() <= files_of("stopped").items()  # no finished job was run again


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--executor", "slurm", "--scenes", f"{PAINTED}/a", *WHAT],
        ["run", f"{PAINTED}/z", *WHAT],
        ["run", f"{PAINTED}/a", *WHAT, "--extend"],
        ["run", f"{PAINTED}/a", *WHAT, "--set", "collector.dorp=1"],
        ["run", f"{PAINTED}/a", *WHAT, "--set", "perception.models.device=cuda:99"],
        ["ablate", f"{PAINTED}/a", "--method", COLLECTOR, "--vary", "dorp=1"],
    ],
)
def test_a_request_that_fails_before_any_work_leaves_no_folder(words: list[str]) -> None:
    assert main([*words, "--out", "new/one"]) == 2
    assert not Path("new").exists()
