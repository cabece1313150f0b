"""Run somebody's program and look at it from outside: time, memory of its whole process tree, what it printed."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import IO, Any

from su3d_bench.baselines.command import supervisor
from su3d_bench.baselines.command.supervisor import AFTERWARDS_S, DONE, END, STOP
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.files import file_text

SUPERVISOR = Path(supervisor.__file__)
ENDING_S = supervisor.ENDING_S + AFTERWARDS_S + 5.0  # for the supervisor to end the program, and a container
KEPT_CHARACTERS = 100_000  # of each stream, from its end: a log that a person still reads
GRACE_S = 5.0  # between asking a program to stop and ending it
MOST_WAIT_S = 0.2  # between two looks at a program; the first ones follow each other faster
CGROUPS = Path("/sys/fs/cgroup")
# Where docker's drivers (systemd, cgroupfs) put a container's peak, for both versions of cgroups.
PEAK_FILES = (
    "system.slice/docker-{id}.scope/memory.peak",
    "docker/{id}/memory.peak",
    "memory/docker/{id}/memory.max_usage_in_bytes",
    "memory/system.slice/docker-{id}.scope/memory.max_usage_in_bytes",
)


@dataclass(frozen=True)
class Finished:
    """A program that has ended; ``exit_code`` is negative where a signal ended it, as in ``subprocess``.

    ``peak_memory_bytes``: None where it was not measured; ``memory_source`` says how it was, or why not.
    """

    exit_code: int
    is_timed_out: bool
    wall_s: float
    peak_memory_bytes: int | None
    memory_source: str
    stdout: str
    stderr: str


class Watch:
    """The most memory that something held; ``look`` is called again and again while it runs.

    ``source``: how the memory was measured, or that it was not.
    """

    source = "not measured"
    peak_bytes: int | None = None

    def look(self) -> None:
        """Note what is held now."""

    def end(self) -> None:
        """End what was seen and is left running."""


class TreeWatch(Watch):
    """A process and all its descendants; pages that several share count once for each."""

    source = "resident memory of all processes together, sampled"

    def __init__(self, pid: int) -> None:
        import psutil

        self._errors: type[Exception] = psutil.Error
        self._seen: dict[int, Any] = {}
        try:
            self._root: Any = psutil.Process(pid)
        except psutil.Error:
            self._root = None

    def look(self) -> None:
        if self._root is None:
            return
        try:
            processes = [self._root, *self._root.children(recursive=True)]
        except self._errors:
            return
        together, peak = 0, self.peak_bytes or 0
        for process in processes:
            self._seen[process.pid] = process
            try:
                together += int(process.memory_info().rss)
            except self._errors:
                continue
            peak = max(peak, _own_peak_bytes(process.pid))
        self.peak_bytes = max(peak, together) or None

    def end(self) -> None:
        # Where the system has no orphans that can be adopted, or the supervisor was killed.
        for process in self._seen.values():
            try:
                if process.is_running():
                    process.kill()
            except self._errors:
                continue


def _own_peak_bytes(pid: int) -> int:
    """The peak of one process since it began its program, which no sample can miss; 0 where it is not told."""
    try:
        lines = file_text(Path(f"/proc/{pid}/status")).splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


class ContainerWatch(Watch):
    """A docker container, by the peak that its cgroup keeps; files that it caches in memory count too."""

    source = "not measured: the cgroup cannot be read here"

    def __init__(self, id_file: Path, cgroups: Path = CGROUPS) -> None:
        self._id_file = id_file
        self._cgroups = cgroups

    def look(self) -> None:
        try:
            identity = file_text(self._id_file).strip()
        except OSError:
            return
        if not identity.isalnum():
            return
        for pattern in PEAK_FILES:
            try:
                self.peak_bytes = int(file_text(self._cgroups / pattern.format(id=identity)))
            except (OSError, ValueError):
                continue
            self.source = "the container's cgroup"
            return


class _Tail(Thread):
    """Reads a stream to its end and keeps its last characters, whatever comes."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(daemon=True)
        self._stream = stream
        self._chunks: deque[bytes] = deque()
        self._n_kept = self._n_dropped = 0

    def run(self) -> None:
        # ValueError: the stream was closed because a runaway child still holds its other end.
        try:
            while chunk := os.read(self._stream.fileno(), 65536):
                self._chunks.append(chunk)
                self._n_kept += len(chunk)
                while self._n_kept - len(self._chunks[0]) >= KEPT_CHARACTERS:
                    dropped = len(self._chunks.popleft())
                    self._n_kept -= dropped
                    self._n_dropped += dropped
        except (OSError, ValueError):
            return

    def text(self) -> str:
        self.join(GRACE_S)
        kept = b"".join(list(self._chunks))
        n_dropped = self._n_dropped + max(len(kept) - KEPT_CHARACTERS, 0)
        text = kept[-KEPT_CHARACTERS:].decode("utf-8", "replace")
        return f"[{n_dropped} bytes before are left out]\n{text}" if n_dropped else text


class _Supervised:
    """A program under its supervisor, ``supervisor.py``, which ends it when this process does, however that comes."""

    def __init__(self, words: Sequence[str], folder: Path, environment: Mapping[str, str], leaving: Leaving) -> None:
        self.exit_code: int | None = None
        orders, self._orders = os.pipe()
        self._answers, answers = os.pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(SUPERVISOR), str(orders), str(answers)],
                pass_fds=(orders, answers),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # what ends this process's group leaves the supervisor to do its work
            )
        except OSError as error:
            self._close_pipes()
            raise ConfigError(f"'{sys.executable}' cannot be started: {error.strerror}") from error
        except BaseException:
            self._close_pipes()
            raise
        finally:
            os.close(orders)
            os.close(answers)
        self._said = b""
        assert self._process.stdout is not None and self._process.stderr is not None
        self.streams: tuple[IO[bytes], IO[bytes]] = (self._process.stdout, self._process.stderr)
        try:
            self.pid = self._started(words, folder, environment, leaving)
        except BaseException:
            self.close()
            raise

    def _started(self, words: Sequence[str], folder: Path, environment: Mapping[str, str], leaving: Leaving) -> int:
        order = {
            "words": list(words),
            "folder": str(folder),
            "environment": dict(environment),
            "scratch": str(leaving.scratch or ""),
            "afterwards": list(leaving.words),
        }
        with suppress(BrokenPipeError), open(self._orders, "wb", closefd=False) as pipe:
            pipe.write(json.dumps(order).encode() + b"\n")
        answer = self._answer(None) or {"error": "its supervisor was ended"}
        if "error" in answer:
            raise ConfigError(f"'{words[0]}' cannot be started: {answer['error']}")
        return int(answer["pid"])

    def has_ended(self, wait_s: float) -> bool:
        """Whether the program has ended, at the latest after ``wait_s``."""
        if self.exit_code is None and (answer := self._answer(wait_s)) is not None:
            # A supervisor that was killed has no answer, and the system has ended the program after it.
            self.exit_code = int(answer.get("exit_code", -signal.SIGKILL))
        return self.exit_code is not None

    def stop(self) -> None:
        """Ask the program to stop."""
        self._order(STOP)

    def end(self) -> None:
        """End the program and all that it started."""
        if self.exit_code is None:
            self._order(END)
            self.has_ended(ENDING_S)
        self._order(DONE)

    def close(self) -> None:
        self._close_pipes()
        for stream in self.streams:
            stream.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)

    def _close_pipes(self) -> None:
        os.close(self._orders)
        os.close(self._answers)

    def _order(self, order: bytes) -> None:
        with suppress(BrokenPipeError):
            os.write(self._orders, order)

    def _answer(self, wait_s: float | None) -> dict[str, Any] | None:
        """The next answer, empty where no supervisor is left to give one; None where none came within ``wait_s``."""
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


@dataclass(frozen=True)
class Leaving:
    """What the supervisor does where a program does not end by itself.

    ``words`` are run wherever it is ended; ``scratch`` is removed where this process is gone and cannot do it.
    """

    words: Sequence[str] = ()
    scratch: Path | None = None


def run_program(
    words: Sequence[str],
    *,
    folder: Path,
    environment: Mapping[str, str],
    timeout_s: float,
    watch_of: Callable[[int], Watch] = TreeWatch,
    leaving: Leaving | None = None,
) -> Finished:
    """Run ``words`` in ``folder`` until it ends or ``timeout_s`` is over; nothing that it started outlives the call.

    Nor this process, however that ends. ``watch_of`` makes the watch of a process id. A program that cannot be started
    is a ``ConfigError``.
    """
    start = time.perf_counter()
    with closing(_Supervised(words, folder, environment, leaving or Leaving())) as program:
        tails = [_Tail(stream) for stream in program.streams]
        for tail in tails:
            tail.start()
        watch = watch_of(program.pid)
        is_timed_out = False
        try:
            is_timed_out = not _ends_within(program, watch, start, timeout_s)
            wall_s = time.perf_counter() - start
            if is_timed_out:
                program.stop()
                _ends_within(program, watch, time.perf_counter(), GRACE_S)
        finally:
            program.end()
            watch.end()
        stdout, stderr = (tail.text() for tail in tails)
    exit_code = -signal.SIGKILL if program.exit_code is None else program.exit_code
    return Finished(exit_code, is_timed_out, wall_s, watch.peak_bytes, watch.source, stdout, stderr)


def _ends_within(program: _Supervised, watch: Watch, start: float, limit_s: float) -> bool:
    wait_s = 0.0
    while not program.has_ended(wait_s):
        watch.look()
        elapsed_s = time.perf_counter() - start
        if elapsed_s >= limit_s:
            return False
        wait_s = min(0.01 + elapsed_s / 20, MOST_WAIT_S, limit_s - elapsed_s)
    return True
