"""Damaged copies of a file, and a check that a reader rejects each with a typed error, quickly and in little memory.

The peak memory of this process is measured and limited here.
"""

from __future__ import annotations

import os
import resource
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, Su3dError

N_DAMAGES = int(os.environ.get("SU3D_DAMAGES", "400"))  # per file; make proofs uses 2,000
MAX_SECONDS = 20.0  # one read of a small file; generous, for a busy machine, but no infinite loop passes
MAX_BYTES = 256 << 20  # of memory, used or only reserved, beyond that before the first read
LENGTHS = (1, 1, 2, 4, 8, 64)
EXTREMES = (0, 0x7F, 0x80, 0xFF)


def truncations(content: bytes) -> Iterator[bytes]:
    """Every proper prefix of ``content``."""
    for end in range(len(content)):
        yield content[:end]


def damages(content: bytes, n: int = N_DAMAGES, seed: int = 0) -> Iterator[bytes]:
    """``n`` copies with random damage: bytes flipped or set to extremes, ranges removed, doubled or overwritten."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        damaged = bytearray(content)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(len(damaged))) if damaged else 0
            end = min(len(damaged), at + LENGTHS[int(rng.integers(len(LENGTHS)))])
            kind = int(rng.integers(5))
            if kind == 0:
                damaged[at:end] = rng.bytes(end - at)
            elif kind == 1:
                damaged[at:end] = bytes([EXTREMES[int(rng.integers(len(EXTREMES)))]]) * (end - at)
            elif kind == 2:
                del damaged[at:end]
            elif kind == 3:
                damaged[at:at] = damaged[at:end]
            elif damaged:
                damaged[at] ^= 1 << int(rng.integers(8))
        yield bytes(damaged)


def outcomes(
    read: Callable[[bytes], object],
    copies: Iterator[bytes],
    *,
    must_name: str,
    refusal: type[Su3dError] = DataError,
) -> tuple[int, int]:
    """How many copies were read and how many rejected; fails on any other error, or if time or memory is exceeded.

    Each rejection must be a one-line ``refusal`` that contains ``must_name``, the name of the file.
    """
    n_read = n_refused = 0
    with bounded_addresses(MAX_BYTES):
        before = reset_peak()
        for damaged in copies:
            started = time.monotonic()
            try:
                read(damaged)
                n_read += 1
            except refusal as error:
                assert_fit(error, must_name)
                n_refused += 1
            assert time.monotonic() - started < MAX_SECONDS
            assert peak_bytes() - before < MAX_BYTES
    return n_read, n_refused


def assert_fit(error: Su3dError, must_name: str) -> None:
    message = str(error)
    assert must_name in message and "\n" not in message and len(message) < 600, message
    assert not lacked_memory(error), message


def lacked_memory(error: BaseException | None) -> bool:
    """Whether a reader reported its own lack of memory as damage."""
    return error is not None and (isinstance(error, MemoryError) or lacked_memory(error.__context__))


def facts(value: Any) -> Any:
    """A value with the types of all its parts."""
    if is_dataclass(value) or isinstance(value, dict):
        return [(key, facts(one)) for key, one in (value if isinstance(value, dict) else vars(value)).items()]
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape, value.tolist()
    return type(value), [facts(one) for one in value] if isinstance(value, list | tuple) else value


def assert_same(ours: Any, theirs: Any) -> None:
    assert facts(ours) == facts(theirs)


@contextmanager
def bounded_addresses(max_bytes: int) -> Iterator[None]:
    """At most ``max_bytes`` of address space beyond current use; larger requests raise MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + max_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def traced(max_bytes: int) -> Iterator[None]:
    """The block must end, in any way, with less than ``max_bytes`` allocated at any time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < max_bytes
    finally:
        tracemalloc.stop()


def reset_peak() -> int:
    """The current resident memory; resets the peak."""
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
