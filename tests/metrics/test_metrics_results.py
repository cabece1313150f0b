"""Combined results: several scenes, warnings, stored bytes, and errors."""

from __future__ import annotations

import io
import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scored_room import (
    ENCODER,
    ID,
    INSTANCE,
    NAMES,
    ROOM,
    SEMANTIC,
    instances,
    noisy,
    noisy_scores,
    room,
    truth_as_prediction,
)

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import LabelSet
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, combined_metrics, pack_scores, score_scene, unpack_scores

LABELLED, UNLABELLED = (truth_as_prediction(room(), with_labels=labels) for labels in (True, False))

# ---- several scenes


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_pooled_values_differ_from_the_mean_of_the_scenes(name: str) -> None:
    result = combine(load_protocol(name), noisy_scores(name, 5))
    key = result.headline[0]
    assert result.pooled[key] != result.scene_mean[key]
    assert result.scene_mean[key] == pytest.approx(np.mean([row[key] for row in result.per_scene.values()]))
    assert result.metrics == result.pooled


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_interval_is_student_t_on_leave_one_out_values(name: str, aggregate: str) -> None:
    rules = load_protocol(name).model_copy(update={"aggregate": aggregate})
    scores = noisy_scores(name, 6)
    result = combine(rules, scores)
    without = [combine(rules, {s: score for s, score in scores.items() if s != left_out}) for left_out in scores]
    for key in rules.headline:
        pseudo = [6 * result.metrics[key] - 5 * one.metrics[key] for one in without]
        half = 2.5705818366147395 * np.std(pseudo, ddof=1) / np.sqrt(6)  # Student's t, 5 degrees of freedom
        expected = (max(0.0, result.metrics[key] - half), min(1.0, result.metrics[key] + half))
        assert result.intervals[key] == pytest.approx(expected, abs=1e-9)


def test_a_single_scene_has_no_interval_and_two_have_one() -> None:
    assert combine(ROOM, noisy_scores("rooms-semantic", 1)).intervals == {"mAcc": None, "F-mIoU": None}
    assert all(combine(ROOM, noisy_scores("rooms-semantic", 2)).intervals.values())
    assert not any(combine(ROOM, noisy_scores("rooms-semantic", 2), with_intervals=False).intervals.values())


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
def test_reported_values_equal_those_of_the_full_result(aggregate: str) -> None:
    rules, scores = ROOM.model_copy(update={"aggregate": aggregate}), noisy_scores("rooms-semantic", 2)
    assert combined_metrics(rules, scores) == combine(rules, scores).metrics


def test_groups_are_averaged_over_the_classes_that_have_ground_truth() -> None:
    classes = [entry.model_copy(update={"group": "head"}) if entry.name == "chair" else entry for entry in ROOM.classes]
    rules = load_protocol("rooms-instance").model_copy(update={"classes": tuple(classes)})
    result = combine(rules, noisy_scores("rooms-instance", 3))
    assert result.groups == {"head": result.per_class["chair"]}


# ---- warnings


def warnings_of(name: str, prediction: Prediction, encoder: Encoder | None = None) -> str:
    rules = load_protocol(name)
    return "\n".join(combine(rules, {"rooms/a": score_scene(rules, room(), prediction, encoder)}).warnings)


CHAIRS = [np.flatnonzero(room().instance == k) for k in (2, 3)]


def chairs(masks: list[np.ndarray], *scores: float) -> Instances:
    return instances(room().points, masks, ["chair"] * len(masks), scores=scores or None)


def test_constant_confidences_give_a_warning_if_they_count() -> None:
    alike = chairs(CHAIRS, 0.25, 0.25)
    answer = warnings_of("rooms-instance", alike)
    assert answer == "rooms/a: all confidences are 0.25: AP per class is recall x (1 + precision) / 2"
    assert warnings_of("rooms-instance", chairs(CHAIRS, 0.25, 0.5)) == ""
    assert warnings_of("rooms-instance", chairs(CHAIRS[:1])) == ""  # a single one has no order
    assert warnings_of("replica-openmask3d", alike) == ""
    for name in (*SEMANTIC, "rooms-instance"):
        assert warnings_of(name, LABELLED) == ""


def test_duplicates_give_a_warning() -> None:
    of_one = CHAIRS[0]
    small = [of_one[:99], of_one[50:], of_one[50:], of_one[:99]]  # two of 100 points, and two that do not count
    answer = warnings_of("rooms-instance", chairs(small))
    assert answer.startswith("rooms/a: 1 pair of predictions overlaps with IoU above 0.9 (first 1 and 2); ")
    assert "3 pairs of predictions overlap with" in warnings_of("rooms-instance", chairs([of_one] * 3))


def test_different_encoder_gives_one_warning_for_all_scenes() -> None:
    rules = load_protocol("replica-mesh-ex6")
    answer = combine(rules, dict.fromkeys("abc", score_scene(rules, room(), UNLABELLED, ENCODER))).warnings
    assert len(answer) == 1
    assert "labels come from the encoder 'one-hot', the protocol's is 'ViT-H-14/laion2b_s32b_b79k'" in answer[0]
    assert warnings_of("rooms-semantic", UNLABELLED, ENCODER) == ""


def test_class_without_scored_points_gives_a_warning_and_counts_zero_only_in_its_scene() -> None:
    rules = load_protocol("replica-conceptgraphs-ex6")
    points = room().points[room().semantic != ID["lamp"]]
    truth = replace(room(), variant="conceptgraphs", evaluation_points=points)
    score = score_scene(rules, truth, truth_as_prediction(room(), with_labels=True), None)
    result = combine(rules, {"a": score})
    assert result.warnings == (
        "a: the ground truth has 'lamp', but no scored point does; such a class counts 0 in this scene",
    )
    assert result.per_scene["a"]["mAcc"] == 4 / 5
    assert result.pooled["mAcc"] == 1.0


def test_class_with_only_small_instances_gives_a_warning() -> None:
    truth = room(n_each=99)
    rules = load_protocol("rooms-instance")
    result = combine(rules, {"a": score_scene(rules, truth, truth_as_prediction(truth, with_labels=True), None)})
    assert np.isnan(result.metrics["AP"])
    assert result.warnings == (
        "not scored, because no scene has an instance of 100 points: "
        "'backpack', 'book', 'chair', 'cushion', 'lamp', 'table'",
    )


@pytest.mark.parametrize("name", [*SEMANTIC, "rooms-instance"])
def test_coverage_is_the_share_of_scored_points_without_a_predicted_point_in_the_radius(name: str) -> None:
    truth = room()
    rules = load_protocol(name)
    half = [k for k in range(8) if k != 4]  # the lamp is missing; the nearest object is 20 cm or more away
    whole = truth_as_prediction(truth, with_labels=True)
    prediction = instances(truth.points, [whole.mask(k) for k in half], [NAMES[k] for k in half])
    coverage = combine(rules, {"a": score_scene(rules, truth, prediction, None)}).coverage
    n_scored = 6 if name == "replica-mesh-ex6" else 7
    assert coverage == {"0.025": 1 / n_scored, "0.05": 1 / n_scored, "0.1": 1 / n_scored}


# ---- bytes


def test_packed_scores_contain_no_pickle_and_are_reproducible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scores = {name: score_scene(load_protocol(name), *noisy(0), None) for name in (*SEMANTIC, *INSTANCE)}
    data = pack_scores(scores)
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        assert all(archive[key].dtype != object for key in archive.files)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    assert pack_scores(unpack_scores(data)) == pack_scores(dict(reversed(scores.items()))) == data


@pytest.mark.parametrize("cut", [0, 10, 500])
def test_damaged_counts_are_a_data_error(cut: int) -> None:
    data = pack_scores({"rooms-semantic": score_scene(ROOM, *noisy(0), None)})
    with pytest.raises(DataError, match="counts: are damaged"):
        unpack_scores(data[:cut])


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"n_predictions": -1}, "'n_predictions' is -1"),
        ({"n_scored": 7e300}, r"'n_scored' is 7e\+300"),
        ({"n_farther": [2, 1, 9]}, r"'n_farther' is \[2, 1, 9\] of 3 scored points"),
        ({"n_farther": [1, 2, 0]}, r"'n_farther' is \[1, 2, 0\] of 3 scored points"),
        ({"protocol": "other"}, "'rooms-semantic' contains those of 'other'"),
    ],
)
def test_metadata_of_counts_is_checked(changed: dict[str, Any], line: str) -> None:
    score = replace(score_scene(ROOM, *noisy(0), None), n_scored=3, n_farther=np.array([2, 1, 0]))
    assert unpack_scores(pack_scores({ROOM.name: score}))[ROOM.name].n_scored == 3
    if "n_farther" in changed:
        changed = {"n_farther": np.array(changed["n_farther"])}
    with pytest.raises(DataError, match=f"counts: {line}; score the scene again"):
        unpack_scores(pack_scores({ROOM.name: replace(score, **changed)}))


def test_a_result_has_no_nan_in_its_json() -> None:
    result = combine(load_protocol("rooms-instance"), noisy_scores("rooms-instance", 2))
    text = json.dumps(result.to_json(), allow_nan=False)
    assert '"sofa": {"AP": null' in text


# ---- errors


UNFIT: list[tuple[str, Instances, Encoder | None, str]] = [
    ("rooms-semantic", replace(LABELLED, labels=None), ENCODER, "needs features and an encoder, or labels"),
    ("rooms-semantic", UNLABELLED, None, "needs features and an encoder, or labels"),
    ("rooms-semantic", replace(UNLABELLED, features=np.ones((8, 3), np.float32)), ENCODER,
     "features have 3 dimensions, the encoder 'one-hot' has 70"),
    ("rooms-semantic", replace(LABELLED, points=np.full_like(LABELLED.points, np.nan)), None, "not finite"),
    *((name, replace(LABELLED, scores=np.array([0.5] * 3 + [np.nan] * 5)), None, "instance 3 has the confidence nan")
      for name in ("rooms-semantic", "rooms-instance", "replica-openmask3d")),
]  # fmt: skip


@pytest.mark.parametrize(("name", "prediction", "encoder", "printed"), UNFIT)
def test_prediction_without_names_or_with_non_finite_values_is_refused(
    name: str, prediction: Instances, encoder: Encoder | None, printed: str
) -> None:
    with pytest.raises(PredictionError, match=printed):
        score_scene(load_protocol(name), room(), prediction, encoder)


def test_ground_truth_of_another_kind_is_refused() -> None:
    prediction = truth_as_prediction(room(), with_labels=True)
    with pytest.raises(DataError, match="needs ground truth 'mesh-vertices', this one is 'face-corners'"):
        score_scene(ROOM, replace(room(), variant="face-corners"), prediction, None)
    scannet = replace(room(), labels=LabelSet("scannet", (5,), ("chair",)))
    with pytest.raises(DataError, match="needs the label space 'replica', ground truth has 'scannet'"):
        score_scene(ROOM, scannet, prediction, None)


def test_scores_of_another_version_are_refused() -> None:
    score = score_scene(ROOM, *noisy(0), None)
    newer: ProtocolRules = ROOM.model_copy(update={"version": ROOM.version + 1})
    with pytest.raises(
        DataError, match="rooms/a: was scored under rooms-semantic version 2, not rooms-semantic version 3; score"
    ):
        combine(newer, {"rooms/a": score})
    with pytest.raises(DataError, match="no scene was scored"):
        combine(ROOM, {})


@pytest.mark.parametrize("name", ["rooms-semantic", "rooms-instance"])
def test_scores_of_other_classes_under_the_same_version_are_refused(name: str) -> None:
    rules = load_protocol(name)
    fewer = rules.model_copy(update={"classes": rules.classes[:5]})
    n_before, n_after = (len(one.curve_names) if one.kind == "instance" else len(one.classes) for one in (rules, fewer))
    with pytest.raises(
        DataError, match=f"rooms/0: was scored with {n_before} classes, {name} has {n_after} here; score it again"
    ):
        combine(fewer, noisy_scores(name, 1))


def test_an_instance_id_that_spills_into_the_next_class_is_refused() -> None:
    truth = replace(room(), instance=np.where(room().instance == 2, 1000, room().instance).astype(np.int32))
    with pytest.raises(DataError, match="instance id 1000 would spill into the next class"):
        score_scene(load_protocol("rooms-instance"), truth, truth_as_prediction(room(), with_labels=True), None)
