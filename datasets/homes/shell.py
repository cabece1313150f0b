"""The bare home: floors, ceilings and walls, each an object of its own; doors, windows, radiators; sun and sky."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.homes.groups import resized
from su3d_bench.datasets.homes.layout import DOOR_HEIGHT_M, PARTITION_M, Rect, Room, Wall
from su3d_bench.datasets.homes.plan import GAP_M, HomePlan, Span, upright
from su3d_bench.datasets.homes.solids import Solids
from su3d_bench.datasets.procedural.items import Item, Part
from su3d_bench.datasets.procedural.materials import Material, Rgb, Texture, mix, shade, tone
from su3d_bench.datasets.procedural.rendering.light import Sun, Window
from su3d_bench.datasets.procedural.shapes import Shape, block, box, join

New = Callable[..., Item | None]
SKIRTING = (0.012, 0.08)  # thickness and height, m
CASING_M = 0.06  # width of the boards around a doorway
WALL_COLOURS = ("white", "white", "beige", "grey", "yellow", "green", "blue", "pink")
SKY, NIGHT_SKY = (0.75, 0.83, 0.94), (0.02, 0.025, 0.04)
LINTEL_M = 2.3  # highest top of a window: the rod of a curtain fits under the ceiling
SUNLIGHT = 4.0  # times the sky's: 100 klx of direct sun to 25 klx of blue sky, at noon


def add_shell(plan: HomePlan, covers: list[str]) -> None:
    """Floors (of ``covers``: wooden, tiles, carpet), ceilings and walls."""
    rng = plan.rng
    for room, cover in zip(plan.layout.rooms, covers, strict=True):
        _add_floor(plan, room, cover)
        _add_ceiling(plan, room)
        colour = str(rng.choice(WALL_COLOURS[:4] if plan.muted else WALL_COLOURS))
        rgb = mix(tone(colour, rng), tone("white"), 0.0 if colour in ("white", "grey") else 0.55)
        style = 2 if "bathroom" in room.kinds else int(rng.choice([0, 0, 1, 3]))
        accent = int(rng.integers(0, len(room.walls))) if style != 2 and rng.random() < 0.4 else -1
        for k, wall in enumerate(room.walls):
            base = shade(rgb, 0.8) if k == accent else rgb
            paint = Material(
                Texture.WALL, base, shade(base, 0.82), plan.uniform(0.12, 0.3), 0.3 if style == 2 else 0.02,
                axis=0 if k == accent else style, seed=int(rng.integers(1, 999)),
            )  # fmt: skip
            _add_wall(plan, room, wall, paint, colour)
    plan.n_structure = len(plan.placed)


def _add(
    plan: HomePlan, name: str, colour: str, made_of: str, parts: tuple[Part, ...], position: Float64Array, yaw: float
) -> None:
    corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in parts])
    size = corners.max(axis=0) - corners.min(axis=0)
    plan.add(Item(name, colour, made_of, "medium", parts, (), size), position, yaw, "room")


def _flat(quads: list[list[tuple[float, float, float]]], normal: tuple[float, float, float]) -> Shape:
    corners = np.array(quads, np.float64)
    return Shape(corners, np.broadcast_to(np.array(normal), corners.shape).copy())


def _level(rect: Rect) -> list[tuple[float, float]]:
    x0, x1, y0, y1 = rect
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def _add_floor(plan: HomePlan, room: Room, cover: str) -> None:
    rng = plan.rng
    colours = {"wooden": ["brown", "beige", "beige", "grey"], "tiles": ["beige", "grey", "white"],
               "carpet": ["grey", "beige", "blue", "green"]}[cover]  # fmt: skip
    colour = str(rng.choice(colours[:2] if plan.muted else colours))
    base = mix(tone(colour, rng), tone("grey"), 0.55 if cover == "carpet" else 0.0)  # carpets are dull
    seed = int(rng.integers(1, 999))
    material = {
        "wooden": Material(Texture.PLANKS, base, shade(base, 0.55), 0.035, 0.15, seed=seed),
        "tiles": Material(Texture.TILES, base, shade(base, 0.6), plan.uniform(0.28, 0.42), 0.25, seed=seed),
        "carpet": Material(Texture.CARPET, base, shade(base, 0.75), 0.02, 0.0, seed=seed),
    }[cover]
    rects = room.tiles()[0]
    if plan.layout.doorway is not None and room is plan.layout.rooms[0]:
        rects = [*rects, plan.layout.doorway]
    shape = _flat([[(x, y, 0.0) for x, y in _level(rect)] for rect in rects], (0.0, 0.0, 1.0))
    made_of = {"wooden": "wooden", "tiles": "stone", "carpet": "fabric"}[cover]
    _add(plan, "floor", colour, made_of, (Part(shape, material),), np.zeros(3), 0.0)


def _add_ceiling(plan: HomePlan, room: Room) -> None:
    """The level part and, as an object of its own, the sloped part."""
    white = Material(Texture.PLAIN, tone("white"), shade(tone("white"), 0.95))
    level: list[list[tuple[float, float, float]]] = []
    sloped: list[list[tuple[float, float, float]]] = []
    for rect in room.tiles()[0]:
        points = np.array(_level(rect))
        heights = room.ceiling(points)
        quad = [(float(x), float(y), float(z)) for (x, y), z in zip(points, heights, strict=True)]
        (level if (heights == room.height).all() else sloped).append(quad)
    for quads in (level, sloped):
        if quads:
            a, b, _, d = np.array(quads[0])
            normal = np.cross(d - a, b - a)
            normal /= np.linalg.norm(normal)
            _add(plan, "ceiling", "white", "stone", (Part(_flat(quads, tuple(normal)), white),), np.zeros(3), 0.0)


def _add_wall(plan: HomePlan, room: Room, wall: Wall, paint: Material, colour: str) -> None:
    """A wall with its skirting board; with the inside and the casing of a doorway if there is one."""
    hole = plan.layout.hole(wall)
    stops = {0.0, wall.length, *(hole or ())}
    if room.slope is not None:
        bend = np.array([room.slope.nx, room.slope.ny])
        rise = float(wall.along @ bend)
        if abs(rise) > 0.5:
            stops.add((room.slope.offset + room.slope.run - float(wall.start @ bend)) / rise)
    at = sorted(stops)
    ends = room.ceiling(np.array([wall.point(a, 1e-9) for a in at])).tolist()
    quads, boards = [], []
    for a, b, top_a, top_b in zip(at[:-1], at[1:], ends[:-1], ends[1:], strict=True):
        is_open = hole is not None and a >= hole[0] - 1e-9 and b <= hole[1] + 1e-9
        low = DOOR_HEIGHT_M if is_open else 0.0
        quads.append([(a, 0.0, low), (b, 0.0, low), (b, 0.0, top_b), (a, 0.0, top_a)])
        if not is_open:
            inset = [CASING_M if hole and edge in hole else 0.0 for edge in (a, b)]
            boards.append(box(a + inset[0], b - inset[1], -SKIRTING[0], 0.0, 0.0, SKIRTING[1]))
    trim = Material(Texture.PLAIN, tone("white"), shade(tone("white"), 0.9), gloss=0.08)
    if hole:
        a, b = hole
        boards += [box(a - CASING_M, a, -0.015, 0.0, 0.0, DOOR_HEIGHT_M + CASING_M),
                   box(b, b + CASING_M, -0.015, 0.0, 0.0, DOOR_HEIGHT_M + CASING_M),
                   box(a, b, -0.015, 0.0, DOOR_HEIGHT_M, DOOR_HEIGHT_M + CASING_M)]  # fmt: skip
        if room is plan.layout.rooms[0]:
            deep, top = PARTITION_M, DOOR_HEIGHT_M
            boards += [
                _flat([[(a, 0, 0), (a, deep, 0), (a, deep, top), (a, 0, top)]], (1.0, 0.0, 0.0)),
                _flat([[(b, 0, 0), (b, deep, 0), (b, deep, top), (b, 0, top)]], (-1.0, 0.0, 0.0)),
                _flat([[(a, 0, top), (b, 0, top), (b, deep, top), (a, deep, top)]], (0.0, 0.0, -1.0)),
            ]
    parts = (Part(_flat(quads, (0.0, -1.0, 0.0)), paint), Part(join(boards), trim))
    _add(plan, "wall", colour, "stone", parts, np.append(wall.start, 0.0), wall.yaw)


def add_openings(plan: HomePlan, new: New) -> bool:
    """The entrance, the door between the rooms, and windows with what belongs to them; whether all found a place."""
    rooms = plan.layout.rooms
    if not (_add_inner_door(plan) and _add_entrance(plan, new)):
        return False
    for room in rooms:
        n = 1 if len(rooms) > 1 else 2 + int(plan.rng.random() < 0.3)
        walls = [w for w in room.walls if plan.layout.hole(w) is None and w.length > 1.9]
        before = len(plan.windows)
        for k in plan.rng.permutation(len(walls)):
            n -= bool(n > 0 and _add_window(plan, walls[int(k)], new))
        if len(plan.windows) == before:
            return False
    _add_sun(plan)
    return True


def _add_entrance(plan: HomePlan, new: New) -> bool:
    walls = [w for w in plan.layout.rooms[0].walls if plan.layout.hole(w) is None and w.length > 1.6]
    for k in plan.rng.permutation(len(walls)):
        wall, door = walls[int(k)], new("door")
        assert door is not None
        half, deep = door.size[0] / 2, float(door.size[1])  # deep if it is ajar
        along = 0.2 + half if plan.rng.random() < 0.5 else wall.length - 0.2 - half
        plan.doors.append(wall.point(along, deep + 0.35))
        if plan.hang(door, Span(wall, 0.0, wall.length), along, GAP_M):
            plan.keep_free.append(_before(wall, along, half + 0.05, deep + 0.8))
            side = 1.0 if along < wall.length / 2 else -1.0
            plan.hang(new("switch"), Span(wall, 0.0, wall.length), along + side * (half + 0.2), 1.05)
            return True
        plan.doors.pop()
    return False


def _add_inner_door(plan: HomePlan) -> bool:
    """A door leaf ajar, hinged at the second room's side of the doorway."""
    if plan.layout.doorway is None:
        return True
    for room in plan.layout.rooms:
        wall, hole = next((w, h) for w in room.walls if (h := plan.layout.hole(w)) is not None)
        plan.keep_free.append(_before(wall, sum(hole) / 2, (hole[1] - hole[0]) / 2 + 0.05, 0.8))
        plan.doors.append(wall.point(sum(hole) / 2, 0.35))
    width, height = hole[1] - hole[0] - 0.02, DOOR_HEIGHT_M - 0.02
    colour = str(plan.rng.choice(["white", "white", "brown", "beige", "grey"]))
    paint = Material(Texture.PLAIN, tone(colour), shade(tone(colour), 0.9), gloss=0.1)
    steel = Material(Texture.BRUSHED, tone("grey"), shade(tone("grey"), 0.7), 0.01, 0.7)
    panels = [block(width - 0.24, 0.052, h, z=z) for z, h in ((0.15, 0.7), (1.05, 0.8))]
    handles = [block(0.12, 0.03, 0.02, width / 2 - 0.1, side * 0.045, 0.98) for side in (-1, 1)]
    parts = (Part(join([block(width, 0.04, height), *panels]), paint), Part(join(handles), steel))
    leaf = Item("door", colour, "wooden", "medium", parts, (), np.array([width, 0.12, height]))
    hinges = [(hole[0], 1.0), (hole[1], -1.0)]
    if plan.rng.random() < 0.5:
        hinges.reverse()
    for opened, (hinge, sign) in product((plan.uniform(75, 110), 90.0, 80.0), hinges):
        angle = np.deg2rad(opened)
        at = wall.point(hinge + sign * np.cos(angle) * width / 2, np.sin(angle) * width / 2 + 0.05)
        if plan.put(leaf, at, wall.yaw - sign * opened, GAP_M, "wall"):
            return True
    return False


def _before(wall: Wall, along: float, half: float, reach: float, z0: float = 0.0, z1: float = 2.0) -> Solids:
    (ax, ay), (bx, by) = wall.point(along - half, 0.0), wall.point(along + half, reach)
    return upright((min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)), z0, z1)


def _add_window(plan: HomePlan, wall: Wall, new: New) -> bool:
    item = new("window")
    assert item is not None
    margin = item.size[0] / 2 + 0.5
    if wall.length < 2 * margin:
        return False
    along, sill = plan.uniform(margin, wall.length - margin), plan.uniform(0.86, 1.0)
    sill = min(sill, LINTEL_M - float(item.size[2]))
    span = Span(wall, 0.0, wall.length)
    placed = plan.hang(item, span, along, sill)
    if placed is None:
        return False
    width, height = item.size[0] / 2 - 0.05, item.size[2] / 2 - 0.05
    x, y = wall.point(along, 0.0).tolist()
    sky = shade(NIGHT_SKY if plan.is_evening else SKY, plan.uniform(0.8, 1.2))
    u = (float(wall.along[0] * width), float(wall.along[1] * width), 0.0)
    plan.windows.append(Window((x, y, sill + float(item.size[2]) / 2), u, (0.0, 0.0, float(height)), sky))
    plan.keep_free.append(_before(wall, along, item.size[0] / 2, 0.45, sill + 0.05, 2.3))
    plan.hang(new("radiator"), span, along, 0.12)
    top, cover = sill + float(item.size[2]), plan.rng.random()
    if cover < 0.6 and (curtain := new("curtain")) is not None:
        z = max(GAP_M, top + 0.1 - float(curtain.size[2]))
        for side in (-1, 1):  # the same panel on both sides
            plan.hang(curtain, span, along + side * float(item.size[0] + curtain.size[0] + 0.02) / 2, z)
    elif cover < 0.8 and (blind := new("blinds")) is not None:
        blind = resized(blind, x=float(item.size[0] / blind.size[0]), z=min(1.0, float(item.size[2] / blind.size[2])))
        plan.hang(blind, span, along, top - float(blind.size[2]), float(item.size[1]) + GAP_M)
    return True


def _add_sun(plan: HomePlan) -> None:
    """By day the sun shines into one of the windows, from 25 to 50 degrees above the horizon."""
    if plan.is_evening or not plan.windows:
        return
    window = plan.windows[int(plan.rng.integers(len(plan.windows)))]
    along = np.array(window.u) / np.linalg.norm(window.u)
    outward = np.array([-along[1], along[0], 0.0])  # walls have the room to the right of u
    height, turn = np.deg2rad(plan.uniform(25, 50)), np.deg2rad(plan.uniform(-40, 40))
    level = np.cos(turn) * outward + np.sin(turn) * along
    x, y, z = np.cos(height) * level + np.array([0.0, 0.0, np.sin(height)])
    warm = mix((1.0, 0.96, 0.9), (1.0, 0.82, 0.62), float(np.interp(np.rad2deg(height), [25, 50], [1, 0])))
    colour: Rgb = (SUNLIGHT * warm[0], SUNLIGHT * warm[1], SUNLIGHT * warm[2])
    plan.sun = Sun((float(x), float(y), float(z)), colour)
