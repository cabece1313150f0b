"""A program that gets a scene frame by frame: messages through two named pipes, each with one answer.

The pipes are files, so a container, a wrapper script or ``conda run`` passes them on, and prints of the program do not
mix with messages. Every message is a ``HEADER`` and as many bytes as it states, little-endian; docs/methods/
command-method.md has the table. An answer repeats the number of its request and has a short text.
"""

from __future__ import annotations

import os
import select
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

from su3d_bench.baselines.command.process import GRACE_S, MAX_WAIT_S, Finished, Program
from su3d_bench.core.errors import ConfigError, PredictionError, printable

VERSION = 1
MAGIC = b"SU3D"
HEADER = struct.Struct("<4sIQQ")  # magic, kind, number of the request, bytes that follow
FRAME = struct.Struct("<qdII9d16d")  # frame number, seconds, width, height, intrinsics, pose; then depth and colour
POSE = struct.Struct("<q16d")
MAX_ANSWER_BYTES = 4096
MAX_CHUNK_BYTES = 1 << 20
FINISH_S = 30.0  # for the answer to the last request, when all maps have been read
LAST_WORDS_S = 1.0  # for a program that fails to end by itself
REQUESTS, ANSWERS = "requests", "answers"  # the two pipes


class Kind(IntEnum):
    """The kinds of messages; the last three are answers."""

    HELLO = 1
    FRAME = 2
    SNAPSHOT = 3
    REVISE = 4
    SAVE = 5
    LOAD = 6
    FINISH = 7
    OK = 100
    REFUSED = 101
    ERROR = 102


ANSWER_KINDS = (Kind.OK, Kind.REFUSED, Kind.ERROR)
MAY_REFUSE = (Kind.REVISE, Kind.SAVE, Kind.LOAD)


class _BrokenError(Exception):
    """Why there is no valid answer; without a text, the program ended or closed a pipe."""


class PipedProgram:
    """A program that answers one request after another, each within ``timeout_s``; ``how``: arguments of ``Program``.

    ``waited_s``: the time of all requests until now. ``finished`` is set once the program has been ended.
    """

    def __init__(self, pipes: Path, timeout_s: float, words: Sequence[str], **how: Any) -> None:
        self._timeout_s, self._fault, self._n_asked = timeout_s, "", 0
        self.waited_s = 0.0
        self.finished: Finished | None = None
        ends = [(REQUESTS, os.O_RDONLY), (REQUESTS, os.O_WRONLY), (ANSWERS, os.O_RDONLY), (ANSWERS, os.O_WRONLY)]
        for name in (REQUESTS, ANSWERS):
            os.mkfifo(pipes / name)
        # The program's ends stay open here too until it has opened them: a pipe with one end counts as closed.
        theirs, self._writer, self._reader, others = (
            os.open(pipes / name, mode | os.O_NONBLOCK) for name, mode in ends
        )
        self._open, self._of_program = [self._writer, self._reader, theirs, others], [theirs, others]
        try:
            self._program = Program(words, **how)
        except BaseException:
            self._close_pipes(self._open)
            raise

    @property
    def peak_bytes(self) -> int | None:
        """The program's peak memory until now, if it can be measured."""
        if self.finished is None:
            self._program.watch.look()
        return self._program.watch.peak_bytes

    def ask(self, kind: Kind, what: str, *content: bytes | memoryview) -> str:
        """The text of the program's answer to a request; ``what`` names it in messages.

        Raises ``ConfigError`` if the program refuses a request that it may refuse, and ``PredictionError`` if it fails,
        ends, breaks the rules or needs too long; it is ended then and every further request raises the same error.
        """
        if self._fault:
            raise PredictionError(self._fault)
        self._fault, start = f"{what}: was interrupted", time.perf_counter()
        limit_s = min(self._timeout_s, FINISH_S) if kind == Kind.FINISH else self._timeout_s
        self._n_asked += 1
        parts = [memoryview(part).cast("B") for part in content]
        header = HEADER.pack(MAGIC, kind, self._n_asked, sum(map(len, parts)))
        try:
            for part in (memoryview(header), *parts):
                self._send(part, start + limit_s)
            answer, text = self._receive_answer(start + limit_s)
        except TimeoutError as error:
            last_line = self.end(is_timed_out=True).last_line
            self._fault = f"{what}: no complete answer within {limit_s:g} s (timeout_s){last_line}"
            raise PredictionError(self._fault) from error
        except _BrokenError as error:
            has_ended = self._program.ends_within(0.0 if str(error) else LAST_WORDS_S)
            done = self.end()
            why = str(error) or (done.ending if has_ended else "it closed its pipe") + " before its answer"
            self._fault = f"{what}: {why}{done.last_line}"
            raise PredictionError(self._fault) from error
        finally:
            self.waited_s += time.perf_counter() - start
        self._close_pipes(self._of_program)
        if answer == Kind.REFUSED and kind in MAY_REFUSE:
            self._fault = ""
            raise ConfigError(f"{what}: the program refuses: {text}")
        if answer != Kind.OK:
            self.end(LAST_WORDS_S)
            self._fault = f"{what}: {text or 'the program reports an error'}"
            raise PredictionError(self._fault)
        self._fault = ""
        return text

    def finish(self) -> None:
        """Tell the program that nothing follows and wait for its end; ``PredictionError`` if it fails then."""
        if self._fault:
            return
        self.ask(Kind.FINISH, "finish")
        done = self.end(GRACE_S)
        if done.exit_code != 0:
            raise PredictionError(f"finish: {done.ending}{done.last_line}")

    def end(self, wait_s: float = 0.0, *, is_timed_out: bool = False) -> Finished:
        """End the program, after ``wait_s`` in which it may end by itself."""
        if self.finished is None:
            try:
                self._fault = self._fault or "it has ended"
                if wait_s:
                    self._program.ends_within(wait_s)
            finally:
                self.finished = self._program.end(is_timed_out=is_timed_out)
                self._close_pipes(self._open)
        return self.finished

    def _send(self, data: memoryview, until: float) -> None:
        while data:
            self._await(until, [], [self._writer])
            try:
                data = data[os.write(self._writer, data[:MAX_CHUNK_BYTES]) :]
            except BrokenPipeError:  # its answer, or the way it ended, says why
                return
            except BlockingIOError:
                continue

    def _receive_answer(self, until: float) -> tuple[int, str]:
        magic, kind, number, n_bytes = HEADER.unpack(self._receive(HEADER.size, until))
        if magic != MAGIC or kind not in ANSWER_KINDS:
            raise _BrokenError(f"its answer begins with {magic!r} and kind {kind}, which is no answer")
        if n_bytes > MAX_ANSWER_BYTES:
            raise _BrokenError(f"its answer has {n_bytes} bytes; at most {MAX_ANSWER_BYTES}")
        if number != self._n_asked:
            raise _BrokenError(f"it answers request {number}; the last one was {self._n_asked}")
        return kind, printable(self._receive(n_bytes, until).decode("utf-8", "replace"), 300)

    def _receive(self, n_bytes: int, until: float) -> bytes:
        received = b""
        while len(received) < n_bytes:
            self._await(until, [self._reader], [])
            chunk = os.read(self._reader, n_bytes - len(received))
            if not chunk:
                raise _BrokenError
            received += chunk
        return received

    def _await(self, until: float, readers: list[int], writers: list[int]) -> None:
        """Return when one of the pipes is ready; what the program wrote before it ended is still read."""
        while True:
            has_ended, left_s = self._program.has_ended(0), until - time.perf_counter()
            ready = select.select(readers, writers, [], 0 if has_ended else max(min(left_s, MAX_WAIT_S), 0))
            if any(ready):
                return
            if has_ended:
                raise _BrokenError
            if left_s <= 0:
                raise TimeoutError
            self._program.watch.look()

    def _close_pipes(self, ends: list[int]) -> None:
        for end in list(ends):
            with suppress(ValueError):
                self._open.remove(end)
                os.close(end)
        ends.clear()
