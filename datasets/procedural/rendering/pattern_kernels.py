"""Compiled procedural textures: the colour of a surface before lighting, one pixel at a time.

Texture numbers are those of ``materials.Texture``, the columns of a material row those of
``Material.row``.
"""

from __future__ import annotations

import math
from typing import Any

from su3d_bench.core.compiled import njit
from su3d_bench.datasets.procedural.rendering.home_patterns import home_colour
from su3d_bench.datasets.procedural.rendering.noise_kernels import hash01, noise, noise3, noise_at

inlined: Any = njit(cache=True, inline="never")


FIBRE_M = 1 / 170  # width of a fibre of wood


@inlined
def _wood(x, y, z, scale, axis, seed, foot):  # type: ignore[no-untyped-def]
    """``foot`` above 0, the width of a pixel in m: with faster noise, and fibres fade where they are thinner."""
    if axis == 1:
        x, y = y, x
    elif axis == 2:
        x, z = z, x
    rings = (y + z * 1.3) / (2.2 * scale) + 3.6 * noise_at(x * 1.9 + seed, y * 7.0, z * 7.0, foot)
    grain = 0.5 + 0.5 * math.sin(6.2832 * rings)
    fibre = 0.5
    if foot == 0:
        fibre = noise(x * 9.0 + seed, y * 170.0, z * 170.0)
    elif foot < FIBRE_M:
        fibre += (noise3(x * 9.0 + seed, y * 170.0, z * 170.0, 2) - 0.5) * (1.0 - foot / FIBRE_M)
    return 0.42 * grain * grain + 0.5 * fibre


@inlined
def _pattern(kind, u, v, scale, axis, seed):  # type: ignore[no-untyped-def]
    """Share of the second colour, for patterns in the plane of a face."""
    if kind == 5:  # stripes
        s = (u if axis == 0 else v) / scale
        return 1.0 if s - math.floor(s) < 0.42 else 0.0
    if kind == 6:  # checks
        a, b = u / scale * 0.8, v / scale * 0.8
        a, b = a - math.floor(a) < 0.5, b - math.floor(b) < 0.5
        return 1.0 if a and b else (0.5 if a or b else 0.0)
    if kind == 7:  # dots
        a, b = u / scale, v / scale
        a += 0.5 * (math.floor(b) % 2)
        a, b = a - math.floor(a) - 0.5, b - math.floor(b) - 0.5
        return 1.0 if a * a + b * b < 0.075 else 0.0
    s = v / scale + 0.5 * abs(2 * (u / scale - math.floor(u / scale)) - 1)  # zigzag
    return 1.0 if s - math.floor(s) < 0.45 else 0.0


@inlined
def _tiles(u, v, scale, seed):  # type: ignore[no-untyped-def]
    """Grout (1) and the tone of the tile (0..0.35)."""
    a, b = u / scale, v / scale
    ia, ib = math.floor(a), math.floor(b)
    a, b = a - ia, b - ib
    edge = 0.0045 / scale
    if min(a, b) < edge or max(a, b) > 1 - edge:
        return 1.0
    return 0.3 * hash01(int(ia), int(ib), int(seed))


@inlined
def _planks(u, v, scale, seed, x, y, z, foot):  # type: ignore[no-untyped-def]
    row = math.floor(v / 0.13)
    offset = hash01(int(row), 3, int(seed))
    piece = math.floor(u / 1.1 + offset)
    a, b = u / 1.1 + offset - piece, v / 0.13 - row
    if b < 0.022 or a < 0.003:
        return 1.15
    tint = hash01(int(row), int(piece), int(seed))
    return 0.55 * tint + 0.45 * _wood(x, y, z, scale, 0, seed + 17.0 * tint, foot)


@inlined
def _rug(u, v, scale, seed):  # type: ignore[no-untyped-def]
    """u, v in 0..1: a border and a repeated motif in the field."""
    edge = min(min(u, 1 - u) * 1.4, min(v, 1 - v))
    if edge < 0.035:
        return 1.0
    if edge < 0.07:
        return 0.0
    if edge < 0.1:
        return 0.75
    style = int(seed) % 3
    a, b = u * 1.4 / scale, v / scale
    if style == 0:  # diamonds
        d = abs(a - math.floor(a) - 0.5) + abs(b - math.floor(b) - 0.5)
        return 0.9 if d < 0.2 else (0.35 if d < 0.34 else 0.0)
    if style == 1:  # bands
        s = b - math.floor(b)
        return 0.85 if s < 0.3 else (0.4 if 0.45 < s < 0.55 else 0.0)
    r = math.sqrt((u - 0.5) * (u - 0.5) * 1.96 + (v - 0.5) * (v - 0.5)) / scale  # rings
    s = r - math.floor(r)
    return 0.85 if s < 0.4 else 0.0


@inlined
def _picture(u, v, ar, ag, ab, br, bg, bb, seed):  # type: ignore[no-untyped-def]
    """u to the right, v up, both 0..1: landscape, still life, portrait or geometry."""
    style = int(seed) % 5
    k = seed * 0.37
    if style == 0:  # hills under a sky with a sun
        d2 = (u - 0.3 - 0.4 * hash01(int(seed), 1, 1)) ** 2 + (v - 0.78) ** 2
        if v > 0.45 + 0.1 * math.sin(5 * u + k) + 0.05 * math.sin(13 * u + k):
            if d2 < 0.008:
                return 0.95, 0.8, 0.35
            return 0.35 + 0.3 * v, 0.5 + 0.25 * v, 0.75
        if v > 0.28 + 0.08 * math.sin(4 * u + 2 * k):
            return 0.1 + 0.5 * ar, 0.2 + 0.5 * ag, 0.1 + 0.4 * ab
        n = 0.7 + 0.5 * noise(u * 18, v * 18, k)
        return 0.12 * n, 0.3 * n, 0.08 * n
    if style == 1:  # fields of colour
        iu, iv = int(u * 3.2 + 0.3 * math.sin(k)), int(v * 3.0 + 0.3 * math.cos(k))
        h = hash01(iu, iv, int(seed))
        if h < 0.25:
            return ar, ag, ab
        if h < 0.5:
            return br, bg, bb
        if h < 0.7:
            return 0.85, 0.82, 0.72
        if h < 0.85:
            return 0.03, 0.03, 0.04
        return 0.5 * (ar + br), 0.5 * (ag + bg), 0.5 * (ab + bb)
    if style == 2:  # a portrait
        face = ((u - 0.5) / 0.17) ** 2 + ((v - 0.6) / 0.22) ** 2
        hair = ((u - 0.5) / 0.22) ** 2 + ((v - 0.66) / 0.26) ** 2
        eye = min((u - 0.43) ** 2, (u - 0.57) ** 2) + (v - 0.63) ** 2
        if face < 1 and v < 0.74:
            if eye < 0.0004 or (abs(u - 0.5) < 0.05 and abs(v - 0.49) < 0.012):
                return 0.1, 0.03, 0.03
            return 0.72, 0.45, 0.31
        if hair < 1 and v > 0.45:
            return 0.08, 0.04, 0.02
        if ((u - 0.5) / 0.42) ** 2 + ((v - 0.02) / 0.38) ** 2 < 1:
            return ar, ag, ab
        n = 0.8 + 0.3 * noise(u * 6, v * 6, k)
        return br * n, bg * n, bb * n
    if style == 3:  # circles
        r = math.sqrt((u - 0.5) ** 2 + (v - 0.5) ** 2) * 9.0 + 0.4 * math.sin(k)
        s = r - math.floor(r)
        if s < 0.33:
            return ar, ag, ab
        if s < 0.66:
            return br, bg, bb
        return 0.85, 0.83, 0.78
    for i in range(7):  # flowers
        cu = 0.15 + 0.7 * hash01(i, 2, int(seed))
        cv = 0.45 + 0.4 * hash01(i, 5, int(seed))
        d = math.sqrt((u - cu) ** 2 + (v - cv) ** 2)
        petals = 0.085 + 0.03 * math.cos(5 * math.atan2(v - cv, u - cu))
        if d < 0.03:
            return 0.9, 0.7, 0.1
        if d < petals:
            if i % 2 == 0:
                return ar, ag, ab
            return br, bg, bb
        if abs(u - (0.5 + (cu - 0.5) * max(0.0, v / cv))) < 0.008 and v < cv:
            return 0.08, 0.28, 0.08
    n = 0.85 + 0.2 * noise(u * 8, v * 8, k)
    return 0.8 * n, 0.78 * n, 0.66 * n


@inlined
def _screen(u, v, lively, ar, ag, ab, br, bg, bb, seed):  # type: ignore[no-untyped-def]
    """A desktop with windows and lines of text if ``lively``, otherwise a dark screen with a reflection."""
    if lively < 0.5:
        m = 1.0 if abs(u - 0.35 - 0.4 * v) < 0.13 else 0.25 * v
        return ar + (br - ar) * m, ag + (bg - ag) * m, ab + (bb - ab) * m
    if v < 0.06:
        if u < 0.3 and (u * 25.0) % 1.0 > 0.35:
            return 0.7, 0.7, 0.75
        return 0.03, 0.04, 0.07
    for i in range(2):
        u0 = 0.08 + 0.42 * i + 0.06 * hash01(i, 7, int(seed))
        v0 = 0.16 + 0.14 * hash01(i, 8, int(seed))
        if u0 < u < u0 + 0.4 and v0 < v < v0 + 0.6:
            if v > v0 + 0.53:
                return 0.12, 0.2, 0.36
            line = (v - v0) * 26.0
            row = int(line)
            if line - row < 0.4 and 0.03 < u - u0 < 0.1 + 0.27 * hash01(row, i, int(seed)):
                return 0.2, 0.22, 0.28
            return br, bg, bb
    g = 0.7 + 0.5 * v
    return ar * g, ag * g, ab * g


@inlined
def _keys(u, v, scale):  # type: ignore[no-untyped-def]
    """1 between the keys; the lowest row has a long space bar."""
    a, b = u / scale, v / scale
    row = math.floor(b)
    a += 0.27 * row
    gap = 0.13
    fb = b - row
    if fb < gap or fb > 1 - gap:
        return 1.0
    if row <= -3 and abs(u) < 3 * scale:
        return 0.0
    fa = a - math.floor(a)
    return 1.0 if fa < gap or fa > 1 - gap else 0.0


@inlined
def _clock(u, v):  # type: ignore[no-untyped-def]
    """u, v in -1..1: twelve hour marks and a rim."""
    r = math.sqrt(u * u + v * v)
    if r > 0.93:
        return 0.8
    if 0.68 < r < 0.86:
        turn = math.atan2(v, u) * 6.0 / math.pi
        width = 0.13 if int(turn + 12.5) % 3 == 0 else 0.07
        if abs(turn - math.floor(turn + 0.5)) < width:
            return 1.0
    return 0.0


@inlined
def _wall(x, z, scale, style, seed, foot):  # type: ignore[no-untyped-def]
    """Share of the second colour; -1 on the skirting board."""
    if z < 0.085 and style != 2:
        return -1.0
    if style == 1:
        s = x / scale
        return 0.45 if s - math.floor(s) < 0.5 else 0.0
    if style == 2:
        if z < 1.95:
            return _tiles(x, z, 0.2, seed)
        return 0.0
    if style == 3 and z < 0.95:
        s = x / 0.45 - math.floor(x / 0.45)
        return 0.55 if s < 0.03 or z > 0.91 else 0.3
    return 0.12 * noise_at(x * 3.0 + seed, z * 3.0, seed, foot)


@inlined
def surface_colour(kind, x, y, z, u, v, row, scale, axis, seed, foot=0.0):  # type: ignore[no-untyped-def]
    """Red, green and blue (0..1, linear) at a point; ``u`` and ``v`` are its position in the plane of the face.

    Lines thinner than ``foot`` metres, the width of a pixel, are blurred in the textures from ``VIEW`` on.
    """
    if kind > 24:
        return home_colour(kind, x, y, z, u, v, row, foot)
    ar, ag, ab, br, bg, bb = row[1], row[2], row[3], row[4], row[5], row[6]
    tone = 1.0
    if kind == 0:
        share = 0.5 * noise_at(x * 25.0 + seed, y * 25.0, z * 25.0, foot)
    elif kind == 1:
        share = _wood(x, y, z, scale, axis, seed, foot)
    elif kind == 2 or (5 <= kind <= 7) or kind == 22:
        share = 0.0 if kind == 2 else _pattern(kind, u, v, scale, axis, seed)
        thread = 0.5 + 0.25 * (math.sin(u * 1300.0) + math.sin(v * 1300.0))
        tone = 0.88 + 0.1 * thread + 0.1 * (noise_at(x * 40.0, y * 40.0, z * 40.0, foot) - 0.5)
    elif kind == 3:
        share = _tiles(u, v, scale, seed)
    elif kind == 4:
        n = noise_at(x / scale, y / scale, z / scale, foot)
        share = 1.0 if n > 0.68 else 0.35 * noise_at(x * 30.0, y * 30.0, z * 30.0, foot)
        if n < 0.25:
            tone = 1.3
    elif kind == 8:
        share = 0.6 * noise_at(x * 25.0 + seed, y * 25.0, z * 500.0, foot)
    elif kind == 9 or kind == 11 or kind == 16:
        fu, fv = (u - row[11]) / (row[12] - row[11]), (v - row[13]) / (row[14] - row[13])
        if kind == 9:
            return _picture(fu, fv, ar, ag, ab, br, bg, bb, seed)
        if kind == 11:
            return _screen(fu, fv, scale, ar, ag, ab, br, bg, bb, seed)
        hill = 0.3 + 0.06 * math.sin(7 * fu + seed) + 0.03 * math.sin(23 * fu + seed)
        if fv < hill:
            n = 0.75 + 0.4 * noise_at(fu * 40.0, fv * 40.0, seed, foot)
            return 0.16 * n, 0.34 * n, 0.13 * n
        share = min(1.0, max(0.0, 1.6 * noise_at(fu * 4.0 + seed, fv * 7.0, seed, foot) - 0.5) + 0.5 * (1 - fv))
    elif kind == 10:
        share = _keys(u, v, scale)
    elif kind == 12:
        share = _planks(u, v, scale, seed, x, y, z, foot)
    elif kind == 13:
        a, b = math.floor(u / scale), math.floor(v / scale)
        over = (int(a) + int(b)) % 2 == 0
        f = (v / scale - b) if over else (u / scale - a)
        share = 0.85 * (2 * f - 1) ** 2 + 0.15 * noise_at(x * 200.0, y * 200.0, z * 200.0, foot)
    elif kind == 14:
        share = 0.7 * noise_at(x * 60.0, y * 60.0, z * 60.0, foot) * noise_at(x * 9.0, y * 9.0, z * 9.0, foot)
    elif kind == 15:
        share = noise_at(x / scale, y / scale, z / scale, foot) * 0.7 + 0.3 * noise_at(
            x * 300.0, y * 300.0, z * 300.0, foot
        )
    elif kind == 17:
        cu, cv = 0.5 * (row[11] + row[12]), 0.5 * (row[13] + row[14])
        share = _clock((u - cu) / (0.5 * (row[12] - row[11])), (v - cv) / (0.5 * (row[14] - row[13])))
    elif kind == 18:
        share = _rug((x - row[11]) / (row[12] - row[11]), (y - row[13]) / (row[14] - row[13]), scale, seed)
        tone = 0.8 + 0.35 * noise_at(x * 180.0, y * 180.0, 1.5, foot)
    elif kind == 19:
        w = noise_at(x * 4.0 + seed, y * 4.0, z * 4.0, foot) * 5.0 + (x + y + z) * 6.0
        share = max(0.0, 1.0 - 5.0 * abs(w - math.floor(w) - 0.5)) * 0.8
    elif kind == 20:
        share = 0.5 + 0.5 * math.sin(u * 600.0)
        tone = 0.94 + 0.12 * noise_at(x * 12.0, y * 12.0, z * 12.0, foot)
    elif kind == 21:
        s = (z if axis == 0 else x) / scale + 0.1 * (seed % 3)
        s -= math.floor(s)
        share = 1.0 if 0.16 < s < 0.24 or 0.62 < s < 0.72 else 0.0
    elif kind == 23:
        s = z * 18.0
        share = 1.0 if s - math.floor(s) < 0.16 else 0.0
    else:
        share = _wall(x, z, scale, axis, seed, foot)
        if share < 0:
            return 0.72, 0.71, 0.68
        tone = 0.98 + 0.04 * noise_at(x * 60.0, y * 60.0, z * 60.0, foot)
    return (ar + (br - ar) * share) * tone, (ag + (bg - ag) * share) * tone, (ab + (bb - ab) * share) * tone
