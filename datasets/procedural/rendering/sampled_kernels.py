"""Compiled shading of ``SampledRenderer``: linear light of rays, with textures filtered over the area of a pixel.

Every ray is computed alone, so that results do not depend on how rays are shared among threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.datasets.procedural.materials import Texture
from su3d_bench.datasets.procedural.rendering.noise_kernels import noise3
from su3d_bench.datasets.procedural.rendering.pattern_kernels import surface_colour
from su3d_bench.datasets.procedural.rendering.shade_kernels import _between, _difference, _highlight

compiled: Any = njit(cache=True, nogil=True, error_model="numpy")
inlined: Any = njit(cache=True, inline="never")

SAMPLES = np.array([[-0.375, -0.125], [0.375, 0.125], [0.125, -0.375], [-0.125, 0.375]])  # rotated grid, in pixels
BORDER_SHIFT = 0.25  # of a sample along its border, in pixels
ALIKE = 0.03  # two of the four samples suffice if they differ less, in linear light
PLAIN, WALL, STAINS = (int(kind) for kind in (Texture.PLAIN, Texture.WALL, Texture.STAINS))
SMOOTH_COSINE = 0.92  # between the facets of a curved surface


@compiled
def mark_edges(start, stop, width, t, triangle, rays, face_normals, instance, material, is_edge):  # type: ignore[no-untyped-def]
    """Marks the pixels of rows ``start`` to ``stop`` with a neighbour on another object, material or plane."""
    for i in range(start * width, stop * width):
        column, hit = i % width, t[i] < 1e9
        f = triangle[i] if hit else 0
        nx, ny, nz = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
        height = t[i] * (nx * rays[i, 3] + ny * rays[i, 4] + nz * rays[i, 5])
        is_edge[i] = False
        for k in range(4):
            j = i + (k == 0) - (k == 1) + width * ((k == 2) - (k == 3))
            if (k == 0 and column == width - 1) or (k == 1 and column == 0) or not 0 <= j < t.shape[0]:
                continue
            g = triangle[j]
            if f == g or not (hit or t[j] < 1e9):
                continue
            if hit and t[j] < 1e9 and instance[f] == instance[g] and material[f] == material[g]:
                alike = nx * face_normals[g, 0] + ny * face_normals[g, 1] + nz * face_normals[g, 2]
                off = t[j] * (nx * rays[j, 3] + ny * rays[j, 4] + nz * rays[j, 5]) - height
                if alike > SMOOTH_COSINE and abs(off) < 0.002 * t[i] + 0.001:
                    continue
            is_edge[i] = True
            break


@compiled
def aim_at_borders(is_edge, inverse, pose, number, rays):  # type: ignore[no-untyped-def]
    """Numbers the left (0) and top (1) borders of edge pixels, and fills the rays of their samples; returns how many.

    In the order of pixels, so that neighbours follow each other; ``inverse`` is that of the intrinsics.
    """
    n, height, width = 0, number.shape[1] - 1, number.shape[2] - 1
    for row in range(height + 1):
        for column in range(width + 1):
            i = row * width + column
            here = row < height and column < width and is_edge[i]
            shift = BORDER_SHIFT if (row + column) % 2 == 0 else -BORDER_SHIFT
            for k in range(2):
                is_there = (column > 0 and row < height) if k == 0 else (row > 0 and column < width)
                if here or (is_there and is_edge[i - (1 if k == 0 else width)]):
                    u, v = (column - 0.5, row + shift) if k == 0 else (column - shift, row - 0.5)
                    x, y = u * inverse[0, 0] + inverse[0, 2], v * inverse[1, 1] + inverse[1, 2]
                    for c in range(3):
                        rays[n, c], rays[n, 3 + c] = pose[c, 3], pose[c, 0] * x + pose[c, 1] * y + pose[c, 2]
                    number[k, row, column] = n
                    n += 1
    return n


@compiled
def shade_rays(start, stop, rays, t, triangle, uv, skip, step, pixel, is_last, vertices, triangles, normals,  # type: ignore[no-untyped-def]
               texture, light, face_normals, material, rows, lights, colour, tint, onward):  # fmt: skip
    """Fills ``colour`` (N, 3) of rays ``start`` to ``stop``, and how they go on: ``tint`` (N, 3) and ray ``onward``.

    ``step`` (2, 3) is how a ray's direction changes to the pixels right and below, zero for one sample of the texture;
    ``pixel`` is the width of a sample at a distance of 1.
    ``is_last`` makes glass and mirrors opaque.
    """
    across, down = (step[0, 0], step[0, 1], step[0, 2]), (step[1, 0], step[1, 1], step[1, 2])
    is_filtered = across != (0.0, 0.0, 0.0)
    for i in range(start, stop):
        tint[i, 0] = tint[i, 1] = tint[i, 2] = 0.0
        colour[i, 0] = colour[i, 1] = colour[i, 2] = 0.0
        far = t[i]
        if skip[i] or not far < 1e9:
            continue
        f = triangle[i]
        i0, i1, i2 = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        b1, b2 = uv[i, 0], uv[i, 1]
        b0 = 1 - b1 - b2
        nx, ny, nz = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        facing = nx * dx + ny * dy + nz * dz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        row = rows[material[f]]  # a record: views of arrays are counted, with atomic operations
        x, y, z = _between(texture, i0, i1, i2, b0, b1, b2)
        e1x, e1y, e1z = _difference(texture, i1, i0)
        e2x, e2y, e2z = _difference(texture, i2, i0)
        px, py, pz = abs(e1y * e2z - e1z * e2y), abs(e1z * e2x - e1x * e2z), abs(e1x * e2y - e1y * e2x)
        plane = 2 if pz >= px and pz >= py else (0 if px >= py else 1)
        kind, n = int(row[0]), 1
        foot = far * length * pixel * length / max(abs(facing), 0.1 * length)
        gux, guy, guz, gvx, gvy, gvz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        # One sample where the texture is smooth at the scale of a pixel.
        is_smooth = kind == PLAIN or (z > 0.1 + foot and (kind == STAINS or (kind == WALL and row[10] == 0)))
        if is_filtered and not is_smooth:
            n = 4
            a, b = _difference(vertices, i1, i0), _difference(vertices, i2, i0)
            e1, e2 = (e1x, e1y, e1z), (e2x, e2y, e2z)
            gux, guy, guz = _step(a, b, e1, e2, nx, ny, nz, dx, dy, dz, facing, far, across)
            gvx, gvy, gvz = _step(a, b, e1, e2, nx, ny, nz, dx, dy, dz, facing, far, down)
        r, g, b = 0.0, 0.0, 0.0
        for k in range(n):
            su, sv = (SAMPLES[k, 0], SAMPLES[k, 1]) if n > 1 else (0.0, 0.0)
            sx, sy, sz = x + su * gux + sv * gvx, y + su * guy + sv * gvy, z + su * guz + sv * gvz
            pu, pv = (sx, sy) if plane == 2 else ((sy, sz) if plane == 0 else (sx, sz))
            kr, kg, kb = surface_colour(kind, sx, sy, sz, pu, pv, row, row[7], int(row[10]), row[15], foot)
            if k == 1 and abs(kr - r) + abs(kg - g) + abs(kb - b) < ALIKE:
                n = 2
            r, g, b = r + kr, g + kg, b + kb
            if k + 1 == n:
                break
        r, g, b = r / n, g / n, b / n
        if row[18] > 0 and foot < 0.02:
            worn = 1 + row[18] * (0.24 * noise3(x * 40.0, y * 40.0, z * 40.0, row[15]) - 0.12)
            r, g, b = r * worn, g * worn, b * worn
        lr, lg, lb = _between(light, i0, i1, i2, b0, b1, b2)
        mean = (lr + lg + lb) / 3
        gloss, glow, mirror, clear = row[8], row[9], row[16], row[17]
        fresnel = 0.04 + 0.96 * (1 - min(1.0, abs(facing) / length)) ** 5
        shine = gloss * fresnel * min(1.0, 0.7 * mean)
        spark = 0.0
        if gloss > 0.1:
            mx, my, mz = _between(normals, i0, i1, i2, b0, b1, b2)
            wx, wy, wz = rays[i, 0] + far * dx, rays[i, 1] + far * dy, rays[i, 2] + far * dz
            spark = _highlight(mx, my, mz, dx / length, dy / length, dz / length, wx, wy, wz, lights, gloss)
            spark *= min(1.0, 1.3 * mean) * (0.6 + 2.0 * fresnel)
        own = 1.0
        if not is_last and (mirror > 0 or clear > 0):
            share = mirror if mirror > 0 else clear * (1 - fresnel)
            own, white = 1.0 - max(mirror, clear), (0.8 if mirror > 0 else 0.5)
            mx, my, mz = _between(normals, i0, i1, i2, b0, b1, b2)
            into = 2 * (dx * mx + dy * my + dz * mz) if mirror > 0 else 0.0
            tint[i, 0], onward[i, 3] = share * (white + (1 - white) * r), dx - into * mx
            tint[i, 1], onward[i, 4] = share * (white + (1 - white) * g), dy - into * my
            tint[i, 2], onward[i, 5] = share * (white + (1 - white) * b), dz - into * mz
            for k in range(3):
                onward[i, k] = rays[i, k] + far * rays[i, 3 + k] + 5e-4 * onward[i, 3 + k] / length
        own *= 1 - gloss * fresnel
        colour[i, 0] = own * r * (lr + glow) + shine + spark
        colour[i, 1] = own * g * (lg + glow) + shine + spark
        colour[i, 2] = own * b * (lb + glow) + shine + spark


@compiled
def wear_off(texture, material, materials, light):  # type: ignore[no-untyped-def]
    """Multiplies ``light`` (V, 3) by the wear at 0.6 m and 0.12 m, which varies slowly enough for vertices."""
    for i in range(len(light)):
        row = materials[material[i]]
        if row[18] > 0:
            x, y, z = texture[i, 0], texture[i, 1], texture[i, 2]
            large = noise3(x * 1.7, y * 1.7, z * 1.7, row[15])
            middle = noise3(x * 8.3, y * 8.3, z * 8.3, row[15])
            worn = 1 + row[18] * ((0.78 + 0.44 * large) * (0.84 + 0.32 * middle) - 1)
            hue = 0.07 * row[18] * (middle + large - 1)
            light[i, 0] *= worn * (1 + hue)
            light[i, 1] *= worn
            light[i, 2] *= worn * (1 - hue)


@inlined
def _step(a, b, e1, e2, nx, ny, nz, dx, dy, dz, facing, far, turn):  # type: ignore[no-untyped-def]
    """Change of the texture coordinates on a triangle's plane if a ray's direction changes by ``turn``.

    ``a`` and ``b`` are two edges of the triangle, ``e1`` and ``e2`` the same in texture coordinates.
    """
    lean = turn[0] * nx + turn[1] * ny + turn[2] * nz
    lean /= facing if abs(facing) > 1e-3 else 1e-3
    wx, wy, wz = far * (turn[0] - lean * dx), far * (turn[1] - lean * dy), far * (turn[2] - lean * dz)
    ax, ay, az = a
    bx, by, bz = b
    aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    wa, wb = wx * ax + wy * ay + wz * az, wx * bx + wy * by + wz * bz
    scale = 1.0 / max(aa * bb - ab * ab, 1e-20)
    u, v = (wa * bb - wb * ab) * scale, (wb * aa - wa * ab) * scale
    return u * e1[0] + v * e2[0], u * e1[1] + v * e2[1], u * e1[2] + v * e2[2]


CODES = 4096  # entries of the table of encoded values, by the square root of linear light up to 16


@compiled
def encode(start, stop, width, colour, is_edge, number, samples, gain, codes, t, triangle, instance, rgb, depth, ids):  # type: ignore[no-untyped-def]
    """Fills ``rgb``, ``depth`` and ``ids`` of rows ``start`` to ``stop``; an edge has the mean of its four samples."""
    for row in range(start, stop):
        for column in range(width):
            i = row * width + column
            hit = t[i] < 1e9
            depth[i], ids[i] = t[i] if hit else 0.0, instance[triangle[i]] if hit else 0
            for k in range(3):
                value = colour[i, k]
                if is_edge[i]:
                    value = samples[number[0, row, column], k] + samples[number[0, row, column + 1], k]
                    value += samples[number[1, row, column], k]
                    value = (value + samples[number[1, row + 1, column], k]) / np.float32(4)
                rgb[i, k] = codes[min(CODES - 1, int(math.sqrt(max(value * gain, 0.0)) * (CODES / 4)))]
