"""Projection of points into a depth image, and the number of pixels per mask; imported lazily."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.compiled import njit


@njit(cache=True)
def project(points, projection, depth_m, tolerance_m):  # type: ignore[no-untyped-def]
    """The pixel of each visible point, -1 for the others; ``projection`` (3, 4) maps the world to the image."""
    height, width = depth_m.shape
    pixels = np.full(len(points), -1, np.int32)
    for k in range(len(points)):
        x, y, z = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        column, row = 0, 0
        if depth != 0:
            u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
            v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
            if not (-1 < u < width and -1 < v < height):
                continue
            column, row = int(u), int(v)  # toward zero
        if abs(np.float64(depth_m[row, column]) - depth) <= tolerance_m:
            pixels[k] = row * width + column
    return pixels


@njit(cache=True)
def count_distinct(pixels, indptr, indices, n_image):  # type: ignore[no-untyped-def]
    """Number of distinct pixels of each mask, in any order of its members."""
    last_mask = np.full(n_image, -1, np.int32)
    counts = np.zeros(len(indptr) - 1, np.int64)
    for k in range(len(indptr) - 1):
        for at in range(indptr[k], indptr[k + 1]):
            pixel = pixels[indices[at]]
            if pixel >= 0 and last_mask[pixel] != k:
                last_mask[pixel] = k
                counts[k] += 1
    return counts
