"""A program that gets a scene frame by frame: requests and answers through two named pipes.

The pipes are files, so a container, a wrapper script or ``conda run`` passes them on, and prints of the program do not
mix with messages. Every message is a ``HEADER`` and as many bytes as it states, little-endian; the page "Methods in any
language" has the table. An answer repeats the number of its request and has a short text.
"""

from __future__ import annotations

import os
import select
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, NoReturn

from su3d_bench.baselines.command.process import GRACE_S, MAX_WAIT_S, Finished, Program
from su3d_bench.core.errors import ConfigError, PredictionError, printable

VERSION = 1
MAGIC = b"SU3D"
HEADER = struct.Struct("<4sIQQ")  # magic, kind, number of the request, bytes that follow
HELLO, FRAME, SNAPSHOT, REVISE, SAVE, LOAD, FINISH = range(1, 8)
ANSWERS = OK, REFUSED, ERROR = range(100, 103)
MAY_REFUSE = (REVISE, SAVE, LOAD)
MAX_ANSWER_BYTES = 4096
FINISH_S = 30.0  # for the answer to the last request, when all maps have been read
EXIT_WAIT_S = 1.0  # for a program that fails to end by itself


class _ProtocolError(Exception):
    """Why there is no valid answer; without a text, the program ended or closed a pipe."""


class PipedProgram:
    """A program that answers one request after another, each within ``timeout_s``.

    ``options``: arguments of ``Program``; ``waited_s``: the time of all requests until now.
    """

    def __init__(self, pipes: Path, timeout_s: float, words: Sequence[str], **options: Any) -> None:
        self._timeout_s, self._fault, self._n_asked, self.waited_s = timeout_s, "", 0, 0.0
        self._finished: Finished | None = None
        self._ends: list[IO[bytes]] = []
        for name in ("requests", "answers"):
            os.mkfifo(pipes / name)
            for mode, flag in (("rb", os.O_RDONLY), ("wb", os.O_WRONLY)):
                self._ends.append(os.fdopen(os.open(pipes / name, flag | os.O_NONBLOCK), mode, 0))
        self.program = Program(words, **options)

    def ask(self, kind: int, what: str, *content: bytes | memoryview) -> str:
        """The text of the program's answer to a request; ``what`` names it in messages.

        Raises ``ConfigError`` if the program refuses what it may refuse, and ``PredictionError`` if it fails, ends,
        violates the protocol or needs too long; it is ended then, and every further request raises the same error.
        """
        if self._fault:
            raise PredictionError(self._fault)
        self._fault, self._n_asked, start = f"{what}: was interrupted", self._n_asked + 1, time.perf_counter()
        until = start + min(self._timeout_s, FINISH_S if kind == FINISH else self._timeout_s)
        parts = [memoryview(part).cast("B") for part in content]
        header = HEADER.pack(MAGIC, kind, self._n_asked, sum(map(len, parts)))
        try:
            for part in (memoryview(header), *parts):
                self._send(part, until)
            answer, text = self._receive_answer(until)
        except _ProtocolError as error:
            self._fail(what, str(error))
        finally:
            self.waited_s += time.perf_counter() - start
        # The program's ends were open here too until it had opened them: a pipe with one end counts as closed.
        self._ends[0].close()
        self._ends[3].close()
        if answer == ERROR or (answer == REFUSED and kind not in MAY_REFUSE):
            self._fail(what, f"error of the program: {text}")
        self._fault = ""
        if answer == REFUSED:
            raise ConfigError(f"{what}: the program refuses: {text}")
        return text

    def end(self, *, in_order: bool = False) -> Finished:
        """End the program; ``in_order``: after a last request, when it may end by itself."""
        if in_order and not self._fault:
            with suppress(PredictionError):
                self.ask(FINISH, "finish")
                self.program.ends_within(GRACE_S)
        if self._finished is None:
            self._fault = self._fault or "it was ended"
            self._finished = self.program.end()
            for end in self._ends:
                end.close()
        return self._finished

    def _fail(self, what: str, why: str) -> NoReturn:
        has_ended = self.program.ends_within(EXIT_WAIT_S)
        done = self.end()
        why = why or f"{done.ending if has_ended else 'it closed its pipe'} before its answer"
        self._fault = f"{what}: {why}{done.last_line}"
        raise PredictionError(self._fault)

    def _send(self, data: memoryview, until: float) -> None:
        while data:
            self._await(until, [], [self._ends[1]])
            try:
                data = data[self._ends[1].write(data) or 0 :]
            except BrokenPipeError:  # its answer, or the way it ended, says why
                return

    def _receive_answer(self, until: float) -> tuple[int, str]:
        magic, kind, number, n_bytes = HEADER.unpack(self._receive(HEADER.size, until))
        if magic != MAGIC or kind not in ANSWERS:
            raise _ProtocolError(f"its answer begins with {magic!r} and kind {kind}, which is no answer")
        if n_bytes > MAX_ANSWER_BYTES:
            raise _ProtocolError(f"its answer has {n_bytes} bytes; at most {MAX_ANSWER_BYTES}")
        if number != self._n_asked:
            raise _ProtocolError(f"it answers request {number}; the last one was {self._n_asked}")
        return kind, printable(self._receive(n_bytes, until).decode("utf-8", "replace"), 300)

    def _receive(self, n_bytes: int, until: float) -> bytes:
        received = b""
        while len(received) < n_bytes:
            self._await(until, [self._ends[2]], [])
            chunk = self._ends[2].read(n_bytes - len(received))
            if chunk == b"":
                raise _ProtocolError
            received += chunk or b""
        return received

    def _await(self, until: float, readers: list[IO[bytes]], writers: list[IO[bytes]]) -> None:
        """Return when one of the pipes is ready; what the program wrote before it ended is still read."""
        while True:
            has_ended, left_s = self.program.has_ended(0), until - time.perf_counter()
            if any(select.select(readers, writers, [], 0 if has_ended else max(min(left_s, MAX_WAIT_S), 0))):
                return
            if has_ended:
                raise _ProtocolError
            if left_s <= 0:
                raise _ProtocolError(f"no complete answer within {self._timeout_s:g} s (timeout_s)")
            self.program.watch.look()
