"""Groups of things that belong together: a seat with its table, a desk with its computer, a laid table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.datasets.rooms.objects.items import Item, Part
from su3d_bench.datasets.rooms.plan import GAP_M, WALL_YAW, Plan
from su3d_bench.datasets.rooms.rendering.mesh import Placed

SHELF_THINGS: tuple[str | tuple[str, str], ...] = (
    ("book", "books"), ("book", "books"), ("book", "book_stack"), "vase", "indoor-plant", "box", "sculpture", "candle",
    ("book", "books"), "bowl",
)  # fmt: skip
SMALL_DECOR: tuple[str | tuple[str, str], ...] = (
    "vase", "candle", "sculpture", "indoor-plant", ("book", "book_stack"), "bowl", "tissue-paper",
    ("lamp", "table_lamp"),
)  # fmt: skip


def stock(plan: Plan, anchor: Placed | None, wanted: Sequence[str | tuple[str, str]], role: str = "top") -> None:
    """Puts things on an anchor, as many as fit."""
    for want in wanted:
        name, model = want if isinstance(want, tuple) else (want, None)
        if anchor is not None:
            plan.on(plan.new(name, model), anchor, role)


def choose(plan: Plan, pool: Sequence[str | tuple[str, str]], n: int) -> list[str | tuple[str, str]]:
    return [pool[int(k)] for k in plan.rng.permutation(len(pool))[:n]]


def stocked_shelf(plan: Plan, extra: Sequence[str | tuple[str, str]] = (), n: int = 7) -> Placed | None:
    shelf = plan.against_wall(plan.new("shelf", "shelf"))
    if shelf:
        for want in [*extra, *choose(plan, SHELF_THINGS, n)]:
            name, model = want if isinstance(want, tuple) else (want, None)
            item = plan.new(name, model)
            if plan.on(item, shelf, "board", turn=3.0) is None:
                plan.on(item, shelf, "top", turn=3.0)
    return shelf


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


def floor_things(plan: Plan, names: Sequence[str]) -> None:
    for name in names:
        plan.somewhere(plan.new(name))


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
    return Item(item.class_name, item.colour, item.material, item.size_word, lifted, (), size)


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
    for _ in range(int(plan.rng.integers(2, 4))):
        plan.on(plan.new("cushion", "cushion"), sofa, "seat", "back", turn=6.0)
    plan.on(plan.new("blanket", "blanket"), sofa, "seat", turn=6.0)
    side = plan.beside(plan.new("table", "side_table"), sofa)
    stock(plan, side, [("lamp", "table_lamp")])
    stock(
        plan,
        low_table,
        choose(
            plan, ["cup", "bowl", ("book", "book_stack"), "candle", "plate", "tissue-paper", "laptop", "cup", "vase"], 5
        ),
    )
    plan.hang_above(plan.new("picture"), sofa, 1.3, float(plan.rng.uniform(-0.2, 0.2)))
    return sofa


def long_walls(plan: Plan) -> list[int]:
    return [0, 2] if plan.width >= plan.depth else [1, 3]


def opposite(plan: Plan, item: Item, other: Placed) -> Placed | None:
    wall, along = plan.wall_of(other)
    facing = (wall + 2) % 4
    x, y = plan.wall_point(facing, along, item.size[1] / 2 + 0.006)
    return plan.try_at(item, x, y, WALL_YAW[facing], None, 0.04) or plan.against_wall(
        item, [facing, (wall + 1) % 4, (wall + 3) % 4]
    )


def television(plan: Plan, sofa: Placed | None) -> None:
    item = plan.new("tv-stand")
    stand = opposite(plan, item, sofa) if sofa else plan.against_wall(item)
    if stand is None:
        return
    if plan.rng.random() < 0.7:
        plan.on(plan.new("tv-screen", "tv_screen"), stand, where="centre", turn=0.0)
    else:
        plan.hang_above(plan.new("tv-screen", "wall_tv"), stand, 0.95)
    stock(plan, stand, choose(plan, ["indoor-plant", "vase", "sculpture", "candle"], 2))
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
    stock(plan, table, ["plate", "plate", "cup", "cup", *choose(plan, ["bowl", "bottle", "vase", "candle"], 2)])
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
            local_x = float(
                (shown.position - desk.position)
                @ np.array([np.cos(np.deg2rad(desk.yaw)), np.sin(np.deg2rad(desk.yaw)), 0])
            )
            before_screen(plan, desk, plan.new("computer-keyboard"), local_x, 0.17)
            before_screen(plan, desk, plan.new("mouse"), local_x + 0.34, 0.17)
    stock(
        plan,
        desk,
        [
            ("lamp", "desk_lamp"),
            *choose(
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


def before_screen(plan: Plan, desk: Placed, item: Item, local_x: float, from_front: float) -> None:
    """On a desk, at a place along it, near its front edge; elsewhere on it where that place is taken or beyond it."""
    spot = desk.item.spots[0]
    half = item.size[0] / 2
    found = None
    if spot.x0 + half < local_x < spot.x1 - half:
        x, y, z = desk.to_world(np.array([local_x, spot.y0 + from_front, spot.z]))
        found = plan.try_at(item, float(x), float(y), desk.yaw, float(z) + GAP_M, 0.005, "object", ignore=[desk.id])
    if found:
        plan.parent[found.id] = (desk.id, "on")
    else:
        plan.on(item, desk, turn=3.0)


def cushioned_bench(plan: Plan) -> None:
    """A bench with a flat cushion on it."""
    bench = plan.against_wall(plan.new("bench"))
    if bench:
        plan.on(plan.new("cushion", "flat_cushion"), bench, "seat", turn=5.0)


def bath_shelf(plan: Plan) -> Placed | None:
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
