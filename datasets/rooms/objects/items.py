"""How an object of a room is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.items import Item, Part, Spot
from su3d_bench.datasets.procedural.materials import Material, Rgb, of_kind, tone
from su3d_bench.datasets.procedural.shapes import Shape, bounds
from su3d_bench.datasets.rooms.classes import CLASS_BY_NAME, CLASSES

USUAL_VOLUME_L: Mapping[str, float] = {model: litres for known in CLASSES for model, litres in known.models.items()}
SMALL_BELOW, LARGE_ABOVE = 0.78, 1.28  # of the typical volume: roughly the outer quartiles of models that vary


def size_word(model: str, size: Float64Array) -> str:
    """small, medium or large, for a box with sides ``size`` in metres."""
    share = 1000.0 * float(np.prod(size)) / USUAL_VOLUME_L[model]
    return "small" if share < SMALL_BELOW else "large" if share > LARGE_ABOVE else "medium"


@dataclass
class Assembly:
    """An instance being built: the choices that distinguish it within its class, its parts and spots so far."""

    class_name: str
    colour: str
    material: str
    scale: float
    rng: np.random.Generator
    rgb: Rgb
    parts: list[Part] = field(default_factory=list)
    spots: list[Spot] = field(default_factory=list)

    def main(self, axis: int = 0) -> Material:
        """The object's material in its colour; ``axis`` is the direction of a wood grain."""
        return self.of(self.material, axis=axis)

    def of(self, kind: str, rgb: Rgb | str | None = None, axis: int = 0) -> Material:
        """A material in a colour, possibly given by name; by default in the object's colour."""
        colour = tone(rgb) if isinstance(rgb, str) else self.rgb if rgb is None else rgb
        return of_kind(kind, colour, self.rng, axis)

    def other(self, *colours: str) -> Rgb:
        """A tone of one of the colours."""
        return tone(str(self.rng.choice(colours)) if len(colours) > 1 else colours[0], self.rng)

    def size(self, low: float, high: float) -> float:
        """A length in metres, scaled with the instance's size."""
        return float(self.rng.uniform(low, high) * self.scale)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def add(self, material: Material | str, *shapes: Shape) -> None:
        """Parts of one material, or of a kind of material in the object's colour."""
        made_of = self.of(material) if isinstance(material, str) else material
        self.parts.extend(Part(shape, made_of) for shape in shapes)

    def spot(self, x: tuple[float, float], y: tuple[float, float], z: float, clearance: float = 10.0,
             role: str = "top") -> None:  # fmt: skip
        self.spots.append(Spot(*x, *y, z, clearance, role))

    def item(self, model: str) -> Item:
        """The finished instance, as a ``model``."""
        low, high = bounds([part.shape for part in self.parts])
        shift = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]])
        parts = tuple(Part(part.shape.moved(*shift), part.material) for part in self.parts)
        spots = tuple(spot.moved(*shift) for spot in self.spots)
        word = size_word(model, high - low)
        return Item(self.class_name, self.colour, self.material, word, parts, spots, high - low, model)


Builder = Callable[[Assembly], None]


def begin(
    class_name: str, rng: np.random.Generator, colour: str | None = None, avoid: frozenset[str] = frozenset()
) -> Assembly:
    """An instance with a random look; colours in ``avoid`` are used only if no other is allowed."""
    known = CLASS_BY_NAME[class_name]
    material = str(rng.choice(list(known.materials)))
    free = [c for c in known.colours if c not in avoid] or list(known.colours)
    chosen = colour or str(rng.choice(free))
    return Assembly(class_name, chosen, material, float(rng.uniform(0.8, 1.22)), rng, tone(chosen, rng))
