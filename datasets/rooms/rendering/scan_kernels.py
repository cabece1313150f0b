"""Compiled test of which small faces a posed depth image shows; imported lazily, as numba takes a second to load."""

from __future__ import annotations

import math
from typing import Any

from su3d_bench.core.compiled import njit

compiled: Any = njit(cache=True)

NEAREST_M, GRAZING = 0.15, 0.08  # closer, or flatter than this cosine, a depth camera sees nothing
LOOSE_M, LOOSE_SHARE = 0.012, 0.012  # depth may differ by this much, and by this share of the distance over the cosine


@compiled
def drop_seen(  # type: ignore[no-untyped-def]
    active, n_active, centres, normals, owner, seen, pose, focal, cx, cy, depth, instance
):
    """Marks in ``seen`` the active faces that the image shows; answers how many stay active.

    ``active`` is compacted in place: what is seen once leaves it. A face is shown where the pixel nearest to its
    centre holds its own object at its depth.
    """
    height, width = depth.shape
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    left = 0
    for k in range(n_active):
        f = active[k]
        dx, dy, dz = centres[f, 0] - ox, centres[f, 1] - oy, centres[f, 2] - oz
        facing = -(dx * normals[f, 0] + dy * normals[f, 1] + dz * normals[f, 2])
        hit = False
        if facing > 0.0:
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            if z > NEAREST_M:
                column = math.floor((dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]) / z * focal + cx + 0.5)
                row = math.floor((dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]) / z * focal + cy + 0.5)
                if 0 <= column < width and 0 <= row < height and instance[row, column] == owner[f]:
                    cosine = facing / math.sqrt(dx * dx + dy * dy + dz * dz)
                    loose = LOOSE_M + LOOSE_SHARE * z / max(cosine, 0.15)
                    hit = cosine > GRAZING and abs(depth[row, column] - z) < loose
        if hit:
            seen[f] = True
        else:
            active[left] = f
            left += 1
    return left
