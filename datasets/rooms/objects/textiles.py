"""Builders of what is made of cloth: cushions, blankets, towels, rugs, bags."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Assembly, Builder, Look
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
from su3d_bench.datasets.rooms.objects.shapes import block, cylinder, lathe, puff, sheet, soft_block, tube


def cushion(look: Look) -> Assembly:
    """A square, often patterned cushion that leans back."""
    build = Assembly(look)
    side, fat = look.size(0.38, 0.46), look.rng.uniform(0.13, 0.17)
    build.add(look.main(), puff(side, side, fat).turned("x", -16))
    return build


def flat_cushion(look: Look) -> Assembly:
    build = Assembly(look)
    side = look.size(0.38, 0.46)
    build.add(look.main(), puff(side, side, 0.12).turned("x", 90))
    return build


def pillow(look: Look) -> Assembly:
    """A wide, flat, pale pillow."""
    build = Assembly(look)
    width, depth = look.size(0.52, 0.64), look.size(0.34, 0.4)
    build.add(plain_cloth(look.rgb, look.rng), puff(width, depth, look.rng.uniform(0.14, 0.18)).turned("x", 90))
    return build


def blanket(look: Look) -> Assembly:
    """A folded blanket: layers with a rounded fold at the front."""
    build = Assembly(look)
    width, depth = look.size(0.42, 0.55), look.size(0.32, 0.4)
    cover = cloth(look.rgb, look.rng, large=True)
    n = int(look.rng.integers(3, 5))
    for i in range(n):
        grow = look.rng.uniform(-0.012, 0.012)
        build.add(
            cover, soft_block(width + grow, depth + grow, 0.034, look.rng.uniform(-0.006, 0.006), 0, i * 0.0345, 0.0165)
        )
    fringe = plain_cloth(shade(look.rgb, 0.6), look.rng)
    for i in range(int(width / 0.03)):
        build.add(
            fringe,
            block(0.011, 0.04, 0.006, -width / 2 + 0.02 + i * 0.03, -depth / 2 - 0.022, (n - 1) * 0.0345 + 0.012),
        )
    return build


def rolled_blanket(look: Look) -> Assembly:
    """A thick roll with a fringe at one end."""
    build = Assembly(look)
    length, r = look.size(0.44, 0.52), look.size(0.075, 0.085)
    spiral = [(r * 0.2, 0.004), (r * 0.3, -0.004), (r * 0.55, -0.004), (r * 0.65, 0.005), (r * 0.8, 0.005), (r, 0.014)]
    build.add(
        cloth(look.rgb, look.rng, large=True), lathe([(0, 0), *spiral, (r, length), (0, length)], 20).turned("y", 90)
    )
    fringe = plain_cloth(shade(look.rgb, 0.6), look.rng)
    for i in range(14):
        strand = block(0.03, 0.008, 0.006, length + 0.016, 0, r * 0.9).turned("x", 360 * i / 14)
        build.add(fringe, strand)
    return build


def folded_towel(look: Look) -> Assembly:
    """A stack of folded towels with a border stripe."""
    build = Assembly(look)
    width, depth = look.size(0.3, 0.38), look.size(0.2, 0.25)
    stripe = plain_cloth(mix(look.rgb, (0.9, 0.9, 0.9), 0.6), look.rng)
    soft = plain_cloth(look.rgb, look.rng)
    for i in range(int(look.rng.integers(2, 4))):
        z = i * 0.047
        build.add(soft, soft_block(width, depth, 0.045, float(look.rng.uniform(-0.008, 0.008)), 0, z, 0.021))
        build.add(stripe, block(width * 0.1, 0.003, 0.03, width * 0.25, -depth / 2 - 0.002, z + 0.008))
    return build


def rolled_towel(look: Look) -> Assembly:
    build = Assembly(look)
    length, r = look.size(0.34, 0.42), look.size(0.055, 0.07)
    soft = plain_cloth(look.rgb, look.rng)
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
    band = plain_cloth(mix(look.rgb, (0.9, 0.9, 0.9), 0.6), look.rng)
    build.add(
        band,
        lathe([(r, 0), (r + 0.003, 0), (r + 0.003, 0.03), (r, 0.03), (r, 0)], 18).turned("y", 90).moved(length * 0.75),
    )
    return build


def rug(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = look.size(1.5, 2.0), look.size(1.1, 1.4)
    second = look.other(
        str(look.rng.choice([c for c in ("red", "blue", "beige", "white", "brown", "orange") if c != look.colour]))
    )
    pile = Material(
        Texture.RUG,
        look.rgb,
        second,
        look.rng.uniform(0.12, 0.22),
        0.0,
        0.0,
        2,
        (-width / 2, width / 2, -depth / 2, depth / 2),
        int(look.rng.integers(1, 999)),
    )
    build.add(pile, block(width, depth, 0.012))
    fringe = plain_cloth(tone("beige"), look.rng)
    for sx in (-1, 1):
        build.add(
            fringe,
            *[
                block(0.05, 0.012, 0.005, sx * (width / 2 + 0.026), y, 0)
                for y in np.arange(-depth / 2 + 0.02, depth / 2, 0.05)
            ],
        )
    return build


def mat(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = look.size(0.6, 0.75), look.size(0.4, 0.46)
    pile = Material(Texture.CARPET, look.rgb, shade(look.rgb, 0.55), 0.012)
    build.add(pile, soft_block(width, depth, 0.026, 0, 0, 0, 0.012))
    edge = plain_cloth(mix(look.rgb, (0.85, 0.85, 0.82), 0.6), look.rng)
    build.add(edge, *[block(width * 0.86, 0.03, 0.003, 0, sy * depth * 0.38, 0.0262) for sy in (-1, 1)])
    return build


def backpack(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth, height = look.size(0.29, 0.34), look.size(0.16, 0.19), look.size(0.4, 0.47)
    cover = plain_cloth(look.rgb, look.rng)
    trim = plain_cloth(shade(look.rgb, 0.4) if look.colour != "black" else tone("grey"), look.rng)
    build.add(cover, soft_block(width, depth, height, 0, 0, 0, 0.07))
    build.add(trim, soft_block(width * 0.78, 0.07, height * 0.42, 0, -depth / 2 - 0.02, 0.03, 0.03))
    build.add(trim, soft_block(width * 0.9, depth * 0.9, 0.03, 0, -0.02, height * 0.72, 0.012))
    build.add(trim, soft_block(0.06, depth * 0.6, height * 0.3, -width / 2 - 0.015, 0, 0.04, 0.025))
    build.add(trim, soft_block(0.06, depth * 0.6, height * 0.3, width / 2 + 0.015, 0, 0.04, 0.025))
    angle = np.linspace(0, np.pi, 7)
    build.add(
        trim,
        tube([(0.05 * float(np.cos(a)), depth * 0.2, height - 0.01 + 0.05 * float(np.sin(a))) for a in angle], 0.01, 7),
    )
    build.add(chrome(look.rng), block(width * 0.66, 0.006, 0.008, 0, -depth / 2 - 0.056, height * 0.36))
    for sx in (-1, 1):
        x = sx * width * 0.27
        strap = [
            (x, depth / 2 - 0.01, height * 0.9),
            (x, depth / 2 + 0.04, height * 0.6),
            (x, depth / 2 - 0.005, height * 0.12),
        ]
        build.add(trim, tube(strap, 0.017, 6))
    return build


def umbrella(look: Look) -> Assembly:
    """A closed umbrella that stands on its tip: shaft, folded canopy, crook."""
    build = Assembly(look)
    h = look.size(0.78, 0.9)
    build.add(metal(tone("grey"), look.rng), cylinder(0.008, h * 0.8))
    r = 0.055 * look.scale
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
    build.add(plain_cloth(look.rgb, look.rng), sheet(grid, 0.004))
    build.add(
        plain_cloth(shade(look.rgb, 0.4), look.rng),
        lathe([(r * 0.9, 0), (r * 1.24, 0), (r * 1.24, 0.03), (r * 0.9, 0.03)], 18).moved(z=h * 0.42),
    )
    turn = np.linspace(0, np.pi, 8)
    crook = [(0.04 - 0.04 * float(np.cos(a)), 0.0, h * 0.9 + 0.04 * float(np.sin(a))) for a in turn]
    build.add(wood(tone("brown"), look.rng, 2), tube([(0, 0, h * 0.66), *crook, (0.08, 0, h * 0.85)], 0.013, 8))
    return build


TEXTILES: Mapping[str, tuple[Builder, ...]] = {
    "cushion": (cushion, flat_cushion),
    "pillow": (pillow,),
    "blanket": (blanket, rolled_blanket),
    "towel": (folded_towel, rolled_towel),
    "rug": (rug,),
    "mat": (mat,),
    "backpack": (backpack,),
    "umbrella": (umbrella,),
}
