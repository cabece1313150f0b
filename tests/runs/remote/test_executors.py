from __future__ import annotations

import os
import signal
import threading
import time

import psutil
import pytest

from su3d_bench.core.errors import StoreError
from su3d_bench.runs.executors import ENDING_S, ONE_THREAD, Event, Report, run_processes


def work(unit: str, report: Report) -> str:
    if unit == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if unit == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    if unit == "exit":
        os._exit(7)
    if unit == "disk":
        raise StoreError("cannot write x: the disk is full")
    if unit == "bug":
        raise KeyError("a mistake")
    if unit == "wait":
        threading.Event().wait(60)
    if unit == "deaf":  # as in native code, which returns to Python much later
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        report(Event(unit, "work", 0, 1))
        threading.Event().wait(60)
    if unit == "threads":
        return " ".join(os.environ[name] for name in sorted(ONE_THREAD))
    if unit == "pid":
        return str(os.getpid())
    report(Event(unit, "work", 1, 1))
    return unit.upper()


def lost(unit: str, reason: str) -> str:
    return f"{unit}: {reason}"


def in_processes(units: list[str], jobs: int = 2) -> list[str]:
    return list(run_processes(work, units, lambda event: None, jobs=jobs, lost=lost))


@pytest.mark.parametrize(
    ("unit", "reason"),
    [
        ("kill", "kill: the worker was killed (signal 9), usually because memory ran out; try fewer --jobs"),
        ("segfault", "segfault: the worker crashed (signal 11, SIGSEGV)"),
        ("exit", "exit: the worker ended early (exit code 7)"),
    ],
)
def test_unit_that_crashes_its_process_fails_alone(unit: str, reason: str) -> None:
    assert sorted(in_processes(["a", unit, "b"])) == sorted(["A", reason, "B"])


def test_user_error_stops_all_units() -> None:
    start = time.monotonic()
    with pytest.raises(StoreError, match="the disk is full"):
        in_processes(["disk", "wait"])
    assert time.monotonic() - start < 30


def test_interrupt_also_ends_workers_that_ignore_signals() -> None:
    def interrupt(event: Event) -> None:
        pids.extend(child.pid for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline()))
        interrupted.append(time.monotonic())
        raise KeyboardInterrupt

    pids, interrupted = list[int](), list[float]()
    with pytest.raises(KeyboardInterrupt):
        list(run_processes(work, ["deaf"], interrupt, jobs=1, lost=lost))
    assert time.monotonic() - interrupted[0] < ENDING_S
    assert len(pids) == 1 and not psutil.pid_exists(pids[0])


def test_workers_use_one_thread_and_parent_settings_are_unchanged() -> None:
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    assert in_processes(["threads"]) == [" ".join("1" for _ in ONE_THREAD)]
    assert {name: os.environ.get(name) for name in ONE_THREAD} == before
