"""Compiled nearest-neighbour search in a grid; imported only when clouds are matched, because numba loads slowly.

Points are in buckets of one or several cells of side ``cell``: bucket b contains the points
``order[starts[b]:starts[b + 1]]``, ascending, their coordinates side by side in ``members``.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.compiled import njit

# A cell is searched even if it is this much beyond the best distance, because float32 distances are rounded.
SLACK = 1.0 + 1e-5


@njit(cache=True, inline="always")
def _bucket(cx, cy, cz, n_buckets):  # type: ignore[no-untyped-def]
    mixed = (
        np.uint64(cx) * np.uint64(0x9E3779B97F4A7C15)
        ^ np.uint64(cy) * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ np.uint64(cz) * np.uint64(0x165667B19E3779F9)
    )
    return np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(n_buckets - 1))


@njit(cache=True, inline="always")
def _cell(x, cell):  # type: ignore[no-untyped-def]
    return np.int64(math.floor(np.float64(x) / cell))


@njit(cache=True)
def fill(points, cell, starts, order, members):  # type: ignore[no-untyped-def]
    """Sorts ``points`` into the buckets; ``starts`` is zero and one longer than the buckets, a power of two."""
    n_buckets = len(starts) - 1
    bucket = np.empty(len(points), np.int64)
    for i in range(len(points)):
        bucket[i] = _bucket(_cell(points[i, 0], cell), _cell(points[i, 1], cell), _cell(points[i, 2], cell), n_buckets)
        starts[bucket[i] + 1] += 1
    for b in range(n_buckets):
        starts[b + 1] += starts[b]
    cursor = starts[:-1].copy()
    for i in range(len(points)):
        place = cursor[bucket[i]]
        cursor[bucket[i]] += 1
        order[place] = i
        members[place] = points[i]


@njit(cache=True, inline="always")
def _gap(x, c, own, cell):  # type: ignore[no-untyped-def]
    """Squared distance along one axis from ``x`` to cell ``c``; 0 inside."""
    gap = 0.0
    if c < own:
        gap = x - (c + 1) * cell
    elif c > own:
        gap = c * cell - x
    return max(gap, 0.0) ** 2


@njit(cache=True)
def nearest(queries, cap, cell, starts, order, members, lower, upper, index, squared):  # type: ignore[no-untyped-def]
    """Writes the nearest point of each query and its squared distance (float32, summed x, y, z), the lowest index in
    a tie; -1 if none is within ``cap``, up to rounding.

    The cells around a query are visited in shells, until no nearer point can be further out.
    """
    n_buckets = len(starts) - 1
    for i in range(len(queries)):
        index[i] = -1
        best = np.float32(np.inf)
        limit = (cap * SLACK) ** 2
        x, y, z = np.float64(queries[i, 0]), np.float64(queries[i, 1]), np.float64(queries[i, 2])
        reach = cap * SLACK
        if (
            x < lower[0] - reach or y < lower[1] - reach or z < lower[2] - reach
            or x > upper[0] + reach or y > upper[1] + reach or z > upper[2] + reach
        ):  # fmt: skip
            squared[i] = best
            continue
        own_x, own_y, own_z = _cell(x, cell), _cell(y, cell), _cell(z, cell)
        shell = 0
        while shell <= 1 or ((shell - 1) * cell) ** 2 <= limit:
            for cx in range(own_x - shell, own_x + shell + 1):
                gap_x = _gap(x, cx, own_x, cell)
                if gap_x > limit:
                    continue
                for cy in range(own_y - shell, own_y + shell + 1):
                    gap_xy = gap_x + _gap(y, cy, own_y, cell)
                    if gap_xy > limit:
                        continue
                    is_side = abs(cx - own_x) == shell or abs(cy - own_y) == shell
                    step = 1 if is_side else 2 * shell
                    for cz in range(own_z - shell, own_z + shell + 1, step):
                        if gap_xy + _gap(z, cz, own_z, cell) > limit:
                            continue
                        b = _bucket(cx, cy, cz, n_buckets)
                        for place in range(starts[b], starts[b + 1]):
                            dx = queries[i, 0] - members[place, 0]
                            dy = queries[i, 1] - members[place, 1]
                            dz = queries[i, 2] - members[place, 2]
                            distance = dx * dx + dy * dy + dz * dz
                            if distance < best or (distance == best and order[place] < index[i]):
                                best = distance
                                index[i] = order[place]
                                limit = min(limit, np.float64(best) * SLACK + 1e-12)
            shell += 1
        squared[i] = best
