"""Builders of decoration: lamps, plants, vases, pictures, clocks, candles, sculptures; textiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from su3d_bench.datasets.procedural.materials import Material, Texture, light, linear, mix, shade, tone
from su3d_bench.datasets.procedural.shapes import (
    Shape,
    block,
    both,
    cylinder,
    ellipsoid,
    join,
    lathe,
    puff,
    sheet,
    soft_block,
    tube,
)
from su3d_bench.datasets.rooms.objects.items import Assembly


def _shade(build: Assembly, radius: float, height: float, z: float) -> None:
    """A lit lampshade, open below and above."""
    glowing = Material(Texture.PLAIN, build.rgb, shade(build.rgb, 0.9), glow=0.35)
    top = radius * build.rng.uniform(0.55, 0.85)
    wall = [(radius, 0), (top, height), (top - 0.008, height), (radius - 0.008, 0), (radius, 0)]
    build.add(glowing, lathe(wall, 26).moved(z=z))
    build.add(light((255, 244, 214)), ellipsoid(0.03, 0.03, 0.04).moved(z=z + height * 0.4))


def table_lamp(build: Assembly) -> None:
    foot, tall = build.size(0.075, 0.1), build.size(0.2, 0.3)
    body = build.of("ceramic", build.other("white", "blue", "green", "brown", "black"))
    if build.chance(0.5):
        belly = [(0, 0), (foot * 0.7, 0), (foot, tall * 0.3), (foot * 0.8, tall * 0.6)]
        build.add(body, lathe([*belly, (0.02, tall * 0.85), (0.02, tall), (0, tall)], 20))
    else:
        stand = lathe([(0, 0), (foot, 0), (foot, 0.015), (0.014, 0.025), (0.014, tall), (0, tall)], 20)
        build.add(build.of("metal", "black"), stand)
    build.add("chrome", cylinder(0.009, 0.12, z=tall - 0.005))
    _shade(build, build.size(0.13, 0.17), build.size(0.15, 0.2), tall + 0.02)


def floor_lamp(build: Assembly) -> None:
    tall = build.rng.uniform(1.25, 1.45)
    pole = build.of("metal", tone(str(build.rng.choice(["black", "grey", "brown"]))))
    build.add(pole, lathe([(0, 0), (0.15, 0), (0.15, 0.02), (0.03, 0.035), (0, 0.035)], 24))
    build.add(pole, cylinder(0.014, tall - 0.03, z=0.03))
    _shade(build, build.size(0.18, 0.23), build.size(0.23, 0.29), tall - 0.05)


def desk_lamp(build: Assembly) -> None:
    body = build.of("metal") if build.material == "metal" else build.of("plastic")
    build.add(body, lathe([(0, 0), (0.085, 0), (0.085, 0.018), (0.02, 0.028), (0, 0.028)], 20))
    build.add(body, tube([(0, 0, 0.02), (0, 0.1, 0.22), (0, -0.06, 0.4)], 0.011))
    build.add(body, ellipsoid(0.02, 0.02, 0.02).moved(0, 0.1, 0.22))
    hood = lathe([(0.02, 0.09), (0.03, 0.065), (0.08, 0.0), (0.085, 0.0), (0.035, 0.07), (0.03, 0.1), (0.0, 0.1)], 18)
    build.add(body, hood.turned("x", -28).moved(0, -0.09, 0.33))
    build.add(light((255, 244, 214)), ellipsoid(0.028, 0.028, 0.028).moved(0, -0.085, 0.36))


def ceiling_lamp(build: Assembly) -> None:
    """Hangs from the ceiling: canopy, cord, shade."""
    cord = build.rng.uniform(0.12, 0.25)
    radius, height = build.size(0.2, 0.27), build.size(0.16, 0.22)
    _shade(build, radius, height, 0.0)
    black = build.of("plastic", "black")
    build.add(black, cylinder(0.008, cord, z=height * 0.5), cylinder(0.05, 0.03, z=height * 0.5 + cord))
    build.add(black, *[block(radius * 0.9, 0.008, 0.006, 0, 0, height * 0.8).turned("z", turn) for turn in (0, 90)])


def _leaf(length: float, width: float, droop: float) -> Shape:
    t = np.linspace(0, 1, 6)
    half = width / 2 * np.sin(np.pi * np.clip(t * 0.93 + 0.05, 0, 1)) ** 0.8
    v = np.linspace(-1, 1, 3)
    x = v[None, :] * half[:, None]
    y = np.repeat((length * t * (1 - 0.25 * droop * t))[:, None], 3, axis=1)
    z = length * (0.55 * t - droop * t**2)[:, None] + 0.12 * width * np.abs(v)[None, :] * np.sin(np.pi * t)[:, None]
    return sheet(np.stack([x, y, z], axis=-1), 0.004)


def indoor_plant(build: Assembly) -> None:
    """A pot with soil and one of three habits: broad leaves, a bushy crown, upright blades."""
    r = build.size(0.08, 0.12)
    pot_height = r * build.rng.uniform(1.4, 1.9)
    pot_colour = build.other("white", "orange", "brown", "blue", "grey", "black", "yellow")
    base = pot_height * 0.9
    profile = [(0, 0), (0.72, 0), (0.98, 0.85), (1.06, 0.86), (1.06, 1), (0.93, 1), (0.93, 0.9), (0, 0.9)]
    build.add(build.of("ceramic", pot_colour), lathe([(r * out, pot_height * up) for out, up in profile], 22))
    soil = Material(Texture.CARPET, linear((62, 42, 28)), linear((30, 20, 14)), 0.01)
    build.add(soil, cylinder(r * 0.92, 0.006, z=base))
    habit = int(build.rng.integers(0, 3))
    (_broad_leaves, _bush, _blades)[habit](build, base, build.size(0.28, 0.5), r)


def _leaf_material(build: Assembly) -> Material:
    tinted = mix(build.rgb, linear((150, 180, 60)), float(build.rng.uniform(0, 0.35)))
    return Material(Texture.LEAF, shade(tinted, float(build.rng.uniform(0.7, 1.15))), shade(tinted, 1.7), 0.02, 0.15)


def _broad_leaves(build: Assembly, base: float, tall: float, r: float) -> None:
    n = int(build.rng.integers(9, 14))
    for i in range(n):
        turn = 360 * i * 0.381966 + build.rng.uniform(-12, 12)  # the golden angle spreads leaves evenly
        lift = tall * (0.25 + 0.6 * i / n)
        stem_end = (0.0, 0.045, base + lift)
        stem = tube([(0, 0, base), (0, 0.02, base + lift * 0.6), stem_end], 0.005, 5)
        length, width = tall * build.rng.uniform(0.42, 0.6), tall * build.rng.uniform(0.24, 0.34)
        leaf = _leaf(length, width, build.rng.uniform(0.5, 0.95))
        build.add(_leaf_material(build), join([stem, leaf.moved(*stem_end)]).turned("z", turn))


def _bush(build: Assembly, base: float, tall: float, r: float) -> None:
    trunk = build.of("wooden", "brown", 2)
    build.add(trunk, tube([(0, 0, base), (0.01, 0, base + tall * 0.35), (0, 0.01, base + tall * 0.6)], 0.012, 6))
    for i in range(26):
        turn, rise = 360 * i * 0.381966, build.rng.uniform(0.3, 0.95)
        out = r * 0.5 * np.sin(np.pi * rise) * build.rng.uniform(0.4, 1.0)
        leaf = _leaf(build.rng.uniform(0.13, 0.18), build.rng.uniform(0.07, 0.1), build.rng.uniform(-0.2, 0.8))
        build.add(_leaf_material(build), leaf.moved(0, float(out), base + tall * float(rise)).turned("z", turn))


def _blades(build: Assembly, base: float, tall: float, r: float) -> None:
    for i in range(int(build.rng.integers(10, 15))):
        length, turn = tall * build.rng.uniform(0.7, 1.15), 360 * i * 0.381966
        t = np.linspace(0, 1, 6)
        half = 0.5 * build.rng.uniform(0.035, 0.05) * (1 - t**2.5) + 0.002
        lean = build.rng.uniform(0.05, 0.3)
        y, z = r * 0.3 + lean * length * t**2, length * t * (1 - 0.2 * lean)
        grid = np.stack([np.stack([half * side, y, z], axis=-1) for side in (-1, 0, 1)], axis=1)
        build.add(_leaf_material(build), sheet(grid, 0.005).moved(z=base - 0.01).turned("z", turn))


def vase(build: Assembly) -> None:
    r, h = build.size(0.065, 0.1), build.size(0.24, 0.36)
    shapes = [
        [(r * 0.6, 0), (r, h * 0.3), (r * 0.85, h * 0.55), (r * 0.38, h * 0.8), (r * 0.55, h)],
        [(r * 0.5, 0), (r * 0.7, h * 0.2), (r, h * 0.65), (r * 0.9, h * 0.82), (r * 0.5, h * 0.9), (r * 0.6, h)],
        [(r * 0.45, 0), (r * 0.5, h * 0.1), (r * 0.62, h * 0.5), (r * 0.95, h)],
    ]
    outer = shapes[int(build.rng.integers(0, 3))]
    inner = [(radius * 0.86, z) for radius, z in reversed(outer[1:])]
    wall = build.main()
    if build.chance(0.4):
        pattern = Texture(int(build.rng.choice([Texture.STRIPES, Texture.ZIGZAG])))
        wall = replace(wall, texture=pattern, b=mix(build.rgb, (0.85, 0.85, 0.85), 0.7), scale=0.05, axis=1)
    build.add(wall, lathe([(0, 0), *outer, *inner, (0, h * 0.12)], 24))
    if build.chance(0.5):
        for i in range(5):
            bend = build.rng.uniform(0.02, 0.07)
            top = (0.0, float(bend), h + build.rng.uniform(0.08, 0.18))
            stem = tube([(0, 0, h * 0.3), (0, bend * 0.4, h), top], 0.004, 5).turned("z", 72 * i)
            build.add(build.of("paint", "green"), stem)
            bloom = build.other("red", "yellow", "pink", "purple", "white")
            build.add(build.of("paint", bloom), ellipsoid(0.028, 0.028, 0.022).moved(*top).turned("z", 72 * i))


def picture(build: Assembly) -> None:
    width, height = build.size(0.42, 0.7), build.size(0.38, 0.56)
    bar = build.rng.uniform(0.02, 0.04)
    frame = build.of("wooden") if build.colour == "brown" else replace(build.of("paint"), gloss=0.25)
    build.add(frame, *[block(bar, 0.026, height, x / 2) for x in both(width - bar)])
    build.add(frame, *[block(width - 2 * bar, 0.026, bar, 0, 0, z) for z in (0.0, height - bar)])
    margin = bar + (0.045 if build.chance(0.5) else 0.0)
    build.add(build.of("paper", "white"), block(width - 2 * bar, 0.01, height - 2 * bar, 0, 0.004, bar))
    extent = (-width / 2 + margin, width / 2 - margin, margin, height - margin)
    colours = [
        build.other(str(name))
        for name in build.rng.choice(["red", "blue", "green", "yellow", "orange", "purple", "pink"], 2, replace=False)
    ]
    art = Material(Texture.PICTURE, colours[0], colours[1], 1.0, 0.1, 0.0, 0, extent, int(build.rng.integers(1, 4000)))
    build.add(art, block(width - 2 * margin, 0.004, height - 2 * margin, 0, -0.0035, margin))


def clock(build: Assembly) -> None:
    r = build.size(0.14, 0.19)
    rim = lathe([(0, 0), (r, 0), (r, 0.03), (r * 0.9, 0.036), (r * 0.88, 0.024), (0, 0.024)], 30)
    build.add(build.main(), rim.turned("x", 90).moved(z=r))
    extent = (-r * 0.88, r * 0.88, r * 0.12, r * 1.88)
    face = Material(Texture.CLOCK_FACE, tone("white"), tone("black"), 1.0, 0.2, extent=extent)
    build.add(face, cylinder(r * 0.87, 0.003).turned("x", 90).moved(0, -0.0245, r))
    hands = build.of("paint", "black")
    for length, thick in ((r * 0.5, 0.016), (r * 0.72, 0.011)):
        turn = build.rng.uniform(0, 360)
        build.add(hands, block(thick, 0.003, length, 0, 0, -0.02).turned("y", turn).moved(0, -0.031, r))


def candle(build: Assembly) -> None:
    r, h = build.size(0.038, 0.05), build.size(0.12, 0.2)
    dish = lathe([(0, 0), (r * 1.6, 0), (r * 1.75, 0.018), (r * 1.6, 0.018), (r * 1.4, 0.008), (0, 0.008)], 20)
    build.add(build.of("metal", linear((176, 140, 70))), dish)
    wax = lathe([(0, 0), (r, 0), (r, h), (r * 0.8, h - 0.008), (0, h - 0.012)], 18)
    build.add(replace(build.of("paint"), gloss=0.2), wax.moved(z=0.009))
    build.add(build.of("paint", "black"), cylinder(0.003, 0.02, z=h - 0.004))
    flame = Material(Texture.PLAIN, linear((255, 190, 70)), linear((255, 170, 50)), glow=1.0)
    build.add(flame, ellipsoid(0.009, 0.009, 0.02).moved(z=h + 0.03))


def sculpture(build: Assembly) -> None:
    h = build.size(0.26, 0.4)
    body = build.main()
    build.add(replace(build.of("paint", "black"), gloss=0.3), block(0.13, 0.13, 0.04))
    kind = int(build.rng.integers(0, 3))
    if kind == 0:  # a bust
        outline = [(0, 0), (0.05, 0), (0.045, 0.18), (0.1, 0.3), (0.09, 0.42), (0.032, 0.52), (0.03, 0.6), (0, 0.6)]
        bust = lathe([(out, h * up) for out, up in outline], 18).stretched(1.0, 0.7, 1.0).moved(z=0.04)
        head = ellipsoid(0.055, 0.065, 0.08).moved(0, -0.005, 0.04 + h * 0.75)
        build.add(body, bust, head, soft_block(0.02, 0.03, 0.03, 0, -0.07, 0.025 + h * 0.75, 0.009))
    elif kind == 1:  # a standing ring
        angle = np.linspace(0, 2 * np.pi, 25)
        r = h * 0.42
        ring = [(r * float(np.sin(a)), 0, 0.04 + r + 0.02 - r * float(np.cos(a))) for a in angle]
        build.add(body, tube(ring, 0.028, 10))
    else:  # stacked pebbles
        z = 0.04
        for share in (0.085, 0.066, 0.05, 0.035):
            pebble = ellipsoid(share, share * 0.9, share * 0.6)
            build.add(body, pebble.moved(float(build.rng.uniform(-0.012, 0.012)), 0, z + share * 0.6))
            z += share * 1.17


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
    build.add(build.of("plain fabric"), puff(width, depth, build.rng.uniform(0.14, 0.18)).turned("x", 90))


def blanket(build: Assembly) -> None:
    """A folded blanket: layers with a rounded fold at the front."""
    width, depth = build.size(0.42, 0.55), build.size(0.32, 0.4)
    cover = build.of("large fabric")
    n = int(build.rng.integers(3, 5))
    for i in range(n):
        grow, x = build.rng.uniform(-0.012, 0.012), build.rng.uniform(-0.006, 0.006)
        build.add(cover, soft_block(width + grow, depth + grow, 0.034, x, 0, i * 0.0345, 0.0165))
    fringe = build.of("plain fabric", shade(build.rgb, 0.6))
    for i in range(int(width / 0.03)):
        x, y, z = -width / 2 + 0.02 + i * 0.03, -depth / 2 - 0.022, (n - 1) * 0.0345 + 0.012
        build.add(fringe, block(0.011, 0.04, 0.006, x, y, z))


def rolled_blanket(build: Assembly) -> None:
    """A thick roll with a fringe at one end."""
    length, r = build.size(0.44, 0.52), build.size(0.075, 0.085)
    spiral = [(r * 0.2, 0.004), (r * 0.3, -0.004), (r * 0.55, -0.004), (r * 0.65, 0.005), (r * 0.8, 0.005), (r, 0.014)]
    roll = lathe([(0, 0), *spiral, (r, length), (0, length)], 20)
    build.add("large fabric", roll.turned("y", 90))
    fringe = build.of("plain fabric", shade(build.rgb, 0.6))
    for i in range(14):
        strand = block(0.03, 0.008, 0.006, length + 0.016, 0, r * 0.9).turned("x", 360 * i / 14)
        build.add(fringe, strand)


def folded_towel(build: Assembly) -> None:
    """A stack of folded towels with a border stripe."""
    width, depth = build.size(0.3, 0.38), build.size(0.2, 0.25)
    stripe = build.of("plain fabric", mix(build.rgb, (0.9, 0.9, 0.9), 0.6))
    soft = build.of("plain fabric")
    for i in range(int(build.rng.integers(2, 4))):
        z = i * 0.047
        build.add(soft, soft_block(width, depth, 0.045, float(build.rng.uniform(-0.008, 0.008)), 0, z, 0.021))
        build.add(stripe, block(width * 0.1, 0.003, 0.03, width * 0.25, -depth / 2 - 0.002, z + 0.008))


def rolled_towel(build: Assembly) -> None:
    length, r = build.size(0.34, 0.42), build.size(0.055, 0.07)
    soft = build.of("plain fabric")
    turns = [(0.2, 0.003), (0.25, 0.003), (0.35, -0.004), (0.55, -0.004), (0.62, 0.004), (0.8, 0.004), (1, 0.012)]
    spiral = [(r * share, x) for share, x in turns]
    build.add(soft, lathe([(0, 0), *spiral, (r, length), (0, length)], 18).turned("y", 90))
    band = lathe([(r, 0), (r + 0.003, 0), (r + 0.003, 0.03), (r, 0.03), (r, 0)], 18).turned("y", 90)
    build.add(build.of("plain fabric", mix(build.rgb, (0.9, 0.9, 0.9), 0.6)), band.moved(length * 0.75))


def rug(build: Assembly) -> None:
    width, depth = build.size(1.5, 2.0), build.size(1.1, 1.4)
    second = build.other(*(c for c in ("red", "blue", "beige", "white", "brown", "orange") if c != build.colour))
    extent, scale = (-width / 2, width / 2, -depth / 2, depth / 2), build.rng.uniform(0.12, 0.22)
    seed = int(build.rng.integers(1, 999))
    pile = Material(Texture.RUG, build.rgb, second, scale, 0.0, axis=2, extent=extent, seed=seed)
    build.add(pile, block(width, depth, 0.012))
    fringe = build.of("plain fabric", "beige")
    for x in both(width / 2 + 0.026):
        build.add(fringe, *[block(0.05, 0.012, 0.005, x, y) for y in np.arange(-depth / 2 + 0.02, depth / 2, 0.05)])


def mat(build: Assembly) -> None:
    width, depth = build.size(0.6, 0.75), build.size(0.4, 0.46)
    pile = Material(Texture.CARPET, build.rgb, shade(build.rgb, 0.55), 0.012)
    build.add(pile, soft_block(width, depth, 0.026, 0, 0, 0, 0.012))
    edge = build.of("plain fabric", mix(build.rgb, (0.85, 0.85, 0.82), 0.6))
    build.add(edge, *[block(width * 0.86, 0.03, 0.003, 0, y, 0.0262) for y in both(depth * 0.38)])


def backpack(build: Assembly) -> None:
    width, depth, height = build.size(0.29, 0.34), build.size(0.16, 0.19), build.size(0.4, 0.47)
    cover = build.of("plain fabric")
    trim = build.of("plain fabric", shade(build.rgb, 0.4) if build.colour != "black" else tone("grey"))
    build.add(cover, soft_block(width, depth, height, 0, 0, 0, 0.07))
    build.add(trim, soft_block(width * 0.78, 0.07, height * 0.42, 0, -depth / 2 - 0.02, 0.03, 0.03))
    build.add(trim, soft_block(width * 0.9, depth * 0.9, 0.03, 0, -0.02, height * 0.72, 0.012))
    build.add(trim, *[soft_block(0.06, depth * 0.6, height * 0.3, x, 0, 0.04, 0.025) for x in both(width / 2 + 0.015)])
    angle = np.linspace(0, np.pi, 7)
    loop = [(0.05 * float(np.cos(a)), depth * 0.2, height - 0.01 + 0.05 * float(np.sin(a))) for a in angle]
    build.add(trim, tube(loop, 0.01, 7))
    build.add("chrome", block(width * 0.66, 0.006, 0.008, 0, -depth / 2 - 0.056, height * 0.36))
    strap = (-0.01, 0.9), (0.04, 0.6), (-0.005, 0.12)
    for x in both(width * 0.27):
        build.add(trim, tube([(x, depth / 2 + back, height * up) for back, up in strap], 0.017, 6))


def umbrella(build: Assembly) -> None:
    """A closed umbrella that stands on its tip: shaft, folded canopy, crook."""
    h = build.size(0.78, 0.9)
    build.add(build.of("metal", "grey"), cylinder(0.008, h * 0.8))
    r = 0.055 * build.scale
    folds = 8
    angle = np.linspace(0, 2 * np.pi, folds * 6 + 1)
    ring = 1 + 0.22 * np.cos(folds * angle)
    outline = (0.06, 0.012), (0.15, r * 0.55), (0.45, r), (0.62, r * 0.9), (0.66, 0.014)
    rings = [(ring * rad * np.cos(angle), ring * rad * np.sin(angle), np.full_like(angle, h * z)) for z, rad in outline]
    grid = np.stack([np.stack(each, axis=-1) for each in rings], axis=1)
    build.add("plain fabric", sheet(grid, 0.004))
    band = lathe([(r * 0.9, 0), (r * 1.24, 0), (r * 1.24, 0.03), (r * 0.9, 0.03)], 18)
    build.add(build.of("plain fabric", shade(build.rgb, 0.4)), band.moved(z=h * 0.42))
    turn = np.linspace(0, np.pi, 8)
    crook = [(0.04 - 0.04 * float(np.cos(a)), 0.0, h * 0.9 + 0.04 * float(np.sin(a))) for a in turn]
    build.add(build.of("wooden", "brown", 2), tube([(0, 0, h * 0.66), *crook, (0.08, 0, h * 0.85)], 0.013, 8))
