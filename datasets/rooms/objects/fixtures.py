"""Builders of fixtures: doors, windows, kitchen and bathroom fixtures, devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.datasets.procedural.materials import Material, Rgb, Texture, light, linear, shade, tone
from su3d_bench.datasets.procedural.shapes import (
    Shape,
    block,
    both,
    box,
    corners,
    cylinder,
    ellipsoid,
    lathe,
    sheet,
    soft_block,
    tube,
)
from su3d_bench.datasets.rooms.objects.items import Assembly


def door(build: Assembly) -> None:
    width, height = build.rng.uniform(0.84, 0.95), build.rng.uniform(2.02, 2.1)
    frame = build.of("paint", shade(build.rgb, 0.82)) if build.colour == "white" else build.main(axis=2)
    build.add(frame, *[block(0.07, 0.06, height + 0.07, x) for x in both(width / 2 + 0.035)])
    build.add(frame, block(width, 0.06, 0.07, 0, 0, height))
    leaf = build.of("paint") if build.colour == "white" else build.main(axis=2)
    build.add(leaf, block(width - 0.006, 0.03, height - 0.01, 0, 0.015, 0.005))
    panel = replace(leaf, a=shade(leaf.a, 0.84), b=shade(leaf.b, 0.84))
    rows = [(0.14, 0.5), (0.56, 0.95)] if build.chance(0.7) else [(0.1, 0.32), (0.37, 0.62), (0.67, 0.94)]
    for low, high in rows:
        for sx in (-1, 1):
            tall, wide = (high - low) * height, width * 0.33
            x = sx * width * 0.21
            build.add(panel, soft_block(wide, 0.016, tall, x, -0.004, low * height, 0.007))
    steel = build.of("chrome")
    x = width / 2 - 0.07
    build.add(steel, soft_block(0.045, 0.012, 0.2, x, -0.005, 0.95, 0.005))
    build.add(steel, tube([(x, -0.01, 1.05), (x, -0.06, 1.051), (x - 0.12, -0.061, 1.05)], 0.011))


def window(build: Assembly) -> None:
    width, height = build.size(1.15, 1.5), build.rng.uniform(1.05, 1.25)
    frame = build.of("paint")
    extent = (-width / 2, width / 2, 0.0, height)
    above, below, seed = linear((150, 190, 235)), linear((236, 242, 250)), int(build.rng.integers(1, 999))
    sky = Material(Texture.SKY, above, below, 1.0, 0.5, 0.75, extent=extent, seed=seed)
    build.add(sky, block(width - 0.06, 0.012, height - 0.06, 0, 0.014, 0.03))
    bar = 0.055
    for x in (-width / 2 + bar / 2, 0.0, width / 2 - bar / 2):
        build.add(frame, block(bar, 0.05, height, x))
    rails = [(0.046, bar, 0.0), (0.046, bar, height - bar)]
    if build.chance(0.5):
        rails.append((0.03, 0.03, height * 0.62))
    for depth, thick, z in rails:
        for sx in (-1, 1):
            build.add(frame, block(width / 2 - 1.5 * bar, depth, thick, sx * (width / 4 - bar / 4), 0, z))
    build.add(frame, soft_block(width + 0.12, 0.17, 0.03, 0, -0.06, -0.032, 0.01))
    build.add("chrome", soft_block(0.02, 0.03, 0.12, 0.0, -0.035, height * 0.4, 0.008))


def curtain(build: Assembly) -> None:
    """One hanging, pleated panel with its rod."""
    width, height = build.rng.uniform(0.34, 0.48), build.rng.uniform(2.05, 2.25)
    folds = int(build.rng.integers(4, 7))
    u, v = np.linspace(0, 1, folds * 8 + 1), np.linspace(0, 1, 7)
    x = np.repeat(((u - 0.5) * width)[:, None], len(v), axis=1) * (0.86 + 0.14 * np.abs(v - 0.35))
    y = 0.032 * np.sin(2 * np.pi * folds * u)[:, None] * (0.6 + 0.4 * (1 - v))
    grid = np.stack([x, y, np.repeat((v * height)[None], len(u), axis=0)], axis=-1)
    build.add(build.main(), sheet(grid, 0.008))
    rod = build.of("metal", "black")
    build.add(rod, tube([(-width / 2 - 0.03, 0, height + 0.02), (width / 2 + 0.03, 0, height + 0.02)], 0.014))
    build.add(rod, *[ellipsoid(0.025, 0.025, 0.025).moved(x, 0, height + 0.02) for x in both(width / 2 + 0.04)])


def blinds(build: Assembly) -> None:
    width, height = build.rng.uniform(1.15, 1.4), build.rng.uniform(0.55, 0.95)
    slat = build.of("paint") if build.material == "plastic" else build.main(axis=0)
    build.add(slat, soft_block(width, 0.055, 0.05, 0, 0, height - 0.05, 0.01))
    n = int(height / 0.042)
    for i in range(1, n):
        tilted = block(width, 0.045, 0.005, 0, 0, -0.0025).turned("x", 32)
        build.add(slat, tilted.moved(0, 0, height - 0.05 - i * 0.042))
    build.add(slat, block(width, 0.03, 0.022))
    cord = build.of("paint", shade(build.rgb, 0.55))
    build.add(cord, *[block(0.006, 0.006, height - 0.06, x, -0.03, 0.01) for x in both(width * 0.32)])


def switch(build: Assembly) -> None:
    n = 2
    build.add("plastic", soft_block(0.1 * n, 0.014, 0.13, 0, 0, 0, 0.006))
    for i in range(n):
        x = (i - (n - 1) / 2) * 0.088
        build.add(
            build.of("plastic", shade(build.rgb, 0.82)), block(0.062, 0.012, 0.088, x, -0.009, 0.021).turned("x", 2)
        )


def wall_plug(build: Assembly) -> None:
    build.add("plastic", soft_block(0.21, 0.014, 0.11, 0, 0, 0, 0.006))
    dark = build.of("paint", "black")
    for x in (-0.05, 0.05):
        ring = lathe([(0, 0), (0.038, 0), (0.038, 0.008), (0.031, 0.008), (0.031, 0.002), (0, 0.002)], 18)
        build.add(build.of("plastic", shade(build.rgb, 0.75)), ring.turned("x", 90).moved(x, -0.0075, 0.055))
        for dx in (-0.012, 0.012):
            build.add(dark, cylinder(0.006, 0.004).turned("x", 90).moved(x + dx, -0.0095, 0.055))


def vent(build: Assembly) -> None:
    width, height = build.size(0.32, 0.45), build.size(0.2, 0.28)
    frame = build.of("paint")
    build.add(frame, block(width, 0.016, 0.025), block(width, 0.016, 0.025, z=height - 0.025))
    build.add(frame, *[block(0.025, 0.016, height - 0.05, x, 0, 0.025) for x in both(width / 2 - 0.0125)])
    build.add(build.of("paint", shade(tone("grey"), 0.25)), block(width - 0.05, 0.006, height - 0.05, 0, 0.005, 0.025))
    n = int((height - 0.06) / 0.03)
    for i in range(n):
        slat = block(width - 0.052, 0.016, 0.004, 0, 0, 0).turned("x", 35)
        build.add(frame, slat.moved(0, -0.003, 0.035 + (i + 0.3) * (height - 0.06) / n))


def _faucet(build: Assembly, x: float, y: float, z: float, reach: float = 0.16, tall: float = 0.2) -> None:
    steel = build.of("chrome")
    angle = np.linspace(0, np.pi * 0.9, 7)
    radius = reach / 2
    arc = [(x, y - radius + radius * float(np.cos(a)), z + tall + radius * float(np.sin(a))) for a in angle]
    build.add(steel, tube([(x, y, z), *arc], 0.013))
    build.add(steel, cylinder(0.026, 0.03, x, y, z))
    build.add(steel, *[soft_block(0.028, 0.028, 0.055, x + dx, y, z, 0.012) for dx in (-0.09, 0.09)])


def _basin(material: Material, width: float, depth: float, tall: float, wall: float = 0.03) -> list[Shape]:
    """An open rectangular tub out of four walls and a bottom."""
    w, d, high = width / 2, depth / 2, tall - wall - 0.001
    return [
        box(-w, w, -d, d, 0, wall),
        *[soft_block(wall, depth, high, x, 0, wall + 0.001, 0.012) for x in both(w - wall / 2)],
        *[soft_block(width - 2 * wall, wall, high, 0, y, wall + 0.001, 0.012) for y in both(d - wall / 2)],
    ]


def pedestal_sink(build: Assembly) -> None:
    r = build.size(0.25, 0.29)
    white = build.of("ceramic")
    bowl = lathe([(0, 0.66), (r * 0.45, 0.66), (r * 0.85, 0.74), (r, 0.83), (r, 0.85), (r * 0.88, 0.85),
                  (r * 0.8, 0.81), (r * 0.5, 0.735), (0, 0.72)], 28)  # fmt: skip
    build.add(white, bowl.stretched(1.15, 0.85, 1.0))
    build.add(white, lathe([(0, 0), (0.12, 0), (0.1, 0.06), (0.075, 0.3), (0.085, 0.67), (0, 0.67)]))
    build.add(white, soft_block(r * 1.7, 0.09, 0.09, 0, r * 0.85, 0.765, 0.02))
    build.add("chrome", cylinder(0.022, 0.006, 0, 0, 0.722))
    _faucet(build, 0.0, r * 0.85, 0.855, 0.17, 0.1)


def kitchen_sink(build: Assembly) -> None:
    """A steel or ceramic basin that stands on a countertop, with a faucet."""
    width, depth, tall = 0.52, 0.42, 0.13
    body = build.of("metal", linear((186, 188, 192))) if build.material == "metal" else build.of("ceramic")
    build.add(body, *_basin(body, width, depth, tall))
    build.add(build.of("paint", "black"), cylinder(0.03, 0.004, 0, 0, 0.031))
    build.add(body, soft_block(0.34, 0.06, tall, 0, depth / 2 + 0.031, 0, 0.012))
    _faucet(build, 0.0, depth / 2 + 0.03, tall, 0.22, 0.16)


def toilet(build: Assembly) -> None:
    white = build.of("ceramic")
    seat = 0.4
    outside = [(0, 0), (0.13, 0), (0.11, 0.08), (0.13, 0.2), (0.19, 0.34), (0.2, 0.385)]
    bowl = lathe([*outside, (0.15, 0.385), (0.1, 0.28), (0, 0.24)], 24)
    build.add(white, bowl.stretched(0.95, 1.3, 1.0).moved(0, -0.12, 0))
    ring = lathe([(0.13, 0.0), (0.205, 0.0), (0.207, 0.022), (0.13, 0.022), (0.13, 0.0)], 24).stretched(0.97, 1.3, 1.0)
    build.add("plastic", ring.moved(0, -0.12, seat - 0.012))
    build.add(white, soft_block(0.22, 0.26, 0.38, 0, 0.18, 0, 0.04))
    build.add(white, soft_block(0.42, 0.19, 0.37, 0, 0.24, seat - 0.005, 0.035))
    build.add(white, soft_block(0.44, 0.21, 0.04, 0, 0.24, seat + 0.366, 0.015))
    build.add("chrome", cylinder(0.025, 0.012, 0, 0.24, seat + 0.406))
    if build.chance(0.6):  # lid up
        lid = lathe([(0, 0), (0.2, 0), (0.2, 0.02), (0, 0.022)], 24).stretched(0.97, 1.2, 1.0).moved(0, -0.24, 0)
        build.add("plastic", lid.turned("x", -82).moved(0, 0.115, seat + 0.02))
    else:
        lid = lathe([(0, 0), (0.205, 0), (0.2, 0.02), (0, 0.026)], 24).stretched(0.97, 1.3, 1.0)
        build.add("plastic", lid.moved(0, -0.12, seat + 0.012))


def bathtub(build: Assembly) -> None:
    length, depth, tall = build.rng.uniform(1.5, 1.7), build.rng.uniform(0.7, 0.76), 0.54
    white = build.of("ceramic")
    w, d, rim = length / 2, depth / 2, 0.075
    build.add(white, box(-w + 0.01, w - 0.01, -d + 0.01, d - 0.01, 0, 0.14))
    build.add(white, *[soft_block(rim, depth, tall - 0.141, x, 0, 0.141, 0.03) for x in both(w - rim / 2)])
    inner = length - 2 * rim + 0.04
    build.add(white, *[soft_block(inner, rim, tall - 0.141, 0, y, 0.141, 0.03) for y in both(d - rim / 2)])
    build.add("chrome", cylinder(0.03, 0.005, -w * 0.6, 0, 0.141))
    steel = build.of("chrome")
    build.add(steel, soft_block(0.05, 0.22, 0.05, -w + 0.04, 0, tall + 0.04, 0.02))
    build.add(steel, tube([(-w + 0.04, 0, tall), (-w + 0.04, 0, tall + 0.05)], 0.015))
    spout = (0.05, 0.065), (0.16, 0.06), (0.18, 0.02)
    build.add(steel, tube([(-w + x, 0, tall + z) for x, z in spout], 0.014))
    build.spot((-w + 0.6, w - 0.1), (-d + 0.005, -d + rim - 0.005), tall, role="rim")


def countertop(build: Assembly) -> None:
    """A stone slab of one metre; the layout stretches it over its base cabinets."""
    build.add(build.main(), block(1.0, 0.62, 0.04))
    build.spot((-0.5, 0.5), (-0.31, 0.3), 0.04)


def towel_rail(build: Assembly) -> None:
    """A towel over a rail, for a wall."""
    width, front, back = build.size(0.34, 0.46), build.size(0.45, 0.6), 0.3
    angle = np.linspace(0, np.pi, 7)
    over = [(-0.035 - 0.022 * np.cos(a), 0.022 * np.sin(a)) for a in angle]
    profile = np.array([(-0.06, -front), (-0.058, -0.02), *over, (-0.014, -0.02), (-0.012, -back)])
    u = np.linspace(-width / 2, width / 2, 9)
    grid = np.empty((len(u), len(profile), 3))
    wave = 0.006 * np.sin(u * 18.0)[:, None] * np.clip(-profile[:, 1] * 3, 0, 1)[None, :]
    grid[..., 0], grid[..., 1], grid[..., 2] = u[:, None], profile[:, 0] + wave, profile[:, 1] + front
    build.add(build.main(), sheet(grid, 0.012))
    band = build.of("plain fabric", shade(build.rgb, 0.55))
    build.add(band, block(width - 0.01, 0.003, 0.05, 0, -0.0735, 0.06))
    build.add("chrome", tube([(-width / 2 - 0.05, -0.035, front), (width / 2 + 0.05, -0.035, front)], 0.011))
    for sx in (-1, 1):
        build.add("chrome", block(0.02, 0.045, 0.02, sx * (width / 2 + 0.045), -0.0125, front - 0.01))


def _handle(x: float, near: float, far: float, heights: Sequence[float], radius: float) -> Shape:
    """An upright bar in front of a surface: from ``near`` to ``far`` and back, at four heights."""
    return tube([(x, y, z) for y, z in zip((near, far, far, near), heights, strict=True)], radius)


def refrigerator(build: Assembly) -> None:
    width, depth, height = build.size(0.6, 0.7), build.rng.uniform(0.6, 0.66), build.rng.uniform(1.65, 1.85)
    body = build.of("metal") if build.colour == "grey" else build.of("plastic")
    build.add(body, soft_block(width, depth - 0.06, height - 0.04, 0, 0.03, 0.04, 0.02))
    build.add(build.of("paint", "black"), block(width - 0.06, depth - 0.1, 0.04, 0, 0.02))
    split = height * build.rng.uniform(0.6, 0.7)
    y = -depth / 2 + 0.028
    build.add(body, soft_block(width, 0.055, split - 0.055, 0, y, 0.05, 0.018))
    build.add(body, soft_block(width, 0.055, height - split - 0.005, 0, y, split + 0.005, 0.018))
    steel = build.of("chrome")
    x = width / 2 - 0.06
    for z0, z1 in ((split - 0.5, split - 0.06), (split + 0.06, min(split + 0.38, height - 0.08))):
        build.add(steel, _handle(x, y - 0.02, y - 0.065, (z0, z0 + 0.02, z1 - 0.02, z1), 0.012))
    build.spot(both(width / 2 - 0.02), (-depth / 2 + 0.08, depth / 2 - 0.02), height, 0.45)


def cooktop(build: Assembly) -> None:
    width, depth = 0.58, 0.5
    build.add(build.of("glass", linear((22, 22, 25))), soft_block(width, depth, 0.014, 0, 0, 0, 0.005))
    iron = build.of("metal", linear((60, 60, 64)))
    for sx in (-1, 1):
        for sy in (-1, 1):
            r = 0.085 if sx * sy > 0 else 0.065
            at = (sx * 0.15, sy * 0.12, 0.0142)
            ring = lathe([(r * 0.82, 0), (r, 0), (r, 0.006), (r * 0.82, 0.006), (r * 0.82, 0)], 22)
            build.add(build.of("metal", linear((150, 60, 40))), ring.moved(*at))
            build.add(iron, lathe([(0, 0), (r * 0.6, 0), (r * 0.6, 0.005), (0, 0.005)], 20).moved(*at))
            build.spot((at[0] - 0.16, at[0] + 0.16), (at[1] - 0.16, at[1] + 0.16), 0.0225, role="burner")
    for i in range(4):
        build.add("chrome", cylinder(0.016, 0.016, (i - 1.5) * 0.06, -depth / 2 + 0.03, 0.0142))


def microwave(build: Assembly) -> None:
    width, depth, height = build.size(0.45, 0.52), build.rng.uniform(0.32, 0.37), build.size(0.26, 0.3)
    build.add("plastic", soft_block(width, depth, height, 0, 0, 0.012, 0.012))
    y = -depth / 2
    dark = build.of("glass", linear((18, 19, 22)))
    build.add(dark, block(width * 0.6, 0.012, height * 0.68, -width * 0.15, y - 0.006, 0.012 + height * 0.16))
    x = width * 0.36
    panel = block(width * 0.2, 0.008, height * 0.86, x, y - 0.004, 0.012 + height * 0.07)
    build.add(build.of("plastic", shade(tone("grey"), 0.5)), panel)
    digits = Material(Texture.PLAIN, linear((70, 220, 150)), linear((60, 190, 130)), glow=0.6)
    build.add(digits, block(width * 0.14, 0.004, 0.03, x, y - 0.0105, height * 0.82))
    keys = [(x + (i - 1) * 0.028, y - 0.0115, height * 0.3 + j * 0.04) for i in range(3) for j in range(3)]
    build.add(build.of("plastic", "white"), *[block(0.02, 0.006, 0.016, *place) for place in keys])
    heights = [height * share for share in (0.25, 0.27, 0.83, 0.85)]
    build.add("chrome", _handle(width * 0.18, y - 0.012, y - 0.035, heights, 0.008))
    build.add(
        build.of("paint", "black"), *[block(0.04, 0.04, 0.014, *foot) for foot in corners(width * 0.4, depth * 0.38)]
    )
    build.spot(both(width / 2 - 0.03), both(depth / 2 - 0.03), height + 0.012, 0.4)


def _screen(build: Assembly, width: float, z0: float, z1: float, lively: float, glow: float) -> Material:
    base = linear((52, 108, 172)) if build.chance(0.5) else linear((38, 132, 120))
    extent, seed = (-width / 2, width / 2, z0, z1), int(build.rng.integers(1, 999))
    return Material(Texture.SCREEN, base, linear((236, 238, 242)), lively, 0.5, glow, extent=extent, seed=seed)


def tv_screen(build: Assembly) -> None:
    """A flat black television on a wide foot."""
    width = build.size(0.95, 1.2)
    height = width * 0.57
    black = build.of("plastic", linear((20, 20, 22)))
    build.add(black, soft_block(width, 0.04, height, 0, 0, 0.07, 0.012))
    dark = _dark_screen(width, 0.07, height)
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0225, 0.09))
    build.add(build.of("plastic", "grey"), block(0.05, 0.004, 0.008, 0, -0.022, 0.0755))
    build.add(black, block(0.1, 0.04, 0.075, 0, 0.005, 0.012))
    build.add(black, soft_block(width * 0.42, 0.2, 0.014, 0, 0, 0, 0.006))


def _dark_screen(width: float, bottom: float, height: float) -> Material:
    """A screen that is switched off, with a faint reflection."""
    window = (-width / 2, width / 2, bottom, bottom + height)
    return Material(Texture.SCREEN, linear((14, 16, 22)), linear((44, 50, 64)), 0.0, 0.9, 0.0, 0, window, 1)


def wall_tv(build: Assembly) -> None:
    width = build.size(1.0, 1.25)
    height = width * 0.57
    build.add(build.of("plastic", linear((20, 20, 22))), soft_block(width, 0.05, height, 0, 0, 0, 0.012))
    dark = _dark_screen(width, 0.0, height)
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0275, 0.02))
    build.add(build.of("plastic", "grey"), block(0.05, 0.004, 0.008, 0, -0.027, 0.006))


def monitor(build: Assembly) -> None:
    width = build.size(0.5, 0.6)
    height, lift = width * 0.6, 0.13
    case = build.of("plastic")
    build.add(case, soft_block(width, 0.035, height, 0, 0, lift, 0.012))
    view = block(width - 0.03, 0.006, height - 0.045, 0, -0.02, lift + 0.03)
    build.add(_screen(build, width - 0.03, lift + 0.02, lift + height, 1.0, 0.55), view)
    build.add(case, soft_block(0.06, 0.03, lift + height * 0.4, 0, 0.034, 0.012, 0.01))
    foot = lathe([(0, 0), (0.115, 0), (0.115, 0.01), (0.03, 0.018), (0, 0.018)], 24)
    build.add(case, foot.stretched(1.1, 0.8, 1.0).moved(0, 0.02, 0))


def laptop(build: Assembly) -> None:
    width, depth = build.size(0.33, 0.37), build.size(0.23, 0.25)
    case = build.main()
    build.add(case, soft_block(width, depth, 0.02, 0, 0, 0, 0.007))
    keys = _keys(linear((30, 30, 33)), linear((120, 122, 126)), 0.02, width, depth)
    build.add(keys, block(width * 0.86, depth * 0.5, 0.003, 0, depth * 0.14, 0.0202))
    build.add(
        build.of("plastic", shade(build.rgb, 0.7)), block(width * 0.3, depth * 0.26, 0.002, 0, -depth * 0.3, 0.0202)
    )
    lid = block(width, 0.009, depth * 0.98)
    top = depth * 0.95
    view = block(width * 0.93, 0.004, depth * 0.86, 0, -0.007, depth * 0.06)
    for shape, material in ((lid, case), (view, _screen(build, width * 0.93, 0.02, top, 1.0, 0.55))):
        build.add(material, shape.turned("x", -16).moved(0, depth / 2 + 0.004, 0.012))


def _keys(key: Rgb, gap: Rgb, size: float, width: float, depth: float) -> Material:
    return Material(Texture.KEYS, key, gap, size, 0.1, axis=2, extent=(-width / 2, width / 2, -depth / 2, depth / 2))


def keyboard(build: Assembly) -> None:
    width, depth = build.size(0.4, 0.47), build.size(0.13, 0.155)
    build.add("plastic", soft_block(width, depth, 0.022, 0, 0, 0, 0.008))
    light = build.colour == "black"
    a, b = (linear((58, 58, 62)), linear((150, 150, 155))) if light else (linear((250, 250, 250)), linear((80, 80, 84)))
    build.add(_keys(a, b, 0.021, width, depth), block(width - 0.025, depth - 0.025, 0.009, 0, 0, 0.0222))


def mouse(build: Assembly) -> None:
    s = max(1.0, build.scale) * 1.12
    body = build.of("plastic")
    shell = lathe([(0, 0), (0.95, 0), (1, 0.18), (0.86, 0.6), (0.5, 0.92), (0, 1.0)], 22)
    build.add(body, shell.stretched(0.038 * s, 0.063 * s, 0.042 * s))
    build.add(build.of("plastic", "grey"), soft_block(0.012, 0.03, 0.014, 0, -0.032 * s, 0.031 * s, 0.005))
    build.add(build.of("plastic", shade(build.rgb, 0.5)), block(0.003, 0.05 * s, 0.006, 0, -0.006 * s, 0.0375 * s))


def desktop_computer(build: Assembly) -> None:
    width, depth, height = build.size(0.18, 0.22), build.size(0.4, 0.46), build.size(0.4, 0.46)
    build.add("plastic", soft_block(width, depth, height, 0, 0, 0.015, 0.012))
    build.add(
        build.of("paint", "black"), *[block(0.03, 0.06, 0.015, *foot) for foot in corners(width * 0.35, depth * 0.35)]
    )
    y = -depth / 2
    contrast = build.of("plastic", tone("grey") if build.colour == "black" else shade(tone("black"), 1.2))
    for z in (0.85, 0.74):
        build.add(contrast, block(width * 0.82, 0.008, height * 0.075, 0, y - 0.004, 0.015 + height * z))
    for i in range(5):
        build.add(contrast, block(width * 0.7, 0.006, 0.01, 0, y - 0.003, 0.05 + i * 0.026))
    build.add(light((60, 150, 250), 0.8), cylinder(0.014, 0.006).turned("x", 90).moved(0, y, height * 0.6))
    build.spot(both(width / 2 - 0.01), both(depth / 2 - 0.02), height + 0.015, 0.2)
