"""An instance of a model: draws its variant, size, materials and open doors, and makes the shapes of its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.homes.model_format import FABRICS, Ajar, ModelRow, PartRow, Repeat, split_material
from su3d_bench.datasets.procedural.items import Item, Light, Part, Spot
from su3d_bench.datasets.procedural.materials import (
    HOMES_LOOKS,
    LOOKS,
    Material,
    Rgb,
    Texture,
    colours_of,
    linear,
    mix,
    of_kind,
    shade,
    tone,
)
from su3d_bench.datasets.procedural.shapes import (
    Shape,
    block,
    bounds,
    ellipsoid,
    join,
    lathe,
    leaf,
    loft,
    prism,
    puff,
    sheet,
    soft_block,
    tube,
)

MUTED_SHARE = 0.55  # of grey in the colours of a muted home: chroma below half, the hue still nameable
SMALL_BELOW, LARGE_ABOVE = 0.85, 1.18  # of the model's own volume: about the outer quartiles at the usual variation
WARM, COLD = (1.0, 0.82, 0.6), (1.0, 0.98, 0.95)  # of 2700 K and 5000 K lamps, relative
WEAR = {"fabric": 0.5, "wooden": 0.45, "stone": 0.5, "paper": 0.35, "wicker": 0.4, "leather": 0.5}  # others 0.25


@dataclass(frozen=True)
class Paint:
    """A material to be: its kind, and its colour in linear light."""

    kind: str
    rgb: Rgb

    def darker(self, factor: float) -> Paint:
        return Paint(self.kind, shade(self.rgb, factor))


class Look:
    """The random choices of one instance: its materials by slot."""

    def __init__(self, row: ModelRow, rng: np.random.Generator, muted: bool, colour: str | None) -> None:
        self._rng, self._muted = rng, muted
        kind = str(rng.choice(list(row.made_of)))
        words = colours_of(row.colours)
        self.colour = colour if colour in words else str(rng.choice(words))
        self.material = str(HOMES_LOOKS.get(kind, {}).get("word", "fabric" if kind in FABRICS else kind))
        self._paints = {"main": Paint(kind, self._tone(kind, self.colour))}
        for name, text in row.slots.items():
            self._paints[name] = self._paint(text)

    def paint(self, of: str) -> Paint:
        """The material named by a part."""
        name, _, factor = of.partition("*")
        if name not in self._paints:
            self._paints[name] = self._paint(name)
        return self._paints[name].darker(float(factor or 1.0))

    def _paint(self, text: str) -> Paint:
        kind, words = split_material(text)
        if words == ("main",):
            return Paint(kind, self._paints["main"].rgb)
        return Paint(kind, self._tone(kind, str(self._rng.choice(colours_of(words))) if words else ""))

    def _tone(self, kind: str, colour: str) -> Rgb:
        fixed = HOMES_LOOKS.get(kind, {}).get("colour")
        rgb = linear(tuple(fixed)) if fixed else tone(colour, self._rng)
        grey = sum(rgb) / 3
        return mix(rgb, (grey, grey, grey), MUTED_SHARE) if self._muted and not fixed else rgb


def material_of(paint: Paint, shape: Shape, grain: str, rng: np.random.Generator) -> Material:
    """The material of a part; textures that fill a face get the bounds of the part's two longest sides."""
    look = HOMES_LOOKS.get(paint.kind, {})
    axis = "xyz".index(grain)
    word = look.get("word", "fabric" if paint.kind in FABRICS else paint.kind)
    wear = 0.0 if look.get("glow") or look.get("mirror") or look.get("clear") else WEAR.get(word, 0.25)
    if paint.kind in FABRICS or paint.kind in LOOKS:
        return replace(of_kind(paint.kind, paint.rgb, rng, axis), wear=wear)
    scale = look.get("scale", 0.05)
    scale = float(rng.uniform(*scale)) if isinstance(scale, list) else scale
    second = linear((224, 218, 205)) if look.get("fills") and sum(paint.rgb) < 1.2 else shade(paint.rgb, look["second"])
    return Material(
        Texture[look["texture"]], paint.rgb, second, scale, look.get("gloss", 0.05), look.get("glow", 0.0), axis,
        _extent(shape) if look.get("fills") else (0.0, 1.0, 0.0, 1.0),
        int(rng.integers(1, 4000)) if look.get("is_seeded") else 0,
        mirror=look.get("mirror", 0.0), clear=look.get("clear", 0.0), wear=wear,
    )  # fmt: skip


def _extent(shape: Shape) -> tuple[float, float, float, float]:
    low, high = bounds([shape])
    u, v = ((0, 1), (1, 2), (0, 2))[(2, 0, 1).index(int(np.argmin(high - low)))]
    return float(low[u]), float(high[u]), float(low[v]), float(high[v])


def shape_of(row: PartRow) -> Shape:
    """The part's shape before it is moved."""
    if row.block:
        return soft_block(*row.block, radius=row.round) if row.round else block(*row.block)
    if row.revolve:
        return lathe(row.revolve, row.sides)
    if row.extrude:
        return prism(row.extrude, row.length, row.along)
    if row.tube:
        return tube(row.tube, row.radius, row.sides or 8)
    if row.ellipsoid:
        return ellipsoid(*row.ellipsoid).moved(z=row.ellipsoid[2])
    if row.cushion:
        return puff(*row.cushion).moved(z=row.cushion[1] / 2)
    if row.cloth:
        return _hanging_cloth(*row.cloth, row.folds, row.depth)
    if row.loft:
        return loft(row.loft, row.power, row.sides or 20)
    assert row.leaf
    return leaf(*row.leaf)


def _hanging_cloth(width: float, height: float, folds: float, depth: float) -> Shape:
    n = int(np.clip(round(6 * folds), 4, 96))
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, 5), indexing="ij")
    wave = np.sin(2 * np.pi * folds * u + 0.6 * np.sin(5 * u)) * depth / 2 * (1.1 - 0.4 * v)
    return sheet(np.stack([(u - 0.5) * width, wave, v * height], axis=-1), 0.004)


def _opened(shape: Shape, ajar: Ajar | None, shares: dict[Ajar, float], rng: np.random.Generator) -> Shape:
    """The shape opened by the share of its ``ajar``, which is drawn for the first part that has it."""
    if ajar is None:
        return shape
    if ajar not in shares:
        shares[ajar] = float(rng.uniform(0.2, 1.0)) if rng.random() < ajar.chance else 0.0
    if not (share := shares[ajar]):
        return shape
    x, y, z = ajar.hinge
    turned = shape.moved(-x, -y, -z).turned(ajar.axis, ajar.degrees * share).moved(x, y, z)
    return turned.moved(*(share * step for step in ajar.slide))


def _mirrored(shape: Shape, axes: str) -> list[Shape]:
    copies = [shape]
    for axis in axes:
        flip = np.array([-1.0 if axis == name else 1.0 for name in "xyz"])
        copies += [Shape(one.quads * flip, one.normals * flip) for one in copies]
    return copies


def _repeated(shapes: Sequence[Shape], repeat: Repeat | None, rng: np.random.Generator) -> list[Shape]:
    if repeat is None:
        return list(shapes)
    n = repeat.n if isinstance(repeat.n, int) else int(rng.integers(repeat.n[0], repeat.n[1] + 1))
    copies = []
    for k in range(n):
        step = [k * value for value in repeat.step]
        turn = repeat.ring * k / n + (float(rng.uniform(-repeat.jitter, repeat.jitter)) if repeat.jitter else 0.0)
        copies += [one.turned("z", turn).moved(*step) if turn else one.moved(*step) for one in shapes]
    return copies


def _part(row: PartRow, look: Look, shares: dict[Ajar, float], rng: np.random.Generator) -> Part:
    shape = shape_of(row)
    if row.taper != 1.0:
        shape = shape.tapered(row.taper)
    if row.scale != (1, 1, 1):
        shape = shape.stretched(*row.scale)
    for axis, degrees in row.turn:
        shape = shape.turned(axis, degrees)
    shape = _opened(shape.moved(*row.at), row.ajar, shares, rng)
    whole = join(_repeated(_mirrored(shape, row.mirror), row.repeat, rng))
    return Part(whole, material_of(look.paint(row.of), whole, row.grain, rng))


def build_item(row: ModelRow, rng: np.random.Generator, muted: bool = False, colour: str | None = None) -> Item:
    """A new instance; ``colour`` is used if the model can have it, ``muted`` takes chroma out of its colours."""
    variant = str(rng.choice(row.variants)) if row.variants else ""
    look = Look(row, rng, muted, colour)
    scale = (1 + rng.uniform(-row.vary, row.vary)) * (1 + rng.uniform(-row.stretch, row.stretch, 3))
    parts: list[Part] = []
    shares: dict[Ajar, float] = {}
    for part in row.parts:
        is_there = (not part.only or variant in part.only) and (part.chance >= 1 or rng.random() < part.chance)
        if is_there:
            parts.append(_part(part, look, shares, rng))
    low, high = bounds([part.shape for part in parts])
    shift = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]])
    moved = tuple(_scaled(part, shift, scale) for part in parts)
    spots = tuple(
        Spot(*_along(spot.x, shift[0], scale[0]), *_along(spot.y, shift[1], scale[1]), (spot.z + shift[2]) * scale[2],
             spot.clearance * scale[2], spot.role)
        for spot in row.spots if not spot.only or variant in spot.only
    )  # fmt: skip
    lamps = tuple(
        Light(_triple((np.array(lamp.at) + shift) * scale), _lamp_colour(lamp.warmth, lamp.power), lamp.radius)
        for lamp in row.lamps
    )
    share = float(np.prod(scale))
    word = "small" if share < SMALL_BELOW else "large" if share > LARGE_ABOVE else "medium"
    size = (high - low) * scale
    return Item(row.of_class, look.colour, look.material, word, moved, spots, size, row.name, lamps)


def _scaled(part: Part, shift: Float64Array, scale: Float64Array) -> Part:
    material, (x, y, z) = part.material, scale
    if material.extent != (0.0, 1.0, 0.0, 1.0):
        material = replace(material, extent=_extent(part.shape.moved(*shift).stretched(x, y, z)))
    return Part(part.shape.moved(*shift).stretched(x, y, z), material)


def _along(span: tuple[float, float], shift: float, scale: float) -> tuple[float, float]:
    return (span[0] + shift) * scale, (span[1] + shift) * scale


def _triple(values: Float64Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _lamp_colour(warmth: float, power: float) -> Rgb:
    red, green, blue = (power * value for value in mix(COLD, WARM, warmth))
    return red, green, blue
