"""Termination signals as an exception, so that a process releases its resources as after Ctrl-C."""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# Sent by Slurm, systemd, CI and `kill`, by a closed terminal, and by Ctrl-C.
ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
# A sender of the first two sends them at once: the second must not interrupt the shutdown that the first began. A later
# one counts, because an exception may have been lost in a callback.
SIGNAL_IGNORE_S = 5.0


class Terminated(KeyboardInterrupt):
    """The process was asked to end by the signal ``number``."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def exit_code(self) -> int:
        """The exit code, as in shells."""
        return 128 + self.number


@contextmanager
def ending_in_order() -> Iterator[None]:
    """In the block, a signal of ``ENDING`` raises ``Terminated`` in the main thread.

    A signal that is ignored, as after ``nohup``, stays ignored. Outside the main thread this does nothing.
    """
    heard_s, ended = -SIGNAL_IGNORE_S, 0

    def raise_ended(number: int, frame: FrameType | None) -> None:
        nonlocal heard_s, ended
        if number == signal.SIGHUP:
            _detach_from_terminals()
        if number == signal.SIGINT:
            raise Terminated(number)
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
        if ended and not isinstance(interrupt, Terminated):  # some libraries raise Ctrl-C for what a handler raises
            raise Terminated(ended) from interrupt
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def is_interrupt(error: BaseException) -> bool:
    """Whether the user or a signal ends the process, rather than code that raises the exception of an interrupt itself.

    They cannot be told apart outside ``ending_in_order``, as in a notebook.
    """
    is_handled = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    return isinstance(error, Terminated) or (isinstance(error, KeyboardInterrupt) and not is_handled)


def _detach_from_terminals() -> None:
    """Discard output to a closed terminal from now on, so that a write error does not hide the signal."""
    for stream in (1, 2):
        with suppress(OSError):
            look = select.poll()
            look.register(stream, 0)
            if any(found & select.POLLHUP for _, found in look.poll(0)):
                os.dup2(os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC), stream)
