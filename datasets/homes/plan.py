"""A home being furnished: every object is placed where it fits, rests on something and leaves the floor passable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.homes.floor import FloorGrid
from su3d_bench.datasets.homes.layout import Layout, Wall, Zone
from su3d_bench.datasets.homes.solids import Solids, overlap, pieces_of
from su3d_bench.datasets.procedural.items import Box, Item, Light, Placed, Spot, box_of
from su3d_bench.datasets.procedural.rendering.light import Sun, Window
from su3d_bench.datasets.procedural.shapes import rotation

GAP_M = 0.002  # between touching faces, against z-fighting
TOUCH_M = 0.001  # deeper overlaps are collisions: below the gap
BACK_M = 0.018  # of furniture from its wall: the thickness of a skirting board
FLAT_M = 0.03  # lower things on the floor are rugs and mats, on which others may stand
LOW_M = 0.65  # furniture below this height hides what is under it from a standing person
PERSON_M = 0.25  # radius of the disc that can reach all free floor: half the width of a person's shoulders
POCKET_M2 = 0.05  # free regions up to this area are gaps between furniture, not floor: a quarter of the disc
NEAR_WALL = 0.8  # share of things on the floor that are near a wall: people keep the middle free
TRIES = 12  # random positions tried on a spot or along a wall


@dataclass(frozen=True)
class Span:
    """A stretch of a wall, from ``a`` to ``b`` along it."""

    wall: Wall
    a: float
    b: float


@dataclass
class HomePlan:
    """A home; placing methods return ``None`` if there is no space."""

    rng: np.random.Generator
    layout: Layout
    muted: bool = False
    is_evening: bool = False
    placed: list[Placed] = field(default_factory=list)
    boxes: dict[int, Box] = field(default_factory=dict)  # of all but the parts of the home itself
    parent: dict[int, tuple[int, str]] = field(default_factory=dict)  # the holder of an object, and how: on, in
    mount: dict[int, str] = field(default_factory=dict)
    lights: list[Light] = field(default_factory=list)
    windows: list[Window] = field(default_factory=list)
    sun: Sun | None = None
    n_structure: int = 0
    keep_free: list[Solids] = field(default_factory=list)  # where nothing may stand on the floor
    doors: list[Float64Array] = field(default_factory=list)  # points on the floor in front of the doors
    solids: dict[int, Solids] = field(default_factory=dict)
    _pieces: dict[int, tuple[Item, Float64Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._grid = FloorGrid(self.layout, 0.05, PERSON_M)
        self._low, self._high = np.empty((0, 3)), np.empty((0, 3))  # of the boxes, in the order of their ids
        self._ids: list[int] = []
        self._notches = [upright(rect) for room in self.layout.rooms for rect in room.tiles()[1]]

    @property
    def kind(self) -> str:
        return self.layout.name

    @property
    def n_objects(self) -> int:
        """Objects besides walls, floors and ceilings."""
        return len(self.placed) - self.n_structure

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def free(self, cell_m: float = 0.1, clearance_m: float = 0.3) -> tuple[BoolArray, Float64Array]:
        """Cells (X, Y) of the largest region where a camera may be, and the corner (2,) of cell (0, 0)."""
        grid = FloorGrid(self.layout, cell_m, clearance_m)
        for solids in self.solids.values():
            grid.mark(solids)
        grid.taken[grid.low_ceiling] += 1
        return grid.main_region(), grid.origin

    def add(self, item: Item, position: Float64Array, yaw: float, mount: str) -> Placed:
        placed = Placed(len(self.placed) + 1, item, yaw, position)
        self.placed.append(placed)
        self.mount[placed.id] = mount
        if mount != "room":
            self.boxes[placed.id] = box_of(placed)
            self.solids[placed.id] = Solids.of(self.pieces(item), yaw, position)
            self._ids.append(placed.id)
            self._low = np.concatenate([self._low, self.boxes[placed.id].low[None]])
            self._high = np.concatenate([self._high, self.boxes[placed.id].high[None]])
        return placed

    def back_to(self, n: int) -> None:
        """Remove what was placed after the first ``n`` objects."""
        while len(self.placed) > n:
            gone = self.placed.pop().id
            self._grid.mark(self.solids.pop(gone), -1)
            del self.boxes[gone], self.mount[gone]
            self.parent.pop(gone, None)
            self._ids.pop()
            self._low, self._high = self._low[:-1], self._high[:-1]

    def pieces(self, item: Item) -> Float64Array:
        if id(item) not in self._pieces:
            self._pieces[id(item)] = item, pieces_of(item)  # the item is kept, so its id is not used again
        return self._pieces[id(item)][1]

    def put(
        self, item: Item, xy: Float64Array, yaw: float, z: float | None = None, mount: str = "floor",
        holder: Placed | None = None, relation: str = "on", gap: float = 0.0,
    ) -> Placed | None:  # fmt: skip
        """Places the item where it fits; ``z`` None puts it on the floor or the rug there."""
        position = np.array([xy[0], xy[1], GAP_M if z is None else z])
        solids = Solids.of(self.pieces(item), yaw, position)
        if z is None:
            lift = self._rug_below(solids)
            position[2] += lift
            solids.z[...] += lift
        if not self._in_room(xy, solids) or self._hits(solids, holder, relation, position, gap):
            return None
        if mount == "floor" and item.size[2] > FLAT_M:
            if self._is_hidden(position):
                return None
            if any(overlap(solids, free, TOUCH_M).any() for free in self.keep_free):
                return None
        if mount != "object":
            self._grid.mark(solids)
            if not self.is_passable():
                self._grid.mark(solids, -1)
                return None
        placed = self.add(item, position, yaw, mount)
        if mount == "object":
            self._grid.mark(solids)
        if holder is not None:
            self.parent[placed.id] = holder.id, relation
        return placed

    def is_passable(self) -> bool:
        """Whether the free floor is one region that reaches the doors."""
        labels, areas = self._grid.regions()
        large = [k for k, area in enumerate(areas, 1) if area > POCKET_M2]
        return len(large) == 1 and all(labels[self._grid.at(door)] == large[0] for door in self.doors)

    def _rug_below(self, solids: Solids) -> float:
        lift = 0.0
        for other, mount in self.mount.items():
            is_flat = mount == "floor" and self.placed[other - 1].item.size[2] <= FLAT_M
            if is_flat and overlap(solids, self.solids[other], TOUCH_M - GAP_M).any():
                lift = max(lift, float(self.boxes[other].high[2]))
        return lift

    def _is_hidden(self, position: Float64Array) -> bool:
        """Whether a place on the floor is under a bed, a sofa or something as low."""
        over = (self._low[:, :2] < position[:2]).all(axis=1) & (self._high[:, :2] > position[:2]).all(axis=1)
        return bool((over & (self._high[:, 2] > FLAT_M + position[2]) & (self._high[:, 2] < LOW_M)).any())

    def _in_room(self, xy: Float64Array, solids: Solids) -> bool:
        for room in self.layout.rooms:
            x0, x1, y0, y1 = room.rect
            if x0 < xy[0] < x1 and y0 < xy[1] < y1:
                break
        else:
            return False
        corners = solids.corners
        if (corners < (x0, y0)).any() or (corners > (x1, y1)).any() or (solids.z[:, 0] < 0).any():
            return False
        if solids.z.max() > room.height or (room.slope and (room.ceiling(corners) < solids.z[:, 1:]).any()):
            return False
        return not any(overlap(solids, notch, TOUCH_M).any() for notch in self._notches)

    def _hits(self, solids: Solids, holder: Placed | None, relation: str, position: Float64Array, gap: float) -> bool:
        low = np.append((solids.centre - solids.reach).min(axis=0) - gap, solids.z.min())
        high = np.append((solids.centre + solids.reach).max(axis=0) + gap, solids.z.max())
        chain = self.holders(holder)
        near = ((low < self._high) & (self._low < high)).all(axis=1)
        for k in np.flatnonzero(near):
            other = self._ids[k]
            if other not in chain:
                if overlap(solids, self.solids[other], TOUCH_M, gap).any():
                    return True
            elif relation != "in":
                held_by = self.solids[other]
                if overlap(solids, held_by.chosen(~_around(held_by, position)), TOUCH_M).any():
                    return True
        return False

    def holders(self, placed: Placed | None) -> list[int]:
        chain = [] if placed is None else [placed.id]
        while chain and chain[-1] in self.parent:
            chain.append(self.parent[chain[-1]][0])
        return chain

    def spans(self, zone: Zone) -> list[Span]:
        """The stretches of walls beside a zone, without the doorway."""
        x0, x1, y0, y1 = zone.rect
        spans = []
        for wall in self.layout.rooms[zone.room].walls:
            ends = np.stack([wall.start, wall.start + wall.length * wall.along])
            clipped = ends.clip((x0, y0), (x1, y1))
            if np.abs((clipped - ends) @ wall.normal).max() > 1e-6:
                continue
            a, b = (wall.position(end)[0] for end in clipped)
            hole = self.layout.hole(wall) or (a, a)
            spans += [Span(wall, s, e) for s, e in ((a, min(b, hole[0])), (max(a, hole[1]), b)) if e - s > 0.05]
        return spans

    def against_wall(self, item: Item, zone: Zone, gap: float = 0.0, corner: bool = False) -> Placed | None:
        """Back to a wall, at a random position along it (or in a corner)."""
        half = item.size[0] / 2
        spans = [span for span in self.spans(zone) if span.b - span.a > 2 * half + 0.02]
        for _ in range(TRIES if spans else 0):
            span = spans[int(self.rng.integers(len(spans)))]
            low, high = span.a + half + BACK_M, span.b - half - BACK_M
            along = (low if self.rng.random() < 0.5 else high) if corner else self.uniform(low, max(low, high))
            off = item.size[1] / 2 + BACK_M
            places = (span.wall.point(along, off + more) for more in (0.0, 0.12))  # or in front of a radiator
            if placed := first(self.put(item, at, span.wall.yaw, gap=gap) for at in places):
                return placed
        return None

    def hang(
        self, item: Item | None, span: Span, along: float, z: float, off: float = 0.0, gap: float = 0.0
    ) -> Placed | None:
        """Fixed to a wall with its lower edge at height ``z``."""
        if item is None or not span.a + item.size[0] / 2 < along < span.b - item.size[0] / 2:
            return None
        at = span.wall.point(along, item.size[1] / 2 + GAP_M + off)
        return self.put(item, at, span.wall.yaw, z, "wall", gap=gap)

    def hang_somewhere(self, item: Item, zone: Zone, z: float) -> Placed | None:
        half = item.size[0] / 2 + 0.02
        spans = [span for span in self.spans(zone) if span.b - span.a > 2 * half]
        drawn = (spans[int(self.rng.integers(len(spans)))] for _ in range(TRIES if spans else 0))
        return first(self.hang(item, s, self.uniform(s.a + half, s.b - half), z, gap=0.02) for s in drawn)

    def somewhere(
        self, item: Item, zone: Zone, is_middle: bool = False, yaw: float | None = None, gap: float = 0.0
    ) -> Placed | None:
        """On the floor of a zone: in its middle, or anywhere but mostly not far from a wall."""
        inset = 0.3 if is_middle else 0.04
        one, other = np.array(zone.rect).reshape(2, 2).T
        low, high = one + inset * (other - one), other - inset * (other - one)
        spans = self.spans(zone)
        for _ in range(TRIES):
            at, turn = self.rng.uniform(low, high), self.uniform(-180, 180)
            if not is_middle and (item.size[2] > LOW_M or self.rng.random() < NEAR_WALL):
                span = spans[int(self.rng.integers(len(spans)))]
                off = float(item.size[:2].max()) / 2 + BACK_M + self.uniform(0.0, 0.3)
                at, turn = span.wall.point(self.uniform(span.a, span.b), off), span.wall.yaw + self.uniform(-25, 25)
            if placed := self.put(item, at, turn if yaw is None else yaw, gap=gap):
                return placed
        return None

    def by(self, item: Item, anchor: Placed, x: float, y: float, turn: float, gap: float = 0.0) -> Placed | None:
        """On the floor at (x, y) relative to the anchor."""
        at = anchor.to_world(np.array([x, y, 0.0]))[:2]
        return self.put(item, at, anchor.yaw + turn, gap=gap)

    def on_spot(
        self, item: Item, anchor: Placed, spot: Spot, where: str = "any", turn: float = 8.0, gap: float = 0.01
    ) -> Placed | None:
        """On (or in) a spot of an object; ``where``: any, centre, back, front, left, right."""
        if spot.clearance < item.size[2] + GAP_M:
            return None
        for _ in range(1 if where == "centre" else TRIES):
            yaw = self.uniform(-turn, turn)
            local = self._within(item, spot, where, yaw)
            if local is None:
                return None
            x, y, z = anchor.to_world(np.array([*local, spot.z]))
            relation = "in" if spot.role == "inside" else "on"
            at = np.array([x, y])
            if placed := self.put(item, at, anchor.yaw + yaw, z + GAP_M, "object", anchor, relation, gap):
                return placed
        return None

    def on_top(self, item: Item, below: Placed, turn: float = 8.0) -> Placed | None:
        """Stacked on an object of the same kind."""
        x, y, z = below.position
        yaw = below.yaw + self.uniform(-turn, turn)
        return self.put(item, np.array([x, y]), yaw, z + below.item.size[2] + GAP_M, "object", below)

    def _within(self, item: Item, spot: Spot, where: str, yaw: float) -> tuple[float, float] | None:
        """A position at which the item's contact area lies in the spot."""
        (x0, y0), (x1, y1) = item.foot
        feet = np.array([[x0, y0, 0], [x0, y1, 0], [x1, y0, 0], [x1, y1, 0]]) @ rotation("z", yaw).T
        low = spot.x0 - feet[:, 0].min(), spot.y0 - feet[:, 1].min()
        high = spot.x1 - feet[:, 0].max(), spot.y1 - feet[:, 1].max()
        if low[0] > high[0] + 1e-9 or low[1] > high[1] + 1e-9:
            return None
        x, y = self.uniform(low[0], max(low[0], high[0])), self.uniform(low[1], max(low[1], high[1]))
        if where == "centre":
            return (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
        if where in ("back", "front"):
            return x, high[1] if where == "back" else low[1]
        if where in ("left", "right"):
            return low[0] if where == "left" else high[0], y
        return x, y


def first(places: Iterable[Placed | None]) -> Placed | None:
    """The first place that was free."""
    return next(filter(None, places), None)


def upright(rect: Sequence[float], z0: float = 0.0, z1: float = 10.0) -> Solids:
    x0, x1, y0, y1 = rect
    half = np.array([[x1 - x0, y1 - y0]]) / 2
    return Solids(np.array([[x0 + x1, y0 + y1]]) / 2, half, np.zeros(1), np.array([[z0, z1]]))


def _around(solids: Solids, point: Float64Array) -> BoolArray:
    """Which boxes contain a point: pieces that are hollow where it is."""
    away = point[:2] - solids.centre
    cos, sin = np.cos(solids.yaw), np.sin(solids.yaw)
    u, v = away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin
    inside = (np.abs(u) < solids.half[:, 0]) & (np.abs(v) < solids.half[:, 1])
    return np.asarray(inside & (solids.z[:, 0] < point[2]) & (solids.z[:, 1] > point[2] + TOUCH_M))
