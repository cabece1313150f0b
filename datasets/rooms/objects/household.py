"""Builders of household objects: books, boxes, baskets, bins, balls; dishes and bottles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from su3d_bench.datasets.procedural.materials import Material, Rgb, Texture, linear, mix, shade, tone
from su3d_bench.datasets.procedural.shapes import block, both, cylinder, ellipsoid, lathe, soft_block, tube
from su3d_bench.datasets.rooms.objects.items import Assembly


def books(build: Assembly) -> None:
    """A row of standing books, backs to the front."""
    x = 0.0
    for i in range(int(build.rng.integers(3, 7))):
        thick, tall, depth = build.rng.uniform(0.025, 0.048), build.size(0.2, 0.25), build.rng.uniform(0.15, 0.18)
        rgb = build.rgb if i % 2 == 0 else build.other("red", "blue", "green", "brown", "black", "orange", "purple")
        _volume(build, rgb, thick, depth, tall, x + thick / 2)
        x += thick + 0.0015


def _cover(rgb: Rgb, size: float, seed: int) -> Material:
    return Material(Texture.LABEL, rgb, mix(rgb, (0.9, 0.85, 0.6), 0.75), size, 0.1, seed=seed)


def _volume(build: Assembly, rgb: Rgb, thick: float, depth: float, tall: float, x: float) -> None:
    label = _cover(rgb, tall, seed=int(build.rng.integers(1, 999)))
    for side in (x - thick / 2 + 0.0015, x + thick / 2 - 0.0015):
        build.add(label, block(0.003, depth, tall, side))
    build.add(label, block(thick - 0.0062, 0.003, tall, x, -depth / 2 + 0.0015))
    build.add(
        build.of("paper", linear((232, 224, 204))), block(thick - 0.0064, depth - 0.01, tall - 0.008, x, 0.002, 0.004)
    )


def book_stack(build: Assembly) -> None:
    """Books that lie on one another."""
    z = 0.0
    for i in range(int(build.rng.integers(2, 5))):
        width, depth, thick = build.size(0.2, 0.26), build.size(0.15, 0.19), build.rng.uniform(0.022, 0.042)
        rgb = build.rgb if i % 2 == 0 else build.other("red", "blue", "green", "brown", "black", "white")
        turn = float(build.rng.uniform(-14, 14))
        cover = replace(_cover(rgb, 0.2, seed=7), axis=2, extent=(-width / 2, width / 2, -depth / 2, depth / 2))
        boards = [block(width, depth, 0.003, 0, 0, z), block(width, depth, 0.003, 0, 0, z + thick - 0.003)]
        boards.append(block(width, 0.003, thick - 0.0064, 0, -depth / 2 + 0.0015, z + 0.0032))
        build.add(cover, *[shape.turned("z", turn) for shape in boards])
        pages = block(width - 0.01, depth - 0.008, thick - 0.0066, 0, 0.001, z + 0.0033)
        build.add(build.of("paper", linear((232, 224, 204))), pages.turned("z", turn))
        z += thick + 0.001


def cardboard_box(build: Assembly) -> None:
    """A closed carton with tape, or an open one with its flaps out."""
    width, depth, height = build.size(0.32, 0.44), build.size(0.25, 0.34), build.size(0.2, 0.3)
    side = Material(Texture.CARDBOARD, build.rgb, shade(build.rgb, 0.8), 0.012, 0.02, seed=3)
    if build.chance(0.55):
        build.add(side, block(width, depth, height))
        tape = build.of("plastic", mix(build.rgb, linear((226, 206, 150)), 0.75))
        build.add(tape, block(width * 1.002, 0.055, 0.002, 0, 0, height + 0.001))
        build.add(tape, *[block(0.002, 0.055, 0.07, x, 0, height - 0.07) for x in both(width / 2 + 0.0015)])
        build.add(build.of("paper", "white"), block(0.11, 0.002, 0.075, width * 0.2, -depth / 2 - 0.0015, height * 0.4))
        build.spot(both(width / 2 - 0.02), both(depth / 2 - 0.02), height + 0.002, 0.4)
        return
    build.add(side, block(width, depth, 0.006))
    build.add(side, *[block(0.006, depth, height - 0.007, x, 0, 0.007) for x in both(width / 2 - 0.003)])
    build.add(side, *[block(width - 0.014, 0.006, height - 0.007, 0, y, 0.007) for y in both(depth / 2 - 0.003)])
    for sx in (-1, 1):
        flap = block(0.13, depth * 0.96, 0.004, sx * 0.065, 0, 0).turned("y", sx * 28)
        build.add(side, flap.moved(sx * (width / 2 + 0.002), 0, height + 0.002))
    build.spot(both(width / 2 - 0.02), both(depth / 2 - 0.02), 0.007, role="inside")


def basket(build: Assembly) -> None:
    r, h = build.size(0.21, 0.25), build.size(0.24, 0.32)
    weave = build.of("wicker")
    build.add(weave, lathe([(0, 0), (r * 0.8, 0), (r, h), (r - 0.018, h), (r * 0.8 - 0.018, 0.016), (0, 0.016)], 28))
    rim = build.of("wicker", shade(build.rgb, 0.75))
    edge = [(0.001, -0.02), (0.012, -0.01), (0.012, 0.008), (-0.02, 0.008), (-0.02, 0.001)]
    build.add(rim, lathe([(r + out, h + up) for out, up in edge], 28))
    angle = np.linspace(0, np.pi, 9)
    for sx in (-1, 1):
        arc = [(sx * (r + 0.004), 0.07 * float(np.cos(a)), h + 0.005 + 0.06 * float(np.sin(a))) for a in angle]
        build.add(rim, tube(arc, 0.011, 7))
    side = (r * 0.8 - 0.03) * 0.7071
    build.spot(both(side), both(side), 0.017, role="inside")


def bin_(build: Assembly) -> None:
    r, h = build.size(0.13, 0.165), build.size(0.3, 0.4)
    body = build.main()
    if build.chance(0.4):  # pedal bin with a domed lid
        build.add(body, lathe([(0, 0), (r, 0), (r, h), (0, h)], 24))
        lid = lathe([(0, 0), (r + 0.006, 0), (r + 0.006, 0.025), (r * 0.6, 0.07), (0, 0.08)], 24)
        pedal = soft_block(0.09, 0.06, 0.018, 0, -r - 0.02, 0.008, 0.007)
        foot = lathe([(r, 0), (r + 0.006, 0), (r + 0.006, 0.03), (r, 0.03)], 24)
        build.add(build.of("plastic", "black"), lid.moved(z=h + 0.001), pedal, foot)
        return
    outside = [(0, 0), (r * 0.78, 0), (r, h), (r + 0.01, h), (r + 0.01, h + 0.012)]
    inside = [(r - 0.012, h + 0.012), (r * 0.77 - 0.01, 0.01), (0, 0.01)]
    build.add(body, lathe([*outside, *inside], 24))
    liner = build.of("plastic", mix(build.rgb, tone("black"), 0.6))
    build.add(liner, lathe([(0, 0), (r * 0.8, 0), (r * 0.8, 0.004), (0, 0.004)], 20).moved(z=h * 0.35))
    scrap = build.of("paper", "white")
    for i in range(3):
        ball = ellipsoid(r * 0.33, r * 0.3, r * 0.3).moved(r * 0.38, 0, h * 0.35 + r * 0.3)
        build.add(scrap, ball.turned("z", 120 * i))


def exercise_ball(build: Assembly) -> None:
    r = build.size(0.26, 0.33)
    skin = Material(Texture.GORES, build.rgb, shade(build.rgb, 0.7), 0.05, 0.45)
    build.add(skin, ellipsoid(r, r, r))
    valve = cylinder(0.02, 0.012).turned("x", 60)
    build.add(build.of("plastic", "white"), valve.moved(0, -r * 0.866 + 0.004, r * 0.5 - 0.002))


def pan(build: Assembly) -> None:
    """A shallow, dark frying pan with one long handle."""
    r = build.size(0.115, 0.145)
    body = build.of("metal")
    build.add(body, lathe([(0, 0), (r * 0.82, 0), (r, 0.05), (r - 0.006, 0.052), (r * 0.8, 0.008), (0, 0.008)], 26))
    build.add(build.of("metal", linear((44, 44, 47))), cylinder(r * 0.78, 0.002, z=0.0082))
    grip = build.of("plastic", "black")
    build.add(grip, tube([(0, -r + 0.002, 0.042), (0, -r - 0.08, 0.058), (0, -r - 0.2, 0.066)], 0.014, 8))


def pot(build: Assembly) -> None:
    """A cooking pot with a lid, its knob and two side handles."""
    r, h = build.size(0.1, 0.125), build.size(0.12, 0.16)
    body = build.of("metal") if build.colour == "grey" else build.of("ceramic")
    build.add(body, lathe([(0, 0), (r * 0.96, 0), (r, 0.012), (r, h), (0, h)], 26))
    lid = build.of("chrome") if build.colour == "grey" else build.of("ceramic", shade(build.rgb, 0.9))
    cover = lathe([(0, 0), (r + 0.006, 0), (r + 0.006, 0.008), (r * 0.6, 0.028), (0, 0.036)], 26)
    build.add(lid, cover.moved(z=h + 0.0005))
    black = build.of("plastic", "black")
    knob = lathe([(0, 0), (0.012, 0), (0.012, 0.012), (0.022, 0.024), (0.018, 0.034), (0, 0.036)], 14)
    build.add(black, knob.moved(z=h + 0.035))
    grip = [(r - 0.003, -0.045, h * 0.78), (r + 0.035, -0.035, h * 0.8)]
    grip += [(x, -y, z) for x, y, z in reversed(grip)]
    for sx in (-1, 1):
        build.add(black, tube([(sx * x, y, z) for x, y, z in grip], 0.009, 7))


def plate(build: Assembly) -> None:
    r = build.size(0.115, 0.14)
    body = build.of("ceramic")
    profile = [(0, 0), (r * 0.55, 0), (r * 0.7, 0.006), (r, 0.02), (r, 0.024), (r * 0.68, 0.011), (0, 0.009)]
    build.add(body, lathe(profile, 28))
    ring = build.of("ceramic", mix(build.rgb, tone("blue") if build.colour == "white" else tone("white"), 0.75))
    build.add(ring, lathe([(r * 0.84, 0.0178), (r * 0.84, 0.0185), (r * 0.93, 0.0222), (r * 0.93, 0.0215)], 28))


def bowl(build: Assembly) -> None:
    r = build.size(0.085, 0.125)
    h = r * build.rng.uniform(0.62, 0.75)
    outer = [(0, 0), (r * 0.45, 0), (r * 0.45, 0.01), (r * 0.78, h * 0.4), (r, h)]
    inner = [(r - 0.008, h), (r * 0.74, h * 0.45), (r * 0.4, 0.022), (0, 0.018)]
    build.add("ceramic", lathe([*outer, *inner], 26))
    if build.chance(0.4):
        for i in range(4):
            skin = replace(build.of("plastic", build.other("orange", "red", "yellow", "green")), gloss=0.2)
            fruit = ellipsoid(r * 0.36, r * 0.36, r * 0.36).moved(r * 0.4, 0, h * 0.78)
            build.add(skin, fruit.turned("z", 90 * i))


def cup(build: Assembly) -> None:
    r, h = build.size(0.042, 0.05), build.size(0.095, 0.115)
    r, h = max(r, 0.04), max(h, 0.09)
    body = build.of("ceramic")
    if build.chance(0.35):
        body = replace(body, texture=Texture.STRIPES, b=mix(build.rgb, (0.9, 0.9, 0.9), 0.75), scale=0.04, axis=1)
    build.add(body, lathe([(0, 0), (r * 0.9, 0), (r, h), (r - 0.005, h), (r * 0.88 - 0.004, 0.008), (0, 0.008)], 18))
    build.add(build.of("ceramic", linear((74, 44, 24))), cylinder(r * 0.88, 0.002, z=h * 0.78))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 8)
    ring = [(r * 0.93 + 0.03 * float(np.cos(a)), 0, h * 0.52 + 0.03 * float(np.sin(a))) for a in angle]
    build.add("ceramic", tube(ring, 0.007, 7))


def bottle(build: Assembly) -> None:
    r, h = build.size(0.036, 0.046), build.size(0.25, 0.31)
    outline = [(0, 0), (1, 0), (1, 0.58), (0.75, 0.68), (0.36, 0.78), (0.36, 0.95), (0, 0.95)]
    build.add(build.main(), lathe([(r * out, h * up) for out, up in outline], 20))
    label = Material(Texture.LABEL, tone("white"), build.other("red", "blue", "green", "yellow"), h * 0.3, 0.05, seed=5)
    build.add(label, lathe([(r, h * 0.16), (r + 0.0015, h * 0.16), (r + 0.0015, h * 0.46), (r, h * 0.46)], 20))
    cap = build.other("red", "white", "black", "yellow")
    build.add(build.of("plastic", cap), cylinder(r * 0.42, h * 0.07, z=h * 0.94))


def chopping_board(build: Assembly) -> None:
    width, depth = build.size(0.34, 0.42), build.size(0.22, 0.27)
    build.add("wooden", soft_block(width, depth, 0.022, 0, 0, 0, 0.009))
    build.add("wooden", soft_block(0.1, 0.075, 0.02, width / 2 + 0.04, 0, 0.001, 0.009))
    for i in range(3):
        slice_ = cylinder(0.026, 0.008).moved(-width * 0.2 + i * 0.06, -depth * 0.1, 0.0225)
        build.add(build.of("plastic", build.other("red", "green", "orange")), slice_)


def knife_block(build: Assembly) -> None:
    tall = build.size(0.2, 0.24)
    build.add(build.of("wooden", axis=2), block(0.1, 0.13, tall).turned("x", -14))
    black, steel = build.of("plastic", "black"), build.of("chrome")
    for i in range(5):
        x, y = (i % 3 - 1) * 0.031, -0.03 + (i // 3) * 0.055
        build.add(steel, block(0.016, 0.024, 0.02, x, y, tall + 0.0005).turned("x", -14))
        build.add(black, soft_block(0.018, 0.026, 0.085, x, y, tall + 0.021, 0.007).turned("x", -14))


def paper_towel(build: Assembly) -> None:
    """A kitchen roll on an upright holder."""
    r, h = build.size(0.058, 0.066), build.rng.uniform(0.21, 0.24)
    holder = build.of("chrome") if build.chance(0.5) else build.of("wooden", "brown")
    build.add(holder, lathe([(0, 0), (0.082, 0), (0.082, 0.014), (0, 0.014)], 22), cylinder(0.011, h + 0.06, z=0.014))
    build.add(holder, ellipsoid(0.02, 0.02, 0.02).moved(z=h + 0.085))
    roll = Material(Texture.DOTS, tone("white"), shade(tone("white"), 0.8), 0.024)
    build.add(roll, lathe([(0.022, 0), (r, 0), (r, h), (0.022, h), (0.022, 0)], 24).moved(z=0.016))
    build.add(roll, block(0.003, 0.075, h, -r + 0.001, -0.038, 0.016))


def tissue_box(build: Assembly) -> None:
    """A printed carton with a tissue that sticks out of its slit."""
    width, depth, tall = build.size(0.22, 0.25), build.size(0.12, 0.14), build.size(0.085, 0.11)
    second = mix(build.rgb, (0.9, 0.9, 0.9), 0.7)
    print_ = Material(Texture.DOTS, build.rgb, second, 0.035, 0.05)
    build.add(print_, block(width, depth, tall))
    build.add(build.of("paper", shade(second, 0.5)), block(width * 0.6, depth * 0.4, 0.0015, 0, 0, tall + 0.001))
    white = build.of("paper", "white")
    for turn, lean in ((0, 12), (70, -14), (130, 8)):
        tissue = block(0.085, 0.004, 0.075).tapered(0.45).turned("x", lean).turned("z", turn)
        build.add(white, tissue.moved(0, 0, tall + 0.003))
