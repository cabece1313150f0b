"""Compiled textures of homes: views from windows, paintings, packaging, plaster, fabric, bricks, parquet, tiles."""

from __future__ import annotations

import math
from typing import Any

from su3d_bench.core.compiled import njit
from su3d_bench.datasets.procedural.rendering.noise_kernels import cloudy, hash01, noise2, noise3, rough

inlined: Any = njit(cache=True, inline="never")


@inlined
def _blend(a, b, share):  # type: ignore[no-untyped-def]
    share = min(1.0, max(0.0, share))
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, a[2] + (b[2] - a[2]) * share


@inlined
def _times(a, factor):  # type: ignore[no-untyped-def]
    return a[0] * factor, a[1] * factor, a[2] * factor


@inlined
def _line(distance, wide, foot):  # type: ignore[no-untyped-def]
    """Share of a pixel of size ``foot`` that a line covers, at a distance from its middle."""
    return min(1.0, max(0.0, (0.5 * (wide + foot) - distance) / max(foot, 1e-4))) * min(1.0, wide / max(foot, 1e-4))


@inlined
def _text(u, v, lines, seed):  # type: ignore[no-untyped-def]
    """Ink (0 or 1) of ``lines`` lines of something like letters; u, v in 0..1 with v up."""
    b = (1 - v) * lines
    line, a = math.floor(b), u * (5 * lines + 4)
    b, letter = b - line, math.floor(a)
    a -= letter
    if b < 0.25 or b > 0.8 or a > 0.8 or not (0 < u < 0.55 + 0.45 * hash01(line, 3, seed) and 0 < v < 1):
        return 0.0
    pick = int(63 * hash01(letter, line, seed))
    if pick < 9:
        return 0.0  # between words
    stem, bar = a < 0.22 or (a > 0.58 and pick % 2 == 0), int((b - 0.25) * 5.4)
    return 1.0 if stem or (bar == 0 and pick % 3) or (bar == 2 and pick % 5) or (bar == 1 and pick % 7 < 2) else 0.0


@inlined
def _bricks(u, v, length, seed):  # type: ignore[no-untyped-def]
    """Mortar (-1), or the tone of the brick around 1."""
    b = v / (0.34 * length)
    row = math.floor(b)
    a = u / length + 0.5 * (row % 2) + 0.03 * hash01(row, 1, seed)
    piece = math.floor(a)
    ragged = 0.02 * noise2(u / length * 14, v / length * 14, seed)
    if b - row < 0.13 + 3 * ragged or a - piece < 0.035 + ragged:
        return -1.0
    return 0.7 + 0.5 * hash01(piece, row, seed) + 0.35 * (rough(u / length * 9, v / length * 9, seed) - 0.5)


@inlined
def _view(u, v, style, seed, is_night):  # type: ignore[no-untyped-def]
    """What is outside a window, u and v in 0..1: hills, a street, trees, a city, a wall close by, the sea."""
    puff = cloudy(2.2 * u + seed, 4.5 * v, seed) - 0.35 - 0.15 * hash01(1, 2, seed)
    sky = _blend((0.62, 0.72, 0.85), (0.18, 0.36, 0.75), 1.4 * v - 0.4)
    sky = _blend(sky, (0.86, 0.87, 0.9), 4.0 * puff if style != 5 else 0.65 + 2 * puff)
    if is_night:
        sky = _blend((0.5, 0.36, 0.3), (0.07, 0.11, 0.26), 2.2 * v - 0.4)
    dark, lamp = 0.16 if is_night else 1.0, (5.0, 3.2, 1.5)
    if style == 4:
        tone, p, q = _bricks(u * 1.6, v * 1.3, 0.16, seed), abs(u - 0.3 - 0.4 * hash01(5, 5, seed)), abs(v - 0.55)
        wall = (0.3, 0.28, 0.26) if tone < 0 else _times((0.3, 0.13, 0.09), tone)
        if p < 0.17 and q < 0.24:
            wall = _blend((0.06, 0.07, 0.09), sky, 0.3 * v + 0.5 * puff)
            if p > 0.15 or q > 0.22 or p < 0.008:
                wall = (0.6, 0.6, 0.57)
            elif is_night:
                return lamp
        return _times(wall, dark * (0.75 + 0.4 * v))
    if style == 5:
        if v > 0.42:
            return sky
        wave = 0.7 + 0.6 * noise2(u * 12 + 30 * v, 8.5 / (0.46 - v), seed)
        foam = 3 * max(0.0, cloudy(u * 9, 3.0 / (0.45 - v), seed + 3) - 0.68)
        return _times(_blend(_times((0.2, 0.28, 0.32), wave), (0.8, 0.8, 0.8), foam), dark)
    for k in range(4):  # layers, from the nearest
        fine = cloudy(u * 24 + 3 * k, v * (40 if style == 0 else 24), seed + k)
        if style == 0:
            top = 0.14 + 0.12 * k + (0.2 + 0.05 * k) * (cloudy(u * (1.4 + k) + 7 * k, 0.5, seed + k) - 0.35)
            tint = _times(_blend((0.16, 0.24, 0.06), (0.09, 0.15, 0.035), k), 0.7 + 0.6 * fine)
        elif style == 2:
            top = 0.28 + 0.16 * k + 1.8 * (cloudy(u * (4 + 3 * k) + 11 * k, v * (4 + 3 * k), seed + k) - 0.3)
            lit = (0.25 + 2.0 * max(0.0, fine - 0.25)) * (0.6 + v)
            tint = _times(_blend((0.07, 0.15, 0.03), (0.2, 0.23, 0.05), hash01(k, 4, seed)), lit)
        else:
            is_street = style == 1
            a = u / (0.3 - 0.05 * k if is_street else 0.2 - 0.03 * k) + hash01(k, 9, seed)
            house = math.floor(a)
            eaves = (0.45 if is_street else 0.25) + 0.12 * k + 0.25 * hash01(house, k, seed)
            top = eaves + (0.13 * (1 - abs(2 * (a - house) - 1)) if is_street else 0.0)
            tint = _blend((0.5, 0.43, 0.34), (0.36, 0.2, 0.14), hash01(house, k + 20, seed))
            tint = _times(_blend(tint, (0.36, 0.39, 0.43), 0.0 if is_street else 0.8), 0.8 + 0.4 * fine)
            p, q = (a - house) * (3 if is_street else 5), v * (7 + 4 * k if is_street else 22)
            if v > eaves:
                tint = _times((0.16, 0.09, 0.07), 0.6 + 0.8 * fine)
            elif is_street and k == 0 and v < 0.1:
                tint = (0.12, 0.12, 0.13) if v < 0.07 else (0.3, 0.3, 0.29)
            elif 0.3 < p - math.floor(p) < 0.75 and 0.3 < q - math.floor(q) < 0.8 and v < eaves - 0.04:
                pick = hash01(int(p) + 9 * house, int(q), seed + k)
                if is_night and pick < 0.4:
                    return lamp
                tint = _blend((0.05, 0.06, 0.08), sky, 0.4 * pick)
        if v < top:
            return _times(_blend(tint, sky, 0.2 * k), dark)
    return sky


@inlined
def _painting(u, v, style, a, b, seed):  # type: ignore[no-untyped-def]
    """A picture in 0..1: six painted views, a still life, blots, fields of colour, a photograph; 10 is a poster."""
    paper = (0.78, 0.75, 0.68)
    stroke = 0.75 + 0.4 * noise2(u * 90 + 40 * noise2(u * 5, v * 5, seed), v * 45, seed)
    if style < 6:  # strokes displace what is painted
        p, q = 0.03 * (noise2(u * 35, v * 35, seed) - 0.5), 0.03 * (noise2(u * 35, v * 35, seed + 1) - 0.5)
        return _times(_blend(_view(u + p, v + q, style, seed, False), _blend(a, b, v), 0.3), stroke)
    if style == 6:  # fruit and jars on a table, lit from the left
        ground = (0.2, 0.12, 0.07) if v < 0.36 else _times((0.09, 0.08, 0.07), 0.7 + 0.8 * u)
        for k in range(5):
            wide = 0.06 + 0.06 * hash01(k, 1, seed)
            tall = wide * (1.0 if k < 3 else 2.2)
            p, q = (u - 0.2 - 0.14 * k) / wide, (v - 0.26 - 0.05 * hash01(k, 2, seed) - tall) / tall
            if p * p + q * q < 1:
                ripe = _blend((0.5, 0.22, 0.05), (0.35, 0.33, 0.1), hash01(k, 3, seed))
                ground = _blend(_blend(a, b, 0.5 * k), ripe, k % 2)
                ground = _times(ground, 0.25 + 0.75 * max(0.0, 0.6 - 0.55 * p + 0.3 * q))
        return _times(ground, stroke)
    if style < 9 and min(min(u, 1 - u), min(v, 1 - v)) < 0.13:
        return paper
    if style == 7:
        p, q = rough(u * 2.3, v * 2.3, seed), rough(u * 2 + 9, v * 3, seed + 4)
        return _times(_blend(_blend(paper, a, 9 * (p - 0.5)), b, 12 * (q - 0.58)), stroke)
    if style == 8:
        band = math.floor(v * 3.2 + 0.25 * (noise2(u * 3, v, seed) - 0.5))
        return _times(_blend(_blend(a, b, 0.5 * band), paper, 0.35 * hash01(band, 5, seed)), stroke)
    scene = _view(u, v if style == 9 else (v - 0.36) / 0.6, seed % 6, seed, False)
    if style == 9:
        grey = (0.3 * scene[0] + 0.6 * scene[1] + 0.1 * scene[2]) * (0.8 - (u - 0.5) ** 2 - (v - 0.5) ** 2)
        return grey, 0.97 * grey, 0.9 * grey
    ink = max(_text((u - 0.1) / 0.8, (v - 0.2) / 0.13, 1, seed), _text((u - 0.1) / 0.8, (v - 0.05) / 0.12, 4, seed + 1))
    return _blend(scene, a, 0.35) if v > 0.36 else _blend(b, (0.03, 0.03, 0.04) if b[1] > 0.2 else paper, ink)


@inlined
def _package(u, v, a, b, seed):  # type: ignore[no-untyped-def]
    """Packaging in 0..1: bands, a picture, a title, small print, a bar code."""
    cut, paper, dark = 0.3 + 0.3 * hash01(1, 1, seed), (0.8, 0.79, 0.75), (0.03, 0.03, 0.04)
    ground = a if v > cut + 0.05 * math.sin(6 * u) * (seed % 2) else b
    if 0.72 < u < 0.95 and 0.04 < v < 0.16:
        return dark if hash01(int(u * 150), 7, seed) < 0.5 and v > 0.06 else paper
    p, q = u - 0.5, (v - cut) * 1.2
    if p * p + q * q < 0.035 and seed % 3:
        ground = _times(_blend(_blend(b, paper, 0.4), a, 3 * (cloudy(u * 6, v * 6, seed) - 0.3)), 0.8 + p)
    ink = max(
        _text((u - 0.07) / 0.6, (v - 0.03) / 0.2, 7, seed + 2), _text((u - 0.08) / 0.84, (v - 0.72) / 0.2, 1, seed)
    )
    return _blend(ground, paper if ground[1] < 0.35 else dark, 0.85 * ink)


@inlined
def _herringbone(u, v, wide, seed):  # type: ignore[no-untyped-def]
    """A block of 1 by 5: its number as two cells, the place along it and across it in metres."""
    i, j = math.floor(u / wide), math.floor(v / wide)
    m = (i - j) % 10
    if m < 5:
        return i - m, j, u - (i - m) * wide, v - j * wide
    return i, j - (9 - m) + 4096, v - (j - (9 - m)) * wide, u - i * wide


@inlined
def _plaster(u, v, a, b, part, seed, foot):  # type: ignore[no-untyped-def]
    """Painted plaster; ``part`` 0 is a wall, 1 one with a skirting board, 2 a ceiling."""
    if part == 1 and v < 0.075:
        line = 1 - 0.45 * max(_line(abs(v - 0.072), 0.006, foot), _line(v, 0.012, foot))
        return _times((0.66, 0.65, 0.61), line * (0.9 + 0.12 * cloudy(u * 7, v * 30, seed)))
    broad = cloudy(u * 1.2, v * 1.2, seed)
    tone = 0.95 + 0.06 * broad + 0.05 * (noise2(u * 260, v * 260, seed) - 0.5) - 0.5 * max(0.0, broad - 0.64)
    tint = _blend(a, b, 0.5 * (0.6 - broad))
    if part < 2:
        i, j = math.floor(u / 0.5), math.floor(v / 0.5)
        rare = hash01(i, j, seed + 2)
        if rare < 0.5:
            p, q = u - (i + 0.2 + 0.6 * hash01(i, j, seed)) * 0.5, v - (j + 0.2 + 0.6 * hash01(i, j, seed + 1)) * 0.5
            lean = p * (hash01(i, j, seed + 3) - 0.5) + q
            if rare < 0.16 and v > 1.1:  # a nail hole
                tone *= 0.35 if p * p + q * q < 1.2e-5 else (0.93 if abs(p) < 0.004 and -0.03 < q < 0 else 1.0)
            elif v < 1.1 and abs(p) < 0.09 and abs(lean) < 0.006:  # a scuff
                tone *= 1 - 0.3 * (1 - abs(p) / 0.09) * rough(u * 40, v * 160, seed)
        if v < 0.6:
            tone *= 1 - 0.22 * math.exp(-v / 0.16) * rough(u * 3, v * 9, seed + 4)
    return _times(tint, tone)


@inlined
def home_colour(kind, x, y, z, u, v, row, foot):  # type: ignore[no-untyped-def]
    """Red, green and blue (linear) of the textures from ``VIEW`` on; parameters as in ``surface_colour``."""
    a, b = _times((row[1], row[2], row[3]), 1.0), _times((row[4], row[5], row[6]), 1.0)
    scale, seed = row[7] * 1.0, int(row[15])
    fu, fv = (u - row[11]) / (row[12] - row[11]), (v - row[13]) / (row[14] - row[13])
    i, j = math.floor(u / scale), math.floor(v / scale)
    if kind == 25:
        return _view(fu, fv, seed % 6, seed, row[9] < 0.3)
    if kind == 26 or kind == 32:
        return _painting(fu, fv, 10 if kind == 32 else seed % 10, a, b, seed)
    if kind == 27:
        return _plaster(u, v, a, b, int(row[10]), seed, foot)
    if kind == 28:  # woven yarn of two tones, with folds
        p, q = u / scale - i - 0.5, v / scale - j - 0.5
        if (i + j) % 2:
            i, p, q = j + 4096, q, p
        relief, yarn = 1.08 - 1.1 * p * p - 0.5 * q * q, hash01(i, 1, seed)
        folds = 0.8 + 0.26 * noise3(x * 5.0, y * 5.0, z * 5.0, seed) + 0.14 * noise3(x * 17.0, y * 17.0, z * 17.0, seed)
        return _times(_blend(a, b, 0.75 * yarn), relief * folds)
    if kind == 29:
        tone = _bricks(u, v, scale, seed)
        dirt = 0.8 + 0.4 * rough(u * 25, v * 25, seed)
        return _times(b, dirt) if tone < 0 else _times(a, tone * (0.85 + 0.15 * dirt))
    if kind == 30:
        i, j, along, across = _herringbone(u, v, scale, seed)
        tone = 0.72 + 0.5 * hash01(i, j, seed)
        shift = 50 * hash01(i, j, seed + 1)
        grain = rough(along * 7 + shift, across * 130 + shift, seed) - 0.5
        rings = math.sin(6.3 * (across / 0.011 + 3 * noise2(along * 4 + shift, across * 20, seed)))
        gap = min(min(across, scale - across), min(along, 5 * scale - along))
        tone *= 1 - 0.6 * _line(gap, 0.0016, foot) - 0.15 * _line(gap, 0.0044, foot)
        return _times(_blend(a, b, 0.35 + 0.7 * grain + 0.13 * rings), tone)
    if kind == 31:
        p, q = u - i * scale, v - j * scale
        edge = min(min(p, scale - p), min(q, scale - q))
        tone = 0.9 + 0.16 * hash01(i, j, seed) + 0.12 * (rough(u * 14 + 7 * i, v * 14 + 3 * j, seed) - 0.5)
        warm = _blend(a, b, 0.1 * hash01(i, j, seed + 1))
        tone *= 1.0 - 0.12 * max(0.0, 1 - edge / 0.02) * rough(u * 20, v * 20, seed + 2)
        grout = _times(b, 0.55 + 0.75 * rough(u * 9, v * 9, seed))
        return _blend(_times(warm, tone), grout, _line(edge, 0.004, foot))
    if kind == 33:
        return _package(fu, fv, a, b, seed)
    if row[12] - row[11] > row[14] - row[13]:  # a spine that lies
        fu, fv = fv, fu
    cloth = 0.86 + 0.2 * noise2(u * 500, v * 500, seed) + 0.1 * (rough(u * 20, v * 20, seed) - 0.5)
    band = 0.06 + 0.1 * hash01(1, 2, seed)
    if abs(fv - band) < 0.012 or abs(fv - 1 + band) < 0.012 or (fv > 0.84 and seed % 4 == 0):
        return _times(b, cloth)
    ink = _text((0.8 - fv) / 0.55, (fu - 0.2) / 0.6, 1 + seed % 2, seed)
    gilt = (0.7, 0.68, 0.6) if a[1] < 0.3 else (0.04, 0.04, 0.05)
    return _times(_blend(a, b if abs(a[1] - b[1]) > 0.15 else gilt, ink), cloth)
