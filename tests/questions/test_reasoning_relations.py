"""Relations of boxes and the judging of answers, worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bedroom_map import bedroom, box, thing

from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.boxes import bearing_rad, gap_m, is_left_of, shared_ground
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.generated import GeneratedQuestion
from su3d_bench.questions.reasoning.judging import box_iou, is_right
from su3d_bench.questions.reasoning.relations import (
    holds,
    is_above,
    is_between,
    is_next_to,
    is_under,
)
from su3d_bench.questions.reasoning.scene_map import SceneMap
from su3d_bench.questions.reasoning.solver import Solver


def moved(bounds: Float64Array, x: float, y: float, z: float) -> Float64Array:
    placed: Float64Array = bounds + np.array([x, y, z])
    return placed


@pytest.fixture(scope="module")
def solver() -> Solver:
    return Solver(bedroom())


LEAST_IOU = 0.25  # the loosest overlap at which ScanNet's benchmark takes two instances for one


def same_objects(scene: SceneMap, truth: SceneMap) -> dict[int, int]:
    """Id in ``scene`` -> id in ``truth`` of the box that it overlaps most, where that is enough."""
    same = {}
    for own in scene.objects:
        overlaps = [(box_iou(own.box, other.box), -other.id) for other in truth.objects]
        iou, negative_id = max(overlaps, default=(0.0, 0))
        if iou >= LEAST_IOU:
            same[own.id] = -negative_id
    return same


def test_relations_of_two_boxes() -> None:
    table, cup = box(0, 0, 0, 1, 1, 0.7), box(0.4, 0.4, 0.7, 0.1, 0.1, 0.1)
    assert holds("on", cup, table)
    assert not holds("on", table, cup)
    assert is_under(table, cup)
    assert not holds("on", moved(cup, 0, 0, 0.1), table)  # 0.1 m of air
    assert is_above(moved(cup, 0, 0, 0.1), table)
    assert not is_above(moved(cup, 2, 0, 0.1), table)
    chair = box(1.25, 0, 0, 0.5, 0.5, 0.9)
    assert is_next_to(chair, table)
    assert not is_next_to(moved(chair, 0.1, 0, 0), table)  # 0.35 m apart
    assert not is_next_to(cup, table)
    stool = box(0.3, 0.3, 0, 0.3, 0.3, 0.4)
    assert is_under(stool, table)
    assert gap_m(chair, table) == pytest.approx(0.25)
    assert shared_ground(table, box(0.5, 0, 0, 1, 1, 1)) == pytest.approx(0.5)


def test_small_things_are_neighbours_at_a_shorter_distance() -> None:
    cup = box(0, 0, 0, 0.1, 0.1, 0.1)
    assert is_next_to(cup, moved(cup, 0.2, 0, 0))
    assert not is_next_to(cup, moved(cup, 0.3, 0, 0))


def test_a_container_holds_what_a_shelf_carries() -> None:
    holder, held = box(0, 0, 0, 0.5, 0.5, 0.4), box(0.1, 0.1, 0.1, 0.2, 0.2, 0.6)
    assert holds("in", held, holder, b_is_container=True)
    assert not holds("on", held, holder, b_is_container=True)
    assert holds("on", held, holder)
    assert not holds("in", held, holder)  # it sticks out


def test_between_and_left_are_seen_from_above() -> None:
    a, b = np.array([0.0, 0.0, 0.0]), np.array([4.0, 0.0, 0.0])
    assert is_between(np.array([2.0, 0.9, 2.0]), a, b)
    assert not is_between(np.array([2.0, 1.1, 0.0]), a, b)  # more than half of 2 m aside
    assert not is_between(np.array([4.1, 0.0, 0.0]), a, b)
    assert not is_between(a, b, b)
    eye = np.zeros(3)
    assert bearing_rad(eye, np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])) == pytest.approx(np.pi / 4)
    # The angle goes over the line where bearings jump from -180 to 180 degrees.
    assert is_left_of(np.array([-1.0, -0.1, 0.0]), np.array([-1.0, 0.1, 0.0]), eye)


def test_an_answer_is_judged_over_the_objects_that_are_the_same() -> None:
    truth = bedroom()
    # The same map with other ids, one cup lost, and the bed cut in two.
    kept = [replace(one, id=100 + one.id) for one in truth.objects if one.id not in (1, 8)]
    halves = [thing(201, "bed", box(0, 0, 0, 2, 1.0, 0.5)), thing(202, "bed", box(0, 1.0, 0, 2, 0.3, 0.5))]
    scene = SceneMap((*kept, *halves))
    same = same_objects(scene, truth)
    assert same[109] == 9
    assert same[201] == 1  # 5/8 of the bed
    assert 202 not in same  # 3/16 of it
    solver, true = Solver(scene), Solver(truth)

    def judged(text: str, kind: str) -> bool:
        return is_right(GeneratedQuestion(text, kind, true.answer(text)), solver.answer(text), same)

    assert judged("Which sink is closer to the bed?", "closer")
    assert judged("What is on the shelf?", "what on")
    assert not judged("What is on the table?", "what on")  # a cup is lost
    assert not judged("How many cups are there?", "count")
    assert judged("Is there a lamp on the table?", "is on")
    assert judged("What is the distance between the table and the basket?", "distance")
    # The nearer part of the bed is 3.43 m away, the whole one 3.68 m: a tenth is allowed.
    assert judged("What is the distance between the bed and the table?", "distance")
    far = GeneratedQuestion(
        "How far?", "distance", replace(true.answer("How far is the bed from the table?"), value=3.0)
    )
    assert not is_right(far, solver.answer("How far is the bed from the table?"), same)


def test_answers_in_words_are_judged_by_their_yes_or_number() -> None:
    truth = Solver(bedroom())

    def judged(text: str, said: str) -> bool:
        return is_right(GeneratedQuestion(text, "any", truth.answer(text)), Answer(said), {})

    assert judged("How many cups are there?", "There are 2 cups (ID #7 and #8)")
    assert not judged("How many cups are there?", "There are 3")
    assert judged("Is there a piano?", "No, there is none")
    assert not judged("Is there a piano?", "perhaps")
    assert judged("What is the distance between the bed and the table?", "about 3.7 m")


def test_boxes_overlap_by_hand() -> None:
    assert box_iou(box(0, 0, 0, 2, 1, 1), box(1, 0, 0, 2, 1, 1)) == pytest.approx(1 / 3)
    assert box_iou(box(0, 0, 0, 1, 1, 1), box(2, 0, 0, 1, 1, 1)) == 0.0
    assert box_iou(box(0, 0, 0, 0, 0, 0), box(0, 0, 0, 0, 0, 0)) == 0.0
