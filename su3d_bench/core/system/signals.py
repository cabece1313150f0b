"""Signals that ask a process to end, as an exception that unwinds it: what it holds is let go of, as after Ctrl-C."""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# What Slurm, systemd, CI and `kill` send, and what a terminal sends that is closed.
ENDING = (signal.SIGTERM, signal.SIGHUP)
# Those who send both send them at once: the second must not break into what the first began. One that comes later is
# heard, for an exception may have been lost in a callback.
SIGNAL_IGNORE_S = 5.0


class Terminated(KeyboardInterrupt):
    """The process was asked to end by the signal ``number``."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def exit_code(self) -> int:
        """As shells have it."""
        return 128 + self.number


@contextmanager
def ending_in_order() -> Iterator[None]:
    """In the block, ``Terminated`` is raised in the main thread where a signal of ``ENDING`` comes.

    One that is ignored, as after ``nohup``, stays so. In another thread than the main one the block changes nothing.
    """
    heard_s, ended = -SIGNAL_IGNORE_S, 0

    def raise_ended(number: int, frame: FrameType | None) -> None:
        nonlocal heard_s, ended
        if number == signal.SIGHUP:
            _detach_from_terminals()
        if time.monotonic() - heard_s >= SIGNAL_IGNORE_S:
            heard_s, ended = time.monotonic(), number
            raise Terminated(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, raise_ended) for number in heard}
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if ended and not isinstance(interrupt, Terminated):  # Ray takes what a handler raises for a Ctrl-C
            raise Terminated(ended) from interrupt
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def restored_handlers() -> Iterator[None]:
    """What hears the signals of ``ENDING`` before the block hears them after it, whatever a library puts there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _detach_from_terminals() -> None:
    """What is said from now on goes nowhere where a closed terminal would refuse it: no error then hides the signal."""
    for stream in (1, 2):
        with suppress(OSError):
            look = select.poll()
            look.register(stream, 0)
            if any(found & select.POLLHUP for _, found in look.poll(0)):
                os.dup2(os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC), stream)
