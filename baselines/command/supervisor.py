"""Runs one program, and kills it and everything it started as soon as the requesting process is gone.

A script, started with ``python -I -S``: it imports nothing of the harness, so it starts fast and needs little
memory. It sits between a run and a user's program because a killed process cannot clean up, but the
system closes its pipes, which can be detected.

It reads its standard input: one line of JSON with the command, then ``STOP`` or ``DONE``. When that pipe closes because
the parent process has died, it ends the program and removes its folders. It writes to a second pipe, one line of JSON
per answer: the program's process id or why it cannot be started, then its exit code.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

STOP, DONE = b"S", b"D"  # ask the program to stop; kill it, the parent process removes its folders
ENDING_S = 5.0  # for killed processes to disappear; those blocked on a dead disk stay
KILL_WAIT_S = 60.0  # for `docker kill`
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h


def main(answers: int) -> None:
    # Detached from its parent: some schedulers kill the children of a worker, or whole process trees.
    if os.fork() > 0:
        os._exit(0)
    # Killing all processes of a job (as closing a terminal does) must not leave the program without its supervisor.
    # Handlers, because the program would inherit ignored signals.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, frame: None)
    woken, waker = os.pipe()
    os.set_blocking(waker, False)
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    _prctl(PR_SET_CHILD_SUBREAPER, 1)  # orphans of the program become children of this process
    with open(0, "rb", buffering=0, closefd=False) as orders:
        line = orders.readline()
    if not line.endswith(b"\n"):  # the parent process is gone already
        return
    order = json.loads(line)
    try:
        program = _start(order)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        _answer(answers, {"error": getattr(error, "strerror", None) or str(error)})
        return
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):  # the program's streams end with the program
        os.dup2(nowhere, stream)
    _answer(answers, {"pid": program})
    exit_code, last = _wait(program, woken)
    ended = _end_all(program)
    if last is not None:  # it did not end by itself
        _run_afterwards(order)
    exit_code = ended if exit_code is None else exit_code
    _answer(answers, {"exit_code": -signal.SIGKILL if exit_code is None else exit_code})
    if last != DONE and os.read(0, 1) != DONE:  # the parent process is gone
        shutil.rmtree(order["scratch"], ignore_errors=True)


def _start(order: dict[str, Any]) -> int:
    process = subprocess.Popen(
        order["words"],
        cwd=order["folder"],
        env=order["environment"],
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # a separate process group, which can be killed as a whole
        preexec_fn=lambda: _prctl(PR_SET_PDEATHSIG, signal.SIGKILL),
    )
    process.returncode = 0  # reaped here, with all adopted processes
    return process.pid


def _prctl(option: int, value: int) -> None:
    with suppress(OSError, AttributeError):  # not Linux: only the process group is killed
        ctypes.CDLL(None).prctl(option, ctypes.c_ulong(value), 0, 0, 0)


def _answer(answers: int, content: dict[str, object]) -> None:
    with suppress(OSError):  # the reader is gone
        os.write(answers, json.dumps(content).encode() + b"\n")


def _wait(program: int, woken: int) -> tuple[int | None, bytes | None]:
    """The program's exit code once it has ended, and the last order (empty after the pipe closed, or None)."""
    last = None
    while True:
        ready, _, _ = select.select([0, woken], [], [])
        if woken in ready:
            with suppress(BlockingIOError):
                os.read(woken, 65536)
        exit_code = _reap(program)
        if exit_code is not None:
            return exit_code, last
        if 0 in ready:
            last = os.read(0, 1)
            if last != STOP:
                return None, last
            _signal_group(program, signal.SIGTERM)


def _reap(program: int) -> int | None:
    """Reap every child that has ended; the exit code of the program if it is among them."""
    exit_code = None
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return exit_code
        if pid == 0:
            return exit_code
        if pid == program:
            exit_code = os.waitstatus_to_exitcode(status)


def _end_all(program: int) -> int | None:
    """Kill the program's group and all descendants; the program's exit code if it was still running."""
    exit_code = None
    until = time.monotonic() + ENDING_S
    while True:
        _signal_group(program, signal.SIGKILL)
        left = _descendants()
        for pid in left:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        ended = _reap(program)
        exit_code = ended if exit_code is None else exit_code
        if not left or time.monotonic() >= until:
            return exit_code
        time.sleep(0.01)


def _signal_group(program: int, number: signal.Signals) -> None:
    # The group outlives its leader while any member runs, so its number cannot be reused.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(program, number)


def _descendants() -> list[int]:
    """The processes below this one; none without /proc."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            parent = int(path.read_bytes().rpartition(b")")[2].split()[1])  # a name may hold spaces and brackets
            children.setdefault(parent, []).append(int(path.parent.name))
    found, waiting = [], [os.getpid()]
    while waiting:
        below = children.get(waiting.pop(), [])
        found += below
        waiting += below
    return found


def _run_afterwards(order: dict[str, Any]) -> None:
    if order["afterwards"]:
        with suppress(OSError, ValueError, subprocess.SubprocessError):
            subprocess.run(
                order["afterwards"],
                cwd="/",
                env=order["environment"],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=KILL_WAIT_S,
                check=False,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]))
