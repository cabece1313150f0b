"""The semantic metrics equal the original evaluators."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from places import CASES

from su3d_bench.metrics.semantic.confusion import (
    SemanticCounts,
    SemanticMetrics,
    conceptgraphs_metrics,
    confusion_matrix,
    per_scene,
    resampled_semantic,
    scannet_metrics,
)

GOLDEN = json.loads((CASES / "conceptgraphs_golden.json").read_text())
POOLING = GOLDEN["cg_pooling"]
CONCEPTGRAPHS_CASES = {
    "all five classes": (GOLDEN["cg"]["conf"], range(5), GOLDEN["cg"]["all5"]),
    "four kept classes": (GOLDEN["cg"]["conf"], GOLDEN["cg"]["keep"], GOLDEN["cg"]["kept"]),
    "F1 quirk": (GOLDEN["cg_f1_quirk"]["conf"], range(3), GOLDEN["cg_f1_quirk"]["metrics"]),
    "zero rows": (GOLDEN["cg_zero_rows"]["conf"], range(3), GOLDEN["cg_zero_rows"]["metrics"]),
    "scene A": (POOLING["A"], POOLING["keepA"], POOLING["metricsA"]),
    "scene B": (POOLING["B"], POOLING["keepB"], POOLING["metricsB"]),
    "pooled": (POOLING["all"], POOLING["keep_all"], POOLING["metrics_all"]),
}
FLOAT32_CASES = {case["what"]: case for case in GOLDEN["cg_float32"]["cases"]}
SCANNET_CASES = ("sem01_all_classes", "sem02_missing_classes", "sem03_no_valid_gt", "sem04_perfect")


def as_golden(metrics: SemanticMetrics) -> dict[str, Any]:
    return {
        "iou": metrics.iou.tolist(),
        "miou": metrics.mean_iou,
        "fmiou": metrics.frequency_weighted_iou,
        "num_classes": len(metrics.class_index),
        "acc0.15": metrics.n_classes_above[0],
        "acc0.25": metrics.n_classes_above[1],
        "acc0.50": metrics.n_classes_above[2],
        "acc0.75": metrics.n_classes_above[3],
        "precision": metrics.precision.tolist(),
        "recall": metrics.recall.tolist(),
        "f1score": metrics.f1_conceptgraphs.tolist(),
    }


@pytest.mark.parametrize("case", CONCEPTGRAPHS_CASES)
def test_conceptgraphs_golden_values_are_equal_in_every_bit_in_float32(case: str) -> None:
    confusion, keep, expected = CONCEPTGRAPHS_CASES[case]
    assert as_golden(conceptgraphs_metrics(np.array(confusion), np.array(keep), np.float32)) == expected


@pytest.mark.parametrize("case", CONCEPTGRAPHS_CASES)
def test_float64_differs_from_the_golden_values_by_less_than_float32_rounding(case: str) -> None:
    confusion, keep, expected = CONCEPTGRAPHS_CASES[case]
    ours = as_golden(conceptgraphs_metrics(np.array(confusion), np.array(keep)))
    for key, value in expected.items():
        np.testing.assert_allclose(ours[key], value, rtol=0, atol=6e-8)


@pytest.mark.parametrize("what", FLOAT32_CASES)
def test_float32_rounds_where_the_original_rounds(what: str) -> None:
    confusion, expected = np.array(FLOAT32_CASES[what]["conf"]), FLOAT32_CASES[what]["metrics"]
    assert as_golden(conceptgraphs_metrics(confusion, np.arange(len(confusion)), np.float32)) == expected


def test_classes_above_a_level_are_counted_in_float32_by_default_too() -> None:
    case = FLOAT32_CASES["an IoU of 3/20 is above 0.15"]
    metrics = conceptgraphs_metrics(np.array(case["conf"]), np.arange(3))
    assert metrics.iou[0] == 0.15
    assert metrics.n_classes_above[0] == case["metrics"]["acc0.15"] == 3


def test_conceptgraphs_f1_and_harmonic_mean_have_separate_names() -> None:
    metrics = conceptgraphs_metrics(np.array(GOLDEN["cg_f1_quirk"]["conf"]), np.arange(3))
    np.testing.assert_allclose(metrics.f1, [0.1379, 0.1818, 0.2979], atol=5e-5)
    np.testing.assert_allclose(metrics.f1_conceptgraphs, [0.0444, 0.0667, 0.1815], atol=5e-5)


def test_points_in_the_extra_column_lower_recall_but_not_precision() -> None:
    metrics = conceptgraphs_metrics(np.array([[6, 0, 2], [0, 4, 0]]), np.arange(2))
    assert metrics.recall.tolist() == [0.75, 1.0]
    assert metrics.precision.tolist() == [1.0, 1.0]
    assert metrics.iou.tolist() == [0.75, 1.0]


@pytest.mark.parametrize("case", SCANNET_CASES)
def test_scannet_cases_are_equal_in_every_bit(case: str) -> None:
    expected = json.loads((CASES / f"{case}.json").read_text())
    official = expected["official_py3"]
    ids = official["class_ids"]
    index_of = np.full(100_000, -1)
    index_of[ids] = np.arange(len(ids))
    with np.load(CASES / f"{case}.npz") as archive:
        counts = [
            per_scene(index_of[archive[f"gt_{s}"]], index_of[archive[f"pred_{s}"]], np.ones(len(ids), bool))
            for s in range(len(archive["scene_names"]))
        ]
    whole = SemanticCounts.joined(counts)
    assert whole.confusion.tolist() == official["confusion_valid_plus_unknown"]
    metrics = scannet_metrics(whole.confusion)
    iou = [np.nan if value is None else value for value in official["iou"].values()]
    assert np.array_equal(metrics.iou, iou, equal_nan=True)
    for ours, key in (
        (metrics.mean_iou, "mean_iou_nanmean"),
        (metrics.mean_accuracy, "derived_mean_acc_over_classes_with_gt"),
    ):
        assert ours == expected[key] or (np.isnan(ours) and expected[key] is None)


def test_scannet_values_equal_hand_computed_ones() -> None:
    # of 9 points of the first class 3 are correct, 1 is called the second and 5 the third, which is never true;
    # 2 of the second have no prediction
    with np.errstate(all="raise"):  # nothing is divided by zero
        metrics = scannet_metrics(np.array([[3, 1, 5, 0], [0, 0, 0, 2], [0, 0, 0, 0]]))
    assert metrics.class_index.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(metrics.recall, [3 / 9, 0.0, np.nan])
    np.testing.assert_array_equal(metrics.precision, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(metrics.iou, [3 / 9, 0.0, 0.0])
    np.testing.assert_array_equal(metrics.f1, [6 / 12, 0.0, 0.0])
    np.testing.assert_array_equal(metrics.f1_conceptgraphs, [2 * (3 / 9) / (1 + 3 / 9), 0.0, np.nan])
    assert (metrics.mean_accuracy, metrics.mean_precision) == ((3 / 9) / 2, 1 / 3)
    assert (metrics.mean_iou, metrics.mean_f1) == ((3 / 9) / 3, (6 / 12) / 3)
    assert metrics.frequency_weighted_iou == pytest.approx(9 * (3 / 9) / 11)
    assert metrics.point_accuracy == pytest.approx(3 / 11)
    assert metrics.n_classes_above == (1, 1, 0, 0)


def test_classes_are_counted_above_but_not_at_a_level() -> None:
    n_hit = np.array([4, 5, 6, 8, 10, 12, 15, 18])  # of 20 points each, the others without a prediction
    metrics = scannet_metrics(np.column_stack([np.diag(n_hit), 20 - n_hit]))
    assert metrics.iou.tolist() == [0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.75, 0.9]
    assert metrics.n_classes_above == (8, 6, 3, 1)


def test_points_of_unscored_classes_are_excluded() -> None:
    counts = per_scene(np.array([0, 1, 1]), np.array([0, 0, 1]), np.array([True, False]))
    assert counts.confusion.tolist() == [[1, 0, 0], [0, 0, 0]]


def test_concatenated_scenes_contain_the_classes_of_each() -> None:
    empty = confusion_matrix(np.zeros(0, int), np.zeros(0, int), 2)
    a, b = SemanticCounts(empty, np.array([True, False])), SemanticCounts(empty, np.array([False, True]))
    assert SemanticCounts.joined([a, b]).is_present.tolist() == [True, True]


def test_ovo_counts_only_predicted_classes_as_0_in_mean_accuracy() -> None:
    confusion = np.array([[3, 1, 0], [0, 0, 0]])
    plain, of_ovo = scannet_metrics(confusion), scannet_metrics(confusion, counts_unseen=True)
    assert (plain.mean_accuracy, of_ovo.mean_accuracy) == (0.75, 0.375)
    assert plain.mean_iou == of_ovo.mean_iou == 0.375
    counts = [SemanticCounts(confusion, np.array([True, False]))]
    drawn = resampled_semantic(counts, np.ones((1, 1), np.int64), "ovo")
    assert (drawn["mAcc"][0], drawn["mIoU"][0]) == (of_ovo.mean_accuracy, of_ovo.mean_iou)
    assert np.isnan(scannet_metrics(np.array([[3, 0, 0], [0, 0, 0]]), counts_unseen=True).recall[1])
