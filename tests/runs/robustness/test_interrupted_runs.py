"""A run that is ended, in whatever way, leaves no user program running and no temporary folder behind."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from places import SCENES
from waiting import hear_signals, wait_until

from su3d_bench.core.system.signals import Terminated, ending_in_order

EXECUTORS = {"inline": ("--jobs", "1"), "processes": ("--jobs", "2")}
WORKER = "spawn_main"
# It leaves a child in its group, one in a group of its own, and one that makes itself a daemon; all three write on.
PROGRAM = """
import os, subprocess, sys, time
line = "while :; do echo x >> $0; sleep 0.05; done"
def begin(name, **how):
    subprocess.Popen(["/bin/sh", "-c", line, os.path.join(sys.argv[1], name)], **how)
begin("in its group")
begin("of its own", start_new_session=True)
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        begin("of a daemon")
    os._exit(0)
open(os.path.join(sys.argv[2], f"begun-{os.getpid()}"), "w").close()
time.sleep(600)
"""


class Started:
    """A command-line run on two scenes, whose programs are running once this object is created."""

    def __init__(self, place: Path, executor: str, *, n_programs: int, **how: Any) -> None:
        self.place, self.scratch, self.marks = place, place / "scratch", place / "marks"
        for folder in (self.scratch, self.marks):
            folder.mkdir()
        (place / "program.py").write_text(PROGRAM)
        words = [sys.executable, "-m", "su3d_bench", "run", "--scenes", f"{SCENES}/kill_subject.py:Painted/[ab]"]
        words += ["--methods", "command", "--protocols", "rooms-semantic", "--no-pictures", "--out", str(place / "out")]
        program = f'["{sys.executable}", "{place}/program.py", "{{output}}", "{self.marks}"]'
        words += ["--set", "painted.n_frames=2", f"command.command={program}", *EXECUTORS[executor]]
        environment = os.environ | {"TMPDIR": str(self.scratch), "SU3D_CACHE": str(place / "cache")}
        self.log = place / "log"
        with self.log.open("wb") as log:
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log}
            streams |= {"preexec_fn": hear_signals} | how
            self.run = subprocess.Popen(words, env=environment, **streams)
        try:
            wait_until(lambda: self.run.poll() is not None or len(list(self.marks.iterdir())) >= n_programs)
            assert self.run.poll() is None, self.log.read_text()
        except BaseException:
            self.close()
            raise

    def programs(self) -> list[psutil.Process]:
        return [process for process in self.mentions() if _words(process, "while :; do")]

    def mentions(self) -> list[psutil.Process]:
        """Every process, except the run itself, with this folder in its command line."""
        found = [process for process in psutil.process_iter() if _words(process, str(self.place))]
        return [process for process in found if process.pid != self.run.pid]

    def workers(self) -> list[psutil.Process]:
        """The two processes of the run, one per scene."""
        return [process for process in psutil.Process(self.run.pid).children() if _words(process, WORKER)]

    def close(self) -> None:
        with suppress(ProcessLookupError):
            self.run.kill()
        self.run.wait()
        for process in self.mentions():
            with suppress(psutil.Error):
                process.kill()

    def left_behind(self) -> list[str]:
        programs = [str(process.pid) for process in self.mentions() if process.is_running()]  # a name may be gone
        return programs + [path.name for path in self.scratch.iterdir() if path.name.startswith("su3d-")]

    def assert_nothing_is_left(self) -> None:
        with suppress(AssertionError):
            wait_until(lambda: not self.left_behind(), "something is left", 20)
        assert self.left_behind() == []


def _words(process: psutil.Process, mark: str) -> bool:
    """Whether ``mark`` is in the command line of a running process."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE and any(mark in word for word in process.cmdline())
    except psutil.Error:
        return False


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Any]:
    made: list[Started] = []

    def start(executor: str, **how: Any) -> Started:
        made.append(Started(tmp_path, executor, n_programs=1 if executor == "inline" else 2, **how))
        return made[-1]

    yield start
    for one in made:
        one.close()


@pytest.mark.parametrize(
    ("executor", "number"),
    [
        ("processes", signal.SIGKILL),
        ("inline", signal.SIGTERM),
        ("inline", signal.SIGINT),
        pytest.param("processes", signal.SIGTERM, marks=pytest.mark.proof),
        pytest.param("processes", signal.SIGINT, marks=pytest.mark.proof),
        pytest.param("inline", signal.SIGKILL, marks=pytest.mark.proof),
    ],
)
def test_run_ended_by_a_signal_leaves_no_program_and_no_folder(
    started: Any, executor: str, number: signal.Signals
) -> None:
    run = started(executor)
    wait_until(lambda: len(run.programs()) >= 3 * (1 if executor == "inline" else 2))
    run.run.send_signal(number)
    code = run.run.wait(60)
    run.assert_nothing_is_left()
    if number == signal.SIGKILL:
        assert code == -signal.SIGKILL
        return
    how = "interrupted" if number == signal.SIGINT else f"stopped by {number.name}"
    assert (code, run.log.read_text().splitlines()[-1]) == (
        128 + number, f"su3d-bench: {how}; the same command resumes"
    )  # fmt: skip
    assert '"status": "interrupted"' in (run.place / "out" / "run.json").read_text()
    assert "Traceback" not in run.log.read_text()


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.proof)])
def test_worker_ended_by_a_signal_leaves_no_program_and_only_its_scene_fails(
    started: Any, number: signal.Signals
) -> None:
    run = started("processes")
    wait_until(lambda: len(run.programs()) == 6)
    one, other = run.workers()
    one.send_signal(number)
    wait_until(lambda: len(run.programs()) == 3 and len(run.workers()) == 1, "its program runs on")
    assert run.run.poll() is None
    other.send_signal(number)
    assert run.run.wait(60) == 3
    run.assert_nothing_is_left()
    how = "was killed (signal 9)" if number == signal.SIGKILL else "crashed (signal 15, SIGTERM)"
    assert run.log.read_text().count(how) >= 2


@pytest.mark.proof
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=lambda n: n.name)
def test_signal_to_the_process_group_leaves_nothing(started: Any, number: signal.Signals) -> None:
    run = started("processes", start_new_session=True)
    os.killpg(run.run.pid, number)
    assert run.run.wait(60) in {-number, 128 + number}
    run.assert_nothing_is_left()


@pytest.mark.parametrize("executor", ["processes", pytest.param("inline", marks=pytest.mark.proof)])
def test_closing_the_terminal_stops_the_run_cleanly(started: Any, executor: str) -> None:
    ours, theirs = pty.openpty()
    run = started(executor, stdin=theirs, stdout=theirs, stderr=theirs, preexec_fn=_own_terminal)
    os.close(theirs)
    os.close(ours)
    assert run.run.wait(60) == 128 + signal.SIGHUP
    run.assert_nothing_is_left()
    assert '"status": "interrupted"' in (run.place / "out" / "run.json").read_text()


def _own_terminal() -> None:
    import fcntl
    import termios

    hear_signals()
    os.setsid()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def test_ignored_sighup_stays_ignored_and_only_the_first_of_two_signals_is_raised() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    term_before = signal.getsignal(signal.SIGTERM)  # a cluster of another test in this process may have set its own
    heard = []
    try:
        with ending_in_order():
            os.kill(os.getpid(), signal.SIGHUP)
            for _ in range(2):
                try:
                    os.kill(os.getpid(), signal.SIGTERM)
                except Terminated as end:
                    heard.append((str(end), end.exit_code))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert heard == [("SIGTERM", 143)]
    assert signal.getsignal(signal.SIGTERM) == term_before
