"""Damaged copies of a file, and a check that a reader meets each with a typed error, soon and in little memory."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterator

import numpy as np

from su3d_bench.core.errors import DataError, Su3dError

N_DAMAGES = 2_000
MOST_SECONDS = 20.0  # one read of a small file; generous, for a busy machine, yet no endless loop passes
MOST_BYTES = 256 << 20


def truncations(content: bytes) -> Iterator[bytes]:
    """Every proper beginning of ``content``."""
    for end in range(len(content)):
        yield content[:end]


def damages(content: bytes, n: int = N_DAMAGES, seed: int = 0) -> Iterator[bytes]:
    """``n`` copies with random damage: bytes flipped, set to extremes, runs cut out, doubled or overwritten."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        damaged = bytearray(content)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(len(damaged))) if damaged else 0
            end = min(len(damaged), at + int(rng.choice([1, 1, 2, 4, 8, 64])))
            kind = int(rng.integers(5))
            if kind == 0:
                damaged[at:end] = rng.bytes(end - at)
            elif kind == 1:
                damaged[at:end] = bytes([int(rng.choice([0, 0x7F, 0x80, 0xFF]))]) * (end - at)
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
    """How many copies were read and how many refused; fails on any other error, and where time or memory run away.

    Each refusal must be one ``refusal`` of one line that holds ``must_name``, the name of the file.
    """
    n_read = n_refused = 0
    tracemalloc.start()
    try:
        for damaged in copies:
            tracemalloc.reset_peak()
            started = time.monotonic()
            try:
                read(damaged)
                n_read += 1
            except refusal as error:
                message = str(error)
                assert must_name in message, message
                assert "\n" not in message and len(message) < 600, message
                n_refused += 1
            assert time.monotonic() - started < MOST_SECONDS
            assert tracemalloc.get_traced_memory()[1] < MOST_BYTES
    finally:
        tracemalloc.stop()
    return n_read, n_refused
