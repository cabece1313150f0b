"""Builders of what is fitted to a room: doors, windows, kitchen and bathroom fixtures, devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from su3d_bench.datasets.rooms_items import Assembly, Builder, Look
from su3d_bench.datasets.rooms_materials import (
    Material,
    Texture,
    ceramic,
    chrome,
    glass,
    linear,
    metal,
    paint,
    plain_cloth,
    plastic,
    shade,
    tone,
)
from su3d_bench.datasets.rooms_shapes import Shape, block, box, cylinder, ellipsoid, lathe, sheet, soft_block, tube


def door(look: Look) -> Assembly:
    build = Assembly(look)
    width, height = look.rng.uniform(0.84, 0.95), look.rng.uniform(2.02, 2.1)
    frame = paint(shade(look.rgb, 0.82)) if look.colour == "white" else look.main(axis=2)
    build.add(frame, *[block(0.07, 0.06, height + 0.07, sx * (width / 2 + 0.035)) for sx in (-1, 1)])
    build.add(frame, block(width, 0.06, 0.07, 0, 0, height))
    leaf = paint(look.rgb) if look.colour == "white" else look.main(axis=2)
    build.add(leaf, block(width - 0.006, 0.03, height - 0.01, 0, 0.015, 0.005))
    panel = replace(leaf, a=shade(leaf.a, 0.84), b=shade(leaf.b, 0.84))
    rows = [(0.14, 0.5), (0.56, 0.95)] if look.chance(0.7) else [(0.1, 0.32), (0.37, 0.62), (0.67, 0.94)]
    for low, high in rows:
        for sx in (-1, 1):
            tall, wide = (high - low) * height, width * 0.33
            x = sx * width * 0.21
            build.add(panel, soft_block(wide, 0.016, tall, x, -0.004, low * height, 0.007))
    steel = chrome(look.rng)
    x = width / 2 - 0.07
    build.add(steel, soft_block(0.045, 0.012, 0.2, x, -0.005, 0.95, 0.005))
    build.add(steel, tube([(x, -0.01, 1.05), (x, -0.06, 1.051), (x - 0.12, -0.061, 1.05)], 0.011))
    return build


def window(look: Look) -> Assembly:
    build = Assembly(look)
    width, height = look.size(1.15, 1.5), look.rng.uniform(1.05, 1.25)
    frame = paint(look.rgb)
    extent = (-width / 2, width / 2, 0.0, height)
    sky = Material(
        Texture.SKY,
        linear((150, 190, 235)),
        linear((236, 242, 250)),
        1.0,
        0.5,
        0.75,
        0,
        extent,
        int(look.rng.integers(1, 999)),
    )
    build.add(sky, block(width - 0.06, 0.012, height - 0.06, 0, 0.014, 0.03))
    bar = 0.055
    for x in (-width / 2 + bar / 2, 0.0, width / 2 - bar / 2):
        build.add(frame, block(bar, 0.05, height, x))
    for z in (0.0, height - bar):
        build.add(
            frame, *[block(width / 2 - 1.5 * bar, 0.046, bar, sx * (width / 4 - bar / 4), 0, z) for sx in (-1, 1)]
        )
    if look.chance(0.5):
        build.add(
            frame,
            *[block(width / 2 - 1.5 * bar, 0.03, 0.03, sx * (width / 4 - bar / 4), 0, height * 0.62) for sx in (-1, 1)],
        )
    build.add(frame, soft_block(width + 0.12, 0.17, 0.03, 0, -0.06, -0.032, 0.01))
    build.add(chrome(look.rng), soft_block(0.02, 0.03, 0.12, 0.0, -0.035, height * 0.4, 0.008))
    return build


def curtain(look: Look) -> Assembly:
    """One hanging, pleated panel with its rod."""
    build = Assembly(look)
    width, height = look.rng.uniform(0.34, 0.48), look.rng.uniform(2.05, 2.25)
    folds = int(look.rng.integers(4, 7))
    u, v = np.linspace(0, 1, folds * 8 + 1), np.linspace(0, 1, 7)
    x = np.repeat(((u - 0.5) * width)[:, None], len(v), axis=1) * (0.86 + 0.14 * np.abs(v - 0.35))
    y = 0.032 * np.sin(2 * np.pi * folds * u)[:, None] * (0.6 + 0.4 * (1 - v))
    grid = np.stack([x, y, np.repeat((v * height)[None], len(u), axis=0)], axis=-1)
    build.add(look.main(), sheet(grid, 0.008))
    rod = metal(tone("black"), look.rng)
    build.add(rod, tube([(-width / 2 - 0.03, 0, height + 0.02), (width / 2 + 0.03, 0, height + 0.02)], 0.014))
    build.add(rod, *[ellipsoid(0.025, 0.025, 0.025).moved(sx * (width / 2 + 0.04), 0, height + 0.02) for sx in (-1, 1)])
    return build


def blinds(look: Look) -> Assembly:
    build = Assembly(look)
    width, height = look.rng.uniform(1.15, 1.4), look.rng.uniform(0.55, 0.95)
    slat = paint(look.rgb) if look.material == "plastic" else look.main(axis=0)
    build.add(slat, soft_block(width, 0.055, 0.05, 0, 0, height - 0.05, 0.01))
    n = int(height / 0.042)
    for i in range(1, n):
        tilted = block(width, 0.045, 0.005, 0, 0, -0.0025).turned("x", 32)
        build.add(slat, tilted.moved(0, 0, height - 0.05 - i * 0.042))
    build.add(slat, block(width, 0.03, 0.022))
    cord = paint(shade(look.rgb, 0.55))
    build.add(cord, *[block(0.006, 0.006, height - 0.06, sx * width * 0.32, -0.03, 0.01) for sx in (-1, 1)])
    return build


def switch(look: Look) -> Assembly:
    build = Assembly(look)
    n = 2
    build.add(plastic(look.rgb), soft_block(0.1 * n, 0.014, 0.13, 0, 0, 0, 0.006))
    for i in range(n):
        x = (i - (n - 1) / 2) * 0.088
        build.add(plastic(shade(look.rgb, 0.82)), block(0.062, 0.012, 0.088, x, -0.009, 0.021).turned("x", 2))
    return build


def wall_plug(look: Look) -> Assembly:
    build = Assembly(look)
    build.add(plastic(look.rgb), soft_block(0.21, 0.014, 0.11, 0, 0, 0, 0.006))
    dark = paint(tone("black"))
    for x in (-0.05, 0.05):
        ring = lathe([(0, 0), (0.038, 0), (0.038, 0.008), (0.031, 0.008), (0.031, 0.002), (0, 0.002)], 18).turned(
            "x", 90
        )
        build.add(plastic(shade(look.rgb, 0.75)), ring.moved(x, -0.0075, 0.055))
        for dx in (-0.012, 0.012):
            build.add(dark, cylinder(0.006, 0.004).turned("x", 90).moved(x + dx, -0.0095, 0.055))
    return build


def vent(look: Look) -> Assembly:
    build = Assembly(look)
    width, height = look.size(0.32, 0.45), look.size(0.2, 0.28)
    frame = paint(look.rgb)
    build.add(frame, block(width, 0.016, 0.025), block(width, 0.016, 0.025, z=height - 0.025))
    build.add(frame, *[block(0.025, 0.016, height - 0.05, sx * (width / 2 - 0.0125), 0, 0.025) for sx in (-1, 1)])
    build.add(paint(shade(tone("grey"), 0.25)), block(width - 0.05, 0.006, height - 0.05, 0, 0.005, 0.025))
    n = int((height - 0.06) / 0.03)
    for i in range(n):
        slat = block(width - 0.052, 0.016, 0.004, 0, 0, 0).turned("x", 35)
        build.add(frame, slat.moved(0, -0.003, 0.035 + (i + 0.3) * (height - 0.06) / n))
    return build


def _faucet(build: Assembly, x: float, y: float, z: float, reach: float = 0.16, tall: float = 0.2) -> None:
    steel = chrome(build.look.rng)
    angle = np.linspace(0, np.pi * 0.9, 7)
    radius = reach / 2
    arc = [(x, y - radius + radius * float(np.cos(a)), z + tall + radius * float(np.sin(a))) for a in angle]
    build.add(steel, tube([(x, y, z), *arc], 0.013))
    build.add(steel, cylinder(0.026, 0.03, x, y, z))
    build.add(steel, *[soft_block(0.028, 0.028, 0.055, x + dx, y, z, 0.012) for dx in (-0.09, 0.09)])


def _basin(material: Material, width: float, depth: float, tall: float, wall: float = 0.03) -> list[Shape]:
    """An open rectangular tub out of four walls and a bottom."""
    w, d = width / 2, depth / 2
    return [
        box(-w, w, -d, d, 0, wall),
        soft_block(wall, depth, tall - wall - 0.001, -w + wall / 2, 0, wall + 0.001, 0.012),
        soft_block(wall, depth, tall - wall - 0.001, w - wall / 2, 0, wall + 0.001, 0.012),
        soft_block(width - 2 * wall, wall, tall - wall - 0.001, 0, -d + wall / 2, wall + 0.001, 0.012),
        soft_block(width - 2 * wall, wall, tall - wall - 0.001, 0, d - wall / 2, wall + 0.001, 0.012),
    ]


def pedestal_sink(look: Look) -> Assembly:
    build = Assembly(look)
    r = look.size(0.25, 0.29)
    white = ceramic(look.rgb)
    bowl = lathe([(0, 0.66), (r * 0.45, 0.66), (r * 0.85, 0.74), (r, 0.83), (r, 0.85), (r * 0.88, 0.85),
                  (r * 0.8, 0.81), (r * 0.5, 0.735), (0, 0.72)], 28)  # fmt: skip
    build.add(white, bowl.stretched(1.15, 0.85, 1.0))
    build.add(white, lathe([(0, 0), (0.12, 0), (0.1, 0.06), (0.075, 0.3), (0.085, 0.67), (0, 0.67)]))
    build.add(white, soft_block(r * 1.7, 0.09, 0.09, 0, r * 0.85, 0.765, 0.02))
    build.add(chrome(look.rng), cylinder(0.022, 0.006, 0, 0, 0.722))
    _faucet(build, 0.0, r * 0.85, 0.855, 0.17, 0.1)
    return build


def kitchen_sink(look: Look) -> Assembly:
    """A steel or ceramic basin that stands on a countertop, with a faucet."""
    build = Assembly(look)
    width, depth, tall = 0.52, 0.42, 0.13
    body = metal(linear((186, 188, 192)), look.rng) if look.material == "metal" else ceramic(look.rgb)
    build.add(body, *_basin(body, width, depth, tall))
    build.add(paint(tone("black")), cylinder(0.03, 0.004, 0, 0, 0.031))
    build.add(body, soft_block(0.34, 0.06, tall, 0, depth / 2 + 0.031, 0, 0.012))
    _faucet(build, 0.0, depth / 2 + 0.03, tall, 0.22, 0.16)
    return build


def toilet(look: Look) -> Assembly:
    build = Assembly(look)
    white = ceramic(look.rgb)
    seat = 0.4
    bowl = lathe(
        [
            (0, 0),
            (0.13, 0),
            (0.11, 0.08),
            (0.13, 0.2),
            (0.19, 0.34),
            (0.2, 0.385),
            (0.15, 0.385),
            (0.1, 0.28),
            (0, 0.24),
        ],
        24,
    )
    build.add(white, bowl.stretched(0.95, 1.3, 1.0).moved(0, -0.12, 0))
    ring = lathe([(0.13, 0.0), (0.205, 0.0), (0.207, 0.022), (0.13, 0.022), (0.13, 0.0)], 24).stretched(0.97, 1.3, 1.0)
    build.add(plastic(look.rgb), ring.moved(0, -0.12, seat - 0.012))
    build.add(white, soft_block(0.22, 0.26, 0.38, 0, 0.18, 0, 0.04))
    build.add(white, soft_block(0.42, 0.19, 0.37, 0, 0.24, seat - 0.005, 0.035))
    build.add(white, soft_block(0.44, 0.21, 0.04, 0, 0.24, seat + 0.366, 0.015))
    build.add(chrome(look.rng), cylinder(0.025, 0.012, 0, 0.24, seat + 0.406))
    if look.chance(0.6):  # lid up
        lid = lathe([(0, 0), (0.2, 0), (0.2, 0.02), (0, 0.022)], 24).stretched(0.97, 1.2, 1.0).moved(0, -0.24, 0)
        build.add(plastic(look.rgb), lid.turned("x", -82).moved(0, 0.115, seat + 0.02))
    else:
        lid = lathe([(0, 0), (0.205, 0), (0.2, 0.02), (0, 0.026)], 24).stretched(0.97, 1.3, 1.0)
        build.add(plastic(look.rgb), lid.moved(0, -0.12, seat + 0.012))
    return build


def bathtub(look: Look) -> Assembly:
    build = Assembly(look)
    length, depth, tall = look.rng.uniform(1.5, 1.7), look.rng.uniform(0.7, 0.76), 0.54
    white = ceramic(look.rgb)
    w, d, rim = length / 2, depth / 2, 0.075
    build.add(white, box(-w + 0.01, w - 0.01, -d + 0.01, d - 0.01, 0, 0.14))
    build.add(white, *[soft_block(rim, depth, tall - 0.141, sx * (w - rim / 2), 0, 0.141, 0.03) for sx in (-1, 1)])
    build.add(
        white,
        *[soft_block(length - 2 * rim + 0.04, rim, tall - 0.141, 0, sy * (d - rim / 2), 0.141, 0.03) for sy in (-1, 1)],
    )
    build.add(chrome(look.rng), cylinder(0.03, 0.005, -w * 0.6, 0, 0.141))
    steel = chrome(look.rng)
    build.add(steel, soft_block(0.05, 0.22, 0.05, -w + 0.04, 0, tall + 0.04, 0.02))
    build.add(steel, tube([(-w + 0.04, 0, tall), (-w + 0.04, 0, tall + 0.05)], 0.015))
    build.add(
        steel, tube([(-w + 0.05, 0, tall + 0.065), (-w + 0.16, 0, tall + 0.06), (-w + 0.18, 0, tall + 0.02)], 0.014)
    )
    build.spot((-w + 0.6, w - 0.1), (-d + 0.005, -d + rim - 0.005), tall, role="rim")
    return build


def refrigerator(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth, height = look.size(0.6, 0.7), look.rng.uniform(0.6, 0.66), look.rng.uniform(1.65, 1.85)
    body = metal(look.rgb, look.rng) if look.colour == "grey" else plastic(look.rgb)
    build.add(body, soft_block(width, depth - 0.06, height - 0.04, 0, 0.03, 0.04, 0.02))
    build.add(paint(tone("black")), block(width - 0.06, depth - 0.1, 0.04, 0, 0.02))
    split = height * look.rng.uniform(0.6, 0.7)
    y = -depth / 2 + 0.028
    build.add(body, soft_block(width, 0.055, split - 0.055, 0, y, 0.05, 0.018))
    build.add(body, soft_block(width, 0.055, height - split - 0.005, 0, y, split + 0.005, 0.018))
    steel = chrome(look.rng)
    x = width / 2 - 0.06
    for z0, z1 in ((split - 0.5, split - 0.06), (split + 0.06, min(split + 0.38, height - 0.08))):
        build.add(
            steel,
            tube([(x, y - 0.02, z0), (x, y - 0.065, z0 + 0.02), (x, y - 0.065, z1 - 0.02), (x, y - 0.02, z1)], 0.012),
        )
    build.spot((-width / 2 + 0.02, width / 2 - 0.02), (-depth / 2 + 0.08, depth / 2 - 0.02), height, 0.45)
    return build


def cooktop(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = 0.58, 0.5
    build.add(glass(linear((22, 22, 25))), soft_block(width, depth, 0.014, 0, 0, 0, 0.005))
    iron = metal(linear((60, 60, 64)), look.rng)
    for sx in (-1, 1):
        for sy in (-1, 1):
            r = 0.085 if sx * sy > 0 else 0.065
            at = (sx * 0.15, sy * 0.12, 0.0142)
            ring = lathe([(r * 0.82, 0), (r, 0), (r, 0.006), (r * 0.82, 0.006), (r * 0.82, 0)], 22)
            build.add(metal(linear((150, 60, 40)), look.rng), ring.moved(*at))
            build.add(iron, lathe([(0, 0), (r * 0.6, 0), (r * 0.6, 0.005), (0, 0.005)], 20).moved(*at))
            build.spot((at[0] - 0.16, at[0] + 0.16), (at[1] - 0.16, at[1] + 0.16), 0.0225, role="burner")
    for i in range(4):
        build.add(chrome(look.rng), cylinder(0.016, 0.016, (i - 1.5) * 0.06, -depth / 2 + 0.03, 0.0142))
    return build


def microwave(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth, height = look.size(0.45, 0.52), look.rng.uniform(0.32, 0.37), look.size(0.26, 0.3)
    build.add(plastic(look.rgb), soft_block(width, depth, height, 0, 0, 0.012, 0.012))
    y = -depth / 2
    dark = glass(linear((18, 19, 22)))
    build.add(dark, block(width * 0.6, 0.012, height * 0.68, -width * 0.15, y - 0.006, 0.012 + height * 0.16))
    build.add(
        plastic(shade(tone("grey"), 0.5)),
        block(width * 0.2, 0.008, height * 0.86, width * 0.36, y - 0.004, 0.012 + height * 0.07),
    )
    build.add(
        Material(Texture.PLAIN, linear((70, 220, 150)), linear((60, 190, 130)), glow=0.6),
        block(width * 0.14, 0.004, 0.03, width * 0.36, y - 0.0105, height * 0.82),
    )
    grey = plastic(tone("white"))
    for i in range(3):
        for j in range(3):
            build.add(
                grey, block(0.02, 0.006, 0.016, width * 0.36 + (i - 1) * 0.028, y - 0.0115, height * 0.3 + j * 0.04)
            )
    build.add(
        chrome(look.rng),
        tube(
            [
                (width * 0.18, y - 0.012, height * 0.25),
                (width * 0.18, y - 0.035, height * 0.27),
                (width * 0.18, y - 0.035, height * 0.83),
                (width * 0.18, y - 0.012, height * 0.85),
            ],
            0.008,
        ),
    )
    build.add(
        paint(tone("black")),
        *[block(0.04, 0.04, 0.014, sx * width * 0.4, sy * depth * 0.38) for sx in (-1, 1) for sy in (-1, 1)],
    )
    build.spot((-width / 2 + 0.03, width / 2 - 0.03), (-depth / 2 + 0.03, depth / 2 - 0.03), height + 0.012, 0.4)
    return build


def _screen(look: Look, width: float, z0: float, z1: float, lively: float, glow: float) -> Material:
    base = linear((52, 108, 172)) if look.chance(0.5) else linear((38, 132, 120))
    return Material(
        Texture.SCREEN,
        base,
        linear((236, 238, 242)),
        lively,
        0.5,
        glow,
        0,
        (-width / 2, width / 2, z0, z1),
        int(look.rng.integers(1, 999)),
    )


def tv_screen(look: Look) -> Assembly:
    """A flat black television on a wide foot."""
    build = Assembly(look)
    width = look.size(0.95, 1.2)
    height = width * 0.57
    black = plastic(linear((20, 20, 22)))
    build.add(black, soft_block(width, 0.04, height, 0, 0, 0.07, 0.012))
    dark = Material(
        Texture.SCREEN,
        linear((14, 16, 22)),
        linear((44, 50, 64)),
        0.0,
        0.9,
        0.0,
        0,
        (-width / 2, width / 2, 0.07, 0.07 + height),
        1,
    )
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0225, 0.09))
    build.add(plastic(tone("grey")), block(0.05, 0.004, 0.008, 0, -0.022, 0.0755))
    build.add(black, block(0.1, 0.04, 0.075, 0, 0.005, 0.012))
    build.add(black, soft_block(width * 0.42, 0.2, 0.014, 0, 0, 0, 0.006))
    return build


def wall_tv(look: Look) -> Assembly:
    build = Assembly(look)
    width = look.size(1.0, 1.25)
    height = width * 0.57
    build.add(plastic(linear((20, 20, 22))), soft_block(width, 0.05, height, 0, 0, 0, 0.012))
    dark = Material(
        Texture.SCREEN,
        linear((14, 16, 22)),
        linear((44, 50, 64)),
        0.0,
        0.9,
        0.0,
        0,
        (-width / 2, width / 2, 0, height),
        1,
    )
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0275, 0.02))
    build.add(plastic(tone("grey")), block(0.05, 0.004, 0.008, 0, -0.027, 0.006))
    return build


def monitor(look: Look) -> Assembly:
    build = Assembly(look)
    width = look.size(0.5, 0.6)
    height, lift = width * 0.6, 0.13
    case = plastic(look.rgb)
    build.add(case, soft_block(width, 0.035, height, 0, 0, lift, 0.012))
    build.add(
        _screen(look, width - 0.03, lift + 0.02, lift + height, 1.0, 0.55),
        block(width - 0.03, 0.006, height - 0.045, 0, -0.02, lift + 0.03),
    )
    build.add(case, soft_block(0.06, 0.03, lift + height * 0.4, 0, 0.034, 0.012, 0.01))
    build.add(
        case,
        lathe([(0, 0), (0.115, 0), (0.115, 0.01), (0.03, 0.018), (0, 0.018)], 24)
        .stretched(1.1, 0.8, 1.0)
        .moved(0, 0.02, 0),
    )
    return build


def laptop(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = look.size(0.33, 0.37), look.size(0.23, 0.25)
    case = metal(look.rgb, look.rng) if look.material == "metal" else plastic(look.rgb)
    build.add(case, soft_block(width, depth, 0.02, 0, 0, 0, 0.007))
    keys = Material(
        Texture.KEYS,
        linear((30, 30, 33)),
        linear((120, 122, 126)),
        0.02,
        0.1,
        axis=2,
        extent=(-width / 2, width / 2, -depth / 2, depth / 2),
    )
    build.add(keys, block(width * 0.86, depth * 0.5, 0.003, 0, depth * 0.14, 0.0202))
    build.add(plastic(shade(look.rgb, 0.7)), block(width * 0.3, depth * 0.26, 0.002, 0, -depth * 0.3, 0.0202))
    lid = block(width, 0.009, depth * 0.98)
    top = depth * 0.95
    view = block(width * 0.93, 0.004, depth * 0.86, 0, -0.007, depth * 0.06)
    for shape, material in ((lid, case), (view, _screen(look, width * 0.93, 0.02, top, 1.0, 0.55))):
        build.add(material, shape.turned("x", -16).moved(0, depth / 2 + 0.004, 0.012))
    return build


def keyboard(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = look.size(0.4, 0.47), look.size(0.13, 0.155)
    build.add(plastic(look.rgb), soft_block(width, depth, 0.022, 0, 0, 0, 0.008))
    light = look.colour == "black"
    a, b = (linear((58, 58, 62)), linear((150, 150, 155))) if light else (linear((250, 250, 250)), linear((80, 80, 84)))
    keys = Material(Texture.KEYS, a, b, 0.021, 0.1, axis=2, extent=(-width / 2, width / 2, -depth / 2, depth / 2))
    build.add(keys, block(width - 0.025, depth - 0.025, 0.009, 0, 0, 0.0222))
    return build


def mouse(look: Look) -> Assembly:
    build = Assembly(look)
    s = max(1.0, look.scale) * 1.12
    body = plastic(look.rgb)
    build.add(
        body,
        lathe([(0, 0), (0.95, 0), (1, 0.18), (0.86, 0.6), (0.5, 0.92), (0, 1.0)], 22).stretched(
            0.038 * s, 0.063 * s, 0.042 * s
        ),
    )
    build.add(plastic(tone("grey")), soft_block(0.012, 0.03, 0.014, 0, -0.032 * s, 0.031 * s, 0.005))
    build.add(plastic(shade(look.rgb, 0.5)), block(0.003, 0.05 * s, 0.006, 0, -0.006 * s, 0.0375 * s))
    return build


def desktop_computer(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth, height = look.size(0.18, 0.22), look.size(0.4, 0.46), look.size(0.4, 0.46)
    build.add(plastic(look.rgb), soft_block(width, depth, height, 0, 0, 0.015, 0.012))
    build.add(
        paint(tone("black")),
        *[block(0.03, 0.06, 0.015, sx * width * 0.35, sy * depth * 0.35) for sx in (-1, 1) for sy in (-1, 1)],
    )
    y = -depth / 2
    contrast = plastic(tone("grey") if look.colour == "black" else shade(tone("black"), 1.2))
    for z in (0.85, 0.74):
        build.add(contrast, block(width * 0.82, 0.008, height * 0.075, 0, y - 0.004, 0.015 + height * z))
    for i in range(5):
        build.add(contrast, block(width * 0.7, 0.006, 0.01, 0, y - 0.003, 0.05 + i * 0.026))
    glow = Material(Texture.PLAIN, linear((60, 150, 250)), linear((60, 150, 250)), glow=0.8)
    build.add(glow, cylinder(0.014, 0.006).turned("x", 90).moved(0, y, height * 0.6))
    build.spot((-width / 2 + 0.01, width / 2 - 0.01), (-depth / 2 + 0.02, depth / 2 - 0.02), height + 0.015, 0.2)
    return build


def countertop(look: Look) -> Assembly:
    """A stone slab of one metre; the layout stretches it over its base cabinets."""
    build = Assembly(look)
    build.add(look.main(), block(1.0, 0.62, 0.04))
    build.spot((-0.5, 0.5), (-0.31, 0.3), 0.04)
    return build


def towel_rail(look: Look) -> Assembly:
    """A towel over a rail, for a wall."""
    build = Assembly(look)
    width, front, back = look.size(0.34, 0.46), look.size(0.45, 0.6), 0.3
    angle = np.linspace(0, np.pi, 7)
    path = [
        (-0.06, -front),
        (-0.058, -0.02),
        *[(-0.035 - 0.022 * np.cos(a), 0.022 * np.sin(a)) for a in angle],
        (-0.014, -0.02),
        (-0.012, -back),
    ]
    profile = np.array(path)
    u = np.linspace(-width / 2, width / 2, 9)
    grid = np.empty((len(u), len(profile), 3))
    wave = 0.006 * np.sin(u * 18.0)[:, None] * np.clip(-profile[:, 1] * 3, 0, 1)[None, :]
    grid[..., 0], grid[..., 1], grid[..., 2] = u[:, None], profile[:, 0] + wave, profile[:, 1] + front
    build.add(look.main(), sheet(grid, 0.012))
    band = plain_cloth(shade(look.rgb, 0.55), look.rng)
    build.add(band, block(width - 0.01, 0.003, 0.05, 0, -0.0735, 0.06))
    build.add(chrome(look.rng), tube([(-width / 2 - 0.05, -0.035, front), (width / 2 + 0.05, -0.035, front)], 0.011))
    for sx in (-1, 1):
        build.add(chrome(look.rng), block(0.02, 0.045, 0.02, sx * (width / 2 + 0.045), -0.0125, front - 0.01))
    return build


FIXTURES: Mapping[str, tuple[Builder, ...]] = {
    "door": (door,),
    "window": (window,),
    "curtain": (curtain,),
    "blinds": (blinds,),
    "switch": (switch,),
    "wall-plug": (wall_plug,),
    "vent": (vent,),
    "sink": (pedestal_sink, kitchen_sink),
    "toilet": (toilet,),
    "bathtub": (bathtub,),
    "refrigerator": (refrigerator,),
    "cooktop": (cooktop,),
    "microwave": (microwave,),
    "tv-screen": (tv_screen, wall_tv),
    "monitor": (monitor,),
    "laptop": (laptop,),
    "computer-keyboard": (keyboard,),
    "mouse": (mouse,),
    "desktop-computer": (desktop_computer,),
    "countertop": (countertop,),
    "towel": (towel_rail,),
}
