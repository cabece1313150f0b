"""Wait for another thread or program, no longer than necessary."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import TypeVar

Value = TypeVar("Value")


def wait_until(is_so: Callable[[], Value], what: str = "it stayed false", seconds: float = 60.0) -> Value:
    """The first true value of ``is_so``; fails with ``what`` after ``seconds``."""
    end = time.monotonic() + seconds
    while not (value := is_so()):
        assert time.monotonic() < end, f"{what} in {seconds:g} s"
        time.sleep(0.01)
    return value


def hear_signals() -> None:
    """For ``preexec_fn``: restores signals that ``nohup`` or a background job makes this process ignore."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
