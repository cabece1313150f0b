"""Builders of what is made of cloth: cushions, blankets, towels, rugs, bags."""

from __future__ import annotations

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Assembly
from su3d_bench.datasets.rooms.objects.materials import (
    Material,
    Texture,
    chrome,
    cloth,
    metal,
    mix,
    plain_cloth,
    shade,
    tone,
    wood,
)
from su3d_bench.datasets.rooms.objects.shapes import block, both, cylinder, lathe, puff, sheet, soft_block, tube


def cushion(build: Assembly) -> None:
    """A square, often patterned cushion that leans back."""
    side, fat = build.size(0.38, 0.46), build.rng.uniform(0.13, 0.17)
    build.add(build.main(), puff(side, side, fat).turned("x", -16))


def flat_cushion(build: Assembly) -> None:
    side = build.size(0.38, 0.46)
    build.add(build.main(), puff(side, side, 0.12).turned("x", 90))


def pillow(build: Assembly) -> None:
    """A wide, flat, pale pillow."""
    width, depth = build.size(0.52, 0.64), build.size(0.34, 0.4)
    build.add(plain_cloth(build.rgb, build.rng), puff(width, depth, build.rng.uniform(0.14, 0.18)).turned("x", 90))


def blanket(build: Assembly) -> None:
    """A folded blanket: layers with a rounded fold at the front."""
    width, depth = build.size(0.42, 0.55), build.size(0.32, 0.4)
    cover = cloth(build.rgb, build.rng, large=True)
    n = int(build.rng.integers(3, 5))
    for i in range(n):
        grow, x = build.rng.uniform(-0.012, 0.012), build.rng.uniform(-0.006, 0.006)
        build.add(cover, soft_block(width + grow, depth + grow, 0.034, x, 0, i * 0.0345, 0.0165))
    fringe = plain_cloth(shade(build.rgb, 0.6), build.rng)
    for i in range(int(width / 0.03)):
        build.add(
            fringe,
            block(0.011, 0.04, 0.006, -width / 2 + 0.02 + i * 0.03, -depth / 2 - 0.022, (n - 1) * 0.0345 + 0.012),
        )


def rolled_blanket(build: Assembly) -> None:
    """A thick roll with a fringe at one end."""
    length, r = build.size(0.44, 0.52), build.size(0.075, 0.085)
    spiral = [(r * 0.2, 0.004), (r * 0.3, -0.004), (r * 0.55, -0.004), (r * 0.65, 0.005), (r * 0.8, 0.005), (r, 0.014)]
    build.add(
        cloth(build.rgb, build.rng, large=True), lathe([(0, 0), *spiral, (r, length), (0, length)], 20).turned("y", 90)
    )
    fringe = plain_cloth(shade(build.rgb, 0.6), build.rng)
    for i in range(14):
        strand = block(0.03, 0.008, 0.006, length + 0.016, 0, r * 0.9).turned("x", 360 * i / 14)
        build.add(fringe, strand)


def folded_towel(build: Assembly) -> None:
    """A stack of folded towels with a border stripe."""
    width, depth = build.size(0.3, 0.38), build.size(0.2, 0.25)
    stripe = plain_cloth(mix(build.rgb, (0.9, 0.9, 0.9), 0.6), build.rng)
    soft = plain_cloth(build.rgb, build.rng)
    for i in range(int(build.rng.integers(2, 4))):
        z = i * 0.047
        build.add(soft, soft_block(width, depth, 0.045, float(build.rng.uniform(-0.008, 0.008)), 0, z, 0.021))
        build.add(stripe, block(width * 0.1, 0.003, 0.03, width * 0.25, -depth / 2 - 0.002, z + 0.008))


def rolled_towel(build: Assembly) -> None:
    length, r = build.size(0.34, 0.42), build.size(0.055, 0.07)
    soft = plain_cloth(build.rgb, build.rng)
    spiral = [
        (r * 0.2, 0.003),
        (r * 0.25, 0.003),
        (r * 0.35, -0.004),
        (r * 0.55, -0.004),
        (r * 0.62, 0.004),
        (r * 0.8, 0.004),
        (r, 0.012),
    ]
    build.add(soft, lathe([(0, 0), *spiral, (r, length), (0, length)], 18).turned("y", 90))
    band = plain_cloth(mix(build.rgb, (0.9, 0.9, 0.9), 0.6), build.rng)
    build.add(
        band,
        lathe([(r, 0), (r + 0.003, 0), (r + 0.003, 0.03), (r, 0.03), (r, 0)], 18).turned("y", 90).moved(length * 0.75),
    )


def rug(build: Assembly) -> None:
    width, depth = build.size(1.5, 2.0), build.size(1.1, 1.4)
    second = build.other(*(c for c in ("red", "blue", "beige", "white", "brown", "orange") if c != build.colour))
    pile = Material(
        Texture.RUG,
        build.rgb,
        second,
        build.rng.uniform(0.12, 0.22),
        0.0,
        0.0,
        2,
        (-width / 2, width / 2, -depth / 2, depth / 2),
        int(build.rng.integers(1, 999)),
    )
    build.add(pile, block(width, depth, 0.012))
    fringe = plain_cloth(tone("beige"), build.rng)
    for sx in (-1, 1):
        build.add(
            fringe,
            *[
                block(0.05, 0.012, 0.005, sx * (width / 2 + 0.026), y, 0)
                for y in np.arange(-depth / 2 + 0.02, depth / 2, 0.05)
            ],
        )


def mat(build: Assembly) -> None:
    width, depth = build.size(0.6, 0.75), build.size(0.4, 0.46)
    pile = Material(Texture.CARPET, build.rgb, shade(build.rgb, 0.55), 0.012)
    build.add(pile, soft_block(width, depth, 0.026, 0, 0, 0, 0.012))
    edge = plain_cloth(mix(build.rgb, (0.85, 0.85, 0.82), 0.6), build.rng)
    build.add(edge, *[block(width * 0.86, 0.03, 0.003, 0, y, 0.0262) for y in both(depth * 0.38)])


def backpack(build: Assembly) -> None:
    width, depth, height = build.size(0.29, 0.34), build.size(0.16, 0.19), build.size(0.4, 0.47)
    cover = plain_cloth(build.rgb, build.rng)
    trim = plain_cloth(shade(build.rgb, 0.4) if build.colour != "black" else tone("grey"), build.rng)
    build.add(cover, soft_block(width, depth, height, 0, 0, 0, 0.07))
    build.add(trim, soft_block(width * 0.78, 0.07, height * 0.42, 0, -depth / 2 - 0.02, 0.03, 0.03))
    build.add(trim, soft_block(width * 0.9, depth * 0.9, 0.03, 0, -0.02, height * 0.72, 0.012))
    build.add(trim, *[soft_block(0.06, depth * 0.6, height * 0.3, x, 0, 0.04, 0.025) for x in both(width / 2 + 0.015)])
    angle = np.linspace(0, np.pi, 7)
    build.add(
        trim,
        tube([(0.05 * float(np.cos(a)), depth * 0.2, height - 0.01 + 0.05 * float(np.sin(a))) for a in angle], 0.01, 7),
    )
    build.add(chrome(build.rng), block(width * 0.66, 0.006, 0.008, 0, -depth / 2 - 0.056, height * 0.36))
    for sx in (-1, 1):
        x = sx * width * 0.27
        strap = [
            (x, depth / 2 - 0.01, height * 0.9),
            (x, depth / 2 + 0.04, height * 0.6),
            (x, depth / 2 - 0.005, height * 0.12),
        ]
        build.add(trim, tube(strap, 0.017, 6))


def umbrella(build: Assembly) -> None:
    """A closed umbrella that stands on its tip: shaft, folded canopy, crook."""
    h = build.size(0.78, 0.9)
    build.add(metal(tone("grey"), build.rng), cylinder(0.008, h * 0.8))
    r = 0.055 * build.scale
    folds = 8
    angle = np.linspace(0, 2 * np.pi, folds * 6 + 1)
    ring = 1 + 0.22 * np.cos(folds * angle)
    heights, radii = [0.06, 0.15, 0.45, 0.62, 0.66], [0.012, r * 0.55, r, r * 0.9, 0.014]
    grid = np.stack(
        [
            np.stack([ring * rad * np.cos(angle), ring * rad * np.sin(angle), np.full_like(angle, h * z)], axis=-1)
            for z, rad in zip(heights, radii, strict=True)
        ],
        axis=1,
    )
    build.add(plain_cloth(build.rgb, build.rng), sheet(grid, 0.004))
    build.add(
        plain_cloth(shade(build.rgb, 0.4), build.rng),
        lathe([(r * 0.9, 0), (r * 1.24, 0), (r * 1.24, 0.03), (r * 0.9, 0.03)], 18).moved(z=h * 0.42),
    )
    turn = np.linspace(0, np.pi, 8)
    crook = [(0.04 - 0.04 * float(np.cos(a)), 0.0, h * 0.9 + 0.04 * float(np.sin(a))) for a in turn]
    build.add(wood(tone("brown"), build.rng, 2), tube([(0, 0, h * 0.66), *crook, (0.08, 0, h * 0.85)], 0.013, 8))
