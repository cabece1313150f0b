"""Compiled loops of OpenSU3D: over the pixels of a frame, and over the hash of voxels."""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.numerics.clusters import ABSENT, slot_of

LABEL_SHIFT = 40  # a view spans fewer than 2**39 voxels, at any voxel size that a depth image can fill
OWNED, BACKGROUND, DROPPED = 0, 1, 2  # treatment of ring pixels
UNUSED = -9  # not a label: labels are at least ABSENT * 3 + 2


@njit(cache=True, nogil=True)
def extents(masks, areas, bounds):  # type: ignore[no-untyped-def]
    """Write the pixel count of each mask (K, H, W) uint8 and its bounds: first and last row, first and last column."""
    n_masks, height, width = masks.shape
    for k in range(n_masks):
        areas[k] = 0
        top, bottom, left, right = height, -1, width, -1
        for row in range(height):
            n = 0
            for column in range(width):
                n += masks[k, row, column]
            if n == 0:
                continue
            areas[k] += n
            top, bottom = min(top, row), row
            column = 0
            while column < left and masks[k, row, column] == 0:
                column += 1
            left = min(left, column)
            column = width - 1
            while column > right and masks[k, row, column] == 0:
                column -= 1
            right = max(right, column)
        bounds[k, 0], bounds[k, 1], bounds[k, 2], bounds[k, 3] = top, bottom, left, right


@njit(cache=True, nogil=True)
def paint(mask, k, bounds, reach, ids, owner):  # type: ignore[no-untyped-def]
    """Paint one mask (H, W) uint8 into ``ids`` and ``owner``, and a ring of ABSENT around it into ``ids``.

    ``reach[d]``: half-width of the ring ``d`` rows away. Each run of the mask marks its start and end in the rows
    around it, so that the ring of a row is the running sum of its marks.
    """
    height, width = mask.shape
    border = len(reach) - 1
    top, bottom = max(bounds[0] - border, 0), min(bounds[1] + border, height - 1)
    left, right = max(bounds[2] - border, 0), min(bounds[3] + border, width - 1)
    marks = np.zeros((bottom - top + 1, right - left + 2), np.int32)
    for row in range(bounds[0], bounds[1] + 1):
        column = bounds[2]
        while column <= bounds[3]:
            if mask[row, column] == 0:
                column += 1
                continue
            first = column
            while column <= bounds[3] and mask[row, column] != 0:
                column += 1
            for other in range(max(row - border, top), min(row + border, bottom) + 1):
                by = reach[abs(other - row)]
                marks[other - top, max(first - by, left) - left] += 1
                marks[other - top, min(column - 1 + by, right) + 1 - left] -= 1
    for row in range(top, bottom + 1):
        covered = 0
        for column in range(left, right + 1):
            covered += marks[row - top, column - left]
            if mask[row, column] != 0:
                ids[row, column] = k
                owner[row, column] = k
            elif covered > 0:
                ids[row, column] = ABSENT


@njit(cache=True)
def _grown(table, keys, n):  # type: ignore[no-untyped-def]
    larger = np.full(4 * len(table), ABSENT, np.int32)
    for j in range(n):
        larger[slot_of(larger, keys, keys[j, 0], keys[j, 1], keys[j, 2])] = j
    return larger


@njit(cache=True)
def _label_row(pixels, ids, owner, rings, drop_background, labels):  # type: ignore[no-untyped-def]
    """Owner * 3 + rank of each pixel of a row, UNUSED if it gives no point; ranks as in ``cloud``."""
    for column in range(len(pixels)):
        k = owner[column]
        is_ring = k != ABSENT and ids[column] == ABSENT
        label = ABSENT * 3 + 2 if k == ABSENT or (is_ring and rings == BACKGROUND) else k * 3 + is_ring
        is_dropped = (is_ring and rings == DROPPED) or (k == ABSENT and drop_background) or not pixels[column]
        labels[column] = UNUSED if is_dropped else label


@njit(cache=True)
def _place_row(depth_m, row_part, of_column, origin, points):  # type: ignore[no-untyped-def]
    """World points (3, W) of a row of pixels."""
    for axis in range(3):
        of_row, start = row_part[axis], origin[axis]
        for column in range(len(depth_m)):
            points[axis, column] = (of_row + of_column[axis, column]) * np.float64(depth_m[column]) + start


@njit(cache=True)
def _mark_new(points, voxel, labels, above_labels, cells, above_cells, is_new):  # type: ignore[no-untyped-def]
    """Whether each pixel of a row differs in voxel or label from its left and upper neighbours, which precede it.

    ``cells`` receives the voxels (3, W) as floats, so that every step is vectorised.
    """
    width = len(labels)
    for axis in range(3):
        for column in range(width):
            cells[axis, column] = np.floor(points[axis, column] / voxel)
    for column in range(width):
        is_new[column] = (
            (labels[column] != above_labels[column])
            | (cells[0, column] != above_cells[0, column])
            | (cells[1, column] != above_cells[1, column])
            | (cells[2, column] != above_cells[2, column])
        )
    for column in range(1, width):
        is_new[column] &= (
            (labels[column] != labels[column - 1])
            | (cells[0, column] != cells[0, column - 1])
            | (cells[1, column] != cells[1, column - 1])
            | (cells[2, column] != cells[2, column - 1])
        )


@njit(cache=True, nogil=True)
def cloud(  # type: ignore[no-untyped-def]
    depth_m, pixels, of_row, of_column, origin, ids, owner, rings, drop_background, voxel
):
    """Points, owners and ranks (0 in a mask, 1 in a ring, 2 in no mask) of ``pixels``.

    ``rings``: OWNED, BACKGROUND or DROPPED. Rows are in order; with ``voxel`` above 0 only the first point per
    voxel, owner and rank is included.
    """
    height, width = depth_m.shape
    row_points = np.empty((3, width))
    row_labels, above_labels = np.empty(width, np.int32), np.full(width, UNUSED, np.int32)
    cells, above_cells = np.empty((3, width)), np.zeros((3, width))
    is_new = np.ones(width, np.bool_)
    n_pixels = np.count_nonzero(pixels)
    points, owners, ranks = np.empty((n_pixels, 3)), np.empty(n_pixels, np.int32), np.empty(n_pixels, np.int8)
    keys = np.empty((n_pixels if voxel > 0 else 0, 3), np.int64)  # voxels, the label above the bits of the first axis
    table = np.full(1 << 12, ABSENT, np.int32)
    n = 0
    for row in range(height):
        _label_row(pixels[row], ids[row], owner[row], rings, drop_background, row_labels)
        _place_row(depth_m[row], of_row[:, row], of_column, origin, row_points)
        if voxel > 0:
            _mark_new(row_points, voxel, row_labels, above_labels, cells, above_cells, is_new)
        for column in range(width):
            label = row_labels[column]
            if not is_new[column] or label == UNUSED:
                continue
            if voxel > 0:
                x = (np.int64(label) << LABEL_SHIFT) + np.int64(cells[0, column])
                y, z = np.int64(cells[1, column]), np.int64(cells[2, column])
                slot = slot_of(table, keys, x, y, z)
                if table[slot] != ABSENT:
                    continue
                if 2 * n >= len(table):
                    table = _grown(table, keys, n)
                    slot = slot_of(table, keys, x, y, z)
                table[slot] = n
                keys[n, 0], keys[n, 1], keys[n, 2] = x, y, z
            for axis in range(3):
                points[n, axis] = row_points[axis, column]
            owners[n], ranks[n] = label // 3, label % 3
            n += 1
        above_labels, row_labels = row_labels, above_labels
        above_cells, cells = cells, above_cells
    return points[:n], owners[:n], ranks[:n]


VOXELS = 512  # per block
UNKNOWN = -2
# The point that is dropped when a new one meets an occupied voxel: the scene's, the frame's, neither.
SCENE, FRAME, ALL = 0, 1, 2
# Columns of ``pairs``, one row per instance and block: the key (instance, block, 0), the points of the instance in
# the block, its next row, and the number of its rows from this one on.
N_POINTS, NEXT, N_ROWS = 3, 4, 5
STEPS = (0, -1, 1, -2, 2)  # relative to the voxel of the query, nearest first


@njit(cache=True, inline="always")
def _local(vx, vy, vz):  # type: ignore[no-untyped-def]
    return ((vx & 7) * 8 + (vy & 7)) * 8 + (vz & 7)


@njit(cache=True, inline="always")
def _voxel(x, eps):  # type: ignore[no-untyped-def]
    return np.int64(math.floor(x / eps))


@njit(cache=True)
def rehash(table, keys, n_blocks):  # type: ignore[no-untyped-def]
    """Insert the first ``n_blocks`` blocks into an empty ``table``."""
    for block in range(n_blocks):
        table[slot_of(table, keys, keys[block, 0], keys[block, 1], keys[block, 2])] = block


@njit(cache=True, inline="always")
def _tally(instance, block, n, counts, pairs, pair_table, first_pair):  # type: ignore[no-untyped-def]
    """Add ``n`` to the number of points of ``instance`` in ``block``."""
    slot = slot_of(pair_table, pairs, instance, block, 0)
    row = pair_table[slot]
    if row == ABSENT:
        row, following = counts[3], first_pair[instance]
        pairs[row, 0], pairs[row, 1], pairs[row, 2], pairs[row, N_POINTS] = instance, block, 0, 0
        pairs[row, NEXT], pairs[row, N_ROWS] = following, 1 + (pairs[following, N_ROWS] if following != ABSENT else 0)
        pair_table[slot] = first_pair[instance] = row
        counts[3] += 1
    pairs[row, N_POINTS] += n


@njit(cache=True)
def copy_pairs(old, counts, pairs, pair_table, first_pair):  # type: ignore[no-untyped-def]
    """Add those of the pairs ``old`` that have points to ``pairs``."""
    for row in range(len(old)):
        if old[row, N_POINTS] > 0:
            _tally(old[row, 0], old[row, 1], old[row, N_POINTS], counts, pairs, pair_table, first_pair)


@njit(cache=True)
def insert(  # type: ignore[no-untyped-def]
    new_points, new_ids, start, eps, density, placed, ids, born,
    counts, pairs, pair_table, first_pair, points, following, keys, heads, table,
):  # fmt: skip
    """Insert new points from ``start`` on; stop when the blocks or pairs run out and return the point reached.

    ``placed`` receives the map index of each inserted point (that of the point it replaced, if any), ABSENT for the
    others. ``counts``: the numbers of points, of blocks, of all points inserted so far and of pairs.
    """
    bx, by, bz, block = np.int64(0), np.int64(0), np.int64(0), np.int32(ABSENT)
    for i in range(start, len(new_points)):
        if counts[3] == len(pairs):
            return i
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
        old_id = ids[target] if target != ABSENT else 0
        if target == ABSENT:
            target = counts[0]
            following[target] = heads[block, local]
            heads[block, local] = target
            counts[0] += 1
        elif density == FRAME or (new_ids[i] == 0 and old_id != 0):
            continue
        if old_id != 0 and old_id != new_ids[i]:
            _tally(old_id, block, -1, counts, pairs, pair_table, first_pair)
        if new_ids[i] != 0 and old_id != new_ids[i]:
            _tally(new_ids[i], block, 1, counts, pairs, pair_table, first_pair)
        points[target, 0], points[target, 1], points[target, 2] = x, y, z
        ids[target], born[target] = new_ids[i], born_as
        placed[i] = target
    return len(new_points)


@njit(cache=True, inline="always")
def _write_gaps(x, voxel, eps, gaps):  # type: ignore[no-untyped-def]
    """Write the squared distance along one axis from ``x`` to the voxels -2 to +2 of its own into ``gaps`` (5,).

    Rounded down, so that rounding never skips a voxel: the outer ones can contain a point within eps if ``x`` is on the
    border of its voxel, up to rounding.
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
    """Write the nearest map point strictly within ``eps`` of each query into ``answer``, or ABSENT.

    The oldest of equally near points wins. Returns the number of voxels visited.
    """
    visited = 0
    gaps_x, gaps_y, gaps_z = np.empty(5), np.empty(5), np.empty(5)
    around = np.full((3, 3, 3), UNKNOWN, np.int32)  # blocks around that of the last query
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
def _count_pair(pair, lower, upper, first, last, pairs, ids, points, following, keys, heads):  # type: ignore[no-untyped-def]
    """Number of points of the pair in the closed box, which reaches from the block ``first`` to ``last``."""
    instance, block, n = pairs[pair, 0], pairs[pair, 1], pairs[pair, N_POINTS]
    x, y, z = keys[block, 0], keys[block, 1], keys[block, 2]
    if first[0] < x < last[0] and first[1] < y < last[1] and first[2] < z < last[2]:
        return n
    if n == 0 or not (first[0] <= x <= last[0] and first[1] <= y <= last[1] and first[2] <= z <= last[2]):
        return 0
    n = 0
    for local in range(VOXELS):
        j = heads[block, local]
        while j != ABSENT:
            if ids[j] == instance:
                x, y, z = points[j, 0], points[j, 1], points[j, 2]
                n += lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]
            j = following[j]
    return n


@njit(cache=True)
def count_inside(  # type: ignore[no-untyped-def]
    lower, upper, wanted, eps, inside, ids, pairs, pair_table, first_pair, points, following, keys, heads, table
):
    """Add the points of each id of ``wanted`` in the closed box to ``inside``; return the number of blocks visited.

    Iterates over the blocks of the id, or over those of the box if they are fewer. Blocks between those of the box's
    faces are inside with all points.
    """
    first, last = np.floor(lower / eps).astype(np.int64) >> 3, np.floor(upper / eps).astype(np.int64) >> 3
    span = last - first + 1
    n_in_box = float(span[0]) * float(span[1]) * float(span[2])
    visited = 0.0
    for row in range(len(wanted)):
        pair = first_pair[wanted[row]]
        n_rows = pairs[pair, N_ROWS] if pair != ABSENT else 0
        visited += min(n_rows, n_in_box)
        if n_rows <= n_in_box:
            while pair != ABSENT:
                inside[row] += _count_pair(pair, lower, upper, first, last, pairs, ids, points, following, keys, heads)
                pair = pairs[pair, NEXT]
            continue
        for x, y, z in np.ndindex(span[0], span[1], span[2]):
            block = table[slot_of(table, keys, first[0] + x, first[1] + y, first[2] + z)]
            pair = pair_table[slot_of(pair_table, pairs, wanted[row], block, 0)]  # no pair has block ABSENT
            if pair != ABSENT:
                inside[row] += _count_pair(pair, lower, upper, first, last, pairs, ids, points, following, keys, heads)
    return visited
