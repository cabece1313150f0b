"""Stage timers and memory: the cost of an update, a scene, a method."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array

GPUS = Path("/proc/driver/nvidia/gpus")  # one folder per GPU


class Timer:
    """Collects the milliseconds of each stage of the current update; ``take`` returns and resets them.

    If a GPU is in use, each stage waits for it at both ends, so that work counts in the stage that started it.

    >>> import su3d_bench as su3d
    >>> timer = su3d.Timer()
    >>> with timer.stage("match"):
    ...     pass
    >>> list(timer.take()), timer.take()
    (['match'], {})
    """

    def __init__(self) -> None:
        self._elapsed_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        synchronise_device()
        start = time.perf_counter()
        try:
            yield
        finally:
            synchronise_device()
            spent = (time.perf_counter() - start) * 1e3
            self._elapsed_ms[name] = self._elapsed_ms.get(name, 0.0) + spent

    def take(self) -> dict[str, float]:
        taken, self._elapsed_ms = self._elapsed_ms, {}
        return taken


@dataclass
class Spent:
    """Wall time of calls of a method, ``perception_ms`` of it in perception that the method requested."""

    total_ms: float = 0.0
    perception_ms: float = 0.0

    @property
    def method_ms(self) -> float:
        """The time of the method itself."""
        return max(0.0, self.total_ms - self.perception_ms)


class MethodClock:
    """The wall time of a method per part, measured around its calls; the stages that it times itself do not count.

    Perception that it requests is measured separately, only in the thread that runs the method: work of other threads
    is not subtracted.
    """

    def __init__(self) -> None:
        self._spent: dict[str, Spent] = {}
        self._running: tuple[Spent, int] | None = None

    @contextmanager
    def running(self, part: str) -> Iterator[None]:
        """The method runs inside; its time adds to ``part``."""
        spent = self._spent.setdefault(part, Spent())
        synchronise_device()
        self._running = spent, threading.get_ident()
        start = time.perf_counter()
        try:
            yield
        finally:
            synchronise_device()
            spent.total_ms += (time.perf_counter() - start) * 1e3
            self._running = None

    @contextmanager
    def perception(self) -> Iterator[None]:
        """Perception runs inside, requested by the method or not."""
        running = self._running
        if running is None or running[1] != threading.get_ident():
            yield
            return
        synchronise_device()
        start = time.perf_counter()
        try:
            yield
        finally:
            synchronise_device()
            running[0].perception_ms += (time.perf_counter() - start) * 1e3

    def take(self, part: str) -> Spent:
        """The time of ``part`` since the last call of ``take``."""
        return self._spent.pop(part, Spent())


def calibration_ms() -> float:
    """Milliseconds of a fixed workload similar to a map's update: sorting, gathering, counting.

    The cost of an update relative to this is more comparable across machines than milliseconds are.
    """
    values, keys = _calibration_arrays()
    start = time.perf_counter()
    order = np.argsort(values, kind="stable")
    np.bincount(keys[order], weights=values[order])
    return (time.perf_counter() - start) * 1e3


@cache
def _calibration_arrays() -> tuple[Float64Array, Int64Array]:
    generator = np.random.default_rng(0)
    return generator.random(60_000), generator.integers(0, 50_000, 60_000)


def synchronise_device() -> None:
    """Wait for the GPU if this process has used one; never imports torch."""
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "cuda") and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def device_memory_bytes() -> int | None:
    """Peak GPU memory of torch since ``start_memory_watch``; None if no GPU is in use."""
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "cuda") or not torch.cuda.is_initialized():
        return None
    return int(torch.cuda.max_memory_allocated())


def memory_bytes() -> int:
    """The present memory of this process (resident set)."""
    import psutil

    return int(psutil.Process().memory_info().rss)


def start_memory_watch() -> None:
    """Reset the peaks of ``peak_memory_bytes`` and ``device_memory_bytes`` to the present memory."""
    # 5 resets the peak of the resident set: proc_pid_clear_refs(5). Elsewhere the peak is that of the whole process.
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "cuda") and torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()


def peak_memory_bytes() -> int | None:
    """Peak memory of this process since ``start_memory_watch``; None if the system does not report it."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return None
    for line in status.read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return None


def hardware_line() -> str:
    """One line about the machine: processor, cores, memory, system, GPUs."""
    import psutil

    memory_gib = psutil.virtual_memory().total / 2**30
    name = processor_name()
    line = f"{name}, {os.cpu_count()} cores, {memory_gib:.0f} GiB, {platform.system()} {platform.machine()}"
    facts = [fact for file in sorted(GPUS.glob("*/information")) for fact in file.read_text().splitlines()]
    gpus = [fact.partition(":")[2].strip() for fact in facts if fact.startswith("Model:")]
    return ", ".join([line, *(f"{gpus.count(gpu)} x {gpu}" for gpu in dict.fromkeys(gpus))])


def processor_name() -> str:
    """The name of the processor with its family numbers: virtual processors differ only in these."""
    about = _first_processor()
    name = about.get("model name") or platform.processor() or "unknown processor"
    numbers = [f"{key} {about[key]}" for key in about if key in ("cpu family", "model", "stepping")]
    return f"{name} ({', '.join(numbers)})" if numbers else name


def processor_digest() -> str:
    """A digest of the processor model with its instruction sets, by which numerical kernels are selected."""
    fields = ("cpu family", "model", "stepping", "flags", "Features")
    name = _first_processor().get("model name") or platform.processor() or "unknown processor"
    kind = [platform.machine(), name, *(line for line in _cpu_info() if line.partition(":")[0].strip() in fields)]
    return hashlib.sha256("\n".join(kind).encode()).hexdigest()[:16]


def _first_processor() -> dict[str, str]:
    """What Linux reports on the first processor, by key."""
    pairs = [line.partition(":") for line in _cpu_info()]
    return {key.strip(): value.strip() for key, _, value in pairs}


def _cpu_info() -> list[str]:
    cpu_info = Path("/proc/cpuinfo")
    return cpu_info.read_text(errors="replace").split("\n\n")[0].splitlines() if cpu_info.is_file() else []
