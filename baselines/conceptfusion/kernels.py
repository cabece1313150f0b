"""Compiled loop of PointFusion's association; imported only when a map is created, because numba loads slowly."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.compiled import njit

ABSENT = -1
# find_active_map_points: a projection may lie this far out of the outermost pixel centres.
BEFORE_FIRST, BEFORE_LAST = -1e-3, 0.999


@njit(cache=True)
def associate(points, normals, counts, view, distance_m, least_cosine):  # type: ignore[no-untyped-def]
    """The map point that each pixel (height * width) of a ``View`` is associated with, ABSENT for none.

    One pass over all points. Of several candidates the one with the highest count wins, then the nearest, then the
    first.
    """
    camera_to_world, intrinsics, width = view.camera_to_world, view.intrinsics, view.width
    matched = np.full(view.height * width, ABSENT, np.int64)
    best_count, best_squared = np.zeros(len(matched)), np.zeros(len(matched))
    for i in range(len(counts)):
        dx = points[i, 0] - camera_to_world[0, 3]
        dy = points[i, 1] - camera_to_world[1, 3]
        dz = points[i, 2] - camera_to_world[2, 3]
        z = camera_to_world[0, 2] * dx + camera_to_world[1, 2] * dy + camera_to_world[2, 2] * dz
        if not z > 0:
            continue
        x = camera_to_world[0, 0] * dx + camera_to_world[1, 0] * dy + camera_to_world[2, 0] * dz
        y = camera_to_world[0, 1] * dx + camera_to_world[1, 1] * dy + camera_to_world[2, 1] * dz
        u = (intrinsics[0, 0] * x + intrinsics[0, 1] * y) / z + intrinsics[0, 2]
        v = intrinsics[1, 1] * y / z + intrinsics[1, 2]
        if not (BEFORE_FIRST < u < width - BEFORE_LAST and BEFORE_FIRST < v < view.height - BEFORE_LAST):
            continue
        column = min(max(int(np.rint(u)), 0), width - 1)
        row = min(max(int(np.rint(v)), 0), view.height - 1)
        pixel = row * width + column
        if not view.has_depth[pixel]:
            continue
        dx = points[i, 0] - view.points[pixel, 0]
        dy = points[i, 1] - view.points[pixel, 1]
        dz = points[i, 2] - view.points[pixel, 2]
        squared = dx * dx + dy * dy + dz * dz
        if not np.sqrt(squared) < distance_m:
            continue
        cosine = (
            normals[i, 0] * view.normals[pixel, 0]
            + normals[i, 1] * view.normals[pixel, 1]
            + normals[i, 2] * view.normals[pixel, 2]
        )
        if not cosine > least_cosine:
            continue
        if (
            matched[pixel] == ABSENT
            or counts[i] > best_count[pixel]
            or (counts[i] == best_count[pixel] and squared < best_squared[pixel])
        ):
            matched[pixel], best_count[pixel], best_squared[pixel] = i, counts[i], squared
    return matched
