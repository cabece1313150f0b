"""Semantic protocols by the vote of several neighbours: HOV-SG's and OVO's; and ScanNet's with 20 and 200 classes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from places import CASES
from scored_room import ENCODER, ID, LABELS, OneHotEncoder, instances, nothing, room, truth_as_prediction

from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet
from su3d_bench.evaluation.ground_truth import VertexTruth
from su3d_bench.evaluation.scoring import score_on_vertices
from su3d_bench.metrics.matching.labelling import text_features
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.metrics.semantic.confusion import hovsg_metrics, per_scene
from su3d_bench.predictions.base import VertexLabels

GOLDEN = json.loads((CASES / "conceptgraphs_golden.json").read_text())["hovsg"]
HOVSG, EXACT, OVO = (load_protocol(name) for name in ("replica-hovsg", "replica-hovsg-exact", "replica-ovo51"))


def fitting(rules: ProtocolRules, truth: GroundTruth) -> GroundTruth:
    return replace(truth, variant=rules.ground_truth)


def metrics(rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition | DenseFeatures) -> list[float]:
    result = combine(rules, {"room": score_scene(rules, fitting(rules, truth), prediction, ENCODER)})
    return [result.metrics[name] for name in rules.headline]


# ---- what the original answers


def test_the_golden_hovsg_values_come_out() -> None:
    as_index = {-1: 0} | {one: one for one in range(8)}  # -1 and 0 are ignored alike
    truth, predicted = (np.array([as_index[one] for one in GOLDEN[key]]) for key in ("gt", "pred"))
    is_scored = np.array([one not in GOLDEN["ignore"] for one in range(8)])
    confusion = per_scene(truth, predicted, np.ones(8, bool)).confusion
    ours = hovsg_metrics(confusion, is_scored)
    assert ours.class_index.tolist() == [1, 2, 3, 5]
    assert ours.mean_iou == GOLDEN["miou"]
    assert ours.frequency_weighted_iou == pytest.approx(GOLDEN["fmiou"], rel=1e-15)
    assert ours.mean_accuracy == pytest.approx(GOLDEN["macc"], rel=1e-15)
    assert ours.point_accuracy == pytest.approx(GOLDEN["pacc"], rel=1e-15)


def test_a_class_of_a_single_point_counts() -> None:
    metrics = hovsg_metrics(np.array([[1, 0, 0], [0, 3, 1]]), np.array([True, True]))
    assert metrics.class_index.tolist() == [0, 1]
    assert metrics.mean_accuracy == (1 + 0.75) / 2


# ---- the label set


def test_the_substring_rule_leaves_out_the_classes_that_the_original_does() -> None:
    ignored = {entry.id for entry in HOVSG.classes if HOVSG.is_ignored(entry.name)}
    assert ignored == {0, 31, 37, 40, 44, 93, 94, 95, 97}
    assert {entry.id for entry in EXACT.classes if EXACT.is_ignored(entry.name)} == {0, 31, 37, 40, 93, 97}
    assert (len(HOVSG.classes), len(OVO.classes)) == (102, 51)


def test_the_mean_of_the_prompts_is_that_of_their_directions() -> None:
    class Loud(OneHotEncoder):
        """The second template speaks a hundred times as loud, along an axis of its own."""

        def encode_texts(self, texts: Sequence[str]) -> Float32Array:
            return np.array([[100.0, 0.0] if text.startswith("There") else [0.0, 1.0] for text in texts], np.float32)

    mean = text_features(HOVSG, ["chair", "table"], np.zeros((1, 2)), Loud())
    assert mean.tolist() == [[0.5, 0.5]] * 2
    assert text_features(OVO, ["chair"], np.zeros((1, 2)), Loud()).tolist() == [[0.0, 1.0]]


# ---- a whole scene


@pytest.mark.parametrize("rules", [HOVSG, EXACT], ids=lambda rules: str(rules.name))
def test_the_truth_on_its_own_points_does_not_reach_one_where_objects_meet(rules: ProtocolRules) -> None:
    """The vote of the neighbours smooths the border, on the scored points themselves too."""
    truth = two_that_meet(rules)
    prediction = truth_as_prediction(truth, with_labels=True)
    assert all(0.8 < value < 1 for value in metrics(rules, truth, prediction))
    alone = rules.model_copy(update={"transfer": rules.transfer.model_copy(update={"neighbours": 1})})
    assert set(metrics(alone, truth, prediction)) == {1.0}


def test_what_lies_on_the_vertices_is_not_voted_on_under_ovo_and_a_cloud_beside_them_is() -> None:
    truth = two_that_meet(OVO)
    prediction = truth_as_prediction(truth, with_labels=True)
    assert set(metrics(OVO, truth, prediction)) == {1.0}
    assert all(0.8 < value < 1 for value in metrics(OVO, truth, replace(prediction, points=truth.points + 1e-6)))


def test_under_ovo_neighbours_vote_for_their_object_and_not_for_its_class() -> None:
    """Two points of a chair among one of each of three tables: the chair, though three points say table."""
    vertex = np.zeros((1, 3), np.float32)
    ring = np.array([[0.1, 0, 0], [0, 0.11, 0], [0, 0, 0.12], [-0.13, 0, 0], [0, -0.14, 0]], np.float32)
    of_chair = np.array([ID["chair"]], np.int32)
    truth = GroundTruth(vertex, of_chair, np.ones(1, np.int32), LABELS, OVO.ground_truth, "test")
    objects = [np.array([0, 1]), np.array([2]), np.array([3]), np.array([4])]
    found = instances(ring, objects, ["chair", "table", "table", "table"])
    for rules, recall in ((OVO, 1.0), (HOVSG, 0.0)):
        scores = {"a": score_scene(rules, fitting(rules, truth), found, None)}
        assert combine(rules, scores).per_class["chair"]["recall"] == recall
    dense = DenseFeatures(ring, ENCODER.encode_texts(["chair", "chair", "table", "table", "table"]).astype(np.float16))
    scores = {"a": score_scene(OVO, fitting(OVO, truth), dense, ENCODER)}
    assert combine(OVO, scores).per_class["chair"]["recall"] == 0.0  # without objects the classes vote


def two_that_meet(rules: ProtocolRules) -> GroundTruth:
    """A chair and a table side by side."""
    rng = np.random.default_rng(0)
    points = rng.random((400, 3)).astype(np.float32)
    semantic = np.where(points[:, 0] < 0.5, ID["chair"], ID["table"]).astype(np.int32)
    return GroundTruth(points, semantic, (semantic == ID["chair"]) + np.int32(1), LABELS, rules.ground_truth, "test")


def test_what_is_predicted_on_an_ignored_surface_lowers_the_iou_under_hovsg_and_not_under_conceptgraphs() -> None:
    truth = room()
    whole = truth_as_prediction(truth, with_labels=True)
    names = whole.labels or ()
    clean, spilled = whole, replace(whole, labels=tuple("chair" if name == "wall" else name for name in names))
    for rules, is_lower in ((HOVSG, True), (load_protocol("replica-mesh-ex6"), False)):
        values = []
        for prediction in (clean, spilled):
            result = combine(rules, {"a": score_scene(rules, fitting(rules, truth), prediction, None)})
            values.append(result.per_class["chair"]["IoU"])
        assert (values[1] < values[0]) == is_lower


def test_objects_that_overlap_vote_each_and_one_without_a_class_does_not() -> None:
    truth = room()
    chairs = np.flatnonzero(truth.instance == 2)
    for extra, recall in ((["table", "table"], 0.0), (["unheard", "unheard"], 1.0), (["table", "chair"], 1.0)):
        prediction = instances(truth.points, [chairs] * 3, ["chair", *extra])
        alone = replace(truth, semantic=np.where(truth.instance == 2, truth.semantic, 0).astype(np.int32))
        score = score_scene(HOVSG, fitting(HOVSG, alone), prediction, None)
        assert combine(HOVSG, {"a": score}).per_class["chair"]["recall"] == recall


def test_under_ovo_what_has_no_class_is_called_the_last_class_of_its_list() -> None:
    """update_confmat takes -1 as an index: of the column of the last class."""
    lists = {name: load_protocol(name).unnamed for name in ("replica-ovo51", "scannet-ovo20", "scannet-ovo200")}
    assert lists == {"replica-ovo51": "switch", "scannet-ovo20": "background", "scannet-ovo200": "mattress"}
    truth = fitting(OVO, room())
    switch = next(entry.id for entry in OVO.classes if entry.name == "switch")
    chairs = np.flatnonzero(truth.instance == 2)
    is_switch = truth.instance == 2
    with_switch = replace(truth, semantic=np.where(is_switch, switch, truth.semantic).astype(np.int32))
    for found in (
        instances(truth.points, [chairs], ["unheard"]),  # an object of no class
        instances(truth.points, [chairs[:1]], ["switch"]),  # vertices in no mask
        instances(truth.points + np.float32(0.001), [chairs, chairs[:9]], ["unheard", "chair"]),  # it votes
    ):
        result = combine(OVO, {"a": score_scene(OVO, with_switch, found, None)})
        assert result.per_class["switch"]["recall"] > 0.9
    of_chairs = combine(OVO, {"a": score_scene(OVO, truth, instances(truth.points, [chairs], ["unheard"]), None)})
    assert of_chairs.per_class["switch"]["IoU"] == 0.0  # never true, and predicted: it counts
    assert set(metrics(OVO, with_switch, nothing(truth))) == {0.0}


def test_a_class_a_vertex_beside_files_of_truth_counts_alike() -> None:
    rules = load_protocol("scannet-ovo20")
    labels = np.array([1, 1, 2, 0])
    truth = VertexTruth(labels * 1000 + 1, labels, ())
    called = VertexLabels(np.array([1, -1, 0, -1], np.int32))
    outcome = score_on_vertices(rules, truth, "a", called, None)
    found = combine(rules, {"a": outcome.score})
    assert found.per_class["background"]["IoU"] == 0.0  # two labelled vertices are called so
    assert found.per_class["wall"]["recall"] == 0.5
    assert found.metrics["mIoU"] == pytest.approx(0.5 / 3)
    none = score_on_vertices(rules, truth, "a", VertexLabels(np.zeros(0, np.int32)), None)
    assert np.isnan(combine(rules, {"a": none.score}).per_class["background"]["IoU"])


def test_objects_of_the_first_class_vote_as_all_others() -> None:
    truth, first = room(), OVO.classes[0]
    own = np.flatnonzero(truth.instance == 2)
    semantic = np.where(truth.instance == 2, first.id, 0).astype(np.int32)
    scene = replace(fitting(OVO, truth), semantic=semantic)
    score = score_scene(OVO, scene, instances(truth.points, [own], [first.name]), None)
    assert combine(OVO, {"a": score}).per_class[first.name]["recall"] == 1.0


# ---- ScanNet


def scan(rules: ProtocolRules, truth_names: Sequence[str], predicted: Sequence[str]) -> dict[str, dict[str, float]]:
    """Values of each class of a scan with ten points a name, and of its groups."""
    labels = LabelSet("scannet", tuple(c.id for c in rules.classes), tuple(c.name for c in rules.classes))
    known = dict(zip(labels.names, labels.ids, strict=True))
    semantic = np.repeat([known.get(name, 0) for name in truth_names], 10).astype(np.int32)
    points = np.random.default_rng(0).random((len(semantic), 3)).astype(np.float32)
    truth = GroundTruth(points, semantic, semantic, labels, rules.ground_truth, "made for a test")
    masks = [np.arange(10 * k, 10 * k + 10) for k in range(len(predicted))]
    result = combine(rules, {"a": score_scene(rules, truth, instances(points, masks, predicted), None)})
    return {**result.per_class, **result.groups, "all": dict(result.metrics)}  # type: ignore[dict-item]


@pytest.mark.parametrize("name", ["scannet-semantic", "scannet200-semantic"])
def test_scannet_counts_a_prediction_of_no_known_class_as_wrong_and_an_absent_class_not_at_all(name: str) -> None:
    values = scan(load_protocol(name), ["chair", "chair", "table", "unlabelled"], ["chair", "ufo", "desk", "sink"])
    assert values["chair"]["IoU"] == values["chair"]["recall"] == 0.5
    assert values["table"]["IoU"] == 0.0
    assert values["desk"]["IoU"] == 0.0 and np.isnan(values["desk"]["recall"])  # never true, yet predicted
    assert np.isnan(values["sink"]["IoU"])  # predicted on an unlabelled point alone
    assert np.isnan(values["bathtub"]["IoU"])
    assert values["all"]["mIoU"] == pytest.approx(0.5 / 3)
    assert values["all"]["mAcc"] == 0.25


def test_scannet200_has_the_means_of_its_three_groups() -> None:
    rules = load_protocol("scannet200-semantic")
    assert [sum(c.group == name for c in rules.scored) for name in ("head", "common", "tail")] == [66, 68, 66]
    values = scan(rules, ["chair", "table", "bag", "cup"], ["chair", "chair", "bag", "clock"])
    assert values["head"] == {"mAcc": 0.5, "mIoU": 0.25}
    assert values["common"] == {"mAcc": 1.0, "mIoU": 1.0}
    assert values["tail"] == {"mAcc": 0.0, "mIoU": 0.0}
