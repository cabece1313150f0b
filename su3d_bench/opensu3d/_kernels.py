"""Compiled loops over points; imported only when a map is made, for numba takes its time to load.

Space is cut into voxels of side ``eps``; 2x2x2 voxels are a cell, 8x8x8 cells a block. ``table`` is an open-addressing
hash of block coordinates; ``heads[block, cell]`` starts the linked list of the cell's points, -1 where it is empty.
Distances are float64 and summed x, y, z, as a KD-tree does.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

CELLS = 512
ABSENT = -1


@njit(cache=True, inline="always")
def _slot(table, keys, bx, by, bz):  # type: ignore[no-untyped-def]
    """Where the block is in ``table``, or the free slot where it belongs."""
    size = np.uint64(len(table) - 1)
    mixed = (
        np.uint64(bx) * np.uint64(0x9E3779B97F4A7C15)
        ^ np.uint64(by) * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ np.uint64(bz) * np.uint64(0x165667B19E3779F9)
    )
    slot = (mixed ^ (mixed >> np.uint64(32))) & size
    while True:
        block = table[slot]
        if block == ABSENT or (keys[block, 0] == bx and keys[block, 1] == by and keys[block, 2] == bz):
            return slot
        slot = (slot + np.uint64(1)) & size


@njit(cache=True, inline="always")
def _local(cx, cy, cz):  # type: ignore[no-untyped-def]
    return ((cx & 7) * 8 + (cy & 7)) * 8 + (cz & 7)


@njit(cache=True, inline="always")
def _voxel(x, eps):  # type: ignore[no-untyped-def]
    return np.int64(math.floor(x / eps))


@njit(cache=True)
def rehash(table, keys, n_blocks):  # type: ignore[no-untyped-def]
    """Enters the first ``n_blocks`` blocks into an empty ``table``."""
    for block in range(n_blocks):
        table[_slot(table, keys, keys[block, 0], keys[block, 1], keys[block, 2])] = block


@njit(cache=True, inline="always")
def _occupant(points, following, head, vx, vy, vz, eps):  # type: ignore[no-untyped-def]
    """The first point of a cell's list that lies in the voxel, or ABSENT."""
    j = head
    while j != ABSENT:
        if _voxel(points[j, 0], eps) == vx and _voxel(points[j, 1], eps) == vy and _voxel(points[j, 2], eps) == vz:
            break
        j = following[j]
    return j


@njit(cache=True)
def insert(  # type: ignore[no-untyped-def]
    new_points, new_ids, start, eps, keep_density, refill, points, ids, following, keys, heads, table, counts, placed
):
    """Enters new points from ``start`` on; stops where the blocks run out and gives the point it stopped at.

    ``counts`` holds the number of points and of blocks; ``placed`` takes the map index of each point that was added
    or took over a voxel of no instance (id 0), ABSENT for the others.
    """
    for i in range(start, len(new_points)):
        x, y, z = new_points[i, 0], new_points[i, 1], new_points[i, 2]
        vx, vy, vz = _voxel(x, eps), _voxel(y, eps), _voxel(z, eps)
        cx, cy, cz = vx >> 1, vy >> 1, vz >> 1
        slot = _slot(table, keys, cx >> 3, cy >> 3, cz >> 3)
        if table[slot] == ABSENT:
            block = counts[1]
            if block == len(keys):
                return i
            keys[block, 0], keys[block, 1], keys[block, 2] = cx >> 3, cy >> 3, cz >> 3
            heads[block, :] = ABSENT
            table[slot] = block
            counts[1] += 1
        block, local = table[slot], _local(cx, cy, cz)
        target = _occupant(points, following, heads[block, local], vx, vy, vz, eps) if keep_density else ABSENT
        placed[i] = ABSENT
        if target == ABSENT:
            target = counts[0]
            following[target] = heads[block, local]
            heads[block, local] = target
            counts[0] += 1
        elif not (refill and ids[target] == 0 and new_ids[i] != 0):
            continue
        points[target, 0], points[target, 1], points[target, 2] = x, y, z
        ids[target] = new_ids[i]
        placed[i] = target
    return len(new_points)


@njit(cache=True, inline="always")
def _squared_gap(x, cell, side, eps):  # type: ignore[no-untyped-def]
    """Of one axis: squared distance from ``x`` to its own cell (side 0), the one below (1), the one above (2).

    Rounded down, so that no cell is passed over for rounding. A cell is 2 eps wide: none further can be within eps.
    """
    if side == 0:
        return 0.0
    gap = x - cell * 2 * eps if side == 1 else (cell + 1) * 2 * eps - x
    gap = max(gap * (1.0 - 1e-9) - abs(x) * 1e-15, 0.0)
    return gap * gap


@njit(cache=True)
def nearest(queries, eps, points, following, keys, heads, table, found):  # type: ignore[no-untyped-def]
    """Writes the nearest map point strictly within ``eps`` of each query into ``found``, ABSENT where there is none.

    Of equally near points the lowest index wins. Gives the number of cells that were looked into.
    """
    visited = 0
    bx, by, bz, block = np.int64(0), np.int64(0), np.int64(0), np.int32(ABSENT)
    is_known = False
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        own_x, own_y, own_z = _voxel(x, eps) >> 1, _voxel(y, eps) >> 1, _voxel(z, eps) >> 1
        best, best_squared = ABSENT, eps * eps
        for side_x in range(3):
            gap_x = _squared_gap(x, own_x, side_x, eps)
            if gap_x > best_squared:
                continue
            cx = own_x + (side_x == 2) - (side_x == 1)
            for side_y in range(3):
                gap_xy = gap_x + _squared_gap(y, own_y, side_y, eps)
                if gap_xy > best_squared:
                    continue
                cy = own_y + (side_y == 2) - (side_y == 1)
                for side_z in range(3):
                    if gap_xy + _squared_gap(z, own_z, side_z, eps) > best_squared:
                        continue
                    cz = own_z + (side_z == 2) - (side_z == 1)
                    if not is_known or cx >> 3 != bx or cy >> 3 != by or cz >> 3 != bz:
                        bx, by, bz, is_known = cx >> 3, cy >> 3, cz >> 3, True
                        block = table[_slot(table, keys, bx, by, bz)]
                    visited += 1
                    j = heads[block, _local(cx, cy, cz)] if block != ABSENT else ABSENT
                    while j != ABSENT:
                        dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                        squared = dx * dx + dy * dy + dz * dz
                        if squared < best_squared or (squared == best_squared and best != ABSENT and j < best):
                            best, best_squared = j, squared
                        j = following[j]
        found[i] = best
    return visited


@njit(cache=True)
def _count_block(block, lower, upper, points, ids, following, heads, row_of_id, found):  # type: ignore[no-untyped-def]
    for local in range(CELLS):
        j = heads[block, local]
        while j != ABSENT:
            row = row_of_id[ids[j]] if ids[j] < len(row_of_id) else ABSENT
            if row != ABSENT:
                x, y, z = points[j, 0], points[j, 1], points[j, 2]
                if lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]:
                    found[row] += 1
            j = following[j]


@njit(cache=True)
def count_inside(  # type: ignore[no-untyped-def]
    lower, upper, row_of_id, eps, points, ids, following, keys, heads, table, n_blocks, found
):
    """Adds to ``found[row_of_id[id]]`` the points of each id in the closed box; gives the number of blocks visited.

    Walks the block coordinates of the box, or the blocks themselves where they are fewer.
    """
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        first[a], last[a] = _voxel(lower[a], eps) >> 4, _voxel(upper[a], eps) >> 4
    span = last - first + 1
    if float(span[0]) * float(span[1]) * float(span[2]) > n_blocks:
        for block in range(n_blocks):
            if (
                first[0] <= keys[block, 0] <= last[0]
                and first[1] <= keys[block, 1] <= last[1]
                and first[2] <= keys[block, 2] <= last[2]
            ):
                _count_block(block, lower, upper, points, ids, following, heads, row_of_id, found)
        return n_blocks
    for bx in range(first[0], last[0] + 1):
        for by in range(first[1], last[1] + 1):
            for bz in range(first[2], last[2] + 1):
                block = table[_slot(table, keys, bx, by, bz)]
                if block != ABSENT:
                    _count_block(block, lower, upper, points, ids, following, heads, row_of_id, found)
    return span[0] * span[1] * span[2]


@njit(cache=True)
def first_of_voxel(points, labels, voxel, table, kept):  # type: ignore[no-untyped-def]
    """Writes the index of the first point of each (voxel, label) into ``kept``, in order; gives their number.

    ``table`` is an empty hash of a power-of-two size above the number of points.
    """
    size = np.uint64(len(table) - 1)
    n = 0
    for i in range(len(points)):
        vx, vy, vz = _voxel(points[i, 0], voxel), _voxel(points[i, 1], voxel), _voxel(points[i, 2], voxel)
        mixed = (
            np.uint64(vx) * np.uint64(0x9E3779B97F4A7C15)
            ^ np.uint64(vy) * np.uint64(0xC2B2AE3D27D4EB4F)
            ^ np.uint64(vz) * np.uint64(0x165667B19E3779F9)
            ^ np.uint64(labels[i]) * np.uint64(0xD6E8FEB86659FD93)
        )
        slot = (mixed ^ (mixed >> np.uint64(32))) & size
        while True:
            j = table[slot]
            if j == ABSENT:
                table[slot] = i
                kept[n] = i
                n += 1
                break
            if (
                labels[j] == labels[i]
                and _voxel(points[j, 0], voxel) == vx
                and _voxel(points[j, 1], voxel) == vy
                and _voxel(points[j, 2], voxel) == vz
            ):
                break
            slot = (slot + np.uint64(1)) & size
    return n
