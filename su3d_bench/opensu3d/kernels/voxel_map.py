"""Compiled loops over points; imported only when a map is made, for numba takes its time to load.

Space is cut into voxels of side ``eps``; 8x8x8 voxels are a block. ``table`` is an open-addressing hash of block
coordinates; ``heads[block, voxel]`` starts the linked list of the voxel's points, the newest first, -1 where it is
empty. ``born`` numbers points in the order in which they came. Distances are float64 and summed x, y, z, as a KD-tree
does.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.numerics.cells import ABSENT, slot_of

VOXELS = 512  # of a block
UNKNOWN = -2
SCENE, FRAME, ALL = 0, 1, 2  # which point goes where a new one meets a held voxel: the scene's, the frame's, none
STEPS = (0, -1, 1, -2, 2)  # from a query's own voxel, the nearest first


@njit(cache=True, inline="always")
def _local(vx, vy, vz):  # type: ignore[no-untyped-def]
    return ((vx & 7) * 8 + (vy & 7)) * 8 + (vz & 7)


@njit(cache=True, inline="always")
def _voxel(x, eps):  # type: ignore[no-untyped-def]
    return np.int64(math.floor(x / eps))


@njit(cache=True)
def rehash(table, keys, n_blocks):  # type: ignore[no-untyped-def]
    """Enters the first ``n_blocks`` blocks into an empty ``table``."""
    for block in range(n_blocks):
        table[slot_of(table, keys, keys[block, 0], keys[block, 1], keys[block, 2])] = block


@njit(cache=True)
def insert(  # type: ignore[no-untyped-def]
    new_points, new_ids, start, eps, density, placed, counts, ids, born, points, following, keys, heads, table
):
    """Enters new points from ``start`` on; stops where the blocks run out and gives the point it stopped at.

    ``counts`` holds the number of points, of blocks and of all points that ever came; ``placed`` takes the map index
    of each point that was entered, that of a point that went where it took its place, ABSENT for the others.
    """
    bx, by, bz, block = np.int64(0), np.int64(0), np.int64(0), np.int32(ABSENT)
    for i in range(start, len(new_points)):
        x, y, z = new_points[i, 0], new_points[i, 1], new_points[i, 2]
        vx, vy, vz = _voxel(x, eps), _voxel(y, eps), _voxel(z, eps)
        if block == ABSENT or vx >> 3 != bx or vy >> 3 != by or vz >> 3 != bz:
            bx, by, bz = vx >> 3, vy >> 3, vz >> 3
            slot = slot_of(table, keys, bx, by, bz)
            if table[slot] == ABSENT:
                new_block = counts[1]
                if new_block == len(keys):
                    return i
                keys[new_block, 0], keys[new_block, 1], keys[new_block, 2] = bx, by, bz
                heads[new_block, :] = ABSENT
                table[slot] = new_block
                counts[1] += 1
            block = table[slot]
        local = _local(vx, vy, vz)
        target = heads[block, local] if density != ALL else ABSENT
        placed[i] = ABSENT
        born_as = counts[2]
        counts[2] += 1
        if target == ABSENT:
            target = counts[0]
            following[target] = heads[block, local]
            heads[block, local] = target
            counts[0] += 1
        elif density == FRAME or (new_ids[i] == 0 and ids[target] != 0):
            continue
        points[target, 0], points[target, 1], points[target, 2] = x, y, z
        ids[target], born[target] = new_ids[i], born_as
        placed[i] = target
    return len(new_points)


@njit(cache=True, inline="always")
def _write_gaps(x, voxel, eps, gaps):  # type: ignore[no-untyped-def]
    """Of one axis: squared distance from ``x`` to the voxels 2 below to 2 above its own, into ``gaps`` (5,).

    Rounded down, so that no voxel is passed over for rounding: the second ones can hold a point within eps where ``x``
    lies on the border of its voxel, up to rounding.
    """
    slack = abs(x) * 1e-15
    below, above = x - voxel * eps, (voxel + 1) * eps - x
    for steps in range(2):
        near = max((below + steps * eps) * (1.0 - 1e-9) - slack, 0.0)
        far = max((above + steps * eps) * (1.0 - 1e-9) - slack, 0.0)
        gaps[1 - steps] = near * near
        gaps[3 + steps] = far * far
    gaps[2] = 0.0


@njit(cache=True, nogil=True)
def nearest(queries, eps, answer, born, points, following, keys, heads, table):  # type: ignore[no-untyped-def]
    """Writes the nearest map point strictly within ``eps`` of each query into ``answer``, ABSENT where there is none.

    Of equally near points the one that came first wins. Gives the number of voxels that were looked into.
    """
    visited = 0
    gaps_x, gaps_y, gaps_z = np.empty(5), np.empty(5), np.empty(5)
    around = np.full((3, 3, 3), UNKNOWN, np.int32)  # the blocks about that of the last query
    mx, my, mz = np.int64(0), np.int64(0), np.int64(0)
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        own_x, own_y, own_z = _voxel(x, eps), _voxel(y, eps), _voxel(z, eps)
        if own_x >> 3 != mx or own_y >> 3 != my or own_z >> 3 != mz:
            mx, my, mz = own_x >> 3, own_y >> 3, own_z >> 3
            around[:] = UNKNOWN
        _write_gaps(x, own_x, eps, gaps_x)
        _write_gaps(y, own_y, eps, gaps_y)
        _write_gaps(z, own_z, eps, gaps_z)
        best, best_squared = ABSENT, eps * eps
        for step_x in STEPS:
            gap_x = gaps_x[step_x + 2]
            if gap_x > best_squared:
                continue
            vx = own_x + step_x
            for step_y in STEPS:
                gap_xy = gap_x + gaps_y[step_y + 2]
                if gap_xy > best_squared:
                    continue
                vy = own_y + step_y
                for step_z in STEPS:
                    if gap_xy + gaps_z[step_z + 2] > best_squared:
                        continue
                    vz = own_z + step_z
                    visited += 1
                    nx, ny, nz = (vx >> 3) - mx + 1, (vy >> 3) - my + 1, (vz >> 3) - mz + 1
                    block = around[nx, ny, nz]
                    if block == UNKNOWN:
                        block = table[slot_of(table, keys, vx >> 3, vy >> 3, vz >> 3)]
                        around[nx, ny, nz] = block
                    j = heads[block, _local(vx, vy, vz)] if block != ABSENT else ABSENT
                    while j != ABSENT:
                        dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                        squared = dx * dx + dy * dy + dz * dz
                        if squared < best_squared or (
                            squared == best_squared and best != ABSENT and born[j] < born[best]
                        ):
                            best, best_squared = j, squared
                        j = following[j]
        answer[i] = best
    return visited


@njit(cache=True)
def _count_block(block, lower, upper, points, ids, following, heads, row_of_id, counts):  # type: ignore[no-untyped-def]
    for local in range(VOXELS):
        j = heads[block, local]
        while j != ABSENT:
            row = row_of_id[ids[j]] if ids[j] < len(row_of_id) else ABSENT
            if row != ABSENT:
                x, y, z = points[j, 0], points[j, 1], points[j, 2]
                if lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]:
                    counts[row] += 1
            j = following[j]


@njit(cache=True)
def count_inside(  # type: ignore[no-untyped-def]
    lower, upper, row_of_id, eps, n_blocks, counts, ids, points, following, keys, heads, table
):
    """Adds to ``counts[row_of_id[id]]`` the points of each id in the closed box; gives the number of blocks visited.

    Walks the block coordinates of the box, or the blocks themselves where they are fewer.
    """
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        first[a], last[a] = _voxel(lower[a], eps) >> 3, _voxel(upper[a], eps) >> 3
    span = last - first + 1
    if float(span[0]) * float(span[1]) * float(span[2]) > n_blocks:
        for block in range(n_blocks):
            if (
                first[0] <= keys[block, 0] <= last[0]
                and first[1] <= keys[block, 1] <= last[1]
                and first[2] <= keys[block, 2] <= last[2]
            ):
                _count_block(block, lower, upper, points, ids, following, heads, row_of_id, counts)
        return n_blocks
    for bx in range(first[0], last[0] + 1):
        for by in range(first[1], last[1] + 1):
            for bz in range(first[2], last[2] + 1):
                block = table[slot_of(table, keys, bx, by, bz)]
                if block != ABSENT:
                    _count_block(block, lower, upper, points, ids, following, heads, row_of_id, counts)
    return span[0] * span[1] * span[2]
