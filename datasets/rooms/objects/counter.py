"""The kitchen counter: base cabinets under one slab with sink and cooktop, wall cabinets above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Item, Part, Spot
from su3d_bench.datasets.rooms.plan import GAP_M, Plan
from su3d_bench.datasets.rooms.rendering.mesh import Placed


def counter_run(plan: Plan) -> None:
    """Base cabinets side by side under one stone slab with sink and cooktop; wall cabinets above."""
    rng = plan.rng
    colour = str(rng.choice(["white", "beige", "grey", "green", "blue", "brown"]))
    for wall in plan.shuffled(range(4)):
        for start in (float(rng.uniform(0.03, 0.1)), 0.6, 1.2, 1.8):
            run, end = cabinet_row(plan, wall, start, colour)
            if len(run) >= 2:
                counter_top(plan, wall, start, end, run)
                return
            for placed in reversed(run):
                take_back(plan, placed)


def cabinet_row(plan: Plan, wall: int, start: float, colour: str) -> tuple[list[Placed], float]:
    """Up to four base cabinets from ``start`` along a wall, and where they end."""
    run: list[Placed] = []
    along = start
    for _ in range(4):
        item = plan.new("base-cabinet", colour=colour)
        centre, half = along + item.size[0] / 2, item.size[0] / 2
        fits = centre + half < plan.wall_length(wall)
        placed = plan.try_at_wall(item, wall, centre, item.size[1] / 2 + 0.006) if fits else None
        if placed is None:
            break
        run.append(placed)
        along = centre + half + 0.004
    return run, along


def take_back(plan: Plan, placed: Placed) -> None:
    assert plan.placed[-1] is placed
    plan.placed.pop()
    del plan.boxes[placed.id], plan.mount[placed.id]


def counter_top(plan: Plan, wall: int, start: float, end: float, run: Sequence[Placed]) -> None:
    slab = plan.new("countertop")
    length = end - start
    shape = slab.parts[0].shape.stretched(length, 1.06)
    spot = slab.spots[0]
    stretched = Spot(spot.x0 * length, spot.x1 * length, spot.y0 * 1.04, spot.y1 * 1.04, spot.z)
    part = Part(shape, slab.parts[0].material)
    size = np.array([length, slab.size[1] * 1.06, slab.size[2]])
    item = Item("countertop", slab.colour, slab.material, "medium", (part,), (stretched,), size)
    z = float(plan.boxes[run[0].id].high[2]) + GAP_M
    top = plan.try_at_wall(item, wall, start + length / 2, item.size[1] / 2 + 0.004, z, mount="object")
    if top is None:
        return
    plan.parent[top.id] = (run[0].id, "on")
    plan.rests_also_on.extend((top.id, cabinet.id) for cabinet in run[1:])
    below_sink, below_stove = plan.shuffled(run)[:2]
    sink = at_cabinet(plan, top, below_sink, plan.new("sink", "kitchen_sink"))
    stove = at_cabinet(plan, top, below_stove, plan.new("cooktop"))
    if stove:
        for name in ("pan", "pot"):
            plan.on(plan.new(name), stove, "burner", "centre", turn=12.0, gap=0.0)
    if sink:
        beside_on(plan, top, sink, plan.new("towel", "folded_towel"))
    plan.on(plan.new("microwave"), top, where="back", turn=3.0)
    for name in ("chopping-board", "knife-block", "paper-towel", "bottle", "bowl", "cup", "plate", "indoor-plant"):
        plan.on(plan.new(name), top, turn=6.0)
    for cabinet in run:
        if plan.rng.random() < 0.8:
            plan.hang_above(plan.new("wall-cabinet", colour=run[0].item.colour), cabinet, 1.5)


def at_cabinet(plan: Plan, top: Placed, cabinet: Placed, item: Item) -> Placed | None:
    """On the slab, over the middle of one cabinet."""
    wall, along = plan.wall_of(cabinet)
    z = float(plan.boxes[top.id].high[2]) + GAP_M
    return plan.try_on(item, top, (*plan.wall_point(wall, along, 0.33), z), top.yaw, 0.0)


def beside_on(plan: Plan, top: Placed, anchor: Placed, item: Item) -> None:
    for side in (-1, 1):
        offset = np.array([side * (anchor.item.size[0] / 2 + 0.04 + item.size[0] / 2), -0.05, 0.0])
        place, inside = anchor.to_world(offset), plan.boxes[top.id]
        if not (inside.low[:2] + 0.1 < place[:2]).all() or not (place[:2] < inside.high[:2] - 0.1).all():
            continue
        if plan.try_on(item, top, place, anchor.yaw, 0.0):
            return
    plan.on(item, top)
