"""Compiled loops over the points of an object; imported only when a map is made.

``table`` is an open-addressing hash of cells of a grid, empty where it holds ABSENT; its length is a power of two above
the number of points.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.numerics.cells import ABSENT, slot_of
from su3d_bench.numerics.compiled import njit


@njit(cache=True)
def cells_of(points, origin, side, table, cells, cell_of_point):  # type: ignore[no-untyped-def]
    """Fills ``cell_of_point`` and the coordinates ``cells``, in the order of their first points; returns how many."""
    n = 0
    for i in range(len(points)):
        x = np.int64(math.floor((points[i, 0] - origin[0]) / side))
        y = np.int64(math.floor((points[i, 1] - origin[1]) / side))
        z = np.int64(math.floor((points[i, 2] - origin[2]) / side))
        slot = slot_of(table, cells, x, y, z)
        if table[slot] == ABSENT:
            table[slot] = n
            cells[n, 0], cells[n, 1], cells[n, 2] = x, y, z
            n += 1
        cell_of_point[i] = table[slot]
    return n


@njit(cache=True)
def means(points, cell_of_point, n_cells):  # type: ignore[no-untyped-def]
    """The mean point (n_cells, 3) of each cell."""
    sums, counts = np.zeros((n_cells, 3)), np.zeros(n_cells, np.int64)
    for i in range(len(points)):
        cell = cell_of_point[i]
        for axis in range(3):
            sums[cell, axis] += points[i, axis]
        counts[cell] += 1
    for cell in range(n_cells):
        for axis in range(3):
            sums[cell, axis] /= counts[cell]
    return sums
