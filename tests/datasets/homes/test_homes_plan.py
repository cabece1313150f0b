"""Layouts and furnishing of the homes: nothing floats, collides or blocks the way; all layouts and many classes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.ndimage import label

from su3d_bench.datasets.homes.catalogue import catalogue
from su3d_bench.datasets.homes.furnish import KINDS, REPEATS, THINGS, furnish
from su3d_bench.datasets.homes.layout import LAYOUTS
from su3d_bench.datasets.homes.plan import HomePlan
from su3d_bench.datasets.homes.solids import overlap

TOUCH_M, REST_M = 0.003, 0.005


@pytest.fixture(
    scope="module", params=[range(12), pytest.param(range(500), marks=pytest.mark.proof)], ids=["12", "500"]
)
def homes(request: pytest.FixtureRequest) -> list[HomePlan]:
    return [furnish(np.random.default_rng(seed), catalogue()) for seed in request.param]


def _things(home: HomePlan) -> Iterator[int]:
    return (one.id for one in home.placed if home.mount[one.id] != "room")


def test_homes_are_full_and_varied(homes: list[HomePlan]) -> None:
    assert all(90 <= home.n_objects <= 150 for home in homes)
    names = [{one.item.class_name for one in home.placed} for home in homes]
    assert all(len(set().union(*names[k : k + 10])) >= 60 for k in range(0, len(homes) - 9, 10))
    assert {home.muted for home in homes} == {home.is_evening for home in homes} == {False, True}
    areas = [
        sum((t[1] - t[0]) * (t[3] - t[2]) for room in home.layout.rooms for t in room.tiles()[0]) for home in homes
    ]
    assert min(areas) >= 25 and max(areas) <= 60


def test_every_layout_is_drawn_and_can_be_furnished() -> None:
    drawn = {furnish(np.random.default_rng(3), catalogue(), layout=name).kind for name in LAYOUTS}
    assert drawn == set(LAYOUTS)


def test_nothing_intersects_another_object(homes: list[HomePlan]) -> None:
    for home in homes:
        solids, ids = home.solids, list(_things(home))
        for k, first in enumerate(ids):
            for second in ids[k + 1 :]:
                related = {first, second} & {*home.holders(home.placed[max(first, second) - 1])}
                if len(related) < 2 and home.boxes[first].overlaps(home.boxes[second]):
                    assert not overlap(solids[first], solids[second], TOUCH_M).any(), (home.kind, first, second)


def test_everything_rests_on_something_and_fits_its_room(homes: list[HomePlan]) -> None:
    for home in homes:
        flat = [b for i, b in home.boxes.items() if home.mount[i] == "floor" and b.high[2] < 0.05]
        for i in _things(home):
            placed, box = home.placed[i - 1], home.boxes[i]
            centre = (box.low + box.high)[:2] / 2
            room = next(room for room in home.layout.rooms if room.contains(centre))
            assert (home.solids[i].z[:, 1:] <= room.ceiling(home.solids[i].corners)).all()
            if home.mount[i] == "floor":
                levels = [0.0, *(b.high[2] for b in flat if b.overlaps(box, 0.001) or b.high[2] < box.low[2])]
            elif home.mount[i] == "ceiling":
                assert room.height - box.high[2] < REST_M
                continue
            elif home.mount[i] == "wall":
                if not placed.item.model:  # a door leaf on its hinges
                    continue
                gaps = [off - placed.item.size[1] / 2 for wall in room.walls for along, off in [
                    wall.position(placed.position[:2])] if 0 < along < wall.length and off > 0]  # fmt: skip
                is_on_wall = min(gaps) < REST_M
                assert is_on_wall or placed.item.class_name == "blinds", placed.item.class_name
                continue
            else:
                holder = home.placed[home.parent[i][0] - 1]
                spots = [holder.position[2] + s.z for s in holder.item.spots]
                levels = [*spots, home.boxes[holder.id].high[2]]
            assert min(abs(box.low[2] - level) for level in levels) < REST_M, (placed.item.class_name, home.mount[i])


def test_the_free_floor_is_one_region_that_reaches_the_doors(homes: list[HomePlan]) -> None:
    for home in homes:
        assert home.is_passable() and home.doors
        free, origin = home.free(0.05, 0.25)
        assert label(free)[1] == 1 and free.sum() * 0.05**2 > 2.0
        for door in home.doors:
            i, j = ((door - origin) / 0.05).astype(int)
            assert free[i - 2 : i + 3, j - 2 : j + 3].any() or home.layout.rooms[0].slope is not None


def test_identical_objects_are_repeated(homes: list[HomePlan]) -> None:
    repeated = [max(Counter(id(one.item) for one in home.placed).values()) >= 2 for home in homes]
    assert sum(repeated) >= 0.98 * len(homes)


def test_by_day_the_sun_shines_into_a_window(homes: list[HomePlan]) -> None:
    for home in homes:
        assert (home.sun is None) == home.is_evening and home.windows and home.lights
        if home.sun is not None:
            faces = [np.cross(window.u, window.v) for window in home.windows]
            inward = [np.dot(home.sun.direction, face) / np.linalg.norm(face) for face in faces]
            assert min(inward) < -0.3 or max(inward) > 0.3
            assert home.sun.direction[2] > 0.3


def test_same_seed_gives_the_same_home() -> None:
    first, second = (furnish(np.random.default_rng(5), catalogue()) for _ in range(2))
    assert [(p.item.model, p.yaw, p.position.tolist()) for p in first.placed] == [
        (p.item.model, p.yaw, p.position.tolist()) for p in second.placed
    ]


def test_training_homes_have_no_held_out_models() -> None:
    known = catalogue()
    for seed in range(3):
        home = furnish(np.random.default_rng(seed), known, training=True)
        for one in home.placed:
            if one.item.model:
                allowed = {model.name for model in known.models(one.item.class_name, training=True)}
                assert one.item.model in allowed


def test_recipes_name_existing_things_and_classes() -> None:
    steps = {step for kind in KINDS.values() for step in kind.steps}
    parts = {name for thing in THINGS.values() for name in (*thing.any, *thing.then, *thing.needs)}
    assert steps | parts | {"ceiling_lamp", "plug"} == set(THINGS)
    assert {name for thing in THINGS.values() for name in thing.put} | set(REPEATS) <= {"=", *catalogue().classes}
