"""Commands on a finished run, right or wrong, never change its files."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
from painted_runs import see_painted
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
WHAT = f"--methods {COLLECTOR} --protocols rooms-semantic rooms-instance --no-pictures"
INTO = "--out runs/demo"
SAME = f"run {PAINTED}/[ab] {WHAT} {INTO}"
OTHER = "su3d-bench: runs/demo: contains a different run ("

# The command, its exit code, and the start of its last line.
SLIPS: dict[str, tuple[str, int, str]] = {
    "one scene of two": (f"run --scenes {PAINTED}/a {WHAT} {INTO}", 2, f"{OTHER}scene painted/b is not requested"),
    "more scenes": (f"run {PAINTED}/* {WHAT} {INTO}", 2, f"{OTHER}scenes painted/c, painted/d are new); --extend"),
    "the defaults": (f"run {INTO}", 2, OTHER),
    "another method": (f"{SAME} --methods oracle", 2, f"{OTHER}method collector is not requested now, method oracle"),
    "another seed": (f"{SAME} --seed 1", 2, f"{OTHER}seed was 0, now 1); --replace"),
    "the same with fewer processes": (f"{SAME} --jobs 1", 0, "run folder: runs/demo"),
    "the same in another order": (f"run {PAINTED}/b {PAINTED}/a {WHAT} {INTO}", 0, "run folder: runs/demo"),
    "the same from its own file": (f"run --config runs/demo/run.toml {INTO}", 0, "run folder: runs/demo"),
    "a plan": (f"{SAME} --dry-run", 0, ""),
    "missing weights": (f"{SAME} --profile paper", 2, "su3d-bench: "),
    "extended by nothing": (f"run --extend {INTO}", 0, "run folder: runs/demo"),
    "extended by another seed": (f"run --extend --seed 1 {INTO}", 2, "su3d-bench: runs/demo: cannot be extended"),
    "a plan of a replacement": (f"run {PAINTED}/c {WHAT} --replace --dry-run {INTO}", 0, ""),
    "replaced by itself": (f"{SAME} --replace", 0, "run folder: runs/demo"),
    "both at once": (f"{SAME} --replace --extend", 2, "su3d-bench: run: argument --extend: not allowed with"),
    "a sweep": (
        f"ablate {PAINTED}/[ab] --method {COLLECTOR} --vary drop=0,1 {INTO} --protocols rooms-semantic",
        2,
        f"{OTHER}method collector@drop=1 is new, protocol rooms-instance is not requested now)",
    ),
    "removed without a word": ("runs remove runs/demo", 2, "su3d-bench: runs remove: no terminal to ask for"),
    "removed through a link": ("runs remove link --yes", 2, "su3d-bench: link: is a link; name the folder"),
    "compared with itself": ("compare runs/demo runs/demo", 2, "su3d-bench: runs/demo: both sides are the same"),
    "a table over its record": (
        "report tables runs/demo --out runs/demo/metrics.json",
        2,
        "su3d-bench: --out runs/demo/metrics.json: lies in runs/demo, which is an input",
    ),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run of two scenes, with pictures, in ``runs/demo``."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        patch.chdir(folder)
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        assert main(f"{SAME} --jobs 1 --quiet".split()) == 0
    os.symlink("runs/demo", folder / "link")
    return folder


@pytest.fixture(autouse=True)
def _painted(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see_painted(monkeypatch)
    monkeypatch.chdir(kept)
    monkeypatch.setenv("SU3D_CACHE", str(kept / "cache"))
    monkeypatch.setenv("SU3D_MODELS", str(kept / "no-models"))
    monkeypatch.setenv("SU3D_DATA", str(kept / "no-data"))


def files_of(run: str) -> dict[str, str]:
    """The digest of every file of a run except its cache, by name."""
    files = [path for path in Path(run).rglob("*") if path.is_file()]
    names = {path.relative_to(run).as_posix(): path for path in files}
    return {name: digest_file(path) for name, path in names.items() if not name.startswith(".cache/")}


@pytest.mark.parametrize("slip", SLIPS)
def test_finished_run_is_unchanged(slip: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, code, line = SLIPS[slip]
    before = files_of("runs/demo")
    assert len(before) > 10
    assert main(shlex.split(words)) == code, capsys.readouterr().err
    printed = capsys.readouterr().err.splitlines()
    assert files_of("runs/demo") == before
    assert not line or any(each.startswith(line) for each in (printed if code == 0 else printed[-1:])), printed
    assert code != 2 or len(printed) == 1, printed


def test_interrupted_extension_leaves_the_run_finished_and_can_be_resumed(
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
            signal.raise_signal(signal.SIGINT)
        return score(*arguments)

    score = scene_run._Scene._score
    with monkeypatch.context() as patch:
        patch.setattr(scene_run._Scene, "_score", stop_at_the_second)
        assert main(words) == 130
    after = files_of("stopped")
    assert before.items() <= after.items()
    assert main(["compare", "stopped", "runs/demo"]) == 0
    assert main(words) == 0
    assert main(f"run {PAINTED}/[abcd] {WHAT} --jobs 1 --out whole".split()) == 0
    assert Path("stopped/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()
    made = {name: digest for name, digest in before.items() if name.startswith("scenes/")}
    assert made.items() <= files_of("stopped").items()  # no finished job was run again


@pytest.mark.parametrize(
    "words",
    [
        f"run --executor slurm --scenes {PAINTED}/a {WHAT}",
        f"run {PAINTED}/a {WHAT} --extend",
        f"run {PAINTED}/a {WHAT} --set perception.models.device=cuda:99",
        f"ablate {PAINTED}/a --method {COLLECTOR} --vary dorp=1",
    ],
)
def test_request_that_fails_early_creates_no_folder(words: str) -> None:
    assert main([*words.split(), "--out", "new/one"]) == 2
    assert not Path("new").exists()
