"""Identity over time: the answers of trackeval 1.3.0 and of deeplab2's STQ to the last bit, and hand-worked values.

identity_answers.json is written by benchmarks/originals/trackeval_answers.py for the problems of synthetic_tracks.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_tracks as synthetic
from plates import SCENE, Plate, look

from su3d_bench.baselines.conceptgraphs.method import ConceptGraphs
from su3d_bench.baselines.conceptgraphs.objects import MappingConfig
from su3d_bench.baselines.sam3d.method import SAM3D, SAM3DConfig
from su3d_bench.core.errors import DataError
from su3d_bench.core.maps import Masks
from su3d_bench.core.system.timing import Timer
from su3d_bench.metrics import identity, tracked_points
from su3d_bench.metrics.identity import Step, count_tracks, label_flips, step_of, track_values
from su3d_bench.metrics.tracked_points import LabelledPoints, count_points, labelled_points, point_values

ANSWERS = json.loads(Path(__file__).with_name("identity_answers.json").read_text())
TRACKS, POINTS = ANSWERS["tracks"], ANSWERS["points"]
CURVES = [name for name in TRACKS["columns"] if not name.startswith("ID")]


@cache
def track_counts() -> list[identity.TrackCounts]:
    problems = map(synthetic.track_problem, range(synthetic.N_TRACKS))
    return [count_tracks([Step(*step) for step in problem]) for problem in problems]


def seen(*similarities: float, ids: tuple[int, ...] = (5, 6)) -> Step:
    """A step with one object."""
    return Step(np.array([1]), np.array(ids[: len(similarities)]), np.array([similarities]))


def test_hota_owta_and_idf1_equal_trackeval_to_the_last_bit() -> None:
    ours = [[track_values(each)[name] for name in TRACKS["columns"]] for each in track_counts()]
    assert ours == TRACKS["values"][: synthetic.N_TRACKS]
    assert len({*map(tuple, ours)}) > 350 and len(ours) == 500


def test_values_at_each_threshold_and_of_joined_sequences_equal_trackeval() -> None:
    whole = identity.TrackCounts.joined(track_counts())
    chosen = [*track_counts()[: synthetic.N_CURVES], whole]
    ours = np.array([[identity.track_curves(each)[name] for name in CURVES] for each in chosen])
    np.testing.assert_array_equal(ours[:-1], TRACKS["curves"][:-1])
    np.testing.assert_allclose(ours[-1], TRACKS["curves"][-1], rtol=0, atol=1e-12)
    values = [track_values(whole)[name] for name in TRACKS["columns"]]
    np.testing.assert_allclose(values, TRACKS["values"][-1], rtol=0, atol=1e-12)


def test_stq_equals_deeplab2_to_the_last_bit_and_joined_to_1e_12() -> None:
    rows = np.array(POINTS["values"], np.float64).reshape(-1, synthetic.N_TOGETHER + 1, 3)
    for group, answers in enumerate(rows):
        counts = []
        for seed in range(group * synthetic.N_TOGETHER, (group + 1) * synthetic.N_TOGETHER):
            steps = [LabelledPoints(*step) for step in synthetic.point_problem(seed)]
            counts.append(count_points(steps, synthetic.is_thing(seed)))
        whole = point_values(tracked_points.PointCounts.joined(counts))
        ours = np.array(
            [[values[name] for name in POINTS["columns"]] for values in [*map(point_values, counts), whole]]
        )
        np.testing.assert_array_equal(ours[:-1], answers[:-1])
        np.testing.assert_allclose(ours[-1], answers[-1], rtol=0, atol=1e-12)
    assert rows.shape[0] * synthetic.N_TOGETHER == synthetic.N_POINTS
    assert (np.isnan(rows).any(axis=2)).sum() > 10 and (rows[..., 1] > 0).sum() > 100


def test_each_object_counts_once_by_object() -> None:
    # Object 1 in 4 steps, with one id in all; object 2 in 2 steps, with another id in each; object 3 is never found.
    both = [Step(np.array([1, 2]), np.array([7, other]), np.eye(2)) for other in (8, 9)]
    steps = [*both, *[Step(np.array([1]), np.array([7]), np.ones((1, 1)))] * 2]
    values = track_values(count_tracks(steps))
    assert values["AssA"] == pytest.approx((4 * 1 + 2 * 0.5) / 6)
    assert values["AssA by object"] == pytest.approx((1 + 0.5) / 2)
    steps.append(Step(np.array([3]), np.zeros(0, int), np.zeros((1, 0))))
    values = track_values(count_tracks(steps))
    assert values["AssA by object"] == pytest.approx((1 + 0.5) / 2)
    assert values["DetRe by object"] == pytest.approx((1 + 1 + 0) / 3) and values["DetRe"] == pytest.approx(6 / 7)
    assert values["OWTA by object"] == pytest.approx(np.sqrt(2 / 3 * 0.75))
    assert np.isnan(track_values(count_tracks([]))["AssA by object"])


def test_each_point_counts_by_time() -> None:
    # An object of 6 points, found; one of 2 points, half of it found by an id without other points.
    true, found = np.array([4] * 6 + [5] * 2), np.array([1] * 6 + [2, 3])
    step = LabelledPoints(np.zeros(8, int), true, np.array([0] * 7 + [-1]), found)
    values = point_values(count_points([step], np.array([True])))
    assert values["AQ"] == (1 + 1 * 0.5 / 2) / 2
    assert values["AQ by time"] == (6 * 1 + 1 * 0.5) / 8


def test_step_has_the_iou_of_counted_points_of_overlapping_masks() -> None:
    instance = np.array([2, 2, 2, 2, 0, 9, -1])
    masks = Masks.of_sets([np.array([0, 1, 4]), np.array([1, 2, 3, 5]), np.array([6])])
    whole = step_of(instance, masks, np.array([30, 10, 20]))
    assert (whole.true_ids.tolist(), whole.ids.tolist()) == ([2, 9], [30, 10, 20])
    assert whole.similarity.tolist() == [[2 / 5, 3 / 5, 0], [0, 1 / 4, 0]]
    part = step_of(instance, masks, np.array([30, 10, 20]), np.array([1, 1, 0, 0, 1, 0, 0], bool))
    assert (part.true_ids.tolist(), part.ids.tolist(), part.similarity.tolist()) == ([2], [30, 10], [[2 / 3, 1 / 2]])
    nothing = step_of(np.zeros(0, int), Masks.of_sets([]), np.zeros(0, int))
    assert nothing.similarity.shape == (0, 0)


def test_point_in_several_masks_belongs_to_the_most_certain() -> None:
    masks = Masks.of_sets([np.array([0, 1]), np.array([1, 2]), np.array([2])])
    classes, ids = np.array([0, 1, 2]), np.array([7, 8, 9])
    first, best = (
        labelled_points(np.zeros(4, int), np.ones(4, int), masks, classes, ids, scores)
        for scores in (None, np.array([0.1, 0.3, 0.3]))
    )
    assert (first.class_index.tolist(), first.id.tolist()) == ([0, 0, 1, -1], [7, 7, 8, 0])
    assert (best.class_index.tolist(), best.id.tolist()) == ([0, 1, 1, -1], [7, 8, 8, 0])


def test_label_flips_compare_with_the_last_step_that_had_an_id() -> None:
    absent = Step(np.zeros(0, int), np.array([5]), np.zeros((0, 1)))
    steps = [seen(0.0), seen(0.4, 0.3), absent, seen(0.0, 0.0), seen(0.2, 0.6), seen(0.6, 0.6), seen(0.7), seen()]
    flips = label_flips(steps)
    assert flips.is_compared[:, 0].tolist() == [False, False, False, False, True, True, True, False]
    assert flips.is_flip[:, 0].tolist() == [False, False, False, False, True, False, True, False]
    assert flips.rate == 2 / 3 and np.isnan(label_flips([]).rate)


@pytest.mark.parametrize(
    ("ids", "similarity"),
    [([1, 1], [[0.5, 0.5]]), ([1], [[0.5, 0.5]]), ([1, 2], [[0.5, np.nan]]), ([1, 2], [[1.1, 0.5]])],
)
def test_step_rejects_repeated_ids_and_wrong_similarities(ids: list[int], similarity: list[list[float]]) -> None:
    with pytest.raises(DataError, match="step"):
        Step(np.array([1]), np.array(ids), np.array(similarity))


SMALL = MappingConfig(noise_m=0.0, max_bbox_area_ratio=1.0, obj_min_detections=0, merge_interval=2)
KEEPS_IDS = [(ConceptGraphs(SMALL), True), (SAM3D(SAM3DConfig(merge_schedule="incremental")), False)]


@pytest.mark.parametrize(("method", "keeps"), KEEPS_IDS, ids=["conceptgraphs", "sam3d@incremental"])
def test_method_declares_whether_an_id_always_names_the_same_instance(method: Any, keeps: bool) -> None:
    left, middle, right = (Plate((low, low + 0.4)) for low in (-0.6, -0.2, 0.2))
    method.start(SCENE)
    views: dict[int, list[set[tuple[int, ...]]]] = {}
    for index, plates in enumerate(([right], [left, right], [middle, left], [right, left, middle], [left])):
        method.update(*look(plates, index), Timer())
        found = method.finish()
        for k, one in enumerate(found.ids.tolist()):
            of_one = found.views[found.view_indptr[k] : found.view_indptr[k + 1]]
            views.setdefault(one, []).append({*map(tuple, of_one.tolist())})
    assert len(views) > 1
    assert all(a & b for of_id in views.values() for a in of_id for b in of_id) == keeps
    assert getattr(type(method), "keeps_ids", False) == keeps
