"""Recipes: what belongs in a living room, bedroom, kitchen, office, bathroom, studio, and where."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.datasets.rooms import groups
from su3d_bench.datasets.rooms.objects.items import Item, Part, Spot
from su3d_bench.datasets.rooms.plan import GAP_M, Plan, add_openings, add_shell
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


def living(plan: Plan) -> None:
    sofa = groups.seating(plan)
    groups.television(plan, sofa)
    groups.stocked_shelf(plan, n=7)
    groups.stocked_cabinet(plan, groups.SMALL_DECOR, 3)
    plan.against_wall(plan.new("lamp", "floor_lamp"), corner=True)
    groups.plant_on_stand(plan)
    groups.filled_basket(plan, "blanket")
    plan.somewhere(plan.new(str(plan.rng.choice(["beanbag", "stool"]))))
    groups.cushioned_bench(plan)
    groups.floor_things(plan, groups.some(plan, 3, "backpack", "exercise-ball", "box", "indoor-plant", "umbrella"))
    groups.wall_things(plan, 2)


def bedroom(plan: Plan) -> None:
    item = plan.new("bed")
    bed = plan.against_wall(item, gap=0.3) or plan.against_wall(item)
    if bed:
        rug = plan.new("rug")
        if plan.facing(rug, bed, -0.7, turn=0.0) is None:
            plan.facing(plan.new("rug"), bed, -0.9, turn=0.0)
        for _ in range(2):
            stand = plan.beside(plan.new("nightstand"), bed, 0.07)
            more = groups.some(plan, 1, ("book", "book_stack"), "cup", "tissue-paper", "candle")
            groups.stock(plan, stand, [("lamp", "table_lamp"), *more])
        groups.bedding(plan, bed)
        plan.on(plan.new("cushion", "flat_cushion"), bed, "seat", turn=20.0)
        plan.hang_above(plan.new("picture"), bed, 1.35)
    wardrobe = plan.against_wall(plan.new("wardrobe"))
    groups.stocked_cabinet(plan, groups.SMALL_DECOR, 4)
    if wardrobe is None or plan.rng.random() < 0.5:
        groups.stocked_shelf(plan, n=6)
    else:
        groups.desk_place(plan, laptop=True)
    groups.filled_basket(plan, "blanket")
    groups.plant_on_stand(plan)
    plan.somewhere(plan.new(str(plan.rng.choice(["stool", "beanbag", "beanbag"]))))
    if plan.rng.random() < 0.5:
        groups.cushioned_bench(plan)
    groups.floor_things(plan, groups.some(plan, 3, "backpack", "box", "exercise-ball", "umbrella"))
    groups.wall_things(plan, 2)


def kitchen(plan: Plan) -> None:
    counter_run(plan)
    fridge = plan.against_wall(plan.new("refrigerator"), gap=0.02)
    if fridge:
        plan.on(plan.new("box"), fridge, turn=6.0)
    groups.dining_table(plan, 3)
    pool = "bowl", "vase", "chopping-board", "bottle", "pot", "indoor-plant", "knife-block", "paper-towel"
    groups.stocked_cabinet(plan, pool, 5)
    plan.against_wall(plan.new("bin"), gap=0.04)
    groups.stocked_wall_shelf(plan, ["cup", "bottle", "bowl", "indoor-plant"], turn=3.0)
    groups.floor_things(plan, ["stool", "mat", "box", "umbrella"])
    groups.wall_things(plan, 1)


def office(plan: Plan) -> None:
    for laptop in (False, bool(plan.rng.random() < 0.4)):
        groups.desk_place(plan, laptop)
    groups.stocked_shelf(plan, [("book", "books"), "box"], 7)
    groups.stocked_cabinet(plan, [*groups.SMALL_DECOR, "box", "paper-towel"], 3)
    if plan.rng.random() < 0.6:
        sofa = plan.against_wall(plan.new("sofa"))
        if sofa:
            groups.cushions(plan, sofa, 2)
    else:
        groups.cushioned_bench(plan)
    plan.against_wall(plan.new("lamp", "floor_lamp"), corner=True)
    groups.stocked_wall_shelf(plan, [("book", "books"), "sculpture", "indoor-plant"])
    groups.plant_on_stand(plan)
    groups.floor_things(plan, groups.some(plan, 3, "backpack", "umbrella", "box", "exercise-ball", "basket"))
    groups.wall_things(plan, 2, n_plugs=3)


def bathroom(plan: Plan) -> None:
    tub = plan.against_wall(plan.new("bathtub"), groups.long_walls(plan), 0.02, corner=True)
    sink_item = plan.new("sink", "pedestal_sink")
    sink = plan.against_wall(sink_item, gap=0.5) or plan.against_wall(sink_item, gap=0.1)
    if sink:
        for side in (-1, 1):
            towel = plan.new("towel", "towel_rail")
            if plan.hang_above(towel, sink, 0.85, side * (sink_item.size[0] / 2 + towel.size[0] / 2 + 0.07)):
                break
    toilet = plan.against_wall(plan.new("toilet"), gap=0.18)
    if toilet:
        plan.beside(plan.new("bin"), toilet, 0.12)
    if tub:
        plan.facing(plan.new("mat"), tub, 0.05, turn=0.0)
    groups.bath_shelf(plan)
    folded = "towel", "folded_towel"
    groups.stocked_cabinet(plan, ["candle", "bottle", "tissue-paper", "indoor-plant", "cup"], 3, [folded])
    groups.stocked_wall_shelf(plan, ["bottle", "cup", "candle", folded], 1.4)
    groups.filled_basket(plan, "towel")
    groups.floor_things(plan, ["stool"])
    plan.hang_somewhere(plan.new("towel", "towel_rail"), 0.95)
    groups.wall_things(plan, 1, clock=False, n_plugs=1)


def studio(plan: Plan) -> None:
    """One room to live, sleep and work in."""
    bed = plan.against_wall(plan.new("bed"), gap=0.2, corner=True)
    if bed:
        groups.bedding(plan, bed)
        stand = plan.beside(plan.new("nightstand"), bed, 0.07)
        groups.stock(plan, stand, [("lamp", "table_lamp"), "cup"])
    sofa = groups.seating(plan)
    groups.television(plan, sofa)
    groups.desk_place(plan, laptop=bool(plan.rng.random() < 0.5))
    plan.against_wall(plan.new("wardrobe"))
    groups.stocked_shelf(plan, n=6)
    plan.against_wall(plan.new("refrigerator"))
    groups.stocked_cabinet(plan, (), 0, ["microwave", "pot", "paper-towel", "bottle"])
    groups.floor_things(plan, groups.some(plan, 3, "backpack", "umbrella", "box", "exercise-ball", "basket", "stool"))
    groups.wall_things(plan, 2)


@dataclass(frozen=True)
class Kind:
    """Ranges of a kind of room, metres, and its recipe."""

    width: tuple[float, float]
    depth: tuple[float, float]
    windows: tuple[int, int]
    tiled: bool
    furnish: Callable[[Plan], None]


KINDS: Mapping[str, Kind] = {
    "living": Kind((5.0, 6.0), (4.3, 5.0), (1, 2), False, living),
    "bedroom": Kind((4.2, 5.0), (3.9, 4.6), (1, 2), False, bedroom),
    "kitchen": Kind((4.2, 5.0), (3.8, 4.4), (1, 2), False, kitchen),
    "office": Kind((4.5, 5.4), (4.0, 4.7), (1, 2), False, office),
    "bathroom": Kind((3.4, 4.0), (3.1, 3.6), (1, 1), True, bathroom),
    "studio": Kind((6.2, 7.0), (4.9, 5.5), (2, 2), False, studio),
}


def furnish(kind: str, rng: np.random.Generator) -> Plan:
    """A furnished room of the kind."""
    rules = KINDS[kind]
    plan = Plan(rng, float(rng.uniform(*rules.width)), float(rng.uniform(*rules.depth)), float(rng.uniform(2.5, 2.75)))
    add_shell(plan, rules.tiled)
    cover = "blinds" if rules.tiled else str(rng.choice(["curtain", "curtain", "blinds"]))
    add_openings(plan, int(rng.integers(rules.windows[0], rules.windows[1] + 1)), cover)
    n_lamps = 2 if kind == "studio" else 1
    for k in range(n_lamps):
        groups.hang_ceiling_lamp(
            plan, plan.width * (k + 1) / (n_lamps + 1), plan.depth * float(rng.uniform(0.45, 0.55))
        )
    rules.furnish(plan)
    plan.finish_lights()
    return plan
