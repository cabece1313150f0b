"""Compiled loop over the points of an object; imported only when a map is made."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

ABSENT = -1


@njit(cache=True)
def voxel_means(points, origin, voxel, table, cells, means, counts):  # type: ignore[no-untyped-def]
    """Fills ``means`` with the mean point of each voxel, voxels in the order of their first points; returns how many.

    ``table`` is an empty open-addressing hash whose length is a power of two above the number of points.
    """
    size = np.uint64(len(table) - 1)
    n = 0
    for i in range(len(points)):
        x = np.int64(math.floor((points[i, 0] - origin[0]) / voxel))
        y = np.int64(math.floor((points[i, 1] - origin[1]) / voxel))
        z = np.int64(math.floor((points[i, 2] - origin[2]) / voxel))
        mixed = (
            np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
            ^ np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
            ^ np.uint64(z) * np.uint64(0x165667B19E3779F9)
        )
        slot = (mixed ^ (mixed >> np.uint64(32))) & size
        while True:
            row = table[slot]
            if row == ABSENT:
                row = n
                table[slot] = row
                cells[row, 0], cells[row, 1], cells[row, 2] = x, y, z
                n += 1
                break
            if cells[row, 0] == x and cells[row, 1] == y and cells[row, 2] == z:
                break
            slot = (slot + np.uint64(1)) & size
        for axis in range(3):
            means[row, axis] += points[i, axis]
        counts[row] += 1
    for row in range(n):
        for axis in range(3):
            means[row, axis] /= counts[row]
    return n
