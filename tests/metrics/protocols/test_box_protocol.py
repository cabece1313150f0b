"""Protocols of kind ``boxes``: overlaps in closed form, counts by hand, and an independent check of each value."""

from __future__ import annotations

import math

import numpy as np
import pytest

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, GroundTruth, LabelSet, ObjectBoxes, OrientedBox
from su3d_bench.datasets.replica.checks import box_truth
from su3d_bench.metrics.instance.boxes import BoxCounts, box_iou, count_boxes, shared_volume, smallest_box
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, metric_of, score_scene

RULES = load_protocol("replica-boxes")
IDS = {entry.name: entry.id for entry in RULES.classes}
WALL = 93
LABELS = LabelSet("replica", (*IDS.values(), WALL), (*IDS, "wall"))


def turn(*degrees: float) -> Float64Array:
    """The rotation about z, then y, then x, in degrees."""
    whole = np.eye(3)
    for axis, angle in zip((2, 1, 0), np.radians(degrees), strict=False):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        one = np.eye(3)
        one[[u, v], [u, v]] = np.cos(angle)
        one[u, v], one[v, u] = -np.sin(angle), np.sin(angle)
        whole = one @ whole
    return whole


def box(centre: tuple[float, ...], sizes: tuple[float, ...], rotation: Float64Array | None = None) -> OrientedBox:
    return OrientedBox(np.array(centre), np.array(sizes), np.eye(3) if rotation is None else rotation)


# ---- overlaps

UNIT = box((0, 0, 0), (1, 1, 1))
OCTAGON = 2 * (math.sqrt(2) - 1)  # a unit square and its copy rotated by 45 degrees share a regular octagon


@pytest.mark.parametrize(
    ("first", "second", "shared"),
    [
        (UNIT, UNIT, 1.0),
        (UNIT, box((0.5, 0, 0), (1, 1, 1)), 0.5),
        (UNIT, box((0.5, 0.5, 0.5), (1, 1, 1)), 0.125),
        (UNIT, box((1, 0, 0), (1, 1, 1)), 0.0),
        (UNIT, box((5, 0, 0), (1, 1, 1), turn(30)), 0.0),
        (UNIT, box((0, 0, 0), (0.5, 0.2, 0.1), turn(20, 30, 40)), 0.01),
        (UNIT, box((0, 0, 0), (9, 9, 9), turn(20, 30, 40)), 1.0),
        (UNIT, box((0, 0, 0), (1, 1, 1), turn(90)), 1.0),
        (UNIT, box((0, 0, 0), (1, 1, 1), turn(45)), OCTAGON),
        (UNIT, box((0, 0, 0.75), (1, 1, 1), turn(45)), OCTAGON / 4),
        (box((3, 4, 5), (1, 1, 1), turn(10)), box((3, 4, 5), (1, 1, 1), turn(55)), OCTAGON),
        # a long bar along the diagonal of the xy plane: a hexagonal slice of width w is sqrt(2) w - w^2 / 2 of a square
        (UNIT, box((0, 0, 0), (9, 0.2, 9), turn(45)), math.sqrt(2) * 0.2 - 0.02),
        (UNIT, box((0, 0, 0), (1, 1, 0), turn(45)), 0.0),
    ],
)
def test_shared_volume_of_boxes_equals_the_formula(first: OrientedBox, second: OrientedBox, shared: float) -> None:
    for one, other in ((first, second), (second, first)):
        assert shared_volume(one, other) == pytest.approx(shared, abs=1e-12)
        either = float(np.prod(one.sizes) + np.prod(other.sizes)) - shared
        assert box_iou(one, other) == pytest.approx(shared / either, abs=1e-12)


def test_corner_cut_across_the_space_diagonal_has_its_volume() -> None:
    """A half space whose boundary meets each edge at distance t from a cube's corner cuts off t^3 / 6."""
    normal = np.ones(3) / math.sqrt(3)
    first = np.array([1.0, -1.0, 0.0]) / math.sqrt(2)
    axes = np.stack([first, np.cross(normal, first), normal], axis=1)
    for t in (0.1, 0.5, 1.0):
        border = (1.5 - t) / math.sqrt(3)
        beyond = OrientedBox(normal * (border + 10), np.array([40.0, 40.0, 20.0]), axes)
        assert shared_volume(UNIT, beyond) == pytest.approx(t**3 / 6, abs=1e-12)


def test_shared_volume_of_random_boxes_equals_the_half_space_hull() -> None:
    from scipy.optimize import linprog
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    rng = np.random.default_rng(4)
    n_met = 0
    for _ in range(150):
        pair = [
            OrientedBox(rng.uniform(-0.7, 0.7, 3), rng.uniform(0.3, 2, 3), turn(*rng.uniform(-180, 180, 3)))
            for _ in range(2)
        ]
        sides = np.concatenate(
            [
                np.column_stack([s * one.rotation.T, -s * one.rotation.T @ one.centre - one.sizes / 2])
                for one in pair
                for s in (1, -1)
            ]
        )
        inner = linprog(
            [0, 0, 0, -1],
            A_ub=np.column_stack([sides[:, :3], np.ones(12)]),
            b_ub=-sides[:, 3],
            bounds=[(None, None)] * 4,
        )
        expected = 0.0
        if inner.x[3] > 1e-9:
            expected = ConvexHull(HalfspaceIntersection(sides, inner.x[:3]).intersections).volume
            n_met += 1
        assert shared_volume(*pair) == pytest.approx(expected, abs=1e-9)
        assert shared_volume(*pair) == pytest.approx(shared_volume(*pair[::-1]), abs=1e-12)
    assert n_met > 100


def test_smallest_box_of_box_corners_is_the_box() -> None:
    turned = box((1, 2, 3), (0.5, 1, 2), turn(20, 30, 40))
    found = smallest_box(turned.corners, turned.rotation)
    np.testing.assert_allclose(found.centre, turned.centre, atol=1e-12)
    np.testing.assert_allclose(found.sizes, turned.sizes, atol=1e-12)


# ---- counts and curves


def counted(
    iou: list[list[float]], true: list[int], called: list[int], scores: list[float], n_classes: int = 2
) -> BoxCounts:
    table = np.array(iou, float).reshape(len(called), len(true))
    return count_boxes(table, table > 0, np.array(true, int), np.array(called, int), np.array(scores), n_classes)


def values(*counts: BoxCounts, rules: ProtocolRules | None = None) -> dict[str, float]:
    rules = rules or RULES.model_copy(update={"classes": RULES.classes[: len(counts[0].n_truth)]})
    return metric_of(rules).combine(list(counts))


def test_more_confident_of_two_instances_on_one_box_is_right() -> None:
    both = values(counted([[0.9], [0.6]], [0], [0, 0], [0.4, 0.8]))
    assert (both["AP25"], both["AP50"], both["recall50"], both["precision50"]) == (1.0, 1.0, 1.0, 0.5)
    # the more confident one is too loose for 0.5 and counts in the curve as a wrong one
    loose = values(counted([[0.9], [0.4]], [0], [0, 0], [0.4, 0.8]))
    assert (loose["AP25"], loose["AP50"], loose["recall50"]) == (1.0, 0.5, 1.0)


def test_instance_whose_best_box_is_taken_is_wrong_even_if_another_is_free() -> None:
    found = values(counted([[0.9, 0.0], [0.7, 0.6]], [0, 0], [0, 0], [0.9, 0.8]))
    assert (found["AP50"], found["recall50"], found["precision50"], found["centroid"]) == (0.5, 0.5, 0.5, 1.0)


def test_an_iou_must_be_above_its_threshold() -> None:
    found = values(counted([[0.5]], [0], [0], [1.0]))
    assert (found["AP25"], found["AP50"]) == (1.0, 0.0)
    assert values(counted([[0.25]], [0], [0], [1.0]))["AP25"] == 0.0


def test_instances_of_equal_confidence_enter_the_curve_together_in_any_order() -> None:
    rows, true = [[0.9, 0.0], [0.0, 0.0], [0.0, 0.8]], [0, 0]
    for order in ([0, 1, 2], [1, 0, 2], [2, 1, 0]):
        found = values(counted([rows[k] for k in order], true, [0, 0, 0], [1.0] * 3))
        assert found["AP50"] == pytest.approx(2 / 3) and found["recall50"] == 1.0


def test_area_is_computed_under_the_envelope() -> None:
    """Right, wrong, right of three boxes: precision 1 up to a third, then 2/3 up to two thirds."""
    found = values(counted([[0.9, 0, 0], [0, 0, 0], [0, 0.9, 0]], [0, 0, 0], [0, 0, 0], [0.9, 0.8, 0.7]))
    assert found["AP50"] == pytest.approx(1 / 3 + 2 / 3 / 3)


def test_absent_class_is_ignored_and_unpredicted_class_scores_zero() -> None:
    found = values(counted([[0.9, 0.0]], [0, 1], [0], [1.0], 3))
    assert (found["AP50"], found["recall50"], found["precision50"], found["centroid"]) == (0.5, 0.5, 1.0, 0.5)
    # an instance of a class without a box lowers only precision
    wrong = values(counted([[0.9, 0.0], [0.0, 0.0]], [0, 1], [0, 2], [1.0, 1.0], 3))
    assert (wrong["AP50"], wrong["precision50"]) == (0.5, 0.5)


def test_empty_map_scores_zero_and_scene_without_boxes_is_undefined() -> None:
    empty = values(counted([], [0, 1], [], []))
    assert {empty[name] for name in ("AP25", "AP50", "centroid", "recall25", "recall50")} == {0.0}
    assert all(math.isnan(empty[name]) for name in ("class", "precision25", "precision50"))
    nothing = values(counted([[]], [], [0], [1.0]))
    assert nothing["precision50"] == 0.0
    assert all(math.isnan(nothing[name]) for name in ("AP25", "AP50", "centroid", "class", "recall25"))


def test_the_class_is_that_of_the_best_instance_on_a_box() -> None:
    assert values(counted([[0.3], [0.9]], [0], [1, 0], [0.9, 0.5]))["class"] == 0.0
    assert values(counted([[0.2], [0.9]], [0], [1, 0], [0.9, 0.5]))["class"] == 1.0  # the first one finds nothing
    assert values(counted([[0.3], [0.9]], [0], [1, 0], [0.5, 0.5]))["class"] == 1.0  # on ties the better IoU
    assert values(counted([[0.9]], [0], [-1], [0.5]))["class"] == 0.0  # of none of the classes


# ---- scenes


def truth_of(*objects: tuple[str, OrientedBox]) -> GroundTruth:
    ids = {**IDS, "wall": WALL}
    boxes = {k + 1: one for k, (_, one) in enumerate(objects)}
    return box_truth(ObjectBoxes(boxes, {k + 1: ids[name] for k, (name, _) in enumerate(objects)}, LABELS))


def map_of(*instances: tuple[str, OrientedBox, float]) -> Instances:
    """A map with the corners of boxes as instances."""
    points = np.concatenate([np.zeros((0, 3)), *(one.corners for _, one, _ in instances)]).astype(np.float32)
    masks = [np.arange(8 * k, 8 * k + 8) for k in range(len(instances))]
    scores = np.array([score for _, _, score in instances])
    return Instances.of(points, masks, scores, labels=tuple(name for name, _, _ in instances))


CHAIR, SOFA = box((0, 0, 0), (1, 1, 1), turn(30, 20, 10)), box((4, 0, 0), (2, 1, 1), turn(-50))


def score_of(truth: GroundTruth, prediction: Instances, rules: ProtocolRules = RULES) -> SceneScore:
    return score_scene(rules, truth, prediction, None)


def test_perfect_instances_score_one_for_any_rotation() -> None:
    truth = truth_of(("chair", CHAIR), ("sofa", SOFA), ("wall", box((0, 9, 0), (9, 0.1, 3))))
    result = combine(RULES, {"a": score_of(truth, map_of(("chair", CHAIR, 0.9), ("sofa", SOFA, 0.3)))})
    assert set(result.metrics.values()) == {1.0}
    assert set(result.per_class["chair"].values()) == {1.0} and math.isnan(result.per_class["lamp"]["AP25"])
    assert all(math.isnan(share) for share in result.coverage.values())


def test_rotated_object_has_the_analytic_iou_along_world_axes() -> None:
    """A cube rotated by 45 degrees about z fills half of its axis-aligned box."""
    turned = box((1, 2, 3), (1, 1, 1), turn(45))
    truth, prediction = truth_of(("chair", turned)), map_of(("chair", turned, 1.0))
    along_truth, along_world = (
        combine(rules, {"a": score_of(truth, prediction, rules)}).metrics
        for rules in (RULES, RULES.model_copy(update={"box_axes": "world"}))
    )
    assert (along_truth["AP50"], along_world["AP25"]) == (1.0, 1.0)
    flat = truth_of(("chair", box((1, 2, 3), (1, 1, 0.98), turn(45))))  # now below a half
    assert combine(RULES, {"a": score_of(flat, prediction)}).metrics["AP50"] == 1.0
    rules = RULES.model_copy(update={"box_axes": "world"})
    assert combine(rules, {"a": score_of(flat, prediction, rules)}).metrics["AP50"] == 0.0


def test_centroid_outside_box_wrong_class_and_few_points_are_counted() -> None:
    truth = truth_of(("chair", CHAIR), ("sofa", SOFA))
    beside = map_of(("chair", box((1.2, 0, 0), (1, 1, 1)), 1.0), ("table", SOFA, 0.5))
    metrics = combine(RULES, {"a": score_of(truth, beside)}).metrics
    assert (metrics["centroid"], metrics["class"], metrics["AP25"], metrics["precision25"]) == (0.0, 0.0, 0.0, 0.0)
    unknown = combine(RULES, {"a": score_of(truth, map_of(("unicorn", CHAIR, 1.0)))}).metrics
    assert (unknown["AP25"], unknown["centroid"], unknown["class"]) == (0.0, 0.0, 0.0)
    few = Instances.of(CHAIR.corners[:4].astype(np.float32), [np.arange(4)], labels=("chair",))
    counts = score_of(truth, few).counts
    assert isinstance(counts, BoxCounts) and not len(counts.score)
