"""Stage timers: how long each part of an update took."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Timer:
    """Collects the milliseconds of each stage of the current update; ``take`` hands them over and starts anew."""

    def __init__(self) -> None:
        self._elapsed_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = (time.perf_counter() - start) * 1e3
            self._elapsed_ms[name] = self._elapsed_ms.get(name, 0.0) + spent

    def take(self) -> dict[str, float]:
        taken, self._elapsed_ms = self._elapsed_ms, {}
        return taken


def hardware_line() -> str:
    """One line on the machine: processor, cores, memory, system."""
    import psutil

    memory_gib = psutil.virtual_memory().total / 2**30
    return f"{_processor()}, {os.cpu_count()} cores, {memory_gib:.0f} GiB, {platform.system()} {platform.machine()}"


def _processor() -> str:
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.is_file():
        for line in cpu_info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown processor"
