"""Compiled noise: pseudo-random numbers of integer cells, and smooth noise between them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from su3d_bench.core.compiled import njit

inlined: Any = njit(cache=True, inline="never")


@inlined
def hash01(ix, iy, iz):  # type: ignore[no-untyped-def]
    """A pseudo-random number in 0..1 for an integer cell."""
    h = np.uint32(ix * 374761393 + iy * 668265263 + iz * 2147483647 + 1274126177)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(2246822519))
    return np.float32(np.uint32(h ^ (h >> np.uint32(15)))) * np.float32(2.3283064e-10)


@inlined
def noise(x, y, z):  # type: ignore[no-untyped-def]
    """Smooth value noise in 0..1."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    low = (hash01(ix, iy, iz) * (1 - u) + hash01(ix + 1, iy, iz) * u) * (1 - v) + (
        hash01(ix, iy + 1, iz) * (1 - u) + hash01(ix + 1, iy + 1, iz) * u
    ) * v
    high = (hash01(ix, iy, iz + 1) * (1 - u) + hash01(ix + 1, iy, iz + 1) * u) * (1 - v) + (
        hash01(ix, iy + 1, iz + 1) * (1 - u) + hash01(ix + 1, iy + 1, iz + 1) * u
    ) * v
    return low * (1 - w) + high * w


A, B, C, M = 0x1E3779B97F4A7C15, 0x3F58476D1CE4E5B9, 0x14D049BB133111EB, 0x2545F4914F6CDD1D


@inlined
def _corner(h):  # type: ignore[no-untyped-def]
    h = (h ^ (h >> 31)) * M
    return float((h >> 40) & 0xFFFFFF) * 5.9604645e-8


@inlined
def noise2(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in 0..1 in a plane."""
    ix, iy = math.floor(x), math.floor(y)
    u, v, h = x - ix, y - iy, ix * A + iy * B + int(seed) * C
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    p, q = _corner(h), _corner(h + B)
    p, q = p + (_corner(h + A) - p) * u, q + (_corner(h + (A + B)) - q) * u
    return p + (q - p) * v


@inlined
def noise3(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in 0..1 in space; faster than ``noise``."""
    iz = math.floor(z)
    w, layer = z - iz, int(seed) * 31 + iz * 7
    p = noise2(x, y, layer)
    return p + (noise2(x, y, layer + 7) - p) * (w * w * (3 - 2 * w))


@inlined
def noise_at(x, y, z, foot):  # type: ignore[no-untyped-def]
    """Smooth noise in 0..1: that of the frozen rooms, drawn with ``foot`` 0, otherwise the faster one."""
    return noise3(x, y, z, 1) if foot > 0 else noise(x, y, z)


@inlined
def rough(x, y, seed):  # type: ignore[no-untyped-def]
    """Two octaves of noise in a plane, 0..1 with mean 0.5."""
    return 0.64 * noise2(x, y, seed) + 0.36 * noise2(2.7 * x, 2.7 * y, seed + 5)


@inlined
def cloudy(x, y, seed):  # type: ignore[no-untyped-def]
    """Four octaves of noise in a plane, 0..1 with mean 0.5."""
    return 0.78 * rough(x, y, seed) + 0.22 * rough(4.3 * x, 4.3 * y, seed + 9)
