"""Every relation rule on both sides of each threshold, by hand; all users of relations give the same answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bedroom_map import box

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.rooms.dataset import DEFAULT_SCENES, Rooms
from su3d_bench.numerics.relations import (
    BAND,
    RELATIONS,
    Relation,
    Relations,
    bearing_rad,
    gap_m,
    is_between,
    is_left_of,
    may_be_between,
)
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import Solver

FLOOR = box(-5, -5, -0.1, 10, 10, 0.1)


def holds(relation: Relation, a: Float64Array, b: Float64Array, *others: Float64Array, name: str = "thing") -> bool:
    """Whether ``a`` is in the relation to ``b``, which is named ``name``, on a floor at 0 among ``others``."""
    boxes = np.array([a, b, FLOOR, *others])
    names = ["thing", name, "floor", *["thing"] * len(others)]
    return bool(Relations(boxes, names).of(relation)[0, 1])


def moved(bounds: Float64Array, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64Array:
    placed: Float64Array = bounds + np.array([x, y, z])
    return placed


TABLE, CUP = box(0, 0, 0, 1, 1, 0.7), box(0.4, 0.4, 0.7, 0.1, 0.1, 0.1)
SHELF = box(0, 0, 0, 1, 0.3, 1.8)
BOOK = box(0.2, 0.05, 0.9, 0.2, 0.2, 0.3)  # on an inner board
PICTURE = box(0.2, 0.97, 1.2, 0.6, 0.03, 0.5)


@pytest.mark.parametrize(
    ("relation", "a", "b", "is_so"),
    [
        # on: contact of 0.04 m, 0.3 of the smaller footprint
        ("on", CUP, TABLE, True),
        ("on", TABLE, CUP, False),
        ("on", moved(CUP, z=0.039), TABLE, True),
        ("on", moved(CUP, z=0.041), TABLE, False),
        ("on", moved(CUP, x=0.56), TABLE, True),  # 0.4 of the cup is over the table
        ("on", moved(CUP, x=0.58), TABLE, False),  # 0.2
        ("on", BOOK, SHELF, True),
        ("on", moved(BOOK, z=-0.84), SHELF, True),  # 0.06 m above the foot: an inner board
        ("on", moved(BOOK, z=-0.86), SHELF, False),  # 0.04 m: it stands on the floor
        ("on", moved(BOOK, y=-0.12), SHELF, False),  # 0.65 of it inside
        # under: what carries it, what has it above, what stands on the ground that it covers
        ("under", TABLE, CUP, True),
        ("under", CUP, TABLE, False),
        ("under", box(0.3, 0.3, 0, 0.3, 0.3, 0.4), TABLE, True),
        ("under", box(0.78, 0.3, 0, 0.3, 0.3, 0.4), TABLE, True),  # 0.73 of its ground is covered
        ("under", box(0.82, 0.3, 0, 0.3, 0.3, 0.4), TABLE, False),  # 0.6
        ("under", box(0.3, 0.3, 0, 0.3, 0.3, 0.8), TABLE, False),  # it reaches higher
        # above: half of it or its centre, at most a metre, not resting
        ("above", PICTURE, TABLE, True),
        ("above", moved(PICTURE, z=0.49), TABLE, True),  # 0.99 m of air
        ("above", moved(PICTURE, z=0.51), TABLE, False),
        ("above", moved(PICTURE, x=0.58), TABLE, True),  # 0.53 of it is over the table grown by 0.1 m
        ("above", moved(PICTURE, x=0.85), TABLE, False),
        ("above", CUP, TABLE, False),
        ("under", TABLE, PICTURE, True),
        # next to: half the longer side of the smaller one, from 0.1 to 0.5 m
        ("next to", box(1.24, 0, 0, 0.5, 0.5, 0.9), TABLE, True),  # 0.24 m apart
        ("next to", box(1.26, 0, 0, 0.5, 0.5, 0.9), TABLE, False),
        ("next to", box(1.49, 0, 0, 1.5, 1, 0.9), TABLE, True),
        ("next to", box(1.51, 0, 0, 1.5, 1, 0.9), TABLE, False),
        ("next to", box(1.09, 0, 0, 0.1, 0.1, 0.2), TABLE, True),
        ("next to", box(1.11, 0, 0, 0.1, 0.1, 0.2), TABLE, False),
        ("next to", box(1.1, 0, 0, 1.0, 0.5, 0.02), TABLE, False),  # a rug is part of the floor
        ("next to", CUP, TABLE, False),
        ("next to", box(0.9, 0, 0, 0.5, 0.5, 0.9), TABLE, True),  # pushed under it by a fifth
        ("next to", box(0.8, 0, 0, 0.5, 0.5, 0.9), TABLE, False),  # by two fifths: under it
        ("next to", PICTURE, TABLE, False),  # one hangs, one stands
        ("next to", PICTURE, moved(PICTURE, x=0.85), True),
        ("next to", PICTURE, moved(PICTURE, x=0.95), False),
        ("next to", PICTURE, moved(PICTURE, y=-0.05), False),  # one hangs before the other
        # near: at most a metre from box to box
        ("near", box(1.99, 0, 0, 0.5, 0.5, 0.9), TABLE, True),
        ("near", box(2.01, 0, 0, 0.5, 0.5, 0.9), TABLE, False),
    ],
)
def test_each_relation_rule_on_both_sides_of_its_threshold(
    relation: Relation, a: Float64Array, b: Float64Array, is_so: bool
) -> None:
    assert holds(relation, a, b) is is_so


def test_object_is_in_a_container_but_on_a_shelf() -> None:
    holder, contents = box(0, 0, 0, 0.5, 0.5, 0.4), box(0.1, 0.1, 0.1, 0.2, 0.2, 0.6)
    assert holds("in", contents, holder, name="basket") and not holds("on", contents, holder, name="basket")
    assert holds("on", contents, holder, name="shelf") and not holds("in", contents, holder, name="shelf")
    assert not holds("in", moved(contents, x=0.31), holder, name="basket")  # 0.45 of it inside


def test_lower_supports_are_under_the_first_support() -> None:
    slab, cabinet = box(0, 0, 0.7, 2, 1, 0.03), box(0, 0, 0, 1, 1, 0.7)
    cup = moved(CUP, z=0.03)
    assert holds("on", cup, slab, cabinet) and holds("on", slab, cabinet, cup)
    assert not holds("on", cup, cabinet, slab)
    assert not holds("under", cabinet, cup, slab)


def test_an_object_in_between_prevents_next_to() -> None:
    chair, bin_between = box(1.24, 0, 0, 0.5, 1, 0.9), box(1.05, 0.3, 0, 0.15, 0.15, 0.3)
    assert holds("next to", chair, TABLE)
    assert not holds("next to", chair, TABLE, bin_between)
    assert holds("next to", chair, TABLE, moved(bin_between, z=2.0))  # above their heads
    assert holds("next to", bin_between, TABLE, chair)


def test_fixtures_rest_on_nothing_and_surfaces_have_no_relations() -> None:
    assert holds("on", box(0.2, 0.9, 0.71, 0.5, 0.1, 1), TABLE)
    boxes = np.array([box(0.2, 0.9, 0.71, 0.5, 0.1, 1), TABLE, FLOOR])
    relations = Relations(boxes, ["window", "table", "floor"])
    assert not relations.on[0, 1]
    assert not any(relations.of(name)[2].any() or relations.of(name)[:, 2].any() for name in RELATIONS)


def test_relation_close_to_a_threshold_is_doubtful() -> None:
    chair = box(1, 0, 0, 0.5, 0.5, 0.9)
    # from 0.25 m less a quarter, half the chair's side, to 0.5 m and a quarter, half the table's
    for gap, is_doubtful in ((0.19, False), (0.21, True), (0.62, True), (0.63, False)):
        relations = Relations(np.array([TABLE, moved(chair, x=gap), FLOOR]), ["table", "chair", "floor"])
        assert relations.doubtful("next to")[0, 1] == is_doubtful, gap
    assert BAND == 1.25
    box_on_floor = moved(BOOK, z=-0.85)  # 0.05 m above the shelf's foot: on its lowest board, or under it
    bottom = Relations(np.array([box_on_floor, SHELF, FLOOR]), ["box", "shelf", "floor"])
    assert bottom.doubtful("on")[0, 1] and bottom.doubtful("under")[0, 1]
    certain = Relations(np.array([TABLE, CUP, FLOOR]), ["table", "cup", "floor"])
    assert not certain.doubtful("on").any()
    assert [(link.subject, link.relation, link.object) for link in certain.links()] == [
        (0, "under", 1),
        (1, "on", 0),
    ]


def test_ambiguous_relation_is_doubtful() -> None:
    door, switch = box(0, 0, 0, 0.9, 0.05, 2.0), box(1.1, 0, 1.2, 0.1, 0.03, 0.1)
    beside = Relations(np.array([door, switch, FLOOR]), ["door", "switch", "floor"])
    assert not beside.next_to.any() and beside.doubtful("next to")[0, 1] and beside.doubtful("next to")[1, 0]
    mouse, bottle = box(0.1, 0.1, 0.7, 0.1, 0.1, 0.04), box(0.35, 0.1, 0.7, 0.08, 0.08, 0.3)
    for aside, is_doubtful in ((0.0, True), (0.16, True), (0.17, False)):  # 0.15, 0.31 and 0.32 m apart
        small = Relations(
            np.array([mouse, moved(bottle, x=aside), TABLE, FLOOR]), ["mouse", "bottle", "table", "floor"]
        )
        assert not small.next_to[0, 1] and small.doubtful("next to")[0, 1] == is_doubtful, aside
    chair = box(1.05, 0, 0, 0.5, 0.5, 0.9)
    by_table = Relations(np.array([moved(CUP, x=0.45), TABLE, chair, FLOOR]), ["cup", "table", "chair", "floor"])
    assert by_table.next_to[1, 2] and not by_table.doubtful("next to")[0, 2]  # the cup is never next to it
    contents = np.array([BOOK, SHELF, FLOOR])
    for name, is_doubtful in (("shelf", False), ("sofa", False), ("stand", True), ("desk", True)):
        inner = Relations(contents, ["book", name, "floor"])
        assert inner.on[0, 1] and inner.doubtful("on")[0, 1] == is_doubtful == inner.doubtful("under")[1, 0], name


def test_facts_are_usual_and_stated_once() -> None:
    counter, sink, vase = (
        box(0, 0, 0, 2, 0.6, 0.9),
        box(0.2, 0.1, 0.9, 0.5, 0.4, 0.2),
        box(1.2, 0.42, 0.9, 0.1, 0.1, 0.3),
    )
    names = ["countertop", "sink", "vase", "picture", "floor"]
    relations = Relations(np.array([counter, sink, vase, box(1, 0.55, 1.3, 0.5, 0.03, 0.5), FLOOR]), names)
    assert relations.on[1, 0] and relations.on[2, 0] and relations.above[3, 2]
    assert np.argwhere(relations.facts("on")).tolist() == [[2, 0]]  # a sink is built in
    assert relations.under[0, 2] and not relations.facts("under").any()
    assert not relations.facts("above").any()  # it hangs above the countertop, not above what stands there


def test_above_beside_the_edge_is_doubtful() -> None:
    lamp, clock = box(0.01, 0.02, 0, 0.41, 0.42, 1.63), box(0.33, 0, 1.85, 0.36, 0.04, 0.36)
    # its centre is 0.09 m or 0.02 m beside the lamp, or above it
    for aside, is_doubtful in ((0.0, True), (-0.07, True), (-0.15, False)):
        relations = Relations(np.array([moved(clock, x=aside), lamp, FLOOR]), ["clock", "lamp", "floor"])
        assert relations.above[0, 1] and relations.doubtful("above")[0, 1] == is_doubtful
    behind = Relations(np.array([moved(PICTURE, y=0.07), TABLE, FLOOR]), ["picture", "table", "floor"])
    assert behind.above[0, 1] and not behind.doubtful("above")[0, 1]  # on the wall, 0.05 m behind the table


def test_between_requires_the_line_and_the_same_height() -> None:
    a, b = box(-0.5, -0.5, 0, 1, 1, 1), box(3.5, -0.5, 0, 1, 1, 1)
    middle = box(1.9, -0.1, 0, 0.2, 0.2, 0.5)
    assert is_between(middle, a, b)
    assert is_between(moved(middle, y=0.04), a, b)  # the line crosses the inner half of its 0.2 m
    assert not is_between(moved(middle, y=0.06), a, b)
    assert is_between(moved(middle, x=-1.7), a, b)  # at a tenth of the 4 m line
    assert not is_between(moved(middle, x=-1.85), a, b)
    assert is_between(box(1.5, 1.5, 0, 1, 1, 1), box(0, 0, 0, 1, 1, 1), box(3, 3, 0, 1, 1, 1))  # diagonal
    assert not is_between(box(2.6, 0.4, 0, 1, 1, 1), box(0, 0, 0, 1, 1, 1), box(3, 3, 0, 1, 1, 1))
    assert not is_between(moved(middle, z=1.0), a, b)  # above them
    assert not is_between(moved(middle, x=1.9), a, b)
    assert not is_between(a, b, b)
    assert not is_between(box(1.9, -0.1, 0, 0.2, 0.2, 0.02), a, b)  # flat


def test_object_in_the_lane_may_be_between() -> None:
    a, b = box(-0.5, -0.5, 0, 1, 1, 1), box(3.75, -0.25, 0, 0.5, 0.5, 1)  # the lane narrows from 1 m to 0.5 m
    middle = box(1.9, -0.1, 0, 0.2, 0.2, 0.5)
    for aside in (0.0, 0.1, 0.5):  # half of the lane is 0.407 m where the thing begins, and half of the thing 0.1 m
        assert may_be_between(moved(middle, y=aside), a, b) and may_be_between(moved(middle, y=-aside), b, a), aside
    assert not may_be_between(moved(middle, y=0.52), a, b) and not may_be_between(moved(middle, z=1.0), a, b)
    assert not may_be_between(moved(middle, x=2.1), a, b) and not may_be_between(moved(middle, x=-2.1), a, b)
    aslant = box(0, 0, 0, 1, 1, 1), box(3, 3, 0, 1, 1, 1)
    assert may_be_between(box(2.4, 0.6, 0, 1, 1, 1), *aslant) and not is_between(box(2.4, 0.6, 0, 1, 1, 1), *aslant)
    assert not may_be_between(box(3.0, 0.0, 0, 0.9, 0.9, 1), *aslant)


def test_left_depends_on_the_viewpoint() -> None:
    eye = np.zeros(3)
    assert bearing_rad(eye, np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])) == pytest.approx(np.pi / 4)
    # The angle crosses the jump of bearings from -180 to 180 degrees.
    assert is_left_of(np.array([-1.0, -0.1, 0.0]), np.array([-1.0, 0.1, 0.0]), eye)
    assert gap_m(box(1.25, 0, 0, 0.5, 0.5, 0.9), TABLE) == pytest.approx(0.25)


@pytest.mark.parametrize("scene", DEFAULT_SCENES[:2])
def test_ground_truth_map_and_solver_agree_for_every_pair(scene: str, rooms_data: Path) -> None:
    """The rooms' ground truth, the relations of a map and the solver, over all pairs of a room."""
    truth = Rooms(rooms_data).truth(scene)
    things = [known.whole() for known in truth.objects]
    objects = SceneMap(tuple(MapObject(t.id, t.name, "", t.box.mean(axis=0), t.box) for t in things))
    of_truth = {(link.subject, link.relation, link.object) for link in truth.relations}
    solver = Solver(objects)
    for a in objects.objects:
        for b in objects.objects:
            for relation in RELATIONS:
                if a is b or relation == "near":
                    continue
                is_so = (a.id, relation, b.id) in of_truth
                assert objects.holds(relation, a, b) is is_so
                assert solver._relation_holds(a, relation, b) is is_so
