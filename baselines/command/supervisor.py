"""Runs one program, and ends it and all that it started as soon as the process that asked for it is gone.

A script, started with ``python -I -S``: it imports nothing of the harness, and so neither waits for it nor holds its
memory. It stands between a run and somebody's program because a process that is killed can do nothing any more, but the
system closes its pipes, and that can be waited for.

It is told through the pipe ``ORDERS``, first one line of JSON, then ``STOP``, ``END`` or ``DONE``; the end of the pipe
is the end of whoever held it. It answers through a second pipe, a line of JSON each: the program's process id or why it
cannot be started, then its exit code.
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

STOP, END, DONE = b"S", b"E", b"D"  # ask the program to stop; end it; nothing is left for the supervisor to do
MOST_ORDER_BYTES = 1 << 24  # an environment and a command line; Linux gives them 2 MiB together
ENDING_S = 5.0  # for processes that were killed to be gone; what waits for a dead disk stays
AFTERWARDS_S = 60.0  # for `docker kill`
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h


def main(orders: int, answers: int) -> None:
    # A child of nobody: Ray ends the children of a worker that it ends, and others end whole trees of processes.
    if os.fork() > 0:
        os._exit(0)
    # Whoever ends all processes of a job, a closed terminal among them, would leave the program without its supervisor.
    # Handlers, for a signal that is ignored would be ignored by the program too.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, frame: None)
    woken, waker = os.pipe()
    os.set_blocking(waker, False)
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    _adopt_orphans()
    line = _first_line(orders)
    if line is None:
        return
    order = json.loads(line)
    try:
        program = _start(order)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        _answer(answers, {"error": getattr(error, "strerror", None) or str(error)})
        return
    _let_go_of_streams()
    _answer(answers, {"pid": program})
    exit_code, last = _wait(program, orders, woken)
    ended = _end_all(program)
    exit_code = ended if exit_code is None else exit_code
    if last is not None:  # it did not end by itself
        _run_afterwards(order)
    if last == b"":
        shutil.rmtree(order["scratch"], ignore_errors=True)
        return
    _answer(answers, {"exit_code": -signal.SIGKILL if exit_code is None else exit_code})
    if _next_order(orders) != DONE:  # whoever asked is gone before it heard the answer
        shutil.rmtree(order["scratch"], ignore_errors=True)


def _first_line(orders: int) -> bytes | None:
    """The line of JSON; None where whoever asked is gone already."""
    content = b""
    while not content.endswith(b"\n") and len(content) <= MOST_ORDER_BYTES:
        chunk = os.read(orders, 65536)
        if not chunk:
            return None
        content += chunk
    return content


def _start(order: dict[str, object]) -> int:
    words, folder, environment = order["words"], order["folder"], order["environment"]
    assert isinstance(words, list) and isinstance(folder, str) and isinstance(environment, dict)
    process = subprocess.Popen(
        words,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # a process group of its own, which can be ended as a whole
        preexec_fn=_die_with_supervisor,
    )
    process.returncode = 0  # it is waited for here, with all that is adopted
    return process.pid


def _die_with_supervisor() -> None:
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _adopt_orphans() -> None:
    """What the program started and left becomes a child of this process, not of the system's first."""
    _prctl(PR_SET_CHILD_SUBREAPER, 1)


def _prctl(option: int, value: int) -> None:
    with suppress(OSError, AttributeError):  # another system than Linux: the process group alone is ended
        ctypes.CDLL(None).prctl(option, ctypes.c_ulong(value), 0, 0, 0)


def _let_go_of_streams() -> None:
    """The program's streams end with the program."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    os.close(nowhere)


def _answer(answers: int, content: dict[str, object]) -> None:
    with suppress(OSError):  # nobody is there to hear it
        os.write(answers, json.dumps(content).encode() + b"\n")


def _wait(program: int, orders: int, woken: int) -> tuple[int | None, bytes | None]:
    """The program's exit code once it has ended, and the last order, empty at the end of the pipe, None without one."""
    last = None
    while True:
        ready, _, _ = select.select([orders, woken], [], [])
        if woken in ready:
            with suppress(BlockingIOError):
                os.read(woken, 65536)
        exit_code = _reap(program)
        if exit_code is not None:
            return exit_code, last
        if orders in ready:
            last = _next_order(orders)
            if last != STOP:
                return None, last
            _signal_group(program, signal.SIGTERM)


def _next_order(orders: int) -> bytes:
    try:
        return os.read(orders, 1)
    except OSError:
        return b""


def _reap(program: int) -> int | None:
    """Let go of every child that has ended; the exit code of the program where it is among them."""
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
    """End the program's group and all descendants; the program's exit code where it was running until now."""
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
    # The group outlives its leader while any of its members runs, so that its number cannot be another's.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(program, number)


def _descendants() -> list[int]:
    """The processes below this one; none where the system has no /proc."""
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


def _run_afterwards(order: dict[str, object]) -> None:
    words, environment = order["afterwards"], order["environment"]
    assert isinstance(words, list) and isinstance(environment, dict)
    if not words:
        return
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        subprocess.run(
            words,
            cwd="/",
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=AFTERWARDS_S,
            check=False,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
