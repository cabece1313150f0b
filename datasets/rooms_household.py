"""Builders of what lies, hangs and stands about: lamps, plants, textiles, dishes, books."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from su3d_bench.datasets.rooms_items import Assembly, Builder, Look
from su3d_bench.datasets.rooms_materials import (
    Material,
    Rgb,
    Texture,
    ceramic,
    chrome,
    cloth,
    glass,
    linear,
    metal,
    mix,
    paint,
    paper,
    plain_cloth,
    plastic,
    shade,
    stone,
    tone,
    wicker,
    wood,
)
from su3d_bench.datasets.rooms_shapes import (
    Shape,
    block,
    cylinder,
    ellipsoid,
    join,
    lathe,
    puff,
    sheet,
    soft_block,
    tube,
)


def _shade(build: Assembly, radius: float, height: float, z: float) -> None:
    """A lit lampshade, open below and above."""
    look = build.look
    glowing = Material(Texture.PLAIN, look.rgb, shade(look.rgb, 0.9), glow=0.35)
    top = radius * look.rng.uniform(0.55, 0.85)
    wall = [(radius, 0), (top, height), (top - 0.008, height), (radius - 0.008, 0), (radius, 0)]
    build.add(glowing, lathe(wall, 26).moved(z=z))
    bulb = Material(Texture.PLAIN, linear((255, 244, 214)), linear((255, 244, 214)), glow=1.0)
    build.add(bulb, ellipsoid(0.03, 0.03, 0.04).moved(z=z + height * 0.4))


def table_lamp(look: Look) -> Assembly:
    build = Assembly(look)
    foot, tall = look.size(0.075, 0.1), look.size(0.2, 0.3)
    body = ceramic(look.other(str(look.rng.choice(["white", "blue", "green", "brown", "black"]))))
    if look.chance(0.5):
        build.add(
            body,
            lathe(
                [
                    (0, 0),
                    (foot * 0.7, 0),
                    (foot, tall * 0.3),
                    (foot * 0.8, tall * 0.6),
                    (0.02, tall * 0.85),
                    (0.02, tall),
                    (0, tall),
                ],
                20,
            ),
        )
    else:
        build.add(
            metal(tone("black"), look.rng),
            lathe([(0, 0), (foot, 0), (foot, 0.015), (0.014, 0.025), (0.014, tall), (0, tall)], 20),
        )
    build.add(chrome(look.rng), cylinder(0.009, 0.12, z=tall - 0.005))
    _shade(build, look.size(0.13, 0.17), look.size(0.15, 0.2), tall + 0.02)
    return build


def floor_lamp(look: Look) -> Assembly:
    build = Assembly(look)
    tall = look.rng.uniform(1.25, 1.45)
    pole = metal(tone(str(look.rng.choice(["black", "grey", "brown"]))), look.rng)
    build.add(pole, lathe([(0, 0), (0.15, 0), (0.15, 0.02), (0.03, 0.035), (0, 0.035)], 24))
    build.add(pole, cylinder(0.014, tall - 0.03, z=0.03))
    _shade(build, look.size(0.18, 0.23), look.size(0.23, 0.29), tall - 0.05)
    return build


def desk_lamp(look: Look) -> Assembly:
    build = Assembly(look)
    body = metal(look.rgb, look.rng) if look.material == "metal" else plastic(look.rgb)
    build.add(body, lathe([(0, 0), (0.085, 0), (0.085, 0.018), (0.02, 0.028), (0, 0.028)], 20))
    build.add(body, tube([(0, 0, 0.02), (0, 0.1, 0.22), (0, -0.06, 0.4)], 0.011))
    build.add(body, ellipsoid(0.02, 0.02, 0.02).moved(0, 0.1, 0.22))
    hood = lathe([(0.02, 0.09), (0.03, 0.065), (0.08, 0.0), (0.085, 0.0), (0.035, 0.07), (0.03, 0.1), (0.0, 0.1)], 18)
    build.add(body, hood.turned("x", -28).moved(0, -0.09, 0.33))
    bulb = Material(Texture.PLAIN, linear((255, 244, 214)), linear((255, 244, 214)), glow=1.0)
    build.add(bulb, ellipsoid(0.028, 0.028, 0.028).moved(0, -0.085, 0.36))
    return build


def ceiling_lamp(look: Look) -> Assembly:
    """Hangs from the ceiling: canopy, cord, shade."""
    build = Assembly(look)
    cord = look.rng.uniform(0.12, 0.25)
    radius, height = look.size(0.2, 0.27), look.size(0.16, 0.22)
    _shade(build, radius, height, 0.0)
    black = plastic(tone("black"))
    build.add(black, cylinder(0.008, cord, z=height * 0.5), cylinder(0.05, 0.03, z=height * 0.5 + cord))
    build.add(black, *[block(radius * 0.9, 0.008, 0.006, 0, 0, height * 0.8).turned("z", turn) for turn in (0, 90)])
    return build


def _leaf(length: float, width: float, droop: float) -> Shape:
    t = np.linspace(0, 1, 6)
    half = width / 2 * np.sin(np.pi * np.clip(t * 0.93 + 0.05, 0, 1)) ** 0.8
    v = np.linspace(-1, 1, 3)
    x = v[None, :] * half[:, None]
    y = np.repeat((length * t * (1 - 0.25 * droop * t))[:, None], 3, axis=1)
    z = length * (0.55 * t - droop * t**2)[:, None] + 0.12 * width * np.abs(v)[None, :] * np.sin(np.pi * t)[:, None]
    return sheet(np.stack([x, y, z], axis=-1), 0.004)


def indoor_plant(look: Look) -> Assembly:
    """A pot with soil and one of three habits: broad leaves, a bushy crown, upright blades."""
    build = Assembly(look)
    r = look.size(0.08, 0.12)
    pot_height = r * look.rng.uniform(1.4, 1.9)
    pot_colour = look.other(str(look.rng.choice(["white", "orange", "brown", "blue", "grey", "black", "yellow"])))
    rim = [
        (0, 0),
        (r * 0.72, 0),
        (r * 0.98, pot_height * 0.85),
        (r * 1.06, pot_height * 0.86),
        (r * 1.06, pot_height),
        (r * 0.93, pot_height),
        (r * 0.93, pot_height * 0.9),
        (0, pot_height * 0.9),
    ]
    build.add(ceramic(pot_colour), lathe(rim, 22))
    build.add(
        Material(Texture.CARPET, linear((62, 42, 28)), linear((30, 20, 14)), 0.01),
        cylinder(r * 0.92, 0.006, z=pot_height * 0.9),
    )
    habit = int(look.rng.integers(0, 3))
    tall = look.size(0.28, 0.5)
    base = pot_height * 0.9
    green = look.rgb
    if habit == 0:
        _broad_leaves(build, green, base, tall)
    elif habit == 1:
        _bush(build, green, base, tall, r)
    else:
        _blades(build, green, base, tall, r)
    return build


def _leaf_material(green: Rgb, look: Look) -> Material:
    tinted = mix(green, linear((150, 180, 60)), float(look.rng.uniform(0, 0.35)))
    return Material(Texture.LEAF, shade(tinted, float(look.rng.uniform(0.7, 1.15))), shade(tinted, 1.7), 0.02, 0.15)


def _broad_leaves(build: Assembly, green: Rgb, base: float, tall: float) -> None:
    look = build.look
    n = int(look.rng.integers(9, 14))
    for i in range(n):
        turn = 360 * i * 0.381966 + look.rng.uniform(-12, 12)  # the golden angle spreads leaves evenly
        lift = tall * (0.25 + 0.6 * i / n)
        stem_end = (0.0, 0.045, base + lift)
        stem = tube([(0, 0, base), (0, 0.02, base + lift * 0.6), stem_end], 0.005, 5)
        leaf = _leaf(
            tall * look.rng.uniform(0.42, 0.6), tall * look.rng.uniform(0.24, 0.34), look.rng.uniform(0.5, 0.95)
        )
        build.add(_leaf_material(green, look), join([stem, leaf.moved(*stem_end)]).turned("z", turn))


def _bush(build: Assembly, green: Rgb, base: float, tall: float, r: float) -> None:
    look = build.look
    trunk = wood(tone("brown"), look.rng, 2)
    build.add(trunk, tube([(0, 0, base), (0.01, 0, base + tall * 0.35), (0, 0.01, base + tall * 0.6)], 0.012, 6))
    for i in range(26):
        turn, rise = 360 * i * 0.381966, look.rng.uniform(0.3, 0.95)
        out = r * 0.5 * np.sin(np.pi * rise) * look.rng.uniform(0.4, 1.0)
        leaf = _leaf(look.rng.uniform(0.13, 0.18), look.rng.uniform(0.07, 0.1), look.rng.uniform(-0.2, 0.8))
        build.add(_leaf_material(green, look), leaf.moved(0, float(out), base + tall * float(rise)).turned("z", turn))


def _blades(build: Assembly, green: Rgb, base: float, tall: float, r: float) -> None:
    look = build.look
    for i in range(int(look.rng.integers(10, 15))):
        length, turn = tall * look.rng.uniform(0.7, 1.15), 360 * i * 0.381966
        t = np.linspace(0, 1, 6)
        half = 0.5 * look.rng.uniform(0.035, 0.05) * (1 - t**2.5) + 0.002
        lean = look.rng.uniform(0.05, 0.3)
        y, z = r * 0.3 + lean * length * t**2, length * t * (1 - 0.2 * lean)
        grid = np.stack([np.stack([half * side, y, z], axis=-1) for side in (-1, 0, 1)], axis=1)
        build.add(_leaf_material(green, look), sheet(grid, 0.005).moved(z=base - 0.01).turned("z", turn))


def vase(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.065, 0.1), look.size(0.24, 0.36)
    shapes = [
        [(r * 0.6, 0), (r, h * 0.3), (r * 0.85, h * 0.55), (r * 0.38, h * 0.8), (r * 0.55, h)],
        [(r * 0.5, 0), (r * 0.7, h * 0.2), (r, h * 0.65), (r * 0.9, h * 0.82), (r * 0.5, h * 0.9), (r * 0.6, h)],
        [(r * 0.45, 0), (r * 0.5, h * 0.1), (r * 0.62, h * 0.5), (r * 0.95, h)],
    ]
    outer = shapes[int(look.rng.integers(0, 3))]
    inner = [(radius * 0.86, z) for radius, z in reversed(outer[1:])]
    wall = ceramic(look.rgb) if look.material == "ceramic" else glass(look.rgb)
    if look.chance(0.4):
        wall = replace(
            wall,
            texture=Texture(int(look.rng.choice([Texture.STRIPES, Texture.ZIGZAG]))),
            b=mix(look.rgb, (0.85, 0.85, 0.85), 0.7),
            scale=0.05,
            axis=1,
        )
    build.add(wall, lathe([(0, 0), *outer, *inner, (0, h * 0.12)], 24))
    if look.chance(0.5):
        for i in range(5):
            bend = look.rng.uniform(0.02, 0.07)
            top = (0.0, float(bend), h + look.rng.uniform(0.08, 0.18))
            stem = tube([(0, 0, h * 0.3), (0, bend * 0.4, h), top], 0.004, 5).turned("z", 72 * i)
            build.add(paint(tone("green")), stem)
            bloom = look.other(str(look.rng.choice(["red", "yellow", "pink", "purple", "white"])))
            build.add(paint(bloom), ellipsoid(0.028, 0.028, 0.022).moved(*top).turned("z", 72 * i))
    return build


def picture(look: Look) -> Assembly:
    build = Assembly(look)
    width, height = look.size(0.42, 0.7), look.size(0.38, 0.56)
    bar = look.rng.uniform(0.02, 0.04)
    frame = wood(look.rgb, look.rng) if look.colour == "brown" else paint(look.rgb, 0.25)
    build.add(frame, *[block(bar, 0.026, height, sx * (width - bar) / 2) for sx in (-1, 1)])
    build.add(frame, *[block(width - 2 * bar, 0.026, bar, 0, 0, z) for z in (0.0, height - bar)])
    margin = bar + (0.045 if look.chance(0.5) else 0.0)
    build.add(paper(tone("white")), block(width - 2 * bar, 0.01, height - 2 * bar, 0, 0.004, bar))
    extent = (-width / 2 + margin, width / 2 - margin, margin, height - margin)
    colours = [
        look.other(str(name))
        for name in look.rng.choice(["red", "blue", "green", "yellow", "orange", "purple", "pink"], 2, replace=False)
    ]
    art = Material(Texture.PICTURE, colours[0], colours[1], 1.0, 0.1, 0.0, 0, extent, int(look.rng.integers(1, 4000)))
    build.add(art, block(width - 2 * margin, 0.004, height - 2 * margin, 0, -0.0035, margin))
    return build


def clock(look: Look) -> Assembly:
    build = Assembly(look)
    r = look.size(0.14, 0.19)
    rim = lathe([(0, 0), (r, 0), (r, 0.03), (r * 0.9, 0.036), (r * 0.88, 0.024), (0, 0.024)], 30)
    build.add(
        metal(look.rgb, look.rng) if look.material == "metal" else plastic(look.rgb), rim.turned("x", 90).moved(z=r)
    )
    face = Material(
        Texture.CLOCK_FACE, tone("white"), tone("black"), 1.0, 0.2, 0.0, 0, (-r * 0.88, r * 0.88, r * 0.12, r * 1.88)
    )
    build.add(face, cylinder(r * 0.87, 0.003).turned("x", 90).moved(0, -0.0245, r))
    hands = paint(tone("black"))
    for length, thick, turn in (
        (r * 0.5, 0.016, look.rng.uniform(0, 360)),
        (r * 0.72, 0.011, look.rng.uniform(0, 360)),
    ):
        build.add(hands, block(thick, 0.003, length, 0, 0, -0.02).turned("y", turn).moved(0, -0.031, r))
    return build


def candle(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.038, 0.05), look.size(0.12, 0.2)
    build.add(
        metal(linear((176, 140, 70)), look.rng),
        lathe([(0, 0), (r * 1.6, 0), (r * 1.75, 0.018), (r * 1.6, 0.018), (r * 1.4, 0.008), (0, 0.008)], 20),
    )
    build.add(
        paint(look.rgb, 0.2), lathe([(0, 0), (r, 0), (r, h), (r * 0.8, h - 0.008), (0, h - 0.012)], 18).moved(z=0.009)
    )
    build.add(paint(tone("black")), cylinder(0.003, 0.02, z=h - 0.004))
    flame = Material(Texture.PLAIN, linear((255, 190, 70)), linear((255, 170, 50)), glow=1.0)
    build.add(flame, ellipsoid(0.009, 0.009, 0.02).moved(z=h + 0.03))
    return build


def sculpture(look: Look) -> Assembly:
    build = Assembly(look)
    h = look.size(0.26, 0.4)
    body = stone(look.rgb, look.rng) if look.material == "stone" else metal(look.rgb, look.rng)
    build.add(paint(tone("black"), 0.3), block(0.13, 0.13, 0.04))
    kind = int(look.rng.integers(0, 3))
    if kind == 0:  # a bust
        build.add(
            body,
            lathe(
                [
                    (0, 0),
                    (0.05, 0),
                    (0.045, h * 0.18),
                    (0.1, h * 0.3),
                    (0.09, h * 0.42),
                    (0.032, h * 0.52),
                    (0.03, h * 0.6),
                    (0, h * 0.6),
                ],
                18,
            )
            .stretched(1.0, 0.7, 1.0)
            .moved(z=0.04),
        )
        build.add(
            body,
            ellipsoid(0.055, 0.065, 0.08).moved(0, -0.005, 0.04 + h * 0.75),
            soft_block(0.02, 0.03, 0.03, 0, -0.07, 0.025 + h * 0.75, 0.009),
        )
    elif kind == 1:  # a standing ring
        angle = np.linspace(0, 2 * np.pi, 25)
        r = h * 0.42
        build.add(
            body, tube([(r * float(np.sin(a)), 0, 0.04 + r + 0.02 - r * float(np.cos(a))) for a in angle], 0.028, 10)
        )
    else:  # stacked pebbles
        z = 0.04
        for share in (0.085, 0.066, 0.05, 0.035):
            build.add(
                body,
                ellipsoid(share, share * 0.9, share * 0.6).moved(
                    float(look.rng.uniform(-0.012, 0.012)), 0, z + share * 0.6
                ),
            )
            z += share * 1.17
    return build


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


def books(look: Look) -> Assembly:
    """A row of standing books, backs to the front."""
    build = Assembly(look)
    x = 0.0
    for i in range(int(look.rng.integers(3, 7))):
        thick, tall, depth = look.rng.uniform(0.025, 0.048), look.size(0.2, 0.25), look.rng.uniform(0.15, 0.18)
        rgb = (
            look.rgb
            if i % 2 == 0
            else look.other(str(look.rng.choice(["red", "blue", "green", "brown", "black", "orange", "purple"])))
        )
        _volume(build, rgb, thick, depth, tall, x + thick / 2)
        x += thick + 0.0015
    return build


def _volume(build: Assembly, rgb: Rgb, thick: float, depth: float, tall: float, x: float) -> None:
    label = Material(
        Texture.LABEL, rgb, mix(rgb, (0.9, 0.85, 0.6), 0.75), tall, 0.1, seed=int(build.look.rng.integers(1, 999))
    )
    build.add(
        label, block(0.003, depth, tall, x - thick / 2 + 0.0015), block(0.003, depth, tall, x + thick / 2 - 0.0015)
    )
    build.add(label, block(thick - 0.0062, 0.003, tall, x, -depth / 2 + 0.0015))
    build.add(paper(linear((232, 224, 204))), block(thick - 0.0064, depth - 0.01, tall - 0.008, x, 0.002, 0.004))


def book_stack(look: Look) -> Assembly:
    """Books that lie on one another."""
    build = Assembly(look)
    z = 0.0
    for i in range(int(look.rng.integers(2, 5))):
        width, depth, thick = look.size(0.2, 0.26), look.size(0.15, 0.19), look.rng.uniform(0.022, 0.042)
        rgb = (
            look.rgb
            if i % 2 == 0
            else look.other(str(look.rng.choice(["red", "blue", "green", "brown", "black", "white"])))
        )
        turn = float(look.rng.uniform(-14, 14))
        cover = Material(
            Texture.LABEL,
            rgb,
            mix(rgb, (0.9, 0.85, 0.6), 0.75),
            0.2,
            0.1,
            axis=2,
            extent=(-width / 2, width / 2, -depth / 2, depth / 2),
            seed=7,
        )
        boards = [block(width, depth, 0.003, 0, 0, z), block(width, depth, 0.003, 0, 0, z + thick - 0.003)]
        boards.append(block(width, 0.003, thick - 0.0064, 0, -depth / 2 + 0.0015, z + 0.0032))
        build.add(cover, *[shape.turned("z", turn) for shape in boards])
        build.add(
            paper(linear((232, 224, 204))),
            block(width - 0.01, depth - 0.008, thick - 0.0066, 0, 0.001, z + 0.0033).turned("z", turn),
        )
        z += thick + 0.001
    return build


def cardboard_box(look: Look) -> Assembly:
    """A closed carton with tape, or an open one with its flaps out."""
    build = Assembly(look)
    width, depth, height = look.size(0.32, 0.44), look.size(0.25, 0.34), look.size(0.2, 0.3)
    side = Material(Texture.CARDBOARD, look.rgb, shade(look.rgb, 0.8), 0.012, 0.02, seed=3)
    if look.chance(0.55):
        build.add(side, block(width, depth, height))
        tape = plastic(mix(look.rgb, linear((226, 206, 150)), 0.75))
        build.add(tape, block(width * 1.002, 0.055, 0.002, 0, 0, height + 0.001))
        build.add(tape, *[block(0.002, 0.055, 0.07, sx * (width / 2 + 0.0015), 0, height - 0.07) for sx in (-1, 1)])
        build.add(paper(tone("white")), block(0.11, 0.002, 0.075, width * 0.2, -depth / 2 - 0.0015, height * 0.4))
        build.spot((-width / 2 + 0.02, width / 2 - 0.02), (-depth / 2 + 0.02, depth / 2 - 0.02), height + 0.002, 0.4)
        return build
    build.add(side, block(width, depth, 0.006))
    build.add(side, *[block(0.006, depth, height - 0.007, sx * (width / 2 - 0.003), 0, 0.007) for sx in (-1, 1)])
    build.add(
        side, *[block(width - 0.014, 0.006, height - 0.007, 0, sy * (depth / 2 - 0.003), 0.007) for sy in (-1, 1)]
    )
    for sx in (-1, 1):
        flap = block(0.13, depth * 0.96, 0.004, sx * 0.065, 0, 0).turned("y", sx * 28)
        build.add(side, flap.moved(sx * (width / 2 + 0.002), 0, height + 0.002))
    build.spot((-width / 2 + 0.02, width / 2 - 0.02), (-depth / 2 + 0.02, depth / 2 - 0.02), 0.007, role="inside")
    return build


def basket(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.21, 0.25), look.size(0.24, 0.32)
    weave = wicker(look.rgb, look.rng)
    build.add(weave, lathe([(0, 0), (r * 0.8, 0), (r, h), (r - 0.018, h), (r * 0.8 - 0.018, 0.016), (0, 0.016)], 28))
    rim = wicker(shade(look.rgb, 0.75), look.rng)
    build.add(
        rim,
        lathe(
            [
                (r + 0.001, h - 0.02),
                (r + 0.012, h - 0.01),
                (r + 0.012, h + 0.008),
                (r - 0.02, h + 0.008),
                (r - 0.02, h + 0.001),
            ],
            28,
        ),
    )
    angle = np.linspace(0, np.pi, 9)
    for sx in (-1, 1):
        arc = [(sx * (r + 0.004), 0.07 * float(np.cos(a)), h + 0.005 + 0.06 * float(np.sin(a))) for a in angle]
        build.add(rim, tube(arc, 0.011, 7))
    side = (r * 0.8 - 0.03) * 0.7071
    build.spot((-side, side), (-side, side), 0.017, role="inside")
    return build


def bin_(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.13, 0.165), look.size(0.3, 0.4)
    body = metal(look.rgb, look.rng) if look.material == "metal" else plastic(look.rgb)
    if look.chance(0.4):  # pedal bin with a domed lid
        build.add(body, lathe([(0, 0), (r, 0), (r, h), (0, h)], 24))
        build.add(
            plastic(tone("black")),
            lathe([(0, 0), (r + 0.006, 0), (r + 0.006, 0.025), (r * 0.6, 0.07), (0, 0.08)], 24).moved(z=h + 0.001),
        )
        build.add(
            plastic(tone("black")),
            soft_block(0.09, 0.06, 0.018, 0, -r - 0.02, 0.008, 0.007),
            lathe([(r, 0), (r + 0.006, 0), (r + 0.006, 0.03), (r, 0.03)], 24),
        )
        return build
    build.add(
        body,
        lathe(
            [
                (0, 0),
                (r * 0.78, 0),
                (r, h),
                (r + 0.01, h),
                (r + 0.01, h + 0.012),
                (r - 0.012, h + 0.012),
                (r * 0.77 - 0.01, 0.01),
                (0, 0.01),
            ],
            24,
        ),
    )
    liner = plastic(mix(look.rgb, tone("black"), 0.6))
    build.add(liner, lathe([(0, 0), (r * 0.8, 0), (r * 0.8, 0.004), (0, 0.004)], 20).moved(z=h * 0.35))
    scrap = paper(tone("white"))
    for i in range(3):
        build.add(
            scrap, ellipsoid(r * 0.33, r * 0.3, r * 0.3).moved(r * 0.38, 0, h * 0.35 + r * 0.3).turned("z", 120 * i)
        )
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


def exercise_ball(look: Look) -> Assembly:
    build = Assembly(look)
    r = look.size(0.26, 0.33)
    skin = Material(Texture.GORES, look.rgb, shade(look.rgb, 0.7), 0.05, 0.45)
    build.add(skin, ellipsoid(r, r, r))
    build.add(
        plastic(tone("white")), cylinder(0.02, 0.012).turned("x", 60).moved(0, -r * 0.866 + 0.004, r * 0.5 - 0.002)
    )
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


HOUSEHOLD: Mapping[str, tuple[Builder, ...]] = {
    "lamp": (table_lamp, floor_lamp, desk_lamp, ceiling_lamp),
    "indoor-plant": (indoor_plant,),
    "vase": (vase,),
    "picture": (picture,),
    "clock": (clock,),
    "candle": (candle,),
    "sculpture": (sculpture,),
    "cushion": (cushion, flat_cushion),
    "pillow": (pillow,),
    "blanket": (blanket, rolled_blanket),
    "towel": (folded_towel, rolled_towel),
    "rug": (rug,),
    "mat": (mat,),
    "book": (books, book_stack),
    "box": (cardboard_box,),
    "basket": (basket,),
    "bin": (bin_,),
    "backpack": (backpack,),
    "exercise-ball": (exercise_ball,),
    "umbrella": (umbrella,),
}
