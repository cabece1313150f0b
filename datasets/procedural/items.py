"""An object of a generated scene: its parts, the spots that hold other objects, its size; and where it is placed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.materials import Material
from su3d_bench.datasets.procedural.shapes import Shape, rotation

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
class Light:
    """A soft light: ``position`` m, ``colour`` linear RGB times power, ``radius`` m."""

    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    radius: float


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
    model: str = ""  # the class's model that was built; empty for parts of the room itself
    lights: tuple[Light, ...] = ()  # that it emits, in its own frame

    @cached_property
    def foot(self) -> Float64Array:
        """Corners (2, 2) of the rectangle on which the item stands: its contact area, without overhang."""
        corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in self.parts])
        low = corners[corners[:, 2] < FOOT_HEIGHT_M]
        return np.stack([low[:, :2].min(axis=0), low[:, :2].max(axis=0)])


@dataclass(frozen=True)
class Placed:
    """A placed item: rotated by ``yaw`` degrees about z, then moved to ``position``; ``id`` from 1."""

    id: int
    item: Item
    yaw: float
    position: Float64Array

    def to_world(self, points: Float64Array) -> Float64Array:
        return points @ rotation("z", self.yaw).T + self.position


@dataclass(frozen=True)
class Box:
    low: Float64Array
    high: Float64Array

    @property
    def corners(self) -> Float64Array:
        """The lowest and the highest corner (2, 3)."""
        return np.stack([self.low, self.high])

    def overlaps(self, other: Box, gap: float = 0.0) -> bool:
        """Overlap, with ``gap`` metres of horizontal air around."""
        pad = np.array([gap, gap, 0.0])
        return bool(((self.low - pad < other.high) & (other.low < self.high + pad)).all())


def box_of(placed: Placed) -> Box:
    corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in placed.item.parts])
    world = placed.to_world(corners)
    return Box(world.min(axis=0), world.max(axis=0))
