"""Compiled intersection of oriented boxes and averages of grid cells; imported only when a map is created."""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.numerics.clusters import ABSENT, slot_of

MAX_CORNERS = 16  # a rectangle cut by six planes has at most ten
COINCIDENT_M = 1e-9


@njit(cache=True)
def _cut(polygon, n, axis, side, limit, result):  # type: ignore[no-untyped-def]
    """Clips a polygon of ``n`` corners to ``side * x[axis] <= limit`` into ``result``; returns its corner count."""
    m = 0
    for k in range(n):
        here, there = polygon[k], polygon[(k + 1) % n]
        a, b = side * here[axis] - limit, side * there[axis] - limit
        if a <= 0:
            result[m] = here
            m += 1
        if (a < 0 < b) or (b < 0 < a):
            result[m] = here + (there - here) * (a / (a - b))
            m += 1
    return m


@njit(cache=True)
def _area(polygon, n, normal):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(1, n - 1):
        a, b = polygon[k] - polygon[0], polygon[k + 1] - polygon[0]
        total += normal[0] * (a[1] * b[2] - a[2] * b[1])
        total += normal[1] * (a[2] * b[0] - a[0] * b[2])
        total += normal[2] * (a[0] * b[1] - a[1] * b[0])
    return abs(total) / 2


@njit(cache=True)
def _flux(centre, rotation, half, other_half, origin, skip_coincident):  # type: ignore[no-untyped-def]
    """Flux of ``(x - origin) / 3`` through the faces of a box inside another box.

    All in the coordinates of the other box. ``skip_coincident`` skips faces that coincide with a face of the other and
    have the same normal, which would otherwise count for both boxes.
    """
    total = 0.0
    polygon, result = np.empty((MAX_CORNERS, 3)), np.empty((MAX_CORNERS, 3))
    for face in range(6):
        axis, side = face // 2, 2 * (face % 2) - 1
        normal = rotation[:, axis] * side
        middle = centre + normal * half[axis]
        coincides = False
        for k in range(3):
            sign = 1.0 if normal[k] > 0 else -1.0
            if abs(normal[k]) > 1 - COINCIDENT_M and abs(sign * middle[k] - other_half[k]) < COINCIDENT_M:
                coincides = True
        if skip_coincident and coincides:
            continue
        u = rotation[:, (axis + 1) % 3] * half[(axis + 1) % 3]
        v = rotation[:, (axis + 2) % 3] * half[(axis + 2) % 3]
        polygon[0], polygon[1], polygon[2], polygon[3] = middle - u - v, middle + u - v, middle + u + v, middle - u + v
        n = 4
        for plane in range(6):
            n = _cut(polygon, n, plane // 2, 2.0 * (plane % 2) - 1.0, other_half[plane // 2], result)
            polygon, result = result, polygon
        total += _area(polygon, n, normal) * np.sum(normal * (middle - origin))
    return total / 3


@njit(cache=True)
def intersection_volumes(centres_a, halves_a, rotations_a, centres_b, halves_b, rotations_b):  # type: ignore[no-untyped-def]
    """Intersection volumes (A, B) of boxes, by the divergence theorem over the faces of both."""
    volumes = np.zeros((len(centres_a), len(centres_b)))
    for i in range(len(centres_a)):
        a = np.ascontiguousarray(rotations_a[i])
        reach_a = np.abs(a) @ halves_a[i]
        for j in range(len(centres_b)):
            b = np.ascontiguousarray(rotations_b[j])
            apart = centres_b[j] - centres_a[i]
            if (np.abs(apart) > reach_a + np.abs(b) @ halves_b[j]).any():
                continue
            a_in_b, b_in_a = b.T.copy() @ a, a.T.copy() @ b
            from_b = -(b.T.copy() @ apart)
            volume = _flux(from_b, a_in_b, halves_a[i], halves_b[j], from_b, False)
            volume += _flux(a.T.copy() @ apart, b_in_a, halves_b[j], halves_a[i], np.zeros(3), True)
            volumes[i, j] = max(volume, 0.0)
    return volumes


@njit(cache=True)
def means_of_cells(points, origin, side):  # type: ignore[no-untyped-def]
    """The mean point (V, 3) of each cell of a grid, in the order of the cells' first points."""
    n_slots = 4
    while n_slots <= 2 * len(points):
        n_slots *= 2
    table, cells = np.full(n_slots, ABSENT, np.int32), np.empty((len(points), 3), np.int64)
    sums, counts, n = np.zeros((len(points), 3)), np.zeros(len(points), np.int64), 0
    for i in range(len(points)):
        x = np.int64(math.floor((points[i, 0] - origin[0]) / side))
        y = np.int64(math.floor((points[i, 1] - origin[1]) / side))
        z = np.int64(math.floor((points[i, 2] - origin[2]) / side))
        slot = slot_of(table, cells, x, y, z)
        if table[slot] == ABSENT:
            table[slot] = n
            cells[n, 0], cells[n, 1], cells[n, 2] = x, y, z
            n += 1
        cell = table[slot]
        for axis in range(3):
            sums[cell, axis] += points[i, axis]
        counts[cell] += 1
    return sums[:n] / counts[:n].reshape(-1, 1)
