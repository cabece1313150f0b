"""Floor plans of homes: rooms, walls, sloped ceilings and the doorway between two rooms; drawn at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array

PARTITION_M = 0.12  # thickness of the wall between two rooms: a plasterboard partition
DOOR_HEIGHT_M = 2.02
Rect = tuple[float, float, float, float]  # x0, x1, y0, y1


@dataclass(frozen=True)
class Wall:
    """A wall seen from its room: ``start`` on the left, ``along`` (unit) to the right, ``normal`` into the room."""

    start: Float64Array
    along: Float64Array
    length: float

    @property
    def normal(self) -> Float64Array:
        return np.array([self.along[1], -self.along[0]])

    @property
    def yaw(self) -> float:
        """Of an item with its back to the wall."""
        return float(np.round(np.rad2deg(np.arctan2(self.along[1], self.along[0]))))

    def point(self, along: float, off: float) -> Float64Array:
        return np.asarray(self.start + along * self.along + off * self.normal)

    def position(self, point: Float64Array) -> tuple[float, float]:
        """Position of a point along the wall and off it."""
        return float((point - self.start) @ self.along), float((point - self.start) @ self.normal)


@dataclass(frozen=True)
class Slope:
    """A ceiling ``knee`` m high over the line x * nx + y * ny = offset, that reaches full height after ``run`` m."""

    nx: float
    ny: float
    offset: float
    knee: float
    run: float


@dataclass(frozen=True)
class Room:
    """A room: ``corners`` (N, 2) of its floor, clockwise, edges parallel to x or y; what it is used for; height m."""

    corners: Float64Array
    kinds: tuple[str, ...]
    height: float
    slope: Slope | None = None

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        pairs = zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True)
        return tuple(Wall(a, (b - a) / np.abs(b - a).sum(), float(np.abs(b - a).sum())) for a, b in pairs)

    @property
    def rect(self) -> Rect:
        (x0, y0), (x1, y1) = self.corners.min(axis=0), self.corners.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)

    def ceiling(self, points: Float64Array) -> Float64Array:
        """Height of the ceiling over points (..., 2)."""
        if self.slope is None:
            return np.full(points.shape[:-1], self.height)
        s = self.slope
        away = points[..., 0] * s.nx + points[..., 1] * s.ny - s.offset
        return np.asarray(np.minimum(self.height, s.knee + (self.height - s.knee) * np.maximum(away, 0.0) / s.run))

    def contains(self, points: Float64Array) -> BoolArray:
        """Whether points (..., 2) are over the floor."""
        inside = np.zeros(points.shape[:-1], bool)
        for (ax, ay), (bx, by) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if ax == bx:
                inside ^= (points[..., 1] < max(ay, by)) & (points[..., 1] >= min(ay, by)) & (points[..., 0] < ax)
        return inside

    def tiles(self) -> tuple[list[Rect], list[Rect]]:
        """Rectangles that cover the floor, split at the slope; and those that complete the bounding rectangle."""
        xs, ys = (set(self.corners[:, k].tolist()) for k in (0, 1))
        if self.slope is not None:
            end = self.slope.offset + self.slope.run
            (xs if self.slope.nx else ys).add(end * (self.slope.nx + self.slope.ny))
        all_of = [(a, b, c, d) for a, b in pairwise(sorted(xs)) for c, d in pairwise(sorted(ys))]
        centres = np.array([((a + b) / 2, (c + d) / 2) for a, b, c, d in all_of])
        covered: list[Rect] = []
        notch: list[Rect] = []
        for tile, is_inside in zip(all_of, self.contains(centres), strict=True):
            (covered if is_inside else notch).append(tile)
        return covered, notch


@dataclass(frozen=True)
class Zone:
    """A part of a room that is furnished for one purpose."""

    room: int
    kind: str
    rect: Rect

    def contains(self, point: Float64Array) -> bool:
        x0, x1, y0, y1 = self.rect
        return bool(x0 <= point[0] <= x1 and y0 <= point[1] <= y1)


@dataclass(frozen=True)
class Layout:
    """A floor plan: its name, rooms, zones, and the rectangle of the opening between two rooms."""

    name: str
    rooms: tuple[Room, ...]
    zones: tuple[Zone, ...]
    doorway: Rect | None = None

    @property
    def rect(self) -> Rect:
        rects = np.array([room.rect for room in self.rooms])
        low, high = rects.min(axis=0), rects.max(axis=0)
        return float(low[0]), float(high[1]), float(low[2]), float(high[3])

    def hole(self, wall: Wall) -> tuple[float, float] | None:
        """The span along a wall that is open because of the doorway."""
        if self.doorway is None:
            return None
        x0, x1, y0, y1 = self.doorway
        corners = [wall.position(np.array(p)) for p in ((x0, y0), (x1, y1))]
        offs = sorted(off for _, off in corners)
        (a, b) = sorted(along for along, _ in corners)
        is_behind = offs[0] > -PARTITION_M - 1e-6 and offs[1] < 1e-6 and a > 0 and b < wall.length
        return (a, b) if is_behind else None


def _rectangle(x0: float, x1: float, y0: float, y1: float) -> Float64Array:
    return np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0]])


def _split(rng: np.random.Generator, kinds: Sequence[str], rect: Rect) -> tuple[Zone, ...]:
    """One zone, or two side by side along the longer direction."""
    if len(kinds) == 1:
        return (Zone(0, kinds[0], rect),)
    x0, x1, y0, y1 = rect
    share = float(rng.uniform(0.48, 0.58))
    if x1 - x0 > y1 - y0:
        cut = x0 + share * (x1 - x0)
        return Zone(0, kinds[0], (x0, cut, y0, y1)), Zone(0, kinds[1], (cut, x1, y0, y1))
    cut = y0 + share * (y1 - y0)
    return Zone(0, kinds[0], (x0, x1, y0, cut)), Zone(0, kinds[1], (x0, x1, cut, y1))


def _choice(rng: np.random.Generator, options: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    return options[int(rng.integers(len(options)))]


def _one_room(name: str, width: tuple[float, float], depth: tuple[float, float], *kinds: tuple[str, ...]) -> Draw:
    def draw(rng: np.random.Generator) -> Layout:
        w, d = float(rng.uniform(*width)), float(rng.uniform(*depth))
        uses = _choice(rng, kinds)
        room = Room(_rectangle(0, w, 0, d), uses, float(rng.uniform(2.45, 2.8)))
        return Layout(name, (room,), _split(rng, uses, room.rect))

    return draw


def _l_shaped(rng: np.random.Generator) -> Layout:
    """A main part with a wing; the notch is at the upper right."""
    w, d = float(rng.uniform(6.4, 7.8)), float(rng.uniform(5.6, 6.8))
    nx, ny = w - float(rng.uniform(2.5, 3.4)), d - float(rng.uniform(2.4, 3.2))
    kinds = (("living", "dining"), ("living", "kitchen"), ("dining", "kitchen"), ("bedroom", "office"),
             ("living", "office"), ("hobby", "bedroom"), ("children", "office"), ("living", "bedroom"))  # fmt: skip
    main, wing = _choice(rng, kinds)
    corners = np.array([[0, 0], [0, d], [nx, d], [nx, ny], [w, ny], [w, 0]])
    room = Room(corners, (main, wing), float(rng.uniform(2.45, 2.8)))
    return Layout("l_shaped", (room,), (Zone(0, main, (0, nx, 0, d)), Zone(0, wing, (nx, w, 0, ny))))


def _two_rooms(rng: np.random.Generator) -> Layout:
    """Two rooms with a partition and an open door between them."""
    firsts = (("living",), ("kitchen",), ("office",), ("hobby",), ("dining",), ("bedroom",))
    seconds = (("bedroom",), ("bathroom",), ("office",), ("children",), ("kitchen",), ("bathroom",), ("dining",))
    first, second = _choice(rng, firsts), _choice(rng, seconds)
    while first == second:
        second = _choice(rng, seconds)
    w, d = float(rng.uniform(4.6, 5.8)), float(rng.uniform(4.4, 5.6))
    is_bath = second == ("bathroom",)
    w2, d2 = (float(rng.uniform(*span)) for span in (((2.4, 3.0), (2.8, 3.6)) if is_bath else ((3.4, 4.2), (3.7, 4.6))))
    low = float(rng.uniform(0, d - d2)) if d2 < d else 0.0
    opening, height = float(rng.uniform(0.8, 0.9)), float(rng.uniform(2.45, 2.75))
    at = float(rng.uniform(low + 0.25, min(d, low + d2) - opening - 0.25))
    x = w + PARTITION_M
    rooms = (Room(_rectangle(0, w, 0, d), first, height), Room(_rectangle(x, x + w2, low, low + d2), second, height))
    zones = tuple(Zone(k, room.kinds[0], room.rect) for k, room in enumerate(rooms))
    return Layout("two_rooms", rooms, zones, (w, x, at, at + opening))


def _attic(rng: np.random.Generator) -> Layout:
    """One room under a roof: the ceiling falls along a long wall."""
    draw = _one_room("attic", (6.0, 7.4), (4.8, 6.0), ("studio",), ("bedroom", "office"), ("hobby", "bedroom"),
                     ("children", "hobby"), ("living", "office"))  # fmt: skip
    plan = draw(rng)
    (room,) = plan.rooms
    slope = Slope(0.0, 1.0, 0.0, float(rng.uniform(1.1, 1.5)), float(rng.uniform(1.4, 2.0)))
    return replace(plan, rooms=(replace(room, height=float(rng.uniform(2.55, 2.9)), slope=slope),))


Draw = Callable[[np.random.Generator], Layout]
LAYOUTS: dict[str, Draw] = {
    "rectangular": _one_room(
        "rectangular", (5.8, 7.2), (4.6, 5.8), ("living",), ("living", "dining"), ("bedroom", "office"),
        ("living", "office"), ("office", "hobby"), ("children", "hobby"), ("dining", "living"), ("bedroom", "hobby"),
    ),
    "l_shaped": _l_shaped,
    "two_rooms": _two_rooms,
    "studio": _one_room("studio", (6.4, 7.8), (5.0, 6.0), ("studio",), ("studio", "kitchen")),
    "attic": _attic,
    "island": _one_room("island", (6.6, 8.0), (4.8, 5.8), ("island", "dining"), ("island", "living")),
}  # fmt: skip


def draw_layout(rng: np.random.Generator, name: str) -> Layout:
    """A floor plan of 25 to 60 square metres, seen from any side."""
    layout = LAYOUTS[name](rng)
    return _swapped(layout) if rng.random() < 0.5 else layout


def _swapped(layout: Layout) -> Layout:
    """The mirror image in which x and y change places."""

    def rect(r: Rect) -> Rect:
        return r[2], r[3], r[0], r[1]

    def room(old: Room) -> Room:
        s = old.slope
        return replace(old, corners=old.corners[::-1, ::-1].copy(), slope=s and replace(s, nx=s.ny, ny=s.nx))

    zones = tuple(replace(zone, rect=rect(zone.rect)) for zone in layout.zones)
    return Layout(layout.name, tuple(room(r) for r in layout.rooms), zones, layout.doorway and rect(layout.doorway))
