"""The instance AP equals the original evaluators to the last bit."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CASES
from scored_room import LABELS, instances

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.instance.average_precision import (
    THRESHOLDS,
    InstanceAP,
    InstanceCounts,
    combine,
    encode_ground_truth,
    last_line_of_each_mask_file,
)
from su3d_bench.metrics.instance.scene_counts import per_scene
from su3d_bench.metrics.instance.score import NO_OBJECT, covered_objects
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import metric_of

INSTANCE_CASES = sorted(p.stem for p in CASES.glob("inst*.json")) + sorted(p.stem for p in CASES.glob("replica*.json"))


def load(case: str) -> tuple[dict[str, Any], dict[str, Any]]:
    with np.load(CASES / f"{case}.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    return arrays, json.loads((CASES / f"{case}.json").read_text())


def scene_counts(arrays: dict[str, Any], scene: int, class_ids: list[int]) -> InstanceCounts:
    truth = arrays[f"gt_{scene}"]
    masks = np.unpackbits(arrays[f"masks_packed_{scene}"], axis=1)[:, : len(truth)].astype(bool)
    labels, scores = arrays[f"labels_{scene}"], arrays[f"scores_{scene}"]
    if f"mask_files_{scene}" in arrays:
        lines = last_line_of_each_mask_file([str(f) for f in arrays[f"mask_files_{scene}"]])
        masks = masks[[first for first, _ in lines]]
        labels, scores = labels[[last for _, last in lines]], scores[[last for _, last in lines]]
    indptr = np.concatenate([[0], np.cumsum(masks.sum(axis=1))])
    return per_scene(truth, indptr, np.nonzero(masks)[1], labels, scores, class_ids)


def evaluate(case: str, oracle: str) -> tuple[InstanceAP, dict[str, Any]]:
    arrays, expected = load(case)
    answer = expected[oracle]
    counts = [scene_counts(arrays, s, answer["class_ids"]) for s in range(len(arrays["scene_names"]))]
    return combine(counts), answer


def as_table(answer: dict[str, Any]) -> Any:
    return np.array([[np.nan if v is None else v for v in row] for row in answer["ap"]])


def test_largest_confidence_scores_like_the_refused_infinity() -> None:
    truth = np.repeat([5001, 5002, 7001], 200)
    masks = [np.arange(200), np.arange(400, 600), np.arange(200, 400)]  # a hit, a false positive, a hit
    indptr, indices = np.array([0, 200, 400, 600]), np.concatenate(masks)
    for above in (0.9, 1e300):
        counts = per_scene(truth, indptr, indices, np.full(3, 5), np.array([above, 0.8, 0.1]), [5, 7])
        assert combine([counts]).of_class(0)[1] == pytest.approx((2 / 3 + 1 / 2 + 1 + 1) / 4)
    with pytest.raises(PredictionError, match="confidences that are finite numbers"):
        per_scene(truth, indptr, indices, np.full(3, 5), np.array([np.inf, 0.8, 0.1]), [5, 7])


def test_thresholds_are_the_original_doubles() -> None:
    _, expected = load("inst01_basic")
    assert list(THRESHOLDS) == expected["official_py3_pr26"]["overlaps"]


@pytest.mark.parametrize("case", INSTANCE_CASES)
def test_reference_case_aps_and_averages_are_equal_in_every_bit(case: str) -> None:
    ours, answer = evaluate(case, "official_py3_pr26")
    assert np.array_equal(ours.table, as_table(answer), equal_nan=True)
    assert (ours.ap, ours.ap50, ours.ap25) == (answer["all_ap"], answer["all_ap50"], answer["all_ap25"])
    for index, label in enumerate(answer["class_labels"]):
        expected = [answer["classes"][label][key] for key in ("ap", "ap50", "ap25")]
        assert [None if np.isnan(value) else value for value in ours.of_class(index)] == expected


def test_openmask3d_replica_script_is_equal_in_every_bit() -> None:
    for case in ("replica01_all_ones", "replica02_scores"):
        ours, answer = evaluate(case, "replica_script")
        assert np.array_equal(ours.table, as_table(answer), equal_nan=True)


def test_the_scannet200_case_is_equal_in_every_bit() -> None:
    ours, answer = evaluate("scannet200_01", "openmask3d")
    averages = answer["avgs"]
    assert np.array_equal(ours.table, as_table(answer), equal_nan=True)
    assert ours.ap == averages["all_ap"]
    assert ours.ap50 == averages["all_ap_50%"]
    assert ours.ap25 == averages["all_ap_25%"]
    rules = load_protocol("scannet200-instance")
    assert [entry.id for entry in rules.scored] == answer["class_ids"]
    arrays, _ = load("scannet200_01")
    counts = [scene_counts(arrays, s, answer["class_ids"]) for s in range(len(arrays["scene_names"]))]
    groups = metric_of(rules).pooled(counts).groups
    for group in ("head", "common", "tail"):
        assert tuple(groups[group].values()) == tuple(averages[f"{group}_{key}"] for key in ("ap", "ap50%", "ap25%"))


# ---- hand-computed values


def one_scene(
    truth: Any, masks: list[Any], labels: list[int], scores: list[float], class_ids: tuple[int, ...] = (5, 7)
) -> InstanceAP:
    return combine([counts_of(truth, masks, labels, scores, class_ids)])


def counts_of(
    truth: Any, masks: list[Any], labels: list[int], scores: list[float], class_ids: tuple[int, ...] = (5, 7)
) -> InstanceCounts:
    indptr = np.concatenate([[0], np.cumsum([len(m) for m in masks])]).astype(np.int64)
    indices = np.concatenate([np.zeros(0, np.int64), *masks])
    return per_scene(
        np.asarray(truth), indptr, indices, np.array(labels, np.int64), np.array(scores, np.float64), class_ids
    )


TWO = np.repeat([5001, 5002, 0], [200, 200, 100])  # two instances of class 5, then void
FIRST, SECOND, VOID = np.arange(200), np.arange(200, 400), np.arange(400, 500)


def test_perfect_prediction_is_exactly_one_and_class_without_ground_truth_is_nan() -> None:
    ours = one_scene(TWO, [FIRST, SECOND], [5, 5], [0.9, 0.8])
    assert (ours.ap, ours.ap50, ours.ap25) == (1.0, 1.0, 1.0)
    assert np.isnan(ours.table[1]).all()


def test_iou_equal_to_the_threshold_is_not_a_match() -> None:
    assert one_scene(np.full(200, 5001), [np.arange(100)], [5], [1.0]).ap50 == 0.0
    assert one_scene(np.full(200, 5001), [np.arange(101)], [5], [1.0]).ap50 == 1.0


def test_ap_with_constant_confidences_is_recall_times_one_plus_precision_over_two() -> None:
    masks = [FIRST, np.concatenate([FIRST[:60], SECOND[:60]])]
    assert one_scene(TWO, masks, [5, 5], [1.0, 1.0]).ap50 == 0.5 * (1 + 0.5) / 2


def test_duplicate_is_a_false_positive_with_the_lower_score() -> None:
    counts = counts_of(np.full(200, 5001), [np.arange(150), np.arange(200)], [5, 5], [0.3, 0.8])
    at_50 = counts.threshold_index == 0
    assert counts.score[at_50].tolist() == [0.8, 0.3]
    assert counts.is_true[at_50].tolist() == [True, False]


def test_prediction_with_void_above_the_threshold_is_ignored_and_at_it_counted() -> None:
    half_void = np.concatenate([SECOND[:100], VOID])
    assert one_scene(TWO, [FIRST, half_void], [5, 5], [0.5, 0.9]).ap50 < 0.5
    more_void = np.concatenate([SECOND[:99], VOID])
    assert one_scene(TWO, [FIRST, more_void], [5, 5], [0.5, 0.9]).ap50 == 0.5


def test_a_class_whose_predictions_are_all_ignored_is_zero() -> None:
    assert one_scene(TWO, [VOID], [5], [1.0]).table[0].tolist() == [0.0] * 10


def test_small_predictions_and_labels_outside_the_set_are_dropped() -> None:
    masks = [FIRST, SECOND, FIRST[:99], FIRST, FIRST]
    ours = one_scene(TWO, masks, [5, 5, 5, 6, 0], [0.5, 0.4, 0.9, 0.9, 0.9])
    assert ours.ap == 1.0


def test_a_small_instance_is_neither_found_nor_missed() -> None:
    truth = np.repeat([5001, 5002], [200, 99])
    assert one_scene(truth, [FIRST], [5], [1.0]).ap == 1.0
    assert one_scene(truth, [FIRST, np.arange(199, 299)], [5, 5], [0.5, 1.0]).ap50 == 1.0


def test_void_and_small_instances_are_ignored_together() -> None:
    truth = np.repeat([5001, 5002, 0], [200, 60, 30])
    mask = np.concatenate([FIRST[160:], np.arange(200, 230), np.arange(260, 290)])  # 30 of 100 points on each
    assert one_scene(truth, [FIRST, mask], [5, 5], [0.5, 0.9]).ap50 == 1.0


def test_overlap_with_another_class_is_a_false_positive() -> None:
    truth = np.repeat([5001, 7001], [200, 200])
    ours = one_scene(truth, [FIRST, SECOND], [5, 5], [0.5, 0.9])
    assert ours.table[0, 0] == 0.25
    assert ours.table[1, 0] == 0.0


def test_scenes_share_one_curve() -> None:
    hit = counts_of(TWO, [FIRST, SECOND], [5, 5], [0.5, 0.5])
    false = counts_of(np.repeat([7001, 0], [200, 200]), [FIRST], [5], [0.9])
    assert combine([hit]).ap50 == 1.0
    assert combine([hit, false]).table[0, 0] == pytest.approx((2 / 3) / 2)


def test_scene_without_predictions_counts_all_instances_as_missed() -> None:
    hit = counts_of(TWO, [FIRST, SECOND], [5, 5], [0.5, 0.5])
    assert combine([hit, counts_of(TWO, [], [], [])]).ap == 0.5


def test_no_ground_truth_is_nan_without_warnings(recwarn: pytest.WarningsRecorder) -> None:
    ours = one_scene(np.zeros(300, np.int64), [FIRST], [5], [1.0])
    assert np.isnan([ours.ap, ours.ap50, ours.ap25]).all()
    assert not recwarn.list


def test_instance_covers_vertices_whose_nearest_map_point_it_has() -> None:
    points = np.array([[k, 0, 0] for k in range(6)], np.float32)
    objects = np.array([0, 1, 1, 2, 2, -1], np.int32)
    truth = GroundTruth(points, objects, objects, LABELS, "mesh-vertices", "made for a test")
    moved = instances(points + np.float32(0.01), [np.arange(3), np.arange(2, 5), np.array([0, 5])], None)
    covered = covered_objects(load_protocol("rooms-instance").transfer, truth, moved)
    assert covered.object_ids.tolist() == [1, 2]
    assert covered.n_shared.tolist() == [[2, 0], [1, 2], [0, 0]]
    assert covered.main_object.tolist() == [1, 2, NO_OBJECT]


# ---- properties


@settings(max_examples=30, deadline=None)
@given(
    case=st.sampled_from(["inst02_ties", "inst04_missing_classes_void", "inst06_empty_scenes"]), seed=st.integers(0, 99)
)
def test_order_of_scenes_and_classes_changes_no_bit(case: str, seed: int) -> None:
    arrays, expected = load(case)
    answer = expected["official_py3_pr26"]
    rng = np.random.default_rng(seed)
    classes = rng.permutation(len(answer["class_ids"]))
    ids = [answer["class_ids"][c] for c in classes]
    scenes = rng.permutation(len(arrays["scene_names"]))
    ours = combine([scene_counts(arrays, int(s), ids) for s in scenes])
    assert np.array_equal(ours.table, as_table(answer)[classes], equal_nan=True)


@settings(max_examples=30, deadline=None)
@given(case=st.sampled_from(["inst01_basic", "inst12_float32_scores_8scenes", "replica02_scores"]), data=st.data())
def test_counts_of_parts_combine_to_the_whole(case: str, data: st.DataObject) -> None:
    arrays, expected = load(case)
    answer = expected["official_py3_pr26"]
    counts = [scene_counts(arrays, s, answer["class_ids"]) for s in range(len(arrays["scene_names"]))]
    cut = data.draw(st.integers(1, len(counts) - 1))
    halves = [InstanceCounts.joined(counts[:cut]), InstanceCounts.joined(counts[cut:])]
    assert np.array_equal(combine(halves).table, as_table(answer), equal_nan=True)


# ---- errors


@pytest.mark.parametrize(
    ("masks", "labels", "scores", "message"),
    [
        ([FIRST, SECOND], [5, 5], [0.5, float("nan")], "finite numbers"),
        ([FIRST], [5, 5], [0.5, 0.5], "as many labels"),
        ([FIRST, SECOND], [5, 5], [0.5], "as many labels"),
        ([FIRST, np.arange(350, 501)], [5, 5], [0.5, 0.5], "below 500"),
        ([np.repeat(np.arange(100), 2), FIRST], [5, 5], [0.5, 0.5], "ascending point indices, each once"),
    ],
)
def test_masks_that_do_not_fit_the_scene_are_refused(masks: Any, labels: Any, scores: Any, message: str) -> None:
    with pytest.raises(PredictionError, match=message):
        one_scene(TWO, masks, labels, scores)


def test_ground_truth_beyond_the_encoding_is_refused() -> None:
    with pytest.raises(DataError, match="instance id 1000 would spill into the next class"):
        encode_ground_truth(np.array([5]), np.array([1000]))
    with pytest.raises(DataError, match="contains the id -1"):
        encode_ground_truth(np.array([5, 5]), np.array([3, -1]))
    with pytest.raises(DataError, match="contains the id -2"):
        encode_ground_truth(np.array([-2, 5]), np.array([1, 3]))
    with pytest.raises(DataError, match="contains the value -5;"):
        one_scene(np.repeat([-5, 5001], 100), [FIRST], [5], [1.0])
    with pytest.raises(DataError, match="contains the value 10000001;"):
        one_scene(np.repeat([10_000_001, 0], 100), [FIRST], [5], [1.0])
    with pytest.raises(DataError, match="class ids start at 1"):
        one_scene(TWO, [FIRST], [5], [1.0], class_ids=(0, 5))
