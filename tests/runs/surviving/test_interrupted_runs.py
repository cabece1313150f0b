"""A run that cannot write, that loses a worker, is interrupted or killed, and how it is taken up again."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest
from painted import colour_perception
from painted_runs import in_process, job, metrics, run
from waiting import hear_signals, wait_until

from su3d_bench.runs import resume as finished_scenes
from su3d_bench.runs import scene as scene_run


@pytest.fixture(autouse=True)
def _painted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for module in (scene_run, finished_scenes):
        monkeypatch.setattr(module, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)


def test_a_full_disk_is_one_line_and_the_run_resumes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(out="whole") == 0
    n_writes = 0
    write = os.fsync

    def full_after_twelve(descriptor: int) -> None:
        nonlocal n_writes
        n_writes += 1
        if n_writes > 12:
            raise OSError(28, "No space left on device")
        write(descriptor)

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_after_twelve)
        assert run() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert ": the disk is full; free some space and run the same command again" in error
    assert run() == 0
    assert Path("out/metrics.json").read_bytes() == Path("whole/metrics.json").read_bytes()


def test_worker_processes_give_the_same_bytes_as_one() -> None:
    noise = ("--set", "collector.noise_m=0.02")
    for jobs in ("1", "2"):
        finish(in_process(*noise, "--jobs", jobs, out=f"jobs{jobs}"))
    assert Path("jobs1/metrics.json").read_bytes() == Path("jobs2/metrics.json").read_bytes()
    for scene in "abcd":
        one, two = ((job(scene, out=f"jobs{n}") / "prediction.npz").read_bytes() for n in (1, 2))
        assert one == two


def test_a_killed_worker_fails_its_scene_alone() -> None:
    done = subprocess.run(in_process("--jobs", "2", "--set", "painted.fault=kill"), capture_output=True, text=True)
    assert done.returncode == 3
    assert "painted/b: the worker was killed (signal 9), most often for want of memory; try fewer --jobs" in done.stderr
    assert metrics()["results"][0]["result"]["scenes"] == ["painted/a", "painted/c", "painted/d"]


def test_an_interrupt_ends_cleanly_and_the_run_resumes() -> None:
    command = in_process("--jobs", "2", "--set", "painted.frame_ms=500")
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=hear_signals
    )
    wait_until(job("a").exists)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode == 130
    assert error == "su3d-bench: interrupted; the same command takes it up again\n"
    assert json.loads(Path("out/run.json").read_text())["status"] == "interrupted"


def test_killed_at_any_moment_and_taken_up_again_it_gives_the_same_bytes() -> None:
    slow = ("--set", "painted.frame_ms=20", "--set", "collector.noise_m=0.01")
    started = time.monotonic()
    finish(in_process(*slow, out="whole"))
    whole_s = time.monotonic() - started
    expected = Path("whole/metrics.json").read_bytes()
    moments = random.Random(0)
    for k in range(4):
        command = in_process(*slow, "--jobs", "2" if k % 3 == 0 else "1")
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with suppress(subprocess.TimeoutExpired):
            process.wait(moments.uniform(0.1, 0.9) * whole_s)
        process.kill()
        process.wait()
        if moments.random() < 0.5:
            shutil.rmtree("out/scenes/painted.a", ignore_errors=True)
    finish(in_process(*slow))
    assert Path("out/metrics.json").read_bytes() == expected
    assert not list(Path("out").rglob("*.unfinished"))


def finish(command: list[str]) -> None:
    """Run ``command`` to its end, which must be a good one."""
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
