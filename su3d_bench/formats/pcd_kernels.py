"""Compiled inflation of LZF; imported lazily, as numba takes a second to load."""

from __future__ import annotations

from typing import Any

from su3d_bench.core.compiled import njit

compiled: Any = njit(cache=True)


@compiled
def inflate(packed, plain):  # type: ignore[no-untyped-def]
    """Fills ``plain`` from ``packed`` and answers how many bytes it wrote; -1 where a step leaves either of them.

    Source: the format of LibLZF by Marc Lehmann: a byte below 32 begins a run of that many bytes and one, any other
    byte a repetition, its length in the upper three bits (7: one more byte adds to it), its distance in the rest.
    """
    n_packed, n_plain = len(packed), len(plain)
    at = 0
    written = 0
    while at < n_packed:
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > n_packed or written + length > n_plain:
                return -1
            for k in range(length):
                plain[written + k] = packed[at + k]
            at += length
            written += length
        else:
            length = (control >> 5) + 2
            if length == 9:
                if at >= n_packed:
                    return -1
                length += int(packed[at])
                at += 1
            if at >= n_packed:
                return -1
            distance = ((control & 31) << 8) + int(packed[at]) + 1
            at += 1
            if distance > written or written + length > n_plain:
                return -1
            for _ in range(length):
                plain[written] = plain[written - distance]
                written += 1
    return written
