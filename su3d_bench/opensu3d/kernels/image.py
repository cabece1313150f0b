"""Compiled loops over the pixels of one image; imported only when a map is made, for numba takes its time to load.

Points are float64 and made by the operations of ``geometry.back_project`` in its order, so that both give the same
bits.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.numerics.cells import ABSENT, slot_of

LABEL_SHIFT = 40  # a view spans fewer voxels than 2**39, at any voxel that a depth image can fill
OWNED, BACKGROUND, DROPPED = 0, 1, 2  # what the pixels of a ring become
UNUSED = -9  # no label: those are at least ABSENT * 3 + 2


@njit(cache=True, nogil=True)
def extents(masks, areas, bounds):  # type: ignore[no-untyped-def]
    """Writes the pixels of each mask (K, H, W) uint8 and its bounds: first row, last, first column, last."""
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
    """Paints one mask (H, W) uint8 into ``ids`` and ``owner``, and a ring of ABSENT around it into ``ids``.

    ``reach[d]``: how far the ring goes along a row that lies ``d`` rows off. Each run of the mask marks where it begins
    and ends to count in the rows around it, so that a row's ring is the running sum of its marks.
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
    """Owner * 3 + rank of each pixel of a row, UNUSED where it makes no point; ranks as in ``cloud``."""
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
    """Whether each pixel of a row differs in voxel or label from those left of it and above, which came before.

    ``cells`` takes the voxels (3, W), as floats: so every step here is done for many pixels at once.
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

    ``rings``: OWNED, BACKGROUND or DROPPED. Rows come first to last; with ``voxel`` above 0 only the first point of
    each voxel, owner and rank is kept.
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
