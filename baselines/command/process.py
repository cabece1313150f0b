"""Run somebody's program and look at it from outside: time, memory of its whole process tree, what it printed."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import IO, Any

from su3d_bench.core.errors import ConfigError

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

    def end(self, *, was_stopped: bool) -> None:
        """End what is left running; ``was_stopped``: the program did not end by itself."""


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

    def end(self, *, was_stopped: bool) -> None:
        for process in self._seen.values():
            try:
                if process != self._root and process.is_running():
                    process.kill()
            except self._errors:
                continue


def _own_peak_bytes(pid: int) -> int:
    """The peak of one process since it began its program, which no sample can miss; 0 where it is not told."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


class ContainerWatch(Watch):
    """A docker container, by the peak that its cgroup keeps; files that it caches in memory count too."""

    source = "not measured: the cgroup cannot be read here"

    def __init__(self, name: str, id_file: Path, end: Callable[[str], None], cgroups: Path = CGROUPS) -> None:
        self._name = name
        self._id_file = id_file
        self._end = end
        self._cgroups = cgroups

    def look(self) -> None:
        try:
            identity = self._id_file.read_text().strip()
        except OSError:
            return
        if not identity.isalnum():
            return
        for pattern in PEAK_FILES:
            try:
                self.peak_bytes = int((self._cgroups / pattern.format(id=identity)).read_text())
            except (OSError, ValueError):
                continue
            self.source = "the container's cgroup"
            return

    def end(self, *, was_stopped: bool) -> None:
        if was_stopped:  # otherwise docker has removed it
            self._end(self._name)


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


def run_program(
    words: Sequence[str],
    *,
    folder: Path,
    environment: Mapping[str, str],
    timeout_s: float,
    watch_of: Callable[[int], Watch] = TreeWatch,
) -> Finished:
    """Run ``words`` in ``folder`` until it ends or ``timeout_s`` is over; nothing that it started outlives the call.

    ``watch_of`` makes the watch of a process id. A program that cannot be started is a ``ConfigError``.
    """
    start = time.perf_counter()
    with _started(words, folder, environment) as process:
        assert process.stdout is not None and process.stderr is not None
        tails = [_Tail(process.stdout), _Tail(process.stderr)]
        for tail in tails:
            tail.start()
        watch = watch_of(process.pid)
        is_timed_out = False
        try:
            is_timed_out = not _ends_within(process, watch, start, timeout_s)
            wall_s = time.perf_counter() - start
            if is_timed_out:
                _signal_group(process, signal.SIGTERM)
                _ends_within(process, watch, time.perf_counter(), GRACE_S)
        finally:
            was_stopped = process.returncode is None or is_timed_out
            _signal_group(process, signal.SIGKILL)
            watch.end(was_stopped=was_stopped)
            process.wait()
        stdout, stderr = (tail.text() for tail in tails)
    return Finished(process.returncode, is_timed_out, wall_s, watch.peak_bytes, watch.source, stdout, stderr)


@contextmanager
def _started(words: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    try:
        process = subprocess.Popen(
            list(words),
            cwd=folder,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a process group of its own, which can be ended as a whole
        )
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"'{words[0]}' cannot be started: {reason}") from error
    try:
        yield process
    finally:
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def _ends_within(process: subprocess.Popen[bytes], watch: Watch, start: float, limit_s: float) -> bool:
    while process.poll() is None:
        watch.look()
        elapsed_s = time.perf_counter() - start
        if elapsed_s >= limit_s:
            return False
        time.sleep(min(0.01 + elapsed_s / 20, MOST_WAIT_S, limit_s - elapsed_s))
    return True


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    # The group outlives its leader while any of its members runs, so that its number cannot be another's.
    try:
        os.killpg(process.pid, number)
    except (ProcessLookupError, PermissionError):
        return
