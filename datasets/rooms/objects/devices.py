"""Builders of what runs on electricity: kitchen machines, screens, computers."""

from __future__ import annotations

from collections.abc import Sequence

from su3d_bench.datasets.rooms.objects.items import Assembly
from su3d_bench.datasets.rooms.objects.materials import (
    Material,
    Rgb,
    Texture,
    chrome,
    glass,
    light,
    linear,
    metal,
    paint,
    plastic,
    shade,
    tone,
)
from su3d_bench.datasets.rooms.objects.shapes import Shape, block, both, corners, cylinder, lathe, soft_block, tube


def _handle(x: float, near: float, far: float, heights: Sequence[float], radius: float) -> Shape:
    """An upright bar before a front: from ``near`` to ``far`` and back again, at four heights."""
    return tube([(x, y, z) for y, z in zip((near, far, far, near), heights, strict=True)], radius)


def refrigerator(build: Assembly) -> None:
    width, depth, height = build.size(0.6, 0.7), build.rng.uniform(0.6, 0.66), build.rng.uniform(1.65, 1.85)
    body = metal(build.rgb, build.rng) if build.colour == "grey" else plastic(build.rgb)
    build.add(body, soft_block(width, depth - 0.06, height - 0.04, 0, 0.03, 0.04, 0.02))
    build.add(paint(tone("black")), block(width - 0.06, depth - 0.1, 0.04, 0, 0.02))
    split = height * build.rng.uniform(0.6, 0.7)
    y = -depth / 2 + 0.028
    build.add(body, soft_block(width, 0.055, split - 0.055, 0, y, 0.05, 0.018))
    build.add(body, soft_block(width, 0.055, height - split - 0.005, 0, y, split + 0.005, 0.018))
    steel = chrome(build.rng)
    x = width / 2 - 0.06
    for z0, z1 in ((split - 0.5, split - 0.06), (split + 0.06, min(split + 0.38, height - 0.08))):
        build.add(steel, _handle(x, y - 0.02, y - 0.065, (z0, z0 + 0.02, z1 - 0.02, z1), 0.012))
    build.spot(both(width / 2 - 0.02), (-depth / 2 + 0.08, depth / 2 - 0.02), height, 0.45)


def cooktop(build: Assembly) -> None:
    width, depth = 0.58, 0.5
    build.add(glass(linear((22, 22, 25))), soft_block(width, depth, 0.014, 0, 0, 0, 0.005))
    iron = metal(linear((60, 60, 64)), build.rng)
    for sx in (-1, 1):
        for sy in (-1, 1):
            r = 0.085 if sx * sy > 0 else 0.065
            at = (sx * 0.15, sy * 0.12, 0.0142)
            ring = lathe([(r * 0.82, 0), (r, 0), (r, 0.006), (r * 0.82, 0.006), (r * 0.82, 0)], 22)
            build.add(metal(linear((150, 60, 40)), build.rng), ring.moved(*at))
            build.add(iron, lathe([(0, 0), (r * 0.6, 0), (r * 0.6, 0.005), (0, 0.005)], 20).moved(*at))
            build.spot((at[0] - 0.16, at[0] + 0.16), (at[1] - 0.16, at[1] + 0.16), 0.0225, role="burner")
    for i in range(4):
        build.add(chrome(build.rng), cylinder(0.016, 0.016, (i - 1.5) * 0.06, -depth / 2 + 0.03, 0.0142))


def microwave(build: Assembly) -> None:
    width, depth, height = build.size(0.45, 0.52), build.rng.uniform(0.32, 0.37), build.size(0.26, 0.3)
    build.add(plastic(build.rgb), soft_block(width, depth, height, 0, 0, 0.012, 0.012))
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
    heights = [height * share for share in (0.25, 0.27, 0.83, 0.85)]
    build.add(chrome(build.rng), _handle(width * 0.18, y - 0.012, y - 0.035, heights, 0.008))
    build.add(paint(tone("black")), *[block(0.04, 0.04, 0.014, *foot) for foot in corners(width * 0.4, depth * 0.38)])
    build.spot(both(width / 2 - 0.03), both(depth / 2 - 0.03), height + 0.012, 0.4)


def _screen(build: Assembly, width: float, z0: float, z1: float, lively: float, glow: float) -> Material:
    base = linear((52, 108, 172)) if build.chance(0.5) else linear((38, 132, 120))
    return Material(
        Texture.SCREEN,
        base,
        linear((236, 238, 242)),
        lively,
        0.5,
        glow,
        0,
        (-width / 2, width / 2, z0, z1),
        int(build.rng.integers(1, 999)),
    )


def tv_screen(build: Assembly) -> None:
    """A flat black television on a wide foot."""
    width = build.size(0.95, 1.2)
    height = width * 0.57
    black = plastic(linear((20, 20, 22)))
    build.add(black, soft_block(width, 0.04, height, 0, 0, 0.07, 0.012))
    dark = _dark_screen(width, 0.07, height)
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0225, 0.09))
    build.add(plastic(tone("grey")), block(0.05, 0.004, 0.008, 0, -0.022, 0.0755))
    build.add(black, block(0.1, 0.04, 0.075, 0, 0.005, 0.012))
    build.add(black, soft_block(width * 0.42, 0.2, 0.014, 0, 0, 0, 0.006))


def _dark_screen(width: float, bottom: float, height: float) -> Material:
    """A screen that is switched off, with a faint reflection."""
    window = (-width / 2, width / 2, bottom, bottom + height)
    return Material(Texture.SCREEN, linear((14, 16, 22)), linear((44, 50, 64)), 0.0, 0.9, 0.0, 0, window, 1)


def wall_tv(build: Assembly) -> None:
    width = build.size(1.0, 1.25)
    height = width * 0.57
    build.add(plastic(linear((20, 20, 22))), soft_block(width, 0.05, height, 0, 0, 0, 0.012))
    dark = _dark_screen(width, 0.0, height)
    build.add(dark, block(width - 0.03, 0.006, height - 0.035, 0, -0.0275, 0.02))
    build.add(plastic(tone("grey")), block(0.05, 0.004, 0.008, 0, -0.027, 0.006))


def monitor(build: Assembly) -> None:
    width = build.size(0.5, 0.6)
    height, lift = width * 0.6, 0.13
    case = plastic(build.rgb)
    build.add(case, soft_block(width, 0.035, height, 0, 0, lift, 0.012))
    build.add(
        _screen(build, width - 0.03, lift + 0.02, lift + height, 1.0, 0.55),
        block(width - 0.03, 0.006, height - 0.045, 0, -0.02, lift + 0.03),
    )
    build.add(case, soft_block(0.06, 0.03, lift + height * 0.4, 0, 0.034, 0.012, 0.01))
    build.add(
        case,
        lathe([(0, 0), (0.115, 0), (0.115, 0.01), (0.03, 0.018), (0, 0.018)], 24)
        .stretched(1.1, 0.8, 1.0)
        .moved(0, 0.02, 0),
    )


def laptop(build: Assembly) -> None:
    width, depth = build.size(0.33, 0.37), build.size(0.23, 0.25)
    case = build.main()
    build.add(case, soft_block(width, depth, 0.02, 0, 0, 0, 0.007))
    keys = _keys(linear((30, 30, 33)), linear((120, 122, 126)), 0.02, width, depth)
    build.add(keys, block(width * 0.86, depth * 0.5, 0.003, 0, depth * 0.14, 0.0202))
    build.add(plastic(shade(build.rgb, 0.7)), block(width * 0.3, depth * 0.26, 0.002, 0, -depth * 0.3, 0.0202))
    lid = block(width, 0.009, depth * 0.98)
    top = depth * 0.95
    view = block(width * 0.93, 0.004, depth * 0.86, 0, -0.007, depth * 0.06)
    for shape, material in ((lid, case), (view, _screen(build, width * 0.93, 0.02, top, 1.0, 0.55))):
        build.add(material, shape.turned("x", -16).moved(0, depth / 2 + 0.004, 0.012))


def _keys(key: Rgb, gap: Rgb, size: float, width: float, depth: float) -> Material:
    return Material(Texture.KEYS, key, gap, size, 0.1, axis=2, extent=(-width / 2, width / 2, -depth / 2, depth / 2))


def keyboard(build: Assembly) -> None:
    width, depth = build.size(0.4, 0.47), build.size(0.13, 0.155)
    build.add(plastic(build.rgb), soft_block(width, depth, 0.022, 0, 0, 0, 0.008))
    light = build.colour == "black"
    a, b = (linear((58, 58, 62)), linear((150, 150, 155))) if light else (linear((250, 250, 250)), linear((80, 80, 84)))
    build.add(_keys(a, b, 0.021, width, depth), block(width - 0.025, depth - 0.025, 0.009, 0, 0, 0.0222))


def mouse(build: Assembly) -> None:
    s = max(1.0, build.scale) * 1.12
    body = plastic(build.rgb)
    build.add(
        body,
        lathe([(0, 0), (0.95, 0), (1, 0.18), (0.86, 0.6), (0.5, 0.92), (0, 1.0)], 22).stretched(
            0.038 * s, 0.063 * s, 0.042 * s
        ),
    )
    build.add(plastic(tone("grey")), soft_block(0.012, 0.03, 0.014, 0, -0.032 * s, 0.031 * s, 0.005))
    build.add(plastic(shade(build.rgb, 0.5)), block(0.003, 0.05 * s, 0.006, 0, -0.006 * s, 0.0375 * s))


def desktop_computer(build: Assembly) -> None:
    width, depth, height = build.size(0.18, 0.22), build.size(0.4, 0.46), build.size(0.4, 0.46)
    build.add(plastic(build.rgb), soft_block(width, depth, height, 0, 0, 0.015, 0.012))
    build.add(paint(tone("black")), *[block(0.03, 0.06, 0.015, *foot) for foot in corners(width * 0.35, depth * 0.35)])
    y = -depth / 2
    contrast = plastic(tone("grey") if build.colour == "black" else shade(tone("black"), 1.2))
    for z in (0.85, 0.74):
        build.add(contrast, block(width * 0.82, 0.008, height * 0.075, 0, y - 0.004, 0.015 + height * z))
    for i in range(5):
        build.add(contrast, block(width * 0.7, 0.006, 0.01, 0, y - 0.003, 0.05 + i * 0.026))
    build.add(light((60, 150, 250), 0.8), cylinder(0.014, 0.006).turned("x", 90).moved(0, y, height * 0.6))
    build.spot(both(width / 2 - 0.01), both(depth / 2 - 0.02), height + 0.015, 0.2)
