"""How much memory this process has taken and at most may take."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def bounded_addresses(most_bytes: int) -> Iterator[None]:
    """No more than ``most_bytes`` of address space beyond what is taken now; what asks for more gets a MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def reset_peak() -> int:
    """The resident memory now, from which the peak is counted afresh."""
    Path("/proc/self/clear_refs").write_text("5")  # proc(5): resets the peak of the resident set
    return _status("VmRSS")


def peak_bytes() -> int:
    """The largest resident memory since the peak was reset."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _status(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise KeyError(key)
