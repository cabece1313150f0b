"""Undefined values: a class without ground truth, a scene in which nothing counts, and means that ignore them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceCounts, resampled_ap
from su3d_bench.metrics.metric import Counts, SceneScore, Values, present, scene_mean
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, metric_of, plain_json
from su3d_bench.metrics.semantic.confusion import (
    SemanticCounts,
    conceptgraphs_metrics,
    resampled_semantic,
)
from su3d_bench.numerics.statistics import nan_mean, row_means

NAN = float("nan")
ROOM, INSTANCE = load_protocol("rooms-semantic"), load_protocol("rooms-instance")
N = len(ROOM.classes)
# the first scored classes; the rest of the label set does not matter here
A, B, C = [index for index, entry in enumerate(ROOM.classes) if not ROOM.is_ignored(entry.name)][:3]


def score(rules: ProtocolRules, counts: SemanticCounts | InstanceCounts) -> SceneScore:
    return SceneScore(rules.name, rules.version, counts, 1, 0, np.zeros(3, np.int64), ())


def confusion(rows: dict[int, dict[int, int]], *, present: Sequence[int] = ()) -> SemanticCounts:
    """Points by true and predicted class; ``present``: classes of the scene without a scored point."""
    table = np.zeros((N, N + 1), np.int64)
    for true, of_row in rows.items():
        for predicted, n in of_row.items():
            table[true, predicted] = n
    is_present = table.sum(axis=1) > 0
    is_present[list(present)] = True
    return SemanticCounts(table, is_present)


def masks(*classes: tuple[int, bool]) -> InstanceCounts:
    """A scene with one instance of 100 points of each class, found by a perfect mask or not at all."""
    ids = [INSTANCE.scored[index].id for index, _ in classes]
    truth = np.repeat([one * 1000 + 1 for one in ids] or [0], 100)
    found = [k for k, (_, is_found) in enumerate(classes) if is_found]
    indices = np.concatenate([np.arange(0), *(np.arange(100 * k, 100 * k + 100) for k in found)])
    labels = np.array([ids[k] for k in found], np.int64)
    every_id = [entry.id for entry in INSTANCE.scored]
    return scene_counts.per_scene(
        truth, np.arange(len(found) + 1) * 100, indices, labels, np.ones(len(found)), every_id
    )


# ---- means


def test_mean_ignores_undefined_values_and_is_undefined_if_all_are() -> None:
    assert nan_mean(np.array([NAN, 0.2, NAN, 0.6])) == pytest.approx(0.4)
    assert math.isnan(nan_mean(np.array([NAN, NAN])))
    assert math.isnan(nan_mean(np.zeros(0)))
    np.testing.assert_array_equal(row_means(np.array([[NAN, 0.5], [NAN, NAN], [0.0, 1.0]])), [0.5, NAN, 0.5])
    mean = scene_mean([{"x": 0.5, "y": NAN}, {"x": NAN, "y": NAN}])
    assert mean["x"] == 0.5
    assert math.isnan(mean["y"])


def test_no_file_contains_non_finite_values() -> None:
    value = {"a": [NAN, math.inf, -math.inf, 0.5], "b": (NAN, {"c": 1})}
    assert plain_json(value) == {"a": [None, None, None, 0.5], "b": [None, {"c": 1}]}


# ---- scenes drawn


WEIGHTS = np.array([[1, 1, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0], [0, 0, 2], [0, 3, 0], [2, 0, 1]])


def of_drawn(
    rules: ProtocolRules, counts: Sequence[SemanticCounts | InstanceCounts], weights: Int64Array
) -> list[Values]:
    """The metrics over the drawn scenes, each as a separate scene, with the function without weights."""
    metric = metric_of(rules)
    return [metric.combine([counts[s] for s in range(len(counts)) for _ in range(n[s])]) for n in weights]


def assert_as_drawn(found: dict[str, Float64Array], expected: list[Values], names: Sequence[str]) -> None:
    for name in names:
        np.testing.assert_allclose(found[name], [row[name] for row in expected], rtol=0, atol=1e-12, err_msg=name)


def test_ap_over_drawn_scenes_ignores_absent_classes() -> None:
    counts = [masks((0, True), (1, True)), masks((1, False), (2, False)), masks()]
    found = resampled_ap(counts, WEIGHTS, INSTANCE.thresholds)
    expected = of_drawn(INSTANCE, counts, WEIGHTS)
    assert_as_drawn(found, expected, ("AP", "AP50", "AP25"))
    assert found["AP"][:4].tolist() == pytest.approx([(1 + 0.5 + 0) / 3, 0.0, 1.0, (1 + 0.5 + 0) / 3])
    assert np.isnan(found["AP"][4])


def test_semantic_values_over_drawn_scenes_ignore_absent_classes() -> None:
    counts = [confusion({A: {A: 3, B: 1}}), confusion({B: {B: 2, N: 2}, C: {A: 5}}), confusion({})]
    found = metric_of(ROOM).resampled(counts, WEIGHTS)
    assert_as_drawn(dict(found), of_drawn(ROOM, counts, WEIGHTS), ("mAcc", "mIoU", "F-mIoU"))
    assert found["mAcc"].tolist()[:4] == pytest.approx([(0.75 + 0.5 + 0) / 3, 0.25, 0.75, (0.75 + 0.5 + 0) / 3])
    assert all(np.isnan(found[name][4]) for name in ("mAcc", "mIoU", "F-mIoU"))


def test_mean_over_drawn_scenes_ignores_those_without_a_value() -> None:
    rules = ROOM.model_copy(update={"aggregate": "scene-mean"})
    rows = [{"mAcc": 0.2, "F-mIoU": 0.5}, {"mAcc": 0.8, "F-mIoU": NAN}, {"mAcc": NAN, "F-mIoU": NAN}]
    found = metric_of(rules).resampled_headline([], rows, WEIGHTS)
    np.testing.assert_allclose(found["mAcc"], [0.5, 0.8, 0.2, 0.5, NAN, 0.8, 0.2], atol=1e-12)
    np.testing.assert_allclose(found["F-mIoU"], [0.5, NAN, 0.5, 0.5, NAN, NAN, 0.5], atol=1e-12)


def test_a_class_of_a_single_point_has_values_in_the_scenes_that_have_it() -> None:
    counts = [confusion({A: {A: 1}, B: {B: 3, N: 1}}), confusion({B: {B: 1}})]
    found = metric_of(ROOM).resampled_classes(counts, np.array([[1, 1], [1, 0], [0, 1]]))
    np.testing.assert_array_equal(found[ROOM.classes[A].name]["recall"], [1.0, 1.0, NAN])
    np.testing.assert_array_equal(found[ROOM.classes[A].name]["IoU"], [1.0, 1.0, NAN])
    np.testing.assert_array_equal(found[ROOM.classes[B].name]["recall"], [0.8, 0.75, 1.0])
    assert set(found) == {ROOM.classes[A].name, ROOM.classes[B].name}


def test_scannet_mean_of_drawn_scenes_ignores_classes_neither_true_nor_predicted() -> None:
    found = resampled_semantic([confusion({A: {A: 3, B: 1}})], np.array([[1], [2]]), "scannet")
    assert found["mIoU"].tolist() == [0.375, 0.375]  # 3/4 and 0 for the one that is only predicted
    assert found["mAcc"].tolist() == [0.75, 0.75]


# ---- results


def test_a_class_is_present_with_a_single_point() -> None:
    assert present(np.array([2, -1, 0, 0]), 4).tolist() == [True, False, True, False]


class Nothing(Counts):
    """Of no array."""


def test_counts_without_the_axis_of_a_single_class_are_refused() -> None:
    with pytest.raises(DataError, match="a: was scored with 0 classes, class-agnostic-segment3d has 1 here"):
        metric_of(load_protocol("class-agnostic-segment3d")).check("a", Nothing())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_expected_classes_without_points_score_zero(dtype: type[np.float32] | type[np.float64]) -> None:
    with np.errstate(all="raise"):
        metrics = conceptgraphs_metrics(np.zeros((2, 3), np.int64), np.arange(2), dtype)
    assert (metrics.mean_accuracy, metrics.mean_iou) == (0.0, 0.0)
    assert math.isnan(metrics.frequency_weighted_iou)  # without any point


def test_scene_without_ground_truth_has_no_value_and_affects_none() -> None:
    scored = {"a": score(INSTANCE, masks((0, True), (1, False))), "b": score(INSTANCE, masks((0, True)))}
    with_nothing = combine(INSTANCE, scored | {"c": score(INSTANCE, masks())})
    assert math.isnan(with_nothing.per_scene["c"]["AP"])
    without = combine(INSTANCE, scored)
    assert with_nothing.metrics == without.metrics
    assert with_nothing.scene_mean == without.scene_mean == {"AP": 0.75, "AP50": 0.75, "AP25": 0.75}
    shown = json.loads(json.dumps(with_nothing.to_json(), allow_nan=False))
    assert shown["per_scene"]["c"] == {"AP": None, "AP50": None, "AP25": None}
    assert shown["per_class"][INSTANCE.scored[2].name]["AP"] is None


def test_values_without_any_counts_are_undefined_without_interval() -> None:
    result = combine(INSTANCE, {"a": score(INSTANCE, masks()), "b": score(INSTANCE, masks())})
    assert all(math.isnan(result.metrics[name]) for name in INSTANCE.headline)
    assert result.intervals == dict.fromkeys(INSTANCE.headline)
    empty = combine(ROOM, {"a": score(ROOM, confusion({})), "b": score(ROOM, confusion({}))})
    assert math.isnan(empty.metrics["F-mIoU"])
    assert empty.intervals == {"mAcc": None, "F-mIoU": None}


def test_undefined_scene_is_excluded_from_the_interval() -> None:
    rng = np.random.default_rng(1)
    scored = {
        f"s{k}": score(ROOM, confusion({A: {A: int(rng.integers(5, 30)), N: 10}, B: {B: 4, A: int(rng.integers(9))}}))
        for k in range(6)
    }
    interval = combine(ROOM, scored | {"z": score(ROOM, confusion({}))}).intervals["mAcc"]
    assert interval is not None
    assert np.isfinite(interval).all()
    assert interval[0] < combine(ROOM, scored).metrics["mAcc"] < interval[1]


def test_scene_that_does_not_change_the_mean_is_included_in_the_interval() -> None:
    rules = ROOM.model_copy(update={"aggregate": "scene-mean"})
    scored = {str(n): score(ROOM, confusion({A: {A: n, N: 10 - n}})) for n in (4, 5, 6)}
    # 4.303, of Student's t with 2 degrees of freedom, times 0.1 / sqrt(3)
    assert combine(rules, scored).intervals["mAcc"] == pytest.approx((0.5 - 0.24841, 0.5 + 0.24841), abs=1e-5)


def test_a_scene_without_a_scored_point_has_no_f_miou_under_conceptgraphs_and_adds_nothing_to_the_pooled_row() -> None:
    # compute_metrics of conceptgraph/utils/eval.py: denominators of at least 1, but F-mIoU over the sum of all points
    empty, other = confusion({}, present=[A, B]), confusion({A: {A: 4, B: 1}, B: {B: 3}})
    rules = ROOM.model_copy(update={"aggregate": "scene-mean"})
    for asked in (ROOM, rules):
        result = combine(asked, {"empty": score(asked, empty), "other": score(asked, other)})
        assert np.isnan(result.per_scene["empty"]["F-mIoU"])
        assert (result.per_scene["empty"]["mAcc"], result.per_scene["empty"]["mIoU"]) == (0.0, 0.0)
        assert result.pooled == combine(asked, {"other": score(asked, other)}).pooled
        assert result.scene_mean["F-mIoU"] == result.per_scene["other"]["F-mIoU"]
        assert result.scene_mean["mAcc"] == pytest.approx(result.per_scene["other"]["mAcc"] / 2)


# ---- the column that ConceptGraphs slices away


def test_predictions_of_a_class_without_points_are_sliced_away_only_from_pooled_rows() -> None:
    # eval_replica_semseg.py keeps the rows and columns of classes with points over all scenes: of six points of A that
    # are predicted as C, a true class without a scored point, nothing remains; a scene's own keep_index has C
    one = confusion({A: {A: 4, C: 6}, B: {B: 3, A: 1}}, present=[C])
    other = confusion({A: {A: 2}, B: {B: 1, N: 3}})
    result = combine(ROOM, {"a": score(ROOM, one), "b": score(ROOM, other)})
    keep = np.array([A, B])
    whole = SemanticCounts.joined([one, other]).confusion
    sliced = np.concatenate([whole[np.ix_(keep, keep)], whole[keep, -1:]], axis=1)
    expected = conceptgraphs_metrics(sliced, np.arange(2))
    assert result.pooled["mAcc"] == expected.mean_accuracy == pytest.approx((1.0 + 4 / 8) / 2)
    assert result.pooled["F-mIoU"] == expected.frequency_weighted_iou
    assert result.pooled["n_classes"] == 2
    assert result.per_scene["a"]["mAcc"] == pytest.approx((0.4 + 0.75 + 0) / 3)
    assert result.per_scene["b"]["mAcc"] == pytest.approx((1.0 + 0.25) / 2)


def test_values_over_drawn_scenes_slice_away_what_the_pooled_rows_do() -> None:
    one = confusion({A: {A: 4, C: 6, N: 1}, B: {B: 3, A: 1}}, present=[C])
    counts = [one, confusion({A: {A: 2, B: 1}, B: {C: 2}}), confusion({C: {C: 5, A: 5}})]
    for drawn in (np.ones((1, 3), np.int64), WEIGHTS):
        found = metric_of(ROOM).resampled(counts, drawn)
        assert_as_drawn(dict(found), of_drawn(ROOM, counts, drawn), ("mAcc", "mIoU", "F-mIoU"))


def test_prediction_of_a_class_absent_from_all_scenes_is_wrong() -> None:
    result = combine(ROOM, {"a": score(ROOM, confusion({A: {A: 4, C: 6}}))})
    assert result.pooled["mAcc"] == result.per_scene["a"]["mAcc"] == 0.4


def test_a_class_with_points_in_another_scene_is_sliced_away_nowhere() -> None:
    one, other = confusion({A: {A: 4, C: 6}}, present=[C]), confusion({C: {C: 5, A: 5}})
    result = combine(ROOM, {"a": score(ROOM, one), "b": score(ROOM, other)})
    assert result.pooled["mAcc"] == pytest.approx((0.4 + 0.5) / 2)
