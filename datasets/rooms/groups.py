"""Groups of things that belong together: a seat with its table, a desk with its computer, a laid table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Item, Part
from su3d_bench.datasets.rooms.plan import GAP_M, Plan
from su3d_bench.datasets.rooms.rendering.mesh import Placed

Wanted = str | tuple[str, str]  # a class, or a class and which of its models
SHELF_THINGS: tuple[Wanted, ...] = (
    ("book", "books"), ("book", "books"), ("book", "book_stack"), "vase", "indoor-plant", "box", "sculpture", "candle",
    ("book", "books"), "bowl",
)  # fmt: skip
SMALL_DECOR: tuple[Wanted, ...] = (
    "vase", "candle", "sculpture", "indoor-plant", ("book", "book_stack"), "bowl", "tissue-paper",
    ("lamp", "table_lamp"),
)  # fmt: skip


def stock(plan: Plan, anchor: Placed | None, wanted: Sequence[Wanted], role: str = "top", turn: float = 8.0) -> None:
    """Puts things on an anchor, as many as fit."""
    for want in wanted:
        if anchor is not None:
            plan.on(new(plan, want), anchor, role, turn=turn)


def some(plan: Plan, n: int, *wanted: Wanted) -> list[Wanted]:
    return plan.shuffled(wanted)[:n]


def new(plan: Plan, want: Wanted) -> Item:
    return plan.new(want) if isinstance(want, str) else plan.new(*want)


def stocked_shelf(plan: Plan, extra: Sequence[Wanted] = (), n: int = 7) -> None:
    shelf = plan.against_wall(plan.new("shelf", "shelf"))
    if shelf:
        for want in [*extra, *some(plan, n, *SHELF_THINGS)]:
            item = new(plan, want)
            if plan.on(item, shelf, "board", turn=3.0) is None:
                plan.on(item, shelf, "top", turn=3.0)


def stocked_cabinet(plan: Plan, pool: Sequence[Wanted], n: int, extra: Sequence[Wanted] = ()) -> None:
    """A cabinet with the ``extra`` things and ``n`` of the ``pool`` on it."""
    cabinet = plan.against_wall(plan.new("cabinet"))
    stock(plan, cabinet, [*extra, *some(plan, n, *pool)])


def stocked_wall_shelf(plan: Plan, wanted: Sequence[Wanted], z: float = 1.45, turn: float = 8.0) -> None:
    stock(plan, plan.hang_somewhere(plan.new("shelf", "wall_shelf"), z), wanted, turn=turn)


def bedding(plan: Plan, bed: Placed) -> None:
    for side in ("left", "right"):
        plan.on(plan.new("pillow"), bed, "head", side, turn=3.0, gap=0.0)
    plan.on(plan.new("blanket", "blanket"), bed, "seat", turn=6.0)


def cushions(plan: Plan, sofa: Placed, n: int) -> None:
    for _ in range(n):
        plan.on(plan.new("cushion", "cushion"), sofa, "seat", "back", turn=6.0)


def wall_things(plan: Plan, n_pictures: int, clock: bool = True, n_plugs: int = 2) -> None:
    for _ in range(n_pictures):
        plan.hang_somewhere(plan.new("picture"), float(plan.rng.uniform(1.35, 1.55)))
    if clock:
        plan.hang_somewhere(plan.new("clock"), float(plan.rng.uniform(1.65, 1.9)))
    for _ in range(n_plugs):
        plan.hang_somewhere(plan.new("wall-plug"), float(plan.rng.uniform(0.24, 0.3)))
    plan.hang_somewhere(plan.new("vent"), plan.height - 0.42)


def hang_ceiling_lamp(plan: Plan, x: float, y: float) -> Placed | None:
    lamp = plan.new("lamp", "ceiling_lamp")
    return plan.try_at(lamp, x, y, 0.0, plan.height - lamp.size[2] - 2 * GAP_M, 0.0, "ceiling")


def floor_things(plan: Plan, wanted: Sequence[Wanted]) -> None:
    for want in wanted:
        plan.somewhere(new(plan, want))


def filled_basket(plan: Plan, content: str) -> None:
    """A basket from which a rolled towel or blanket sticks out."""
    basket = plan.somewhere(plan.new("basket"))
    if basket:
        for _ in range(2):
            plan.on(stood_up(plan.new(content, f"rolled_{content}")), basket, "inside", turn=0.0)


def stood_up(item: Item) -> Item:
    """A roll set on its end."""
    parts = [Part(part.shape.turned("y", 90), part.material) for part in item.parts]
    low = min(float(part.shape.quads[..., 2].min()) for part in parts)
    lifted = tuple(Part(part.shape.moved(z=-low), part.material) for part in parts)
    size = np.array([item.size[2], item.size[1], item.size[0]])
    return Item(item.class_name, item.colour, item.material, item.size_word, lifted, (), size, item.model)


def plant_on_stand(plan: Plan) -> None:
    stand = plan.somewhere(plan.new("plant-stand"))
    if stand is None:
        return
    for _ in range(8):
        if plan.on(plan.new("indoor-plant"), stand, where="centre", turn=90.0):
            return


def seating(plan: Plan) -> Placed | None:
    """A sofa with cushions and blanket, a coffee table on a rug before it, a small table with a lamp beside it."""
    sofa_item = plan.new("sofa")
    sofa = plan.against_wall(sofa_item, long_walls(plan)) or plan.against_wall(sofa_item)
    if sofa is None:
        return None
    rug = plan.new("rug")
    if plan.facing(rug, sofa, 0.08, turn=0.0) is None:
        plan.facing(plan.new("rug"), sofa, 0.03, turn=0.0)
    low_table = plan.facing(plan.new("table", "coffee_table"), sofa, float(plan.rng.uniform(0.42, 0.52)), turn=0.0)
    cushions(plan, sofa, int(plan.rng.integers(2, 4)))
    plan.on(plan.new("blanket", "blanket"), sofa, "seat", turn=6.0)
    side = plan.beside(plan.new("table", "side_table"), sofa)
    stock(plan, side, [("lamp", "table_lamp")])
    stack = "book", "book_stack"
    more = some(plan, 5, "cup", "bowl", stack, "candle", "plate", "tissue-paper", "laptop", "cup", "vase")
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


def television(plan: Plan, sofa: Placed | None) -> None:
    item = plan.new("tv-stand")
    stand = opposite(plan, item, sofa) if sofa else plan.against_wall(item)
    if stand is None:
        return
    if plan.rng.random() < 0.7:
        plan.on(plan.new("tv-screen", "tv_screen"), stand, where="centre", turn=0.0)
    else:
        plan.hang_above(plan.new("tv-screen", "wall_tv"), stand, 0.95)
    stock(plan, stand, some(plan, 2, "indoor-plant", "vase", "sculpture", "candle"))
    stock(plan, stand, [("book", "book_stack")], "board")


def dining_table(plan: Plan, n_chairs: int) -> Placed | None:
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
    more = some(plan, 3, "cup", ("book", "books"), ("book", "book_stack"), "tissue-paper", "indoor-plant", "bottle")
    stock(plan, desk, [("lamp", "desk_lamp"), *more])
    chair = plan.new("chair")
    distance, shift = float(plan.rng.uniform(0.04, 0.15)), float(plan.rng.uniform(-0.15, 0.15))
    plan.facing(chair, desk, distance, shift, jitter=8.0)
    plan.beside(plan.new("bin"), desk, 0.08)
    if not laptop:
        plan.beside(plan.new("desktop-computer"), desk, 0.05)
    return desk


def before_screen(plan: Plan, desk: Placed, item: Item, local_x: float, from_front: float) -> None:
    """On a desk, at a place along it, near its front edge; elsewhere on it where that place is taken or beyond it."""
    spot = desk.item.spots[0]
    half = item.size[0] / 2
    placed = None
    if spot.x0 + half < local_x < spot.x1 - half:
        x, y, z = desk.to_world(np.array([local_x, spot.y0 + from_front, spot.z]))
        placed = plan.try_on(item, desk, (x, y, z + GAP_M), desk.yaw, 0.005)
    if placed is None:
        plan.on(item, desk, turn=3.0)


def cushioned_bench(plan: Plan) -> None:
    """A bench with a flat cushion on it."""
    bench = plan.against_wall(plan.new("bench"))
    if bench:
        plan.on(plan.new("cushion", "flat_cushion"), bench, "seat", turn=5.0)


def bath_shelf(plan: Plan) -> None:
    towels = [("towel", "folded_towel"), ("towel", "folded_towel"), ("towel", "rolled_towel")]
    shelf = plan.against_wall(plan.new("shelf", "shelf"))
    stock(plan, shelf, [*towels, "bottle", "indoor-plant", "candle", "tissue-paper"], "board", turn=3.0)
