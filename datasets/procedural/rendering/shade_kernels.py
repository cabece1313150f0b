"""Compiled shading: baked light and highlights on textures, pixel by pixel; and which faces are visible in an image.

Imported lazily: numba takes a second to load. The columns of a material row are those of ``Material.row``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.datasets.procedural.rendering.pattern_kernels import surface_colour

compiled: Any = njit(cache=True)
inlined: Any = njit(cache=True, inline="never")


@compiled
def shade(t_hit, primitive, uv, rays, origin, triangles, normals, texture, light,  # type: ignore[no-untyped-def]
          instance_of_triangle, material_of_triangle, materials, lights, rgb, depth, instance):  # fmt: skip
    """Fills ``rgb``, ``depth`` and ``instance`` of every pixel from the ray caster's result."""
    for i in range(t_hit.shape[0]):
        t = t_hit[i]
        if not t < 1e9:
            depth[i] = 0.0
            instance[i] = 0
            rgb[i] = 0
            continue
        triangle = primitive[i]
        i0, i1, i2 = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        b1, b2 = uv[i, 0], uv[i, 1]
        b0 = 1 - b1 - b2
        depth[i] = t
        instance[i] = instance_of_triangle[triangle]
        x, y, z = _between(texture, i0, i1, i2, b0, b1, b2)
        e1x, e1y, e1z = _difference(texture, i1, i0)
        e2x, e2y, e2z = _difference(texture, i2, i0)
        px, py, pz = abs(e1y * e2z - e1z * e2y), abs(e1z * e2x - e1x * e2z), abs(e1x * e2y - e1y * e2x)
        if pz >= px and pz >= py:
            u, v = x, y
        elif px >= py:
            u, v = y, z
        else:
            u, v = x, z
        row = materials[material_of_triangle[triangle]]
        kind, scale, gloss, glow, axis, seed = int(row[0]), row[7], row[8], row[9], int(row[10]), row[15]
        r, g, b = surface_colour(kind, x, y, z, u, v, row, scale, axis, seed)
        lr, lg, lb = _between(light, i0, i1, i2, b0, b1, b2)
        spark = np.float32(0.0)
        if gloss > 0.1:
            dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            nx, ny, nz = _between(normals, i0, i1, i2, b0, b1, b2)
            wx, wy, wz = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            spark = _highlight(nx, ny, nz, dx / length, dy / length, dz / length, wx, wy, wz, lights, gloss)
            spark *= min(1.0, 1.3 * (lr + lg + lb) / 3)
        rgb[i, 0] = _encode(r * (lr + glow) + spark)
        rgb[i, 1] = _encode(g * (lg + glow) + spark)
        rgb[i, 2] = _encode(b * (lb + glow) + spark)


@inlined
def _between(values, i0, i1, i2, b0, b1, b2):  # type: ignore[no-untyped-def]
    """The three values at a point of a triangle, from those at its vertices."""
    x = b0 * values[i0, 0] + b1 * values[i1, 0] + b2 * values[i2, 0]
    y = b0 * values[i0, 1] + b1 * values[i1, 1] + b2 * values[i2, 1]
    return x, y, b0 * values[i0, 2] + b1 * values[i1, 2] + b2 * values[i2, 2]


@inlined
def _difference(values, i, j):  # type: ignore[no-untyped-def]
    return values[i, 0] - values[j, 0], values[i, 1] - values[j, 1], values[i, 2] - values[j, 2]


@inlined
def _encode(value):  # type: ignore[no-untyped-def]
    """Linear light to sRGB 0..255 with a soft shoulder, to avoid hard clipping."""
    if value > 0.75:
        value = 0.75 + 0.25 * (1 - math.exp(-(value - 0.75) * 4))
    return np.uint8(255.0 * max(0.0, value) ** 0.4545 + 0.5)


@inlined
def _highlight(nx, ny, nz, dx, dy, dz, wx, wy, wz, lights, gloss):  # type: ignore[no-untyped-def]
    """The reflection of lights, and of the bright upper half of a room, along a unit ray at a point with a normal."""
    facing = dx * nx + dy * ny + dz * nz
    rx, ry, rz = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
    total = gloss * 0.10 * max(0.0, rz + 0.2)
    for k in range(lights.shape[0]):
        lx, ly, lz = lights[k, 0] - wx, lights[k, 1] - wy, lights[k, 2] - wz
        along, square = rx * lx + ry * ly + rz * lz, lx * lx + ly * ly + lz * lz
        if along > 0 and along * along > 0.63 * square:  # below 0.8 squared, for any rounding
            cosine = along / (math.sqrt(square) + 1e-6)
            if cosine > 0.8:
                total += gloss * 0.5 * lights[k, 3] * cosine ** (20.0 + 60.0 * gloss)
    return np.float32(total)


@compiled
def aim(directions, pose, rays):  # type: ignore[no-untyped-def]
    """Fills ``rays`` (N, 6) with origin and direction in the world."""
    for i in range(len(directions)):
        for k in range(3):
            rays[i, k] = pose[k, 3]
            rays[i, 3 + k] = (
                pose[k, 0] * directions[i, 0] + pose[k, 1] * directions[i, 1] + pose[k, 2] * directions[i, 2]
            )


NEAREST_M, GRAZING = 0.15, 0.08  # a depth camera sees nothing closer, or below this cosine
LOOSE_M, LOOSE_SHARE = 0.012, 0.012  # depth may differ by this much, and by this share of the distance over the cosine


@compiled
def aim_at_faces(  # type: ignore[no-untyped-def]
    active, n_active, centres, normals, pose, focal, cx, cy, width, height, pixel, is_hit
):
    """Fills ``pixel`` (F,) with the pixel nearest to the centre of each active face, or -1 if the face lies outside the
    image or faces away from the camera. ``is_hit`` (height * width,) marks those pixels.
    """
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    is_hit[:] = False
    for k in range(n_active):
        f = active[k]
        pixel[k] = -1
        dx, dy, dz = centres[f, 0] - ox, centres[f, 1] - oy, centres[f, 2] - oz
        if -(dx * normals[f, 0] + dy * normals[f, 1] + dz * normals[f, 2]) > 0.0:
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            if z > NEAREST_M:
                column = math.floor((dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]) / z * focal + cx + 0.5)
                row = math.floor((dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]) / z * focal + cy + 0.5)
                if 0 <= column < width and 0 <= row < height:
                    pixel[k] = row * width + column
                    is_hit[pixel[k]] = True


@compiled
def drop_seen(active, n_active, pixel, centres, normals, owner, seen, pose, depth, instance):  # type: ignore[no-untyped-def]
    """Marks in ``seen`` the active faces visible in the image; returns the number that stay active.

    ``active`` is compacted in place: seen faces are removed. A face is visible if the pixel nearest to its
    centre shows its object at its depth.
    """
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    left = 0
    for k in range(n_active):
        f = active[k]
        hit = False
        if pixel[k] >= 0 and instance[pixel[k]] == owner[f]:
            dx, dy, dz = centres[f, 0] - ox, centres[f, 1] - oy, centres[f, 2] - oz
            facing = -(dx * normals[f, 0] + dy * normals[f, 1] + dz * normals[f, 2])
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            cosine = facing / math.sqrt(dx * dx + dy * dy + dz * dz)
            loose = LOOSE_M + LOOSE_SHARE * z / max(cosine, 0.15)
            hit = cosine > GRAZING and abs(depth[pixel[k]] - z) < loose
        if hit:
            seen[f] = True
        else:
            active[left] = f
            left += 1
    return left
