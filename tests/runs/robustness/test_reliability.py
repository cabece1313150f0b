"""Runs that are killed, or meet a full disk, a disk without locks, exhausted memory or a clock that jumps."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import random
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from painted_runs import PAINTED, in_process
from places import ROOT, SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import TemporaryFolder, filling
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.perception.cache import FrameCache
from su3d_bench.runs import scene as scene_run
from su3d_bench.store.run_folder import RunFolder

SUBJECT = f"{SCENES}/kill_subject.py"
SETTINGS = ("--set", "painted.n_frames=3", "--protocols", "rooms-semantic", "--no-pictures", "--jobs", "1", "--quiet")


pytestmark = pytest.mark.usefixtures("painted_place")


def run(*more: str, scenes: str = "[ab]", out: str = "out") -> int:
    words = ["run", "--scenes", f"{SCENES}/painted.py:Painted/{scenes}", "--methods", f"{SUBJECT}:Dense"]
    return main([*words, *SETTINGS, "--out", out, *more])


def job(scene: str = "a", out: str = "out") -> Path:
    return Path(out, "scenes", f"painted.{scene}", "dense")


def results(out: str = "out") -> dict[str, bytes]:
    """Every file of a run that contains no times."""
    paths = [path for path in Path(out).rglob("*") if path.is_file() and path.name not in ("updates.csv", "done.json")]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in paths}


@pytest.mark.proof
def test_clock_jumps_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run() == 0
    before = results()
    (job() / "counts.npz").unlink()
    jumps = random.Random(0)
    for path in Path("out").rglob("*"):
        when = jumps.choice((0, 4_000_000_000))
        os.utime(path, (when, when))
    monkeypatch.setattr(time, "time", lambda: jumps.choice((0.0, 4e9)))
    score = Mock(wraps=score_scene)
    monkeypatch.setattr(scene_run, "score_scene", score)
    assert run() == 0
    assert results() == before
    assert score.call_count == 1, "only the step with a missing file is done again"
    rows = [line.split(",") for line in (job() / "updates.csv").read_text().splitlines()]
    assert all(float(row[rows[0].index("total_ms")]) >= 0 for row in rows[1:])


@pytest.mark.proof
def test_commands_killed_at_random_give_the_same_bytes_as_undisturbed_ones() -> None:
    seed = "116"  # its first kill is a power cut
    program = [sys.executable, str(ROOT / "benchmarks"), "kill_at_random", "--kills", "10", "--seed", seed]
    words = ["--only", "inline", "export", "sheets-score", "report-html", "--json", "found.json"]
    done = subprocess.run([*program, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(Path("found.json").read_text())
    rows = [dict(zip(found["columns"], row, strict=True)) for row in found["rows"]]
    assert {row["killed"] for row in rows} == {"inline", "export", "sheets-score", "report-html"}
    for row in rows:
        assert (row["faults"], row["orphans"], row["leftovers"]) == ("0", "0", "0")
        assert int(row["compared"]) > 0
    assert sum(int(row["kills"]) for row in rows) >= 10
    assert sum(int(row["files corrupted"]) for row in rows) > 0


def test_full_disk_is_a_one_line_error_and_the_run_resumes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(out="whole", scenes="a") == 0
    write = os.fsync
    for n_that_fit in (0, 3, 8, 12):
        left = n_that_fit

        def full_after(descriptor: int) -> None:
            nonlocal left
            left -= 1
            if left < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(descriptor)

        shutil.rmtree("out", ignore_errors=True)
        capsys.readouterr()
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full_after)
            code = run(scenes="a")
        error = capsys.readouterr().err
        assert (code, error.count("\n")) == (2, 1), error
        assert ": the disk is full; free some space and run the same command again" in error
        assert not list(Path("out").rglob(".*"))
        assert run(scenes="a") == 0
        assert results() == results("whole")


def test_killed_run_resumed_by_several_workers_gives_the_same_bytes() -> None:
    slow = ("--scenes", f"{PAINTED}/[ab]", "--set", "painted.frame_ms=20", "--set", "collector.noise_m=0.01")
    started = time.monotonic()
    subprocess.run(in_process(*slow, out="whole"), check=True, capture_output=True)
    whole_s = time.monotonic() - started
    for jobs, share in (("1", 0.5), ("2", 0.8)):
        process = subprocess.Popen(
            in_process(*slow, "--jobs", jobs), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        with suppress(subprocess.TimeoutExpired):
            process.wait(share * whole_s)
        process.kill()
        process.wait()
    shutil.rmtree("out/scenes/painted.a", ignore_errors=True)
    subprocess.run(in_process(*slow, "--jobs", "2"), check=True, capture_output=True)
    for name in ("metrics.json", *(f"scenes/painted.{scene}/collector/prediction.npz" for scene in "ab")):
        assert Path("out", name).read_bytes() == Path("whole", name).read_bytes()
    assert not list(Path("out").rglob("*.unfinished"))


def test_out_of_memory_fails_only_its_scene_and_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--set", "painted.fault=memory") == 3
    line = "painted/b: out of memory (Unable to allocate 512. PiB for an array with shape (72057594037927936,) and data"
    assert f"{line} type float64); try fewer --jobs or a machine with more memory\n" in capsys.readouterr().err
    assert "score" in json.loads((job("a") / "done.json").read_text())["steps"]


def test_disk_without_locks_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without_locks(handle: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", without_locks)
    with pytest.raises(StoreError, match="this disk has no locks available"), RunFolder(tmp_path).locked():
        pass


def test_damaged_cache_entry_counts_as_absent(tmp_path: Path) -> None:
    cache = FrameCache(tmp_path)
    key = "ab" * 32
    arrays: dict[str, Any] = {"rows": np.arange(12, dtype=np.float32), "names": np.array(["chair"])}
    cache.save(key, arrays)
    path = cache.path(key)
    assert path is not None
    whole = path.read_bytes()
    draw = random.Random(0)
    n_absent = 0
    for k in range(600):
        damaged = bytearray(whole if k % 3 else whole[: draw.randrange(len(whole))])
        for _ in range(draw.choice((1, 4))):
            if damaged:
                damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(damaged)
        found = cache.load(key)
        n_absent += found is None
        assert found is None or all(np.array_equal(found[name], arrays[name]) for name in arrays)
    assert n_absent > 400


def test_cache_file_is_complete_or_absent_and_leftovers_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "entry.npz"
    (tmp_path / ".entry.npz.000000000000.unfinished").write_bytes(b"left by a killed process, and longer")
    with filling(path) as stream:
        stream.write(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    with suppress(KeyboardInterrupt), filling(path) as stream:
        stream.write(b"half")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"whole"
    assert [child.name for child in tmp_path.iterdir()] == ["entry.npz"]


def test_temporary_folder_of_a_killed_process_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "su3d-test-of-another-kind").mkdir()
    (tmp_path / "su3d-scene-kitchen1").mkdir()
    (tmp_path / "su3d-scene-kitchen1" / "drawing").touch()
    (tmp_path / "su3d-scene-unheld_0.held").mkdir()
    others = {"su3d-test-of-another-kind", "su3d-scene-kitchen1"}
    left = abandoned(tmp_path)
    with TemporaryFolder("su3d-test-") as first, TemporaryFolder("su3d-other-") as second:
        assert first.is_dir() and second.is_dir()
        assert not left.exists()
    assert {path.name for path in tmp_path.iterdir()} == others
    left = abandoned(tmp_path)
    assert run(scenes="a", out=str(tmp_path / "out")) == 0
    assert not left.exists()


def abandoned(folder: Path) -> Path:
    """The temporary folder of a killed process."""
    code = (
        "import os, signal; from su3d_bench.core.files.atomic import TemporaryFolder\n"
        "folder = TemporaryFolder('su3d-test-'); (folder.path / 'large').write_text('x')\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"TMPDIR": str(folder)}, check=False)
    (left,) = folder.glob("su3d-test-*/large")
    return left.parent


KERNEL = """
import sys
from pathlib import Path
from su3d_bench.core.compiled import njit

@njit(cache=True)
def double(x):
    return 2 * x

print(double(21), sum(double.stats.cache_hits.values()))
"""


@pytest.mark.proof
def test_damaged_cached_kernel_is_compiled_again(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL)

    def imported() -> str:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "numba")}
        words = [sys.executable, "-c", "import kernel"]
        return subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    assert imported() == "42 0\n"
    for suffix in ("nbi", "nbc"):
        (kept,) = (tmp_path / "numba").rglob(f"*.{suffix}")
        kept.write_bytes(bytes(kept.stat().st_size))
        assert imported() == "42 0\n"
    assert imported() == "42 1\n"


def test_kernel_is_compiled_again_when_an_imported_function_changes(tmp_path: Path) -> None:
    head = "from su3d_bench.core.compiled import njit\n"
    inner = head + "@njit(cache=True)\ndef factor():\n    return {}\n"
    middle = head + "from inner import factor\n@njit(cache=True)\ndef scaled(x):\n    return x * factor()\n"
    outer = head + "from middle import scaled\n@njit(cache=True)\ndef more(x):\n    return scaled(x) + 1\n"
    (tmp_path / "middle.py").write_text(middle)
    (tmp_path / "outer.py").write_text(outer)

    def result(value: int) -> str:
        (tmp_path / "inner.py").write_text(inner.format(value))
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "numba"), "PYTHONDONTWRITEBYTECODE": "1"}
        words = [sys.executable, "-c", "from outer import more; print(more(10), sum(more.stats.cache_hits.values()))"]
        return subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    assert [result(value) for value in (2, 2, 3)] == ["21 0\n", "21 1\n", "31 0\n"]
