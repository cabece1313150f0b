"""Waiting for what another thread or program does, never longer than it takes."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import TypeVar

Value = TypeVar("Value")


def wait_until(is_so: Callable[[], Value], what: str = "it never became so", seconds: float = 60.0) -> Value:
    """The first value of ``is_so`` that counts as true; fails with ``what`` where none came in ``seconds``."""
    end = time.monotonic() + seconds
    while not (value := is_so()):
        assert time.monotonic() < end, f"{what} in {seconds:g} s"
        time.sleep(0.01)
    return value


def hear_signals() -> None:
    """For ``preexec_fn``: the child hears signals that ``nohup`` or a shell's background has this process ignore."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
