"""Recipes: what belongs in a living room, bedroom, kitchen, office, bathroom, studio, and where."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.datasets.rooms_items import Item, Part, Spot
from su3d_bench.datasets.rooms_layout import GAP_M, WALL_YAW, Plan, add_openings, add_shell
from su3d_bench.datasets.rooms_mesh import Placed


def _stock(plan: Plan, anchor: Placed | None, wanted: Sequence[str | tuple[str, str]], role: str = "top") -> None:
    """Puts things on an anchor, as many as fit."""
    for want in wanted:
        name, model = want if isinstance(want, tuple) else (want, None)
        if anchor is not None:
            plan.on(plan.new(name, model), anchor, role)


def _choose(plan: Plan, pool: Sequence[str | tuple[str, str]], n: int) -> list[str | tuple[str, str]]:
    return [pool[int(k)] for k in plan.rng.permutation(len(pool))[:n]]


_SHELF_THINGS: tuple[str | tuple[str, str], ...] = (
    ("book", "books"), ("book", "books"), ("book", "book_stack"), "vase", "indoor-plant", "box", "sculpture", "candle",
    "clock_", ("book", "books"), "bowl", "picture_",
)  # fmt: skip
_SMALL_DECOR: tuple[str | tuple[str, str], ...] = (
    "vase", "candle", "sculpture", "indoor-plant", ("book", "book_stack"), "bowl", "tissue-paper", ("lamp", "table_lamp"),
)  # fmt: skip


def _shelf(plan: Plan, extra: Sequence[str | tuple[str, str]] = (), n: int = 7) -> Placed | None:
    shelf = plan.against_wall(plan.new("shelf", "shelf"))
    pool = [want for want in _SHELF_THINGS if want not in ("clock_", "picture_")]
    if shelf:
        for want in [*extra, *_choose(plan, pool, n)]:
            name, model = want if isinstance(want, tuple) else (want, None)
            item = plan.new(name, model)
            if plan.on(item, shelf, "board", turn=3.0) is None:
                plan.on(item, shelf, "top", turn=3.0)
    return shelf


def _wall_things(plan: Plan, n_pictures: int, clock: bool = True, n_plugs: int = 2) -> None:
    for _ in range(n_pictures):
        plan.hang_somewhere(plan.new("picture"), float(plan.rng.uniform(1.35, 1.55)))
    if clock:
        plan.hang_somewhere(plan.new("clock"), float(plan.rng.uniform(1.65, 1.9)))
    for _ in range(n_plugs):
        plan.hang_somewhere(plan.new("wall-plug"), float(plan.rng.uniform(0.24, 0.3)))
    plan.hang_somewhere(plan.new("vent"), plan.height - 0.42)


def _ceiling_lamp(plan: Plan, x: float, y: float) -> Placed | None:
    lamp = plan.new("lamp", "ceiling_lamp")
    return plan.try_at(lamp, x, y, 0.0, plan.height - lamp.size[2] - 2 * GAP_M, 0.0, "ceiling")


def _floor_things(plan: Plan, names: Sequence[str]) -> None:
    for name in names:
        plan.somewhere(plan.new(name))


def _filled_basket(plan: Plan, content: str) -> None:
    """A basket from which a rolled towel or blanket sticks out."""
    basket = plan.somewhere(plan.new("basket"))
    if basket:
        for _ in range(2):
            plan.on(_stood_up(plan.new(content, f"rolled_{content}")), basket, "inside", turn=0.0)


def _stood_up(item: Item) -> Item:
    """A roll set on its end."""
    parts = [Part(part.shape.turned("y", 90), part.material) for part in item.parts]
    low = min(float(part.shape.quads[..., 2].min()) for part in parts)
    lifted = tuple(Part(part.shape.moved(z=-low), part.material) for part in parts)
    size = np.array([item.size[2], item.size[1], item.size[0]])
    return Item(item.class_name, item.colour, item.material, item.size_word, lifted, (), size)


def _plant_stand(plan: Plan) -> None:
    stand = plan.somewhere(plan.new("plant-stand"))
    if stand is None:
        return
    for _ in range(8):
        if plan.on(plan.new("indoor-plant"), stand, where="centre", turn=90.0):
            return


def _seating(plan: Plan) -> Placed | None:
    """A sofa with cushions and blanket, a coffee table on a rug before it, a small table with a lamp beside it."""
    sofa_item = plan.new("sofa")
    sofa = plan.against_wall(sofa_item, _long_walls(plan)) or plan.against_wall(sofa_item)
    if sofa is None:
        return None
    rug = plan.new("rug")
    if plan.facing(rug, sofa, 0.08, turn=0.0) is None:
        plan.facing(plan.new("rug"), sofa, 0.03, turn=0.0)
    low_table = plan.facing(plan.new("table", "coffee_table"), sofa, float(plan.rng.uniform(0.42, 0.52)), turn=0.0)
    for _ in range(int(plan.rng.integers(2, 4))):
        plan.on(plan.new("cushion", "cushion"), sofa, "seat", "back", turn=6.0)
    plan.on(plan.new("blanket", "blanket"), sofa, "seat", turn=6.0)
    side = plan.beside(plan.new("table", "side_table"), sofa)
    _stock(plan, side, [("lamp", "table_lamp")])
    _stock(
        plan,
        low_table,
        _choose(
            plan, ["cup", "bowl", ("book", "book_stack"), "candle", "plate", "tissue-paper", "laptop", "cup", "vase"], 5
        ),
    )
    plan.hang_above(plan.new("picture"), sofa, 1.3, float(plan.rng.uniform(-0.2, 0.2)))
    return sofa


def _long_walls(plan: Plan) -> list[int]:
    return [0, 2] if plan.width >= plan.depth else [1, 3]


def _opposite(plan: Plan, item: Item, other: Placed) -> Placed | None:
    wall, along = plan.wall_of(other)
    facing = (wall + 2) % 4
    x, y = plan.wall_point(facing, along, item.size[1] / 2 + 0.006)
    return plan.try_at(item, x, y, WALL_YAW[facing], None, 0.04) or plan.against_wall(
        item, [facing, (wall + 1) % 4, (wall + 3) % 4]
    )


def _television(plan: Plan, sofa: Placed | None) -> None:
    item = plan.new("tv-stand")
    stand = _opposite(plan, item, sofa) if sofa else plan.against_wall(item)
    if stand is None:
        return
    if plan.rng.random() < 0.7:
        plan.on(plan.new("tv-screen", "tv_screen"), stand, where="centre", turn=0.0)
    else:
        plan.hang_above(plan.new("tv-screen", "wall_tv"), stand, 0.95)
    _stock(plan, stand, _choose(plan, ["indoor-plant", "vase", "sculpture", "candle"], 2))
    _stock(plan, stand, [("book", "book_stack")], "board")


def _dining(plan: Plan, n_chairs: int) -> Placed | None:
    """A table in the open with chairs around, laid with plates and cups."""
    table = None
    for _ in range(25):
        item = plan.new("table", "table")
        x = float(plan.rng.uniform(0.35, 0.65)) * plan.width
        y = float(plan.rng.uniform(0.35, 0.65)) * plan.depth
        table = plan.try_at(item, x, y, float(plan.rng.choice([0.0, 90.0])), None, 0.6)
        if table:
            break
    if table is None:
        return None
    chairs_around(plan, table, n_chairs)
    _stock(plan, table, ["plate", "plate", "cup", "cup", *_choose(plan, ["bowl", "bottle", "vase", "candle"], 2)])
    return table


def chairs_around(plan: Plan, table: Placed, n: int) -> None:
    width, depth = table.item.size[0], table.item.size[1]
    for side in [int(k) for k in plan.rng.permutation(4)][:n]:
        chair = plan.new("chair")
        reach = (depth if side % 2 == 0 else width) / 2 + chair.size[1] / 2 + 0.04
        angle = np.deg2rad(90.0 * side)
        local = np.array([np.sin(angle) * reach, -np.cos(angle) * reach, 0.0])
        x, y, _ = table.to_world(local)
        yaw = table.yaw + 180.0 + 90.0 * side + float(plan.rng.uniform(-5, 5))
        plan.try_at(chair, float(x), float(y), yaw, None, 0.0)


def _desk_place(plan: Plan, laptop: bool = False) -> Placed | None:
    """A desk with its computer, chair and bin."""
    desk = plan.against_wall(plan.new("desk"))
    if desk is None:
        return None
    if laptop:
        plan.on(plan.new("laptop"), desk, where="centre", turn=5.0)
    else:
        screen = plan.new("monitor")
        shown = plan.on(screen, desk, where="back", turn=0.0)
        if shown:
            local_x = float(
                (shown.position - desk.position)
                @ np.array([np.cos(np.deg2rad(desk.yaw)), np.sin(np.deg2rad(desk.yaw)), 0])
            )
            _before(plan, desk, plan.new("computer-keyboard"), local_x, 0.17)
            _before(plan, desk, plan.new("mouse"), local_x + 0.34, 0.17)
    _stock(
        plan,
        desk,
        [
            ("lamp", "desk_lamp"),
            *_choose(
                plan, ["cup", ("book", "books"), ("book", "book_stack"), "tissue-paper", "indoor-plant", "bottle"], 3
            ),
        ],
    )
    plan.facing(
        plan.new("chair"), desk, float(plan.rng.uniform(0.04, 0.15)), float(plan.rng.uniform(-0.15, 0.15)), jitter=8.0
    )
    plan.beside(plan.new("bin"), desk, 0.08)
    if not laptop:
        plan.beside(plan.new("desktop-computer"), desk, 0.05)
    return desk


def _before(plan: Plan, desk: Placed, item: Item, local_x: float, from_front: float) -> None:
    """On a desk, at a place along it, near its front edge."""
    spot = desk.item.spots[0]
    x, y, z = desk.to_world(np.array([local_x, spot.y0 + from_front, spot.z]))
    found = plan.try_at(item, float(x), float(y), desk.yaw, float(z) + GAP_M, 0.005, "object", ignore=[desk.id])
    if found:
        plan.parent[found.id] = (desk.id, "on")
    else:
        plan.on(item, desk, turn=3.0)


def _bench(plan: Plan) -> None:
    """A bench with a flat cushion on it."""
    bench = plan.against_wall(plan.new("bench"))
    if bench:
        plan.on(plan.new("cushion", "flat_cushion"), bench, "seat", turn=5.0)


def living(plan: Plan) -> None:
    sofa = _seating(plan)
    _television(plan, sofa)
    _shelf(plan, n=7)
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(plan, cabinet, [*_choose(plan, _SMALL_DECOR, 3)])
    plan.against_wall(plan.new("lamp", "floor_lamp"), corner=True)
    _plant_stand(plan)
    _filled_basket(plan, "blanket")
    plan.somewhere(plan.new(str(plan.rng.choice(["beanbag", "stool"]))))
    _bench(plan)
    _floor_things(
        plan,
        [str(n) for n in plan.rng.permutation(["backpack", "exercise-ball", "box", "indoor-plant", "umbrella"])[:3]],
    )
    _wall_things(plan, 2)


def bedroom(plan: Plan) -> None:
    item = plan.new("bed")
    bed = plan.against_wall(item, gap=0.3) or plan.against_wall(item)
    if bed:
        rug = plan.new("rug")
        if plan.facing(rug, bed, -0.7, turn=0.0) is None:
            plan.facing(plan.new("rug"), bed, -0.9, turn=0.0)
        for _ in range(2):
            stand = plan.beside(plan.new("nightstand"), bed, 0.07)
            _stock(
                plan,
                stand,
                [("lamp", "table_lamp"), *_choose(plan, [("book", "book_stack"), "cup", "tissue-paper", "candle"], 1)],
            )
        for side in ("left", "right"):
            plan.on(plan.new("pillow"), bed, "head", side, turn=3.0, gap=0.0)
        plan.on(plan.new("blanket", "blanket"), bed, "seat", turn=6.0)
        plan.on(plan.new("cushion", "flat_cushion"), bed, "seat", turn=20.0)
        plan.hang_above(plan.new("picture"), bed, 1.35)
    wardrobe = plan.against_wall(plan.new("wardrobe"))
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(plan, cabinet, _choose(plan, _SMALL_DECOR, 4))
    if wardrobe is None or plan.rng.random() < 0.5:
        _shelf(plan, n=6)
    else:
        _desk_place(plan, laptop=True)
    _filled_basket(plan, "blanket")
    _plant_stand(plan)
    plan.somewhere(plan.new(str(plan.rng.choice(["stool", "beanbag", "beanbag"]))))
    if plan.rng.random() < 0.5:
        _bench(plan)
    _floor_things(plan, [str(n) for n in plan.rng.permutation(["backpack", "box", "exercise-ball", "umbrella"])[:3]])
    _wall_things(plan, 2)


def _counter_run(plan: Plan) -> None:
    """Base cabinets side by side under one stone slab with sink and cooktop; wall cabinets above."""
    rng = plan.rng
    colour = str(rng.choice(["white", "beige", "grey", "green", "blue", "brown"]))
    for wall in [int(w) for w in rng.permutation(4)]:
        for start in (float(rng.uniform(0.03, 0.1)), 0.6, 1.2, 1.8):
            run, end = _cabinet_row(plan, wall, start, colour)
            if len(run) >= 2:
                _counter_top(plan, wall, start, end, run)
                return
            for placed in reversed(run):
                _take_back(plan, placed)


def _cabinet_row(plan: Plan, wall: int, start: float, colour: str) -> tuple[list[Placed], float]:
    """Up to four base cabinets from ``start`` along a wall, and where they end."""
    run: list[Placed] = []
    along = start
    for _ in range(4):
        item = plan.new("base-cabinet", colour=colour)
        centre, half = along + item.size[0] / 2, item.size[0] / 2
        x, y = plan.wall_point(wall, centre, item.size[1] / 2 + 0.006)
        fits = centre + half < plan.wall_length(wall)
        found = plan.try_at(item, x, y, WALL_YAW[wall]) if fits else None
        if found is None:
            break
        run.append(found)
        along = centre + half + 0.004
    return run, along


def _take_back(plan: Plan, placed: Placed) -> None:
    assert plan.placed[-1] is placed
    plan.placed.pop()
    del plan.boxes[placed.id], plan.mount[placed.id]


def _counter_top(plan: Plan, wall: int, start: float, end: float, run: Sequence[Placed]) -> None:
    slab = plan.new("countertop")
    length = end - start
    shape = slab.parts[0].shape.stretched(length, 1.06)
    spot = slab.spots[0]
    stretched = Spot(spot.x0 * length, spot.x1 * length, spot.y0 * 1.04, spot.y1 * 1.04, spot.z)
    item = Item(
        "countertop",
        slab.colour,
        slab.material,
        "medium",
        (Part(shape, slab.parts[0].material),),
        (stretched,),
        np.array([length, slab.size[1] * 1.06, slab.size[2]]),
    )
    x, y = plan.wall_point(wall, start + length / 2, item.size[1] / 2 + 0.004)
    z = float(plan.boxes[run[0].id].high[2]) + GAP_M
    top = plan.try_at(item, x, y, WALL_YAW[wall], z, 0.0, "object", ignore=[])
    if top is None:
        return
    plan.parent[top.id] = (run[0].id, "on")
    order = [int(k) for k in plan.rng.permutation(len(run))]
    sink = _at_cabinet(plan, top, run[order[0]], plan.new("sink", "kitchen_sink"))
    stove = _at_cabinet(plan, top, run[order[1]], plan.new("cooktop"))
    if stove:
        for name in ("pan", "pot"):
            plan.on(plan.new(name), stove, "burner", "centre", turn=12.0, gap=0.0)
    if sink:
        _beside_on(plan, top, sink, plan.new("towel", "folded_towel"))
    plan.on(plan.new("microwave"), top, where="back", turn=3.0)
    for name in (
        "chopping-board",
        "knife-block",
        "paper-towel",
        "bottle",
        "bowl",
        "cup",
        "plate",
        "indoor-plant",
    ):
        plan.on(plan.new(name), top, turn=6.0)
    for cabinet in run:
        if plan.rng.random() < 0.8:
            plan.hang_above(plan.new("wall-cabinet", colour=run[0].item.colour), cabinet, 1.5)


def _at_cabinet(plan: Plan, top: Placed, cabinet: Placed, item: Item) -> Placed | None:
    """On the slab, over the middle of one cabinet."""
    wall, along = plan.wall_of(cabinet)
    x, y = plan.wall_point(wall, along, 0.33)
    z = float(plan.boxes[top.id].high[2]) + GAP_M
    found = plan.try_at(item, x, y, top.yaw, z, 0.0, "object", ignore=[top.id])
    if found:
        plan.parent[found.id] = (top.id, "on")
    return found


def _beside_on(plan: Plan, top: Placed, anchor: Placed, item: Item) -> None:
    for side in (-1, 1):
        offset = np.array([side * (anchor.item.size[0] / 2 + 0.04 + item.size[0] / 2), -0.05, 0.0])
        x, y, z = anchor.to_world(offset)
        inside = plan.boxes[top.id]
        if not (inside.low[:2] + 0.1 < (x, y)).all() or not ((x, y) < inside.high[:2] - 0.1).all():
            continue
        found = plan.try_at(item, float(x), float(y), anchor.yaw, float(z), 0.0, "object", ignore=[top.id])
        if found:
            plan.parent[found.id] = (top.id, "on")
            return
    plan.on(item, top)


def kitchen(plan: Plan) -> None:
    _counter_run(plan)
    fridge = plan.against_wall(plan.new("refrigerator"), gap=0.02)
    if fridge:
        plan.on(plan.new("box"), fridge, turn=6.0)
    _dining(plan, 3)
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(
        plan,
        cabinet,
        _choose(
            plan, ["bowl", "vase", "chopping-board", "bottle", "pot", "indoor-plant", "knife-block", "paper-towel"], 5
        ),
    )
    plan.against_wall(plan.new("bin"), gap=0.04)
    rack = plan.new("shelf", "wall_shelf")
    hung = plan.hang_somewhere(rack, 1.45)
    if hung:
        for name in ("cup", "bottle", "bowl", "indoor-plant"):
            plan.on(plan.new(name), hung, turn=3.0)
    _floor_things(plan, ["stool", "mat", "box", "umbrella"])
    _wall_things(plan, 1)


def office(plan: Plan) -> None:
    for laptop in (False, bool(plan.rng.random() < 0.4)):
        _desk_place(plan, laptop)
    _shelf(plan, [("book", "books"), "box"], 7)
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(plan, cabinet, _choose(plan, [*_SMALL_DECOR, "box", "paper-towel"], 3))
    if plan.rng.random() < 0.6:
        sofa = plan.against_wall(plan.new("sofa"))
        if sofa:
            plan.on(plan.new("cushion", "cushion"), sofa, "seat", "back", turn=6.0)
            plan.on(plan.new("cushion", "cushion"), sofa, "seat", "back", turn=6.0)
    else:
        _bench(plan)
    plan.against_wall(plan.new("lamp", "floor_lamp"), corner=True)
    hung = plan.hang_somewhere(plan.new("shelf", "wall_shelf"), 1.45)
    _stock(plan, hung, [("book", "books"), "sculpture", "indoor-plant"])
    _plant_stand(plan)
    _floor_things(
        plan, [str(n) for n in plan.rng.permutation(["backpack", "umbrella", "box", "exercise-ball", "basket"])[:3]]
    )
    _wall_things(plan, 2, n_plugs=3)


def bathroom(plan: Plan) -> None:
    tub = plan.against_wall(plan.new("bathtub"), _long_walls(plan), 0.02, corner=True)
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
    _bath_shelf(plan)
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(
        plan,
        cabinet,
        [("towel", "folded_towel"), *_choose(plan, ["candle", "bottle", "tissue-paper", "indoor-plant", "cup"], 3)],
    )
    hung = plan.hang_somewhere(plan.new("shelf", "wall_shelf"), 1.4)
    _stock(plan, hung, ["bottle", "cup", "candle", ("towel", "folded_towel")])
    _filled_basket(plan, "towel")
    _floor_things(plan, ["stool"])
    plan.hang_somewhere(plan.new("towel", "towel_rail"), 0.95)
    _wall_things(plan, 1, clock=False, n_plugs=1)


def _bath_shelf(plan: Plan) -> Placed | None:
    shelf = plan.against_wall(plan.new("shelf", "shelf"))
    if shelf:
        for want in (
            ("towel", "folded_towel"),
            ("towel", "folded_towel"),
            ("towel", "rolled_towel"),
            "bottle",
            "indoor-plant",
            "candle",
            "tissue-paper",
        ):
            name, model = want if isinstance(want, tuple) else (want, None)
            plan.on(plan.new(name, model), shelf, "board", turn=3.0)
    return shelf


def studio(plan: Plan) -> None:
    """One room to live, sleep and work in."""
    bed = plan.against_wall(plan.new("bed"), gap=0.2, corner=True)
    if bed:
        for side in ("left", "right"):
            plan.on(plan.new("pillow"), bed, "head", side, turn=3.0, gap=0.0)
        plan.on(plan.new("blanket", "blanket"), bed, "seat", turn=6.0)
        stand = plan.beside(plan.new("nightstand"), bed, 0.07)
        _stock(plan, stand, [("lamp", "table_lamp"), "cup"])
    sofa = _seating(plan)
    _television(plan, sofa)
    _desk_place(plan, laptop=bool(plan.rng.random() < 0.5))
    plan.against_wall(plan.new("wardrobe"))
    _shelf(plan, n=6)
    plan.against_wall(plan.new("refrigerator"))
    cabinet = plan.against_wall(plan.new("cabinet"))
    _stock(plan, cabinet, ["microwave", "pot", "paper-towel", "bottle"])
    _floor_things(
        plan,
        [str(n) for n in plan.rng.permutation(["backpack", "umbrella", "box", "exercise-ball", "basket", "stool"])[:3]],
    )
    _wall_things(plan, 2)


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
        _ceiling_lamp(plan, plan.width * (k + 1) / (n_lamps + 1), plan.depth * float(rng.uniform(0.45, 0.55)))
    rules.furnish(plan)
    plan.finish_lights()
    return plan
