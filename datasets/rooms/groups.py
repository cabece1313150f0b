"""Groups of objects that belong together, and their arrangement: the steps of ``recipes.toml``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.procedural.items import Item, Part, Placed, Spot
from su3d_bench.datasets.rooms.plan import GAP_M, Plan

POOLS: Mapping[str, list[str]] = parse_toml(file_text(Path(__file__).with_name("recipes.toml")))


def stock(plan: Plan, anchor: Placed | None, wanted: Sequence[str], role: str = "top", turn: float = 8.0) -> None:
    """Puts objects on an anchor, as many as fit."""
    for want in wanted:
        if anchor is not None:
            plan.on(plan.new(want), anchor, role, turn=turn)


def some(plan: Plan, n: int, *wanted: str) -> list[str]:
    return plan.shuffled(wanted)[:n]


def stocked(plan: Plan, item: str, wanted: Sequence[str] = (), gap: float = 0.05, corner: bool = False,
            role: str = "top", turn: float = 8.0) -> None:  # fmt: skip
    """An object against a wall with others on it."""
    stock(plan, plan.against_wall(plan.new(item), gap=gap, corner=corner), wanted, role, turn)


def stocked_shelf(plan: Plan, extra: Sequence[str] = (), n: int = 7) -> None:
    shelf = plan.against_wall(plan.new("shelf/shelf"))
    if shelf:
        for want in [*extra, *some(plan, n, *POOLS["shelf_things"])]:
            item = plan.new(want)
            if plan.on(item, shelf, "board", turn=3.0) is None:
                plan.on(item, shelf, "top", turn=3.0)


def stocked_cabinet(plan: Plan, n: int, of: Sequence[str] | None = None, extra: Sequence[str] = ()) -> None:
    """A cabinet with the ``extra`` objects and ``n`` others on it (small decoration by default)."""
    cabinet = plan.against_wall(plan.new("cabinet"))
    stock(plan, cabinet, [*extra, *some(plan, n, *(POOLS["small_decor"] if of is None else of))])


def stocked_wall_shelf(plan: Plan, wanted: Sequence[str], z: float = 1.45, turn: float = 8.0) -> None:
    stock(plan, plan.hang_somewhere(plan.new("shelf/wall_shelf"), z), wanted, turn=turn)


def on_a_wall(plan: Plan, item: str, z: float) -> None:
    plan.hang_somewhere(plan.new(item), z)


def bedding(plan: Plan, bed: Placed) -> None:
    for side in ("left", "right"):
        plan.on(plan.new("pillow"), bed, "head", side, turn=3.0, gap=0.0)
    plan.on(plan.new("blanket/blanket"), bed, "seat", turn=6.0)


def cushions(plan: Plan, sofa: Placed, n: int) -> None:
    for _ in range(n):
        plan.on(plan.new("cushion/cushion"), sofa, "seat", "back", turn=6.0)


def wall_things(plan: Plan, n_pictures: int, clock: bool = True, n_plugs: int = 2) -> None:
    for _ in range(n_pictures):
        plan.hang_somewhere(plan.new("picture"), float(plan.rng.uniform(1.35, 1.55)))
    if clock:
        plan.hang_somewhere(plan.new("clock"), float(plan.rng.uniform(1.65, 1.9)))
    for _ in range(n_plugs):
        plan.hang_somewhere(plan.new("wall-plug"), float(plan.rng.uniform(0.24, 0.3)))
    plan.hang_somewhere(plan.new("vent"), plan.height - 0.42)


def hang_ceiling_lamp(plan: Plan, x: float, y: float) -> Placed | None:
    lamp = plan.new("lamp/ceiling_lamp")
    return plan.try_at(lamp, x, y, 0.0, plan.height - lamp.size[2] - 2 * GAP_M, 0.0, "ceiling")


def floor_things(plan: Plan, of: Sequence[str], n: int | None = None) -> None:
    for want in of if n is None else some(plan, n, *of):
        plan.somewhere(plan.new(want))


def one_thing(plan: Plan, of: Sequence[str]) -> None:
    plan.somewhere(plan.new(str(plan.rng.choice(of))))


def filled_basket(plan: Plan, content: str) -> None:
    """A basket from which a rolled towel or blanket sticks out."""
    basket = plan.somewhere(plan.new("basket"))
    if basket:
        for _ in range(2):
            plan.on(stood_up(plan.new(f"{content}/rolled_{content}")), basket, "inside", turn=0.0)


def stood_up(item: Item) -> Item:
    """A roll standing on its end."""
    parts = [Part(part.shape.turned("y", 90), part.material) for part in item.parts]
    low = min(float(part.shape.quads[..., 2].min()) for part in parts)
    lifted = tuple(Part(part.shape.moved(z=-low), part.material) for part in parts)
    size = np.array([item.size[2], item.size[1], item.size[0]])
    return Item(item.class_name, item.colour, item.material, item.size_word, lifted, (), size, item.model)


def plant_on_stand(plan: Plan) -> None:
    stand = plan.somewhere(plan.new("plant-stand"))
    if stand:
        any(plan.on(plan.new("indoor-plant"), stand, where="centre", turn=90.0) for _ in range(8))


def seating(plan: Plan) -> Placed | None:
    """A sofa with cushions and blanket, a coffee table on a rug before it, a small table with a lamp beside it."""
    sofa_item = plan.new("sofa")
    sofa = plan.against_wall(sofa_item, long_walls(plan)) or plan.against_wall(sofa_item)
    if sofa is None:
        return None
    rug = plan.new("rug")
    if plan.facing(rug, sofa, 0.08, turn=0.0) is None:
        plan.facing(plan.new("rug"), sofa, 0.03, turn=0.0)
    low_table = plan.facing(plan.new("table/coffee_table"), sofa, float(plan.rng.uniform(0.42, 0.52)), turn=0.0)
    cushions(plan, sofa, int(plan.rng.integers(2, 4)))
    plan.on(plan.new("blanket/blanket"), sofa, "seat", turn=6.0)
    side = plan.beside(plan.new("table/side_table"), sofa)
    stock(plan, side, ["lamp/table_lamp"])
    more = some(plan, 5, "cup", "bowl", "book/book_stack", "candle", "plate", "tissue-paper", "laptop", "cup", "vase")
    stock(plan, low_table, more)
    plan.hang_above(plan.new("picture"), sofa, 1.3, float(plan.rng.uniform(-0.2, 0.2)))
    return sofa


def long_walls(plan: Plan) -> list[int]:
    return [0, 2] if plan.width >= plan.depth else [1, 3]


def opposite(plan: Plan, item: Item, other: Placed) -> Placed | None:
    wall, along = plan.wall_of(other)
    facing = (wall + 2) % 4
    placed = plan.try_at_wall(item, facing, along, item.size[1] / 2 + 0.006, None, 0.04)
    return placed or plan.against_wall(item, [facing, (wall + 1) % 4, (wall + 3) % 4])


def seating_and_television(plan: Plan) -> None:
    sofa = seating(plan)
    item = plan.new("tv-stand")
    stand = opposite(plan, item, sofa) if sofa else plan.against_wall(item)
    if stand is None:
        return
    if plan.rng.random() < 0.7:
        plan.on(plan.new("tv-screen/tv_screen"), stand, where="centre", turn=0.0)
    else:
        plan.hang_above(plan.new("tv-screen/wall_tv"), stand, 0.95)
    stock(plan, stand, some(plan, 2, "indoor-plant", "vase", "sculpture", "candle"))
    stock(plan, stand, ["book/book_stack"], "board")


def dining_table(plan: Plan, n_chairs: int) -> Placed | None:
    """A table in the open with chairs around, laid with plates and cups."""
    table = None
    for _ in range(25):
        item = plan.new("table/table")
        x = float(plan.rng.uniform(0.35, 0.65)) * plan.width
        y = float(plan.rng.uniform(0.35, 0.65)) * plan.depth
        table = plan.try_at(item, x, y, float(plan.rng.choice([0.0, 90.0])), None, 0.6)
        if table:
            break
    if table is None:
        return None
    chairs_around(plan, table, n_chairs)
    more = some(plan, 2, "bowl", "bottle", "vase", "candle")
    stock(plan, table, ["plate", "plate", "cup", "cup", *more])
    return table


def chairs_around(plan: Plan, table: Placed, n: int) -> None:
    width, depth = table.item.size[0], table.item.size[1]
    for side in plan.shuffled(range(4))[:n]:
        chair = plan.new("chair")
        reach = (depth if side % 2 == 0 else width) / 2 + chair.size[1] / 2 + 0.04
        angle = np.deg2rad(90.0 * side)
        yaw = table.yaw + 180.0 + 90.0 * side + float(plan.rng.uniform(-5, 5))
        plan.try_by(chair, table, np.sin(angle) * reach, -np.cos(angle) * reach, yaw, 0.0)


def desk_place(plan: Plan, laptop: bool = False) -> Placed | None:
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
            yaw = np.deg2rad(desk.yaw)
            local_x = float((shown.position - desk.position) @ np.array([np.cos(yaw), np.sin(yaw), 0]))
            before_screen(plan, desk, plan.new("computer-keyboard"), local_x, 0.17)
            before_screen(plan, desk, plan.new("mouse"), local_x + 0.34, 0.17)
    more = some(plan, 3, "cup", "book/books", "book/book_stack", "tissue-paper", "indoor-plant", "bottle")
    stock(plan, desk, ["lamp/desk_lamp", *more])
    chair = plan.new("chair")
    distance, shift = float(plan.rng.uniform(0.04, 0.15)), float(plan.rng.uniform(-0.15, 0.15))
    plan.facing(chair, desk, distance, shift, jitter=8.0)
    plan.beside(plan.new("bin"), desk, 0.08)
    if not laptop:
        plan.beside(plan.new("desktop-computer"), desk, 0.05)
    return desk


def before_screen(plan: Plan, desk: Placed, item: Item, local_x: float, from_front: float) -> None:
    """On a desk at a position along it, near its front edge; elsewhere on it if that position is taken or outside."""
    spot = desk.item.spots[0]
    half = item.size[0] / 2
    placed = None
    if spot.x0 + half < local_x < spot.x1 - half:
        x, y, z = desk.to_world(np.array([local_x, spot.y0 + from_front, spot.z]))
        placed = plan.try_on(item, desk, (x, y, z + GAP_M), desk.yaw, 0.005)
    if placed is None:
        plan.on(item, desk, turn=3.0)


def bed_place(plan: Plan) -> None:
    """A bed with bedding on a rug, a nightstand with a lamp on either side, a picture above."""
    item = plan.new("bed")
    bed = plan.against_wall(item, gap=0.3) or plan.against_wall(item)
    if bed is None:
        return
    if plan.facing(plan.new("rug"), bed, -0.7, turn=0.0) is None:
        plan.facing(plan.new("rug"), bed, -0.9, turn=0.0)
    for _ in range(2):
        stand = plan.beside(plan.new("nightstand"), bed, 0.07)
        stock(plan, stand, ["lamp/table_lamp", *some(plan, 1, "book/book_stack", "cup", "tissue-paper", "candle")])
    bedding(plan, bed)
    plan.on(plan.new("cushion/flat_cushion"), bed, "seat", turn=20.0)
    plan.hang_above(plan.new("picture"), bed, 1.35)


def bed_in_the_corner(plan: Plan) -> None:
    bed = plan.against_wall(plan.new("bed"), gap=0.2, corner=True)
    if bed:
        bedding(plan, bed)
        stock(plan, plan.beside(plan.new("nightstand"), bed, 0.07), ["lamp/table_lamp", "cup"])


def wardrobe_and_storage(plan: Plan) -> None:
    """A wardrobe, a cabinet, and a shelf or a desk."""
    wardrobe = plan.against_wall(plan.new("wardrobe"))
    stocked_cabinet(plan, 4)
    if wardrobe is None or plan.rng.random() < 0.5:
        stocked_shelf(plan, n=6)
    else:
        desk_place(plan, laptop=True)


def two_desks(plan: Plan) -> None:
    for laptop in (False, bool(plan.rng.random() < 0.4)):
        desk_place(plan, laptop)


def desk_or_laptop(plan: Plan) -> None:
    desk_place(plan, laptop=bool(plan.rng.random() < 0.5))


def sofa_or_bench(plan: Plan) -> None:
    if plan.rng.random() < 0.6:
        sofa = plan.against_wall(plan.new("sofa"))
        if sofa:
            cushions(plan, sofa, 2)
    else:
        stocked(plan, "bench", ["cushion/flat_cushion"], role="seat", turn=5.0)


def bath_sink_and_toilet(plan: Plan) -> None:
    """A bathtub with a mat, a sink with a towel beside it, a toilet with a bin."""
    tub = plan.against_wall(plan.new("bathtub"), long_walls(plan), 0.02, corner=True)
    sink_item = plan.new("sink/pedestal_sink")
    sink = plan.against_wall(sink_item, gap=0.5) or plan.against_wall(sink_item, gap=0.1)
    if sink:
        for side in (-1, 1):
            towel = plan.new("towel/towel_rail")
            if plan.hang_above(towel, sink, 0.85, side * (sink_item.size[0] / 2 + towel.size[0] / 2 + 0.07)):
                break
    toilet = plan.against_wall(plan.new("toilet"), gap=0.18)
    if toilet:
        plan.beside(plan.new("bin"), toilet, 0.12)
    if tub:
        plan.facing(plan.new("mat"), tub, 0.05, turn=0.0)


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
    sink = at_cabinet(plan, top, below_sink, plan.new("sink/kitchen_sink"))
    stove = at_cabinet(plan, top, below_stove, plan.new("cooktop"))
    if stove:
        for name in ("pan", "pot"):
            plan.on(plan.new(name), stove, "burner", "centre", turn=12.0, gap=0.0)
    if sink:
        beside_on(plan, top, sink, plan.new("towel/folded_towel"))
    plan.on(plan.new("microwave"), top, where="back", turn=3.0)
    for name in ("chopping-board", "knife-block", "paper-towel", "bottle", "bowl", "cup", "plate", "indoor-plant"):
        plan.on(plan.new(name), top, turn=6.0)
    for cabinet in run:
        if plan.rng.random() < 0.8:
            plan.hang_above(plan.new("wall-cabinet", colour=run[0].item.colour), cabinet, 1.5)


def at_cabinet(plan: Plan, top: Placed, cabinet: Placed, item: Item) -> Placed | None:
    """On the slab, centred over one cabinet."""
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
