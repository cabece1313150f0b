"""Where an object goes relative to a zone or to another object: the words that ``recipes.toml`` uses for ``at``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from su3d_bench.datasets.homes.layout import Zone
from su3d_bench.datasets.homes.model_format import Strict
from su3d_bench.datasets.homes.plan import BACK_M, GAP_M, TRIES, HomePlan, first
from su3d_bench.datasets.procedural.items import Item, Part, Placed, Spot
from su3d_bench.datasets.procedural.shapes import rotation

FARTHEST_M = 5.0  # from a sofa to the television on the opposite wall
Range = tuple[float, float]


class Thing(Strict):
    """An object of a recipe and what belongs to it.

    ``put``: classes, one is drawn, or "=" for the very item of the anchor; or ``any``: other things, the first that
    fits. ``at``: a word of ``FREE`` or ``RELATIVE``; ``n``: how many, ``same``: identical ones; ``repeat``: also as the
    filler does. ``gap``: m to the anchor; ``shift``: m to its right; ``turn``: degrees at random; ``air``: m kept free
    around; ``z``: m of the lower edge; ``tall``: m, the height that the object may have. ``needs``: things without
    which it is removed again; ``then``: further things.
    """

    put: tuple[str, ...] = ()
    any: tuple[str, ...] = ()
    at: str = "wall"
    n: tuple[int, int] = (1, 1)
    same: bool = False
    repeat: bool = False
    chance: float = 1.0
    gap: Range = (0.0, 0.0)
    shift: Range = (0.0, 0.0)
    turn: float = 0.0
    air: float = 0.0
    z: Range = (0.0, 0.0)
    tall: Range = (0.0, 5.0)
    role: str = "top"
    where: str = "any"
    needs: tuple[str, ...] = ()
    then: tuple[str, ...] = ()


def resized(item: Item, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Item:
    """The item stretched along its axes, with its spots."""
    parts = tuple(Part(part.shape.stretched(x, y, z), part.material) for part in item.parts)
    spots = tuple(
        replace(s, x0=s.x0 * x, x1=s.x1 * x, y0=s.y0 * y, y1=s.y1 * y, z=s.z * z, clearance=s.clearance * z)
        for s in item.spots
    )
    return replace(item, parts=parts, spots=spots, size=item.size * np.array([x, y, z]))


def _draw(plan: HomePlan, span: Range) -> float:
    return plan.uniform(*span) if span[1] > span[0] else span[0]


def _wall(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    return plan.against_wall(item, zone, thing.air) or plan.against_wall(item, zone)


def _corner(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    return plan.against_wall(item, zone, thing.air, corner=True)


def _angled(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    """Head near a wall or a corner, turned away from it."""
    spans = plan.spans(zone)
    for _ in range(TRIES):
        span = spans[int(plan.rng.integers(len(spans)))]
        turn = plan.uniform(8.0, 45.0) * (1 if plan.rng.random() < 0.5 else -1)
        angle = np.deg2rad(abs(turn))
        w, d = item.size[0] / 2, item.size[1] / 2
        along, off = w * np.cos(angle) + d * np.sin(angle), w * np.sin(angle) + d * np.cos(angle)
        if span.b - span.a < 2 * along + 0.1:
            continue
        at = span.wall.point(plan.uniform(span.a + along + 0.03, span.b - along - 0.03), off + 0.03)
        if placed := plan.put(item, at, span.wall.yaw + turn, gap=thing.air):
            return placed
    return None


def _middle(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    turn = 90.0 * int(plan.rng.integers(4)) + plan.uniform(-thing.turn, thing.turn)
    return plan.somewhere(item, zone, True, turn, thing.air) or plan.somewhere(item, zone, True, turn + 90, thing.air)


def _floor(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    return plan.somewhere(item, zone, gap=thing.air)


def _hung(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    return plan.hang_somewhere(item, zone, _draw(plan, thing.z))


def _ceiling(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    """Under the level part of the ceiling, near the middle of the zone."""
    x0, x1, y0, y1 = zone.rect
    room = plan.layout.rooms[zone.room]
    for k in range(TRIES):
        spread = 0.1 + 0.3 * k / TRIES
        share = plan.rng.uniform(0.5 - spread, 0.5 + spread, 2)
        at = np.array([x0 + share[0] * (x1 - x0), y0 + share[1] * (y1 - y0)])
        z = room.height - float(item.size[2]) - GAP_M
        if placed := plan.put(item, at, 0.0, z, "ceiling"):
            return placed
    return None


def _run(plan: HomePlan, item: Item, thing: Thing, zone: Zone) -> Placed | None:
    """Identical cabinets side by side along a wall, as many as there is space for; ``n`` at most. The first of them."""
    spans = plan.spans(zone)
    for k in plan.rng.permutation(len(spans)):
        span, before = spans[int(k)], len(plan.placed)
        room_for = int((span.b - span.a - 0.1) / (item.size[0] + GAP_M))
        for n in range(min(thing.n[1], room_for), thing.n[0] - 1, -1):
            slack = span.b - span.a - n * (item.size[0] + GAP_M)
            start = span.a + (0.03 if plan.rng.random() < 0.5 else slack - 0.03) + item.size[0] / 2
            for i in range(n):
                at = span.wall.point(start + i * (item.size[0] + GAP_M), item.size[1] / 2 + BACK_M)
                if plan.put(item, at, span.wall.yaw) is None:
                    plan.back_to(before)
                    break
            else:
                return plan.placed[before]
    return None


def _before(sign: float) -> Callable[..., Placed | None]:
    """In front of the anchor, turned like it (1) or towards it (-1)."""

    def place(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
        for _ in range(5):
            y = -(anchor.item.size[1] / 2 + _draw(plan, thing.gap) + item.size[1] / 2)
            turn = (0.0 if sign > 0 else 180.0) + plan.uniform(-thing.turn, thing.turn)
            if placed := plan.by(item, anchor, _draw(plan, thing.shift), y, turn, thing.air):
                return placed
        return None

    return place


def _beside(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """To the left or right, backs aligned."""
    x = (anchor.item.size[0] + item.size[0]) / 2 + max(_draw(plan, thing.gap), GAP_M)
    y = (anchor.item.size[1] - item.size[1]) / 2
    side = 1 if plan.rng.random() < 0.5 else -1
    turn = plan.uniform(-thing.turn, thing.turn)
    places = (plan.by(item, anchor, s * x, y - back, turn) for s in (side, -side) for back in (0.0, 0.1))
    return first(places)


def _centre(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    return plan.by(item, anchor, 0.0, 0.0, plan.uniform(-thing.turn, thing.turn))


def _behind(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    y = (anchor.item.size[1] + item.size[1]) / 2 + max(_draw(plan, thing.gap), GAP_M)
    return plan.by(item, anchor, _draw(plan, thing.shift), y, 180.0 + plan.uniform(-thing.turn, thing.turn))


def _opposite(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """Back to the wall that the anchor looks at."""
    whole = replace(zone, rect=plan.layout.rooms[zone.room].rect)
    for span in plan.spans(whole):
        along, off = span.wall.position(anchor.position[:2])
        low, high = span.a + item.size[0] / 2 + BACK_M, span.b - item.size[0] / 2 - BACK_M
        if abs((span.wall.yaw - anchor.yaw) % 360 - 180) < 1 and low < high and off < FARTHEST_M:
            for shift in (0.0, -0.4, 0.4, -0.8, 0.8):
                at = span.wall.point(float(np.clip(along + shift, low, high)), item.size[1] / 2 + BACK_M)
                if placed := plan.put(item, at, span.wall.yaw):
                    return placed
    return None


def _above(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """On the wall behind the anchor, ``z`` over its top."""
    z = _draw(plan, thing.z) + float(plan.boxes[anchor.id].high[2])
    for span in plan.spans(zone):
        along, off = span.wall.position(anchor.position[:2])
        if span.wall.yaw == anchor.yaw and abs(off) < anchor.item.size[1] / 2 + 0.2:
            start = along + (item.size[0] - anchor.item.size[0]) / 2
            row = [start + k * (item.size[0] + GAP_M) for k in range(6)]
            places = row if thing.where == "row" else [along + _draw(plan, thing.shift)]
            return first(plan.hang(item, span, at, z, gap=0.0) for at in places)
    return None


def _around(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """At a free side of a table, facing it, pushed partly under it or pulled out."""
    w, d = anchor.item.size[:2] / 2
    n = max(1, int(2 * w / (item.size[0] + 0.08)))
    seats = [(s, 2 * w * ((k + 0.5) / n - 0.5)) for s in (0, 2) for k in range(n)]
    seats += [(s, 0.0) for s in (1, 3) if d > 0.33]
    pushed = plan.uniform(-0.28, 0.12)
    for k in sorted(range(len(seats)), key=lambda k: (seats[k][0] % 2, plan.rng.random())):
        side, x = seats[k]
        for more in (0.0, 0.12, 0.28):
            away = (w if side % 2 else d) + item.size[1] / 2 + pushed + more
            angle = np.deg2rad(90.0 * side)
            cos, sin = np.cos(angle), np.sin(angle)
            turn = 180.0 + 90.0 * side + plan.uniform(-thing.turn, thing.turn)
            if placed := plan.by(item, anchor, cos * x + sin * away, sin * x - cos * away, turn):
                return placed
    return None


def _spots(anchor: Placed, role: str) -> list[Spot]:
    return [spot for spot in anchor.item.spots if spot.role == role]


def _on(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    spots = _spots(anchor, thing.role)
    for k in plan.rng.permutation(len(spots)):
        if placed := plan.on_spot(item, anchor, spots[int(k)], thing.where, thing.turn, thing.air):
            return placed
    return None


def _before_it(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """On what holds the anchor, in front of it."""
    holder, relation = plan.parent[anchor.id]
    y = -(anchor.item.size[1] + item.size[1]) / 2
    for _ in range(4):
        at = anchor.to_world(np.array([_draw(plan, thing.shift), y - _draw(plan, thing.gap), 0.0]))
        base = plan.placed[holder - 1]
        local = rotation("z", -base.yaw) @ (at - base.position)
        if any(s.x0 < local[0] < s.x1 and s.y0 + item.size[1] / 2 < local[1] < s.y1 for s in _spots(base, "top")):
            turn = plan.uniform(-thing.turn, thing.turn)
            if placed := plan.put(item, at[:2], anchor.yaw + turn, float(anchor.position[2]), "object", base, relation):
                return placed
    return None


def _near(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """On the floor, on or around the anchor."""
    reach = anchor.item.size[:2] / 2 + 0.1
    places = (plan.rng.uniform(-reach, reach) for _ in range(5))
    return first(plan.by(item, anchor, x, y, plan.uniform(-180, 180)) for x, y in places)


def _stack(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """On the top of the highest object of the pile that begins with the anchor."""
    top = anchor
    for other in plan.placed[anchor.id :]:
        if plan.parent.get(other.id, (0, ""))[0] == top.id:
            top = other
    return plan.on_top(item, top, thing.turn)


def _slab(plan: HomePlan, item: Item, thing: Thing, zone: Zone, anchor: Placed) -> Placed | None:
    """A countertop over the run of cabinets that begins with the anchor."""
    run = [p for p in plan.placed[anchor.id - 1 :] if p.item is anchor.item]
    ends = np.array([run[0].position[:2], run[-1].position[:2]])
    length = float(np.linalg.norm(ends[1] - ends[0])) + anchor.item.size[0]
    slab = resized(item, length / item.size[0], (anchor.item.size[1] + 0.02) / item.size[1])
    middle = ends.mean(axis=0)
    forward = anchor.to_world(np.array([0.0, -0.01, 0.0])) - anchor.position
    z = float(plan.boxes[anchor.id].high[2]) + GAP_M
    return plan.put(slab, middle + forward[:2], anchor.yaw, z, "object", anchor)


Free = Callable[[HomePlan, Item, Thing, Zone], Placed | None]
Relative = Callable[[HomePlan, Item, Thing, Zone, Placed], Placed | None]
FREE: Mapping[str, Free] = {
    "wall": _wall, "corner": _corner, "angled": _angled, "middle": _middle, "floor": _floor, "hung": _hung,
    "ceiling": _ceiling, "run": _run,
}  # fmt: skip
RELATIVE: Mapping[str, Relative] = {
    "front": _before(1), "facing": _before(-1), "beside": _beside, "centre": _centre, "behind": _behind,
    "opposite": _opposite, "above": _above, "around": _around, "on": _on, "stack": _stack, "slab": _slab,
    "before": _before_it, "near": _near,
}  # fmt: skip
