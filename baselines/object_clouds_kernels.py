"""Compiled loops over the points of an object; imported only when a map is made.

``table`` is an open-addressing hash of cells of a grid, empty where it holds ABSENT; its length is a power of two above
the number of points.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.cell_kernels import ABSENT, slot_of
from su3d_bench.kernels import njit

NOISE = -1


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


@njit(cache=True)
def _cells_around(table, cells, n_cells):  # type: ignore[no-untyped-def]
    """The 27 cells (n_cells, 27) at and around each cell, ABSENT where there is none."""
    around = np.full((n_cells, 27), ABSENT, np.int32)
    for cell in range(n_cells):
        for k in range(27):
            x, y, z = cells[cell, 0] + k // 9 - 1, cells[cell, 1] + k // 3 % 3 - 1, cells[cell, 2] + k % 3 - 1
            around[cell, k] = table[slot_of(table, cells, x, y, z)]
    return around


@njit(cache=True, inline="always")
def _is_near(points, i, j, squared):  # type: ignore[no-untyped-def]
    dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return dx * dx + dy * dy + dz * dz < squared


@njit(cache=True)
def density_labels(points, eps, min_points, table, cells, cell_of_point, n_cells):  # type: ignore[no-untyped-def]
    """DBSCAN's cluster (N,) of each point, NOISE for none; neighbours are nearer than ``eps``, cells as wide as it.

    Clusters are numbered by their first core point; a point at the rim of two belongs to the lower one.
    """
    n, squared = len(points), eps * eps
    starts = np.zeros(n_cells + 1, np.int64)
    for i in range(n):
        starts[cell_of_point[i] + 1] += 1
    starts = np.cumsum(starts)
    members, filled = np.empty(n, np.int64), starts[:-1].copy()
    for i in range(n):
        members[filled[cell_of_point[i]]] = i
        filled[cell_of_point[i]] += 1
    around = _cells_around(table, cells, n_cells)
    is_core = np.zeros(n, np.bool_)
    for i in range(n):
        found = 0
        for cell in around[cell_of_point[i]]:
            if cell == ABSENT or found >= min_points:
                continue
            for k in range(starts[cell], starts[cell + 1]):
                if _is_near(points, i, members[k], squared):
                    found += 1
        is_core[i] = found >= min_points
    labels, waiting, label = np.full(n, NOISE, np.int64), np.empty(n, np.int64), 0
    for seed in range(n):
        if labels[seed] != NOISE or not is_core[seed]:
            continue
        labels[seed] = label
        waiting[0] = seed
        n_waiting = 1
        while n_waiting:
            n_waiting -= 1
            i = waiting[n_waiting]
            for cell in around[cell_of_point[i]]:
                if cell == ABSENT:
                    continue
                for k in range(starts[cell], starts[cell + 1]):
                    j = members[k]
                    if labels[j] == NOISE and _is_near(points, i, j, squared):
                        labels[j] = label
                        if is_core[j]:
                            waiting[n_waiting] = j
                            n_waiting += 1
        label += 1
    return labels
