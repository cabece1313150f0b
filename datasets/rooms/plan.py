"""Layout of a room: a plan that prevents collisions, and ways to place an item in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.items import Box, Item, Light, Part, Placed, Spot, box_of
from su3d_bench.datasets.procedural.materials import Material, Texture, mix, shade, tone
from su3d_bench.datasets.procedural.shapes import Shape, rotation
from su3d_bench.datasets.rooms.objects.catalog import make

GAP_M = 0.002  # between touching faces, against z-fighting
WALL_YAW = (0.0, -90.0, 180.0, 90.0)  # of an item with its back to the wall at y = depth, x = width, y = 0, x = 0
FLAT = frozenset(("rug", "mat"))
Value = TypeVar("Value")


class Plan:
    """A room being furnished; every placing method returns ``None`` if there is no space."""

    def __init__(self, rng: np.random.Generator, width: float, depth: float, height: float) -> None:
        self.rng = rng
        self.width, self.depth, self.height = width, depth, height
        self.placed: list[Placed] = []
        self.boxes: dict[int, Box] = {}
        self.parent: dict[int, tuple[int, str]] = {}  # the holder of an item, and how: on, in
        self.rests_also_on: list[tuple[int, int]] = []  # for a slab on several holders
        self.mount: dict[int, str] = {}
        self.keep_free: list[Box] = []
        self.lights: list[Light] = []
        self._used: dict[str, set[str]] = {}

    def new(self, want: str, colour: str | None = None) -> Item:
        """An item of a class (or class/model), in a colour that the class does not have yet in this room."""
        class_name, _, model = want.partition("/")
        used = self._used.setdefault(class_name, set())
        item = make(class_name, self.rng, model or None, colour, frozenset(used))
        used.add(item.colour)
        return item

    def shuffled(self, values: Sequence[Value]) -> list[Value]:
        return [values[int(k)] for k in self.rng.permutation(len(values))]

    def wall_length(self, wall: int) -> float:
        return self.width if wall % 2 == 0 else self.depth

    def wall_point(self, wall: int, along: float, off: float) -> tuple[float, float]:
        points = ((along, self.depth - off), (self.width - off, along), (along, off), (off, along))
        return points[wall]

    def add(self, item: Item, x: float, y: float, z: float, yaw: float, mount: str) -> Placed:
        placed = Placed(len(self.placed) + 1, item, yaw, np.array([x, y, z]))
        self.placed.append(placed)
        self.mount[placed.id] = mount
        if mount != "room":
            self.boxes[placed.id] = box_of(placed)
        return placed

    def try_at(
        self, item: Item, x: float, y: float, yaw: float, z: float | None = None, gap: float = 0.0,
        mount: str = "floor", ignore: Sequence[int] = (),
    ) -> Placed | None:  # fmt: skip
        """Places the item where it fits; ``z`` None puts it on the floor or on the rug there."""
        candidate = Placed(0, item, yaw, np.array([x, y, 0.0 if z is None else z]))
        room = box_of(candidate)
        if z is None:
            under = [b for i, b in self.boxes.items() if self._flat(i) and b.overlaps(room)]
            lift = max([GAP_M, *[float(b.high[2]) + GAP_M / 2 for b in under]])
            raised = np.array([0.0, 0.0, lift])
            room = Box(room.low + raised, room.high + raised)
            z = lift
        limits = np.array([self.width, self.depth, self.height])
        if (room.low[:2] < GAP_M / 2).any() or (room.high > limits - GAP_M / 2).any():
            return None
        if mount == "floor" and item.class_name not in FLAT and any(room.overlaps(free) for free in self.keep_free):
            return None
        flat_itself = item.class_name in FLAT
        for other, taken in self.boxes.items():
            if other in ignore or (self._flat(other) and not flat_itself):
                continue
            if room.overlaps(taken, gap):
                return None
        return self.add(item, x, y, z, yaw, mount)

    def try_at_wall(
        self, item: Item, wall: int, along: float, off: float, z: float | None = None, gap: float = 0.0,
        mount: str = "floor", ignore: Sequence[int] = (),
    ) -> Placed | None:  # fmt: skip
        """Back to a wall: its centre ``along`` the wall and ``off`` it."""
        x, y = self.wall_point(wall, along, off)
        return self.try_at(item, x, y, WALL_YAW[wall], z, gap, mount, ignore)

    def try_by(self, item: Item, anchor: Placed, x: float, y: float, yaw: float, gap: float = 0.01) -> Placed | None:
        """On the floor, at a position (x, y) relative to the anchor."""
        world_x, world_y, _ = anchor.to_world(np.array([x, y, 0.0]))
        return self.try_at(item, float(world_x), float(world_y), yaw, None, gap)

    def try_on(
        self, item: Item, holder: Placed, place: Sequence[float] | Float64Array, yaw: float, gap: float,
        relation: str = "on",
    ) -> Placed | None:  # fmt: skip
        """At a world position (x, y, z) on ``holder``, which holds it."""
        x, y, z = (float(value) for value in place)
        placed = self.try_at(item, x, y, yaw, z, gap, "object", ignore=self._chain(holder.id))
        if placed:
            self.parent[placed.id] = (holder.id, relation)
        return placed

    def _flat(self, placed_id: int) -> bool:
        return self.placed[placed_id - 1].item.class_name in FLAT

    def against_wall(
        self, item: Item, walls: Sequence[int] = (0, 1, 2, 3), gap: float = 0.05, corner: bool = False
    ) -> Placed | None:
        """Back to a wall, at a random position along it (or in a corner)."""
        half = item.size[0] / 2
        for wall in self.shuffled(walls) * 14:
            length = self.wall_length(wall)
            if length < 2 * half + 0.02:
                continue
            along = float(self.rng.uniform(half + 0.01, length - half - 0.01))
            if corner:
                along = half + 0.02 if self.rng.random() < 0.5 else length - half - 0.02
            placed = self.try_at_wall(item, wall, along, item.size[1] / 2 + 0.006, None, gap)
            if placed:
                return placed
        return None

    def hang(self, item: Item, wall: int, along: float, z: float, gap: float = 0.03) -> Placed | None:
        """Fixed to a wall with its lower edge at height ``z``."""
        half = item.size[0] / 2
        if not half < along < self.wall_length(wall) - half:
            return None
        return self.try_at_wall(item, wall, along, item.size[1] / 2 + GAP_M, z, gap, mount="wall")

    def hang_somewhere(self, item: Item, z: float, walls: Sequence[int] = (0, 1, 2, 3)) -> Placed | None:
        half = item.size[0] / 2 + 0.05
        places = ((wall, self.rng.uniform(half, self.wall_length(wall) - half)) for wall in self.shuffled(walls) * 10)
        return next(filter(None, (self.hang(item, wall, float(along), z) for wall, along in places)), None)

    def wall_of(self, placed: Placed) -> tuple[int, float]:
        """The wall behind an item, and its position along that wall."""
        wall = WALL_YAW.index(placed.yaw)
        return wall, float(placed.position[0] if wall % 2 == 0 else placed.position[1])

    def hang_above(self, item: Item, anchor: Placed, z: float, shift: float = 0.0) -> Placed | None:
        wall, along = self.wall_of(anchor)
        return self.hang(item, wall, along + shift, z)

    def beside(self, item: Item, anchor: Placed, gap: float = 0.06, back: bool = True) -> Placed | None:
        """To the left or right of an item, backs aligned."""
        y = (anchor.item.size[1] - item.size[1]) / 2 if back else 0.0
        x = anchor.item.size[0] / 2 + gap + item.size[0] / 2
        sides = (self.try_by(item, anchor, side * x, y, anchor.yaw) for side in self.shuffled((-1, 1)))
        return next(filter(None, sides), None)

    def facing(self, item: Item, anchor: Placed, distance: float, shift: float = 0.0, turn: float = 180.0,
               jitter: float = 0.0) -> Placed | None:  # fmt: skip
        """In front of an item; with ``turn`` 180 facing it."""
        depth = item.size[1] if turn % 180 == 0 else item.size[0]
        y = -(anchor.item.size[1] / 2 + distance + depth / 2)
        yaw = anchor.yaw + turn + float(self.rng.uniform(-jitter, jitter))
        return self.try_by(item, anchor, shift, y, yaw)

    def somewhere(self, item: Item, gap: float = 0.1, margin: float = 0.1) -> Placed | None:
        """Anywhere on the floor, preferably near a wall."""
        reach = max(item.size[0], item.size[1]) / 2 + margin
        for _ in range(60):
            wall = int(self.rng.integers(0, 4))
            along = float(self.rng.uniform(reach, max(reach + 0.01, self.wall_length(wall) - reach)))
            x, y = self.wall_point(wall, along, reach + float(self.rng.uniform(0, 0.25)))
            yaw = WALL_YAW[wall] + float(self.rng.uniform(-20, 20))
            placed = self.try_at(item, x, y, yaw, None, gap)
            if placed:
                return placed
        return None

    def on(
        self, item: Item, anchor: Placed, role: str = "top", where: str = "any", turn: float = 8.0, gap: float = 0.015
    ) -> Placed | None:
        """On (or in) one of the anchor's spots; ``where``: any, centre, back, front, left, right."""
        spots = [spot for spot in anchor.item.spots if spot.role == role and spot.clearance >= item.size[2]]
        for spot in self.shuffled(spots) if spots else []:
            for _ in range(24):
                yaw = float(self.rng.uniform(-turn, turn))
                local = self._within(item, spot, where, yaw)
                if local is None:
                    break
                x, y, z = anchor.to_world(np.array([*local, spot.z]))
                relation = "in" if role == "inside" else "on"
                placed = self.try_on(item, anchor, (x, y, z + GAP_M), anchor.yaw + yaw, gap, relation)
                if placed:
                    return placed
        return None

    def _chain(self, placed_id: int) -> list[int]:
        chain = [placed_id]
        while chain[-1] in self.parent:
            chain.append(self.parent[chain[-1]][0])
        return chain

    def _within(self, item: Item, spot: Spot, where: str, yaw: float) -> tuple[float, float] | None:
        """A position at which the item's contact area lies in the spot."""
        (x0, y0), (x1, y1) = item.foot
        feet = np.array([[x0, y0, 0], [x0, y1, 0], [x1, y0, 0], [x1, y1, 0]]) @ rotation("z", yaw).T
        low = spot.x0 - feet[:, 0].min(), spot.y0 - feet[:, 1].min()
        high = spot.x1 - feet[:, 0].max(), spot.y1 - feet[:, 1].max()
        if low[0] > high[0] + 1e-9 or low[1] > high[1] + 1e-9:
            return None
        x = float(self.rng.uniform(low[0], max(low[0], high[0])))
        y = float(self.rng.uniform(low[1], max(low[1], high[1])))
        if where == "centre":
            return (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
        if where in ("back", "front"):
            return x, high[1] if where == "back" else low[1]
        if where in ("left", "right"):
            return low[0] if where == "left" else high[0], y
        return x, y

    def finish_lights(self) -> None:
        """A light under each hanging lamp (or at the centre of the ceiling if there is none) and above floor lamps."""
        lamps = [p for p in self.placed if p.item.class_name == "lamp"]
        hanging = [p for p in lamps if self.mount[p.id] == "ceiling"]
        for lamp in hanging:
            x, y, z = lamp.position.tolist()
            self.lights.append(Light((x, y, z - 0.14), (1.5, 1.44, 1.32), 0.22))
        if not hanging:
            self.lights.append(Light((self.width / 2, self.depth / 2, self.height - 0.2), (1.5, 1.46, 1.38), 0.35))
        for lamp in [p for p in lamps if p.item.size[2] > 1.2][:1]:
            x, y, z = lamp.position.tolist()
            self.lights.append(Light((x, y, z + float(lamp.item.size[2]) + 0.12), (0.5, 0.42, 0.3), 0.08))


def _rectangle(
    side: tuple[float, float, float], normal: tuple[float, float, float], material: Material, name: str, colour: str,
    made_of: str,
) -> Item:  # fmt: skip
    """A single rectangle along x and ``side`` (which is 0 in y or z), with a corner at the origin."""
    x, y, z = side
    quads = np.array([[[0, 0, 0], [x, 0, 0], [x, y, z], [0, y, z]]], np.float64)
    shape = Shape(quads, np.broadcast_to(np.array(normal), (1, 4, 3)).copy())
    return Item(name, colour, made_of, "medium", (Part(shape, material),), (), np.array(side))


def add_shell(plan: Plan, tiled: bool) -> None:
    """Floor, ceiling and the four walls, each a separate object."""
    rng = plan.rng
    made_of = "stone" if tiled or rng.random() < 0.2 else "wooden"
    colours = ["beige", "grey", "white"] if made_of == "stone" else ["brown", "beige", "beige", "grey"]
    floor_colour = str(rng.choice(colours))
    base = tone(floor_colour, rng)
    seed = int(rng.integers(1, 999))
    if made_of == "stone":
        ground = Material(Texture.TILES, base, shade(base, 0.6), float(rng.uniform(0.28, 0.42)), 0.25, seed=seed)
    else:
        ground = Material(Texture.PLANKS, base, shade(base, 0.55), 0.035, 0.15, seed=seed)
    level = (plan.width, plan.depth, 0.0)
    plan.add(_rectangle(level, (0.0, 0.0, 1.0), ground, "floor", floor_colour, made_of), 0, 0, 0, 0, "room")
    lid = Material(Texture.PLAIN, tone("white"), shade(tone("white"), 0.95))
    plan.add(_rectangle(level, (0.0, 0.0, -1.0), lid, "ceiling", "white", "stone"), 0, 0, plan.height, 0, "room")
    colour = str(rng.choice(["white", "white", "beige", "grey", "yellow", "green", "blue", "pink"]))
    rgb = mix(tone(colour, rng), tone("white"), 0.0 if colour in ("white", "grey") else 0.55)
    style = 2 if tiled else int(rng.choice([0, 0, 1, 3]))
    scale, gloss = float(rng.uniform(0.12, 0.3)), 0.3 if tiled else 0.02
    paint = Material(Texture.WALL, rgb, shade(rgb, 0.8), scale, gloss, 0.0, style, seed=seed)
    accent = Material(Texture.WALL, shade(rgb, 0.8), shade(rgb, 0.66), 0.2, 0.02, 0.0, 0, seed=seed)
    accent_wall = int(rng.integers(0, 4)) if not tiled and rng.random() < 0.4 else -1
    corners = ((0.0, plan.depth), (plan.width, plan.depth), (plan.width, 0.0), (0.0, 0.0))
    for wall in range(4):
        material = accent if wall == accent_wall else paint
        side = (plan.wall_length(wall), 0.0, plan.height)
        face = _rectangle(side, (0.0, -1.0, 0.0), material, "wall", colour, "stone")
        plan.add(face, *corners[wall], 0.0, WALL_YAW[wall], "room")


def add_openings(plan: Plan, n_windows: int, cover: str) -> None:
    """A door, windows with coverings, and the floor in front kept free."""
    rng = plan.rng
    door = plan.new("door")
    wall = int(rng.integers(0, 4))
    length = plan.wall_length(wall)
    along = 0.16 + door.size[0] / 2 if rng.random() < 0.5 else length - 0.16 - door.size[0] / 2
    placed = plan.try_at_wall(door, wall, along, door.size[1] / 2 + GAP_M, GAP_M, mount="wall")
    assert placed is not None
    plan.keep_free.append(_in_front(plan, wall, along, door.size[0] / 2 + 0.05, 0.85, 0.0, 2.0))
    side = 1.0 if along < length / 2 else -1.0
    plan.hang(plan.new("switch"), wall, along + side * (door.size[0] / 2 + 0.22), 1.05)
    for chosen in plan.shuffled([other for other in range(4) if other != wall])[:n_windows]:
        _add_window(plan, chosen, cover)


def _in_front(plan: Plan, wall: int, along: float, half: float, reach: float, z0: float, z1: float) -> Box:
    ax, ay = plan.wall_point(wall, along - half, 0.0)
    bx, by = plan.wall_point(wall, along + half, reach)
    return Box(np.array([min(ax, bx), min(ay, by), z0]), np.array([max(ax, bx), max(ay, by), z1]))


def _add_window(plan: Plan, wall: int, cover: str) -> None:
    window = plan.new("window")
    margin = window.size[0] / 2 + 0.55
    if plan.wall_length(wall) < 2 * margin:
        return
    along = float(plan.rng.uniform(margin, plan.wall_length(wall) - margin))
    sill = float(plan.rng.uniform(0.92, 1.02))
    placed = plan.hang(window, wall, along, sill)
    if placed is None:
        return
    x, y = plan.wall_point(wall, along, 0.35)
    power = float(plan.rng.uniform(0.7, 1.1))
    plan.lights.append(Light((x, y, sill + 0.6), (0.88 * power, 0.97 * power, 1.1 * power), 0.4))
    if cover == "curtain":
        colour = str(plan.rng.choice(["red", "green", "blue", "yellow", "orange", "purple", "pink", "beige", "grey"]))
        panel = plan.new("curtain", colour=colour)
        for side in (-1, 1):
            plan.hang(panel, wall, along + side * (window.size[0] / 2 + panel.size[0] / 2 + 0.06), 0.04, 0.0)
    elif cover == "blinds":
        blind = plan.new("blinds")
        off, z = window.size[1] + 0.012 + blind.size[1] / 2, sill + window.size[2] - blind.size[2] * 0.9
        plan.try_at_wall(blind, wall, along, off, z, mount="wall", ignore=[placed.id])
    plan.keep_free.append(_in_front(plan, wall, along, window.size[0] / 2, 0.5, sill + 0.05, 2.3))
