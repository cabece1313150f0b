"""What an object of a room is made of, before it has a place: parts, and spots that hold other objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.rooms.classes import CLASS_BY_NAME
from su3d_bench.datasets.rooms.objects.materials import Material, Rgb, of_kind, tone
from su3d_bench.datasets.rooms.objects.shapes import Shape, bounds

# litres of the bounding box: the median of 200 instances, seeds (7, 0) to (7, 199); a test measures them again
USUAL_VOLUME_L: Mapping[str, float] = {
    "chair": 247,
    "stool": 77.7,
    "bench": 194,
    "beanbag": 486,
    "sofa": 1.28e03,
    "bed": 2.78e03,
    "table": 849,
    "coffee_table": 234,
    "side_table": 133,
    "desk": 738,
    "nightstand": 122,
    "cabinet": 458,
    "base_cabinet": 406,
    "wall_cabinet": 174,
    "wardrobe": 1.67e03,
    "shelf": 512,
    "wall_shelf": 32.9,
    "tv_stand": 304,
    "plant_stand": 64.3,
    "door": 226,
    "window": 293,
    "curtain": 86.4,
    "blinds": 60.6,
    "switch": 0.671,
    "wall_plug": 0.52,
    "vent": 1.88,
    "pedestal_sink": 345,
    "kitchen_sink": 103,
    "toilet": 290,
    "bathtub": 741,
    "countertop": 24.8,
    "towel_rail": 24.7,
    "folded_towel": 9.33,
    "rolled_towel": 6.91,
    "refrigerator": 791,
    "cooktop": 8.76,
    "microwave": 57.7,
    "tv_screen": 148,
    "wall_tv": 40.2,
    "monitor": 48.5,
    "laptop": 27.8,
    "keyboard": 2,
    "mouse": 0.603,
    "desktop_computer": 41.2,
    "table_lamp": 41.4,
    "floor_lamp": 271,
    "desk_lamp": 20.9,
    "ceiling_lamp": 71.1,
    "indoor_plant": 72.2,
    "vase": 11.4,
    "picture": 6.87,
    "clock": 3.91,
    "candle": 5.23,
    "sculpture": 10.7,
    "books": 7.15,
    "book_stack": 5.43,
    "cardboard_box": 37.3,
    "basket": 87.8,
    "bin_": 40.7,
    "exercise_ball": 215,
    "cushion": 36.6,
    "flat_cushion": 22.9,
    "pillow": 36.6,
    "blanket": 24,
    "rolled_blanket": 13.9,
    "rug": 28.7,
    "mat": 8.71,
    "backpack": 60,
    "umbrella": 19,
    "pan": 9.73,
    "pot": 16.2,
    "plate": 1.63,
    "bowl": 3.65,
    "cup": 1.23,
    "bottle": 2.17,
    "chopping_board": 3.64,
    "knife_block": 6.25,
    "paper_towel": 8.84,
    "tissue_box": 5.66,
}
SMALL_BELOW, LARGE_ABOVE = 0.78, 1.28  # of the usual volume: about the outer quarters of the models that vary


def size_word(model: str, size: Float64Array) -> str:
    """small, medium or large, for a box of sides ``size`` metres."""
    share = 1000.0 * float(np.prod(size)) / USUAL_VOLUME_L[model]
    return "small" if share < SMALL_BELOW else "large" if share > LARGE_ABOVE else "medium"


FOOT_HEIGHT_M = 0.025


@dataclass(frozen=True)
class Part:
    shape: Shape
    material: Material


@dataclass(frozen=True)
class Spot:
    """A level rectangle in item coordinates that can hold things up to ``clearance`` metres tall."""

    x0: float
    x1: float
    y0: float
    y1: float
    z: float
    clearance: float = 10.0
    role: str = "top"  # top, board, seat, inside

    def moved(self, x: float, y: float, z: float) -> Spot:
        return Spot(self.x0 + x, self.x1 + x, self.y0 + y, self.y1 + y, self.z + z, self.clearance, self.role)


@dataclass(frozen=True)
class Item:
    """An object in its own frame: centred over the origin, standing on z = 0, its front towards -y."""

    class_name: str
    colour: str
    material: str
    size_word: str
    parts: tuple[Part, ...]
    spots: tuple[Spot, ...]
    size: Float64Array

    @cached_property
    def foot(self) -> Float64Array:
        """Corners (2, 2) of the rectangle on which the item stands: what it touches, without its overhang."""
        corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in self.parts])
        low = corners[corners[:, 2] < FOOT_HEIGHT_M]
        return np.stack([low[:, :2].min(axis=0), low[:, :2].max(axis=0)])


@dataclass(frozen=True)
class Look:
    """The choices for one instance: everything that varies within a class comes from here."""

    class_name: str
    colour: str
    material: str
    scale: float
    rng: np.random.Generator
    rgb: Rgb

    def main(self, axis: int = 0) -> Material:
        """The object's own material in its own colour; ``axis`` is the direction of a wood grain."""
        return of_kind(self.material, self.rgb, self.rng, axis)

    def other(self, colour: str) -> Rgb:
        return tone(colour, self.rng)

    def size(self, low: float, high: float) -> float:
        """A length in metres that grows with the instance's size."""
        return float(self.rng.uniform(low, high) * self.scale)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)


@dataclass
class Assembly:
    """Collects the parts and spots of an item while it is built."""

    look: Look
    parts: list[Part] = field(default_factory=list)
    spots: list[Spot] = field(default_factory=list)

    def add(self, material: Material, *shapes: Shape) -> None:
        self.parts.extend(Part(shape, material) for shape in shapes)

    def spot(self, x: tuple[float, float], y: tuple[float, float], z: float, clearance: float = 10.0,
             role: str = "top") -> None:  # fmt: skip
        self.spots.append(Spot(*x, *y, z, clearance, role))

    def item(self, model: str) -> Item:
        """What was built, as an instance of a ``model``."""
        low, high = bounds([part.shape for part in self.parts])
        shift = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]])
        parts = tuple(Part(part.shape.moved(*shift), part.material) for part in self.parts)
        spots = tuple(spot.moved(*shift) for spot in self.spots)
        look = self.look
        return Item(look.class_name, look.colour, look.material, size_word(model, high - low), parts, spots, high - low)


Builder = Callable[[Look], Assembly]


def choose_look(
    class_name: str, rng: np.random.Generator, colour: str | None = None, avoid: frozenset[str] = frozenset()
) -> Look:
    """A random look of the class; colours in ``avoid`` are taken only where nothing else is allowed."""
    known = CLASS_BY_NAME[class_name]
    material = str(rng.choice(list(known.materials)))
    free = [c for c in known.colours if c not in avoid] or list(known.colours)
    chosen = colour or str(rng.choice(free))
    return Look(class_name, chosen, material, float(rng.uniform(0.8, 1.22)), rng, tone(chosen, rng))
