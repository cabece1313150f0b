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


@inlined
def noise2(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in 0..1 in a plane, at half the cost."""
    fx, fy = math.floor(x), math.floor(y)
    ix, iy, s, u, v = int(fx), int(fy), int(seed), x - fx, y - fy
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = hash01(ix, iy, s) * (1 - u) + hash01(ix + 1, iy, s) * u
    return low * (1 - v) + (hash01(ix, iy + 1, s) * (1 - u) + hash01(ix + 1, iy + 1, s) * u) * v


@inlined
def cloudy(x, y, seed):  # type: ignore[no-untyped-def]
    """Four octaves of noise in a plane, 0..1 with mean 0.5."""
    return (
        0.53 * noise2(x, y, seed)
        + 0.27 * noise2(2.1 * x, 2.1 * y, seed + 5)
        + 0.13 * noise2(4.3 * x, 4.3 * y, seed + 9)
        + 0.07 * noise2(8.9 * x, 8.9 * y, seed + 13)
    )
