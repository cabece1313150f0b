"""Run a user's program and monitor it from outside: time, memory of its process tree, output."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import IO, Any

from su3d_bench.baselines.command import supervisor
from su3d_bench.baselines.command.supervisor import DONE, KILL_WAIT_S, STOP
from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.system.files import file_text

SUPERVISOR = Path(supervisor.__file__)
ENDING_S = supervisor.ENDING_S + KILL_WAIT_S + 5.0  # for the supervisor to end the program, and a container
KEPT_CHARACTERS = 100_000  # of each stream, from its end: still readable
GRACE_S = 5.0  # between asking a program to stop and killing it
MAX_WAIT_S = 0.2  # between two polls of a program; the first polls are faster
CGROUPS = Path("/sys/fs/cgroup")
# Where docker's drivers (systemd, cgroupfs) store a container's peak, for both cgroup versions.
PEAK_FILES = (
    "system.slice/docker-{id}.scope/memory.peak",
    "docker/{id}/memory.peak",
    "memory/docker/{id}/memory.max_usage_in_bytes",
    "memory/system.slice/docker-{id}.scope/memory.max_usage_in_bytes",
)


@dataclass(frozen=True)
class Finished:
    """A finished program; ``exit_code`` is negative if a signal ended it, as in ``subprocess``.

    ``peak_memory_bytes``: None if not measured; ``memory_source``: how it was measured, or why not.
    """

    exit_code: int
    is_timed_out: bool
    wall_s: float
    peak_memory_bytes: int | None
    memory_source: str
    stdout: str
    stderr: str

    @property
    def ending(self) -> str:
        """How it ended, as a clause."""
        return f"exit code {self.exit_code}" if self.exit_code >= 0 else f"terminated by signal {-self.exit_code}"

    @property
    def last_line(self) -> str:
        """The end of a message: the last line of stderr."""
        lines = [line for line in map(printable, self.stderr.splitlines()) if line]
        return f"; its last line: {lines[-1][:200]}" if lines else "; it wrote nothing to stderr"


class MemoryMonitor:
    """The peak memory of a program; ``look`` is called repeatedly while it runs.

    That of a process and all its descendants, where shared pages count once for each; or, if docker
    writes a container id into ``id_file``, the peak recorded by its cgroup, including cached files.
    ``source``: how it was measured, or why not.
    """

    def __init__(self, pid: int, id_file: Path | None = None) -> None:
        self._pid, self._id_file = pid, id_file
        self._seen: dict[int, Any] = {}
        self.peak_bytes: int | None = None
        self.source = "total resident memory of all processes, sampled"
        if id_file is not None:
            self.source = "not measured: the cgroup cannot be read here"

    def look(self) -> None:
        """Record the current memory."""
        if self._id_file is not None:
            self._check_container(self._id_file)
            return
        import psutil

        with suppress(psutil.Error):
            root = psutil.Process(self._pid)
            together, peak = 0, self.peak_bytes or 0
            for process in (root, *root.children(recursive=True)):
                self._seen.setdefault(process.pid, process)
                with suppress(psutil.Error):
                    together += process.memory_info().rss
                    peak = max(peak, _own_peak_bytes(process.pid))
            self.peak_bytes = max(peak, together) or None

    def _check_container(self, id_file: Path) -> None:
        identity = file_text(id_file).strip() if id_file.is_file() else ""
        for pattern in PEAK_FILES if identity.isalnum() else ():
            with suppress(OSError, ValueError):
                self.peak_bytes = int(file_text(CGROUPS / pattern.format(id=identity)))
                self.source = "the container's cgroup"

    def end(self) -> None:
        """Kill processes that were seen and still run.

        Needed if the system cannot adopt orphans, or if the supervisor was killed.
        """
        import psutil

        for process in self._seen.values():
            with suppress(psutil.Error):
                if process.is_running():
                    process.kill()


def _own_peak_bytes(pid: int) -> int:
    """The peak of one process since its program started, which sampling cannot miss; 0 if unavailable."""
    try:
        lines = file_text(Path(f"/proc/{pid}/status")).splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


class _Tail(Thread):
    """Reads a stream to its end and keeps its last characters, regardless of content."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(daemon=True)
        self._stream = stream
        self._kept, self._n_read = b"", 0

    def run(self) -> None:
        # ValueError: the stream was closed because a runaway child still has its other end open.
        with suppress(OSError, ValueError):
            while chunk := os.read(self._stream.fileno(), 65536):
                self._n_read += len(chunk)
                self._kept = (self._kept + chunk)[-KEPT_CHARACTERS:]

    def text(self) -> str:
        self.join(GRACE_S)
        text, n_dropped = self._kept.decode("utf-8", "replace"), self._n_read - len(self._kept)
        return f"[{n_dropped} earlier bytes omitted]\n{text}" if n_dropped > 0 else text


class _Supervised:
    """A program under its supervisor, ``supervisor.py``, which ends it whenever this process ends.

    ``afterwards`` is run if the program does not end by itself; ``scratch`` is removed by the supervisor if this
    process died.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        afterwards: Sequence[str],
        scratch: Path | None,
    ) -> None:
        self.exit_code: int | None = None
        self._said = b""
        self._answers, answers = os.pipe()
        try:
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(SUPERVISOR), str(answers)],
                pass_fds=(answers,),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # killing this process's group spares the supervisor
            )
        finally:
            os.close(answers)
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        self._process, self._orders, self.streams = process, process.stdin, (process.stdout, process.stderr)
        order = {"words": list(words), "folder": str(folder), "environment": dict(environment)}
        order |= {"afterwards": list(afterwards), "scratch": str(scratch or "")}
        try:
            self._order(json.dumps(order).encode() + b"\n")
            answer = self._answer(None) or {"error": "its supervisor was killed"}
            if "error" in answer:
                raise ConfigError(f"'{words[0]}' cannot be started: {answer['error']}")
            self.pid = int(answer["pid"])
        except BaseException:
            self.close()
            raise

    def has_ended(self, wait_s: float) -> bool:
        """Whether the program has ended, waiting at most ``wait_s``."""
        if self.exit_code is None and (answer := self._answer(wait_s)) is not None:
            # A killed supervisor gives no answer, and the system has ended the program after it.
            self.exit_code = int(answer.get("exit_code", -signal.SIGKILL))
        return self.exit_code is not None

    def stop(self) -> None:
        """Ask the program to stop."""
        self._order(STOP)

    def end(self) -> None:
        """Kill the program and everything it started."""
        self._order(DONE)
        self.has_ended(ENDING_S)

    def close(self) -> None:
        os.close(self._answers)
        for stream in (self._orders, *self.streams):
            with suppress(BrokenPipeError):
                stream.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)

    def _order(self, order: bytes) -> None:
        with suppress(BrokenPipeError):
            self._orders.write(order)
            self._orders.flush()

    def _answer(self, wait_s: float | None) -> dict[str, Any] | None:
        """The next answer, empty if the supervisor is gone; None if none came within ``wait_s``."""
        until = None if wait_s is None else time.monotonic() + wait_s
        while b"\n" not in self._said:
            left_s = None if until is None else max(until - time.monotonic(), 0.0)
            if not select.select([self._answers], [], [], left_s)[0]:
                return None
            if not (chunk := os.read(self._answers, 4096)):
                return {}
            self._said += chunk
        line, _, self._said = self._said.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer


class Program:
    """A running program, its output and its memory; nothing that it started outlives ``end``.

    This also holds if this process dies: ``afterwards`` is run if the program does not end by itself, and ``scratch``
    is removed if this process is gone. Docker writes the container id into ``id_file``. A program that cannot be
    started is a ``ConfigError``.
    """

    def __init__(
        self,
        words: Sequence[str],
        *,
        folder: Path,
        environment: Mapping[str, str],
        id_file: Path | None = None,
        afterwards: Sequence[str] = (),
        scratch: Path | None = None,
    ) -> None:
        self._start = time.perf_counter()
        self._supervised = _Supervised(words, folder, environment, afterwards, scratch)
        self.watch = MemoryMonitor(self._supervised.pid, id_file)
        self._tails = [_Tail(stream) for stream in self._supervised.streams]
        for tail in self._tails:
            tail.start()

    def has_ended(self, wait_s: float) -> bool:
        """Whether the program has ended, waiting at most ``wait_s``."""
        return self._supervised.has_ended(wait_s)

    def ends_within(self, limit_s: float) -> bool:
        """Whether the program ends by itself in the next ``limit_s``."""
        start, wait_s = time.perf_counter(), 0.0
        while not self.has_ended(wait_s):
            self.watch.look()
            elapsed_s = time.perf_counter() - start
            if elapsed_s >= limit_s:
                return False
            wait_s = min(0.01 + elapsed_s / 20, MAX_WAIT_S, limit_s - elapsed_s)
        return True

    def end(self, *, is_timed_out: bool = False) -> Finished:
        """End the program and everything that it started; one that is ``is_timed_out`` is asked to stop first."""
        wall_s = time.perf_counter() - self._start
        with closing(self._supervised) as program:
            try:
                if is_timed_out:
                    program.stop()
                    self.ends_within(GRACE_S)
            finally:
                program.end()
                self.watch.end()
            stdout, stderr = (tail.text() for tail in self._tails)
        exit_code = -signal.SIGKILL if program.exit_code is None else program.exit_code
        return Finished(exit_code, is_timed_out, wall_s, self.watch.peak_bytes, self.watch.source, stdout, stderr)


def run_program(words: Sequence[str], *, timeout_s: float, **options: Any) -> Finished:
    """Run ``words`` as a ``Program`` until it ends or after ``timeout_s``; ``options``: its arguments."""
    program, is_timed_out = Program(words, **options), False
    try:
        is_timed_out = not program.ends_within(timeout_s)
    finally:
        finished = program.end(is_timed_out=is_timed_out)
    return finished
