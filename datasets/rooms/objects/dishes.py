"""Builders of what is used at the stove, the table and the sink."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Assembly, Builder, Look
from su3d_bench.datasets.rooms.objects.materials import (
    Material,
    Texture,
    ceramic,
    chrome,
    glass,
    linear,
    metal,
    mix,
    paper,
    plastic,
    shade,
    tone,
    wood,
)
from su3d_bench.datasets.rooms.objects.shapes import block, cylinder, ellipsoid, lathe, soft_block, tube


def pan(look: Look) -> Assembly:
    """A shallow, dark frying pan with one long handle."""
    build = Assembly(look)
    r = look.size(0.115, 0.145)
    body = metal(look.rgb, look.rng)
    build.add(body, lathe([(0, 0), (r * 0.82, 0), (r, 0.05), (r - 0.006, 0.052), (r * 0.8, 0.008), (0, 0.008)], 26))
    build.add(metal(linear((44, 44, 47)), look.rng), cylinder(r * 0.78, 0.002, z=0.0082))
    grip = plastic(tone("black"))
    build.add(grip, tube([(0, -r + 0.002, 0.042), (0, -r - 0.08, 0.058), (0, -r - 0.2, 0.066)], 0.014, 8))
    return build


def pot(look: Look) -> Assembly:
    """A cooking pot with a lid, its knob and two side handles."""
    build = Assembly(look)
    r, h = look.size(0.1, 0.125), look.size(0.12, 0.16)
    body = metal(look.rgb, look.rng) if look.colour == "grey" else ceramic(look.rgb)
    build.add(body, lathe([(0, 0), (r * 0.96, 0), (r, 0.012), (r, h), (0, h)], 26))
    lid = chrome(look.rng) if look.colour == "grey" else ceramic(shade(look.rgb, 0.9))
    build.add(
        lid, lathe([(0, 0), (r + 0.006, 0), (r + 0.006, 0.008), (r * 0.6, 0.028), (0, 0.036)], 26).moved(z=h + 0.0005)
    )
    black = plastic(tone("black"))
    build.add(
        black,
        lathe([(0, 0), (0.012, 0), (0.012, 0.012), (0.022, 0.024), (0.018, 0.034), (0, 0.036)], 14).moved(z=h + 0.035),
    )
    for sx in (-1, 1):
        grip = [
            (sx * (r - 0.003), -0.045, h * 0.78),
            (sx * (r + 0.035), -0.035, h * 0.8),
            (sx * (r + 0.035), 0.035, h * 0.8),
            (sx * (r - 0.003), 0.045, h * 0.78),
        ]
        build.add(black, tube(grip, 0.009, 7))
    return build


def plate(look: Look) -> Assembly:
    build = Assembly(look)
    r = look.size(0.115, 0.14)
    body = ceramic(look.rgb)
    build.add(
        body, lathe([(0, 0), (r * 0.55, 0), (r * 0.7, 0.006), (r, 0.02), (r, 0.024), (r * 0.68, 0.011), (0, 0.009)], 28)
    )
    ring = ceramic(mix(look.rgb, tone("blue") if look.colour == "white" else tone("white"), 0.75))
    build.add(ring, lathe([(r * 0.84, 0.0178), (r * 0.84, 0.0185), (r * 0.93, 0.0222), (r * 0.93, 0.0215)], 28))
    return build


def bowl(look: Look) -> Assembly:
    build = Assembly(look)
    r = look.size(0.085, 0.125)
    h = r * look.rng.uniform(0.62, 0.75)
    outer = [(0, 0), (r * 0.45, 0), (r * 0.45, 0.01), (r * 0.78, h * 0.4), (r, h)]
    build.add(
        ceramic(look.rgb), lathe([*outer, (r - 0.008, h), (r * 0.74, h * 0.45), (r * 0.4, 0.022), (0, 0.018)], 26)
    )
    if look.chance(0.4):
        for i in range(4):
            fruit = look.other(str(look.rng.choice(["orange", "red", "yellow", "green"])))
            size = r * 0.36
            build.add(
                replace(plastic(fruit), gloss=0.2),
                ellipsoid(size, size, size).moved(r * 0.4, 0, h * 0.78).turned("z", 90 * i),
            )
    return build


def cup(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.042, 0.05), look.size(0.095, 0.115)
    r, h = max(r, 0.04), max(h, 0.09)
    body = ceramic(look.rgb)
    if look.chance(0.35):
        body = replace(body, texture=Texture.STRIPES, b=mix(look.rgb, (0.9, 0.9, 0.9), 0.75), scale=0.04, axis=1)
    build.add(body, lathe([(0, 0), (r * 0.9, 0), (r, h), (r - 0.005, h), (r * 0.88 - 0.004, 0.008), (0, 0.008)], 18))
    build.add(ceramic(linear((74, 44, 24))), cylinder(r * 0.88, 0.002, z=h * 0.78))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 8)
    ring = [(r * 0.93 + 0.03 * float(np.cos(a)), 0, h * 0.52 + 0.03 * float(np.sin(a))) for a in angle]
    build.add(ceramic(look.rgb), tube(ring, 0.007, 7))
    return build


def bottle(look: Look) -> Assembly:
    build = Assembly(look)
    r, h = look.size(0.036, 0.046), look.size(0.25, 0.31)
    outline = [
        (0, 0),
        (r, 0),
        (r, h * 0.58),
        (r * 0.75, h * 0.68),
        (r * 0.36, h * 0.78),
        (r * 0.36, h * 0.95),
        (0, h * 0.95),
    ]
    build.add(glass(look.rgb) if look.material == "glass" else plastic(look.rgb), lathe(outline, 20))
    label = Material(
        Texture.LABEL,
        tone("white"),
        look.other(str(look.rng.choice(["red", "blue", "green", "yellow"]))),
        h * 0.3,
        0.05,
        seed=5,
    )
    build.add(label, lathe([(r, h * 0.16), (r + 0.0015, h * 0.16), (r + 0.0015, h * 0.46), (r, h * 0.46)], 20))
    cap = look.other(str(look.rng.choice(["red", "white", "black", "yellow"])))
    build.add(plastic(cap), cylinder(r * 0.42, h * 0.07, z=h * 0.94))
    return build


def chopping_board(look: Look) -> Assembly:
    build = Assembly(look)
    width, depth = look.size(0.34, 0.42), look.size(0.22, 0.27)
    build.add(wood(look.rgb, look.rng), soft_block(width, depth, 0.022, 0, 0, 0, 0.009))
    build.add(wood(look.rgb, look.rng), soft_block(0.1, 0.075, 0.02, width / 2 + 0.04, 0, 0.001, 0.009))
    for i in range(3):
        slice_ = cylinder(0.026, 0.008).moved(-width * 0.2 + i * 0.06, -depth * 0.1, 0.0225)
        build.add(plastic(look.other(str(look.rng.choice(["red", "green", "orange"])))), slice_)
    return build


def knife_block(look: Look) -> Assembly:
    build = Assembly(look)
    tall = look.size(0.2, 0.24)
    build.add(wood(look.rgb, look.rng, 2), block(0.1, 0.13, tall).turned("x", -14))
    black, steel = plastic(tone("black")), chrome(look.rng)
    for i in range(5):
        x, y = (i % 3 - 1) * 0.031, -0.03 + (i // 3) * 0.055
        build.add(steel, block(0.016, 0.024, 0.02, x, y, tall + 0.0005).turned("x", -14))
        build.add(black, soft_block(0.018, 0.026, 0.085, x, y, tall + 0.021, 0.007).turned("x", -14))
    return build


def paper_towel(look: Look) -> Assembly:
    """A kitchen roll on an upright holder."""
    build = Assembly(look)
    r, h = look.size(0.058, 0.066), look.rng.uniform(0.21, 0.24)
    holder = chrome(look.rng) if look.chance(0.5) else wood(tone("brown"), look.rng)
    build.add(holder, lathe([(0, 0), (0.082, 0), (0.082, 0.014), (0, 0.014)], 22), cylinder(0.011, h + 0.06, z=0.014))
    build.add(holder, ellipsoid(0.02, 0.02, 0.02).moved(z=h + 0.085))
    roll = Material(Texture.DOTS, tone("white"), shade(tone("white"), 0.8), 0.024)
    build.add(roll, lathe([(0.022, 0), (r, 0), (r, h), (0.022, h), (0.022, 0)], 24).moved(z=0.016))
    build.add(roll, block(0.003, 0.075, h, -r + 0.001, -0.038, 0.016))
    return build


def tissue_box(look: Look) -> Assembly:
    """A printed carton with a tissue that sticks out of its slit."""
    build = Assembly(look)
    width, depth, tall = look.size(0.22, 0.25), look.size(0.12, 0.14), look.size(0.085, 0.11)
    second = mix(look.rgb, (0.9, 0.9, 0.9), 0.7)
    print_ = Material(Texture.DOTS, look.rgb, second, 0.035, 0.05)
    build.add(print_, block(width, depth, tall))
    build.add(paper(shade(second, 0.5)), block(width * 0.6, depth * 0.4, 0.0015, 0, 0, tall + 0.001))
    white = paper(tone("white"))
    for turn, lean in ((0, 12), (70, -14), (130, 8)):
        build.add(
            white,
            block(0.085, 0.004, 0.075).tapered(0.45).turned("x", lean).turned("z", turn).moved(0, 0, tall + 0.003),
        )
    return build


DISHES: Mapping[str, tuple[Builder, ...]] = {
    "pan": (pan,),
    "pot": (pot,),
    "plate": (plate,),
    "bowl": (bowl,),
    "cup": (cup,),
    "bottle": (bottle,),
    "chopping-board": (chopping_board,),
    "knife-block": (knife_block,),
    "paper-towel": (paper_towel,),
    "tissue-paper": (tissue_box,),
}
