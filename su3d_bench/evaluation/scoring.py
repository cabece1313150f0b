"""One scene's prediction from elsewhere under one protocol: whether it fits, its counts, what stands beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core import registry
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import (
    DenseFeatures,
    Float32Array,
    Float64Array,
    GroundTruth,
    Instances,
    Int64Array,
    Masks,
    Prediction,
)
from su3d_bench.evaluation.checks import (
    MaskFacts,
    check_cloud,
    class_warnings,
    duplicate_warnings,
    empty_warnings,
    label_warnings,
    mask_facts,
)
from su3d_bench.evaluation.truth import MAX_NYU40_ID, TextTruth
from su3d_bench.metrics.fitness import why_not_scorable
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance.score import OBJECT, encode_without_classes, masks_and_scores
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    encoder_warning,
    has_every_label,
    scored_classes,
)
from su3d_bench.metrics.metric import SceneScore, present
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.predictions.base import Content, VertexLabels, VertexMasks

NAMED_KINDS = ("annotation", "reasoning")  # go by names alone
# Ground truths of ScanNet and whose class ids they hold.
ID_LISTS = {"nyu40-vertices": "ids of NYU40 do", "scannet200-vertices": "ids of ScanNet200 do"}


@dataclass(frozen=True)
class SceneOutcome:
    """A scene under a protocol: its counts, those of the ceiling, those of every mask under every class, facts."""

    score: SceneScore
    ceiling: SceneScore | None
    bound: instance_ap.InstanceCounts | None
    facts: MaskFacts | None
    warnings: tuple[str, ...]


def why_not_content(rules: ProtocolRules, content: Content, *, has_points: bool) -> str | None:
    """Why a prediction of this kind cannot be scored under the protocol; None where it can.

    ``has_points``: the points of the truth have coordinates.
    """
    if rules.kind in ("queries", "categories"):
        return f"needs ground truth of the form '{rules.ground_truth}', which neither a dataset nor such texts give"
    if not isinstance(content, VertexMasks | VertexLabels):
        if not has_points:
            return "the prediction has points of its own, the ground truth has no coordinates; name a --dataset"
        reason = why_not_scorable(rules, content)
        return reason.removeprefix(f"{rules.name}: ") if reason else _why_no_labels(rules, content)
    if isinstance(content, VertexLabels):
        if rules.kind == "instance":
            return "needs instances, the prediction has one class a point"
        return (
            None if has_points or rules.metric == "scannet" else "needs the coordinates of the points; name a --dataset"
        )
    if rules.kind == "semantic" and not has_points:
        return "needs a class for every point, the prediction has masks; name a --dataset to make them a map"
    if rules.class_agnostic is None and len(content):
        if content.class_numbers is None and content.features is None:
            return "needs classes, the masks have neither classes nor features"
        if content.class_numbers is not None and content.numbering == "id" and not content.class_numbers.any():
            return "needs classes, every mask has class 0"
    return None


def why_not_numbers(rules: ProtocolRules, content: Content) -> str | None:
    """Why the class ids of a prediction cannot be those of the protocol, where its label space has two lists of ids."""
    if rules.class_agnostic is not None or rules.ground_truth not in ID_LISTS:
        return None
    ids: np.ndarray | None = None
    if isinstance(content, VertexLabels):
        ids = content.class_ids
    elif isinstance(content, VertexMasks) and content.numbering == "id":
        ids = content.class_numbers
    if ids is None or not len(ids):
        return None
    found = "nyu40-vertices" if int(ids.max()) <= MAX_NYU40_ID else "scannet200-vertices"
    return (
        None
        if found == rules.ground_truth
        else f"the predicted classes go up to {int(ids.max())}, as {ID_LISTS[found]}"
    )


def _why_no_labels(rules: ProtocolRules, content: Prediction) -> str | None:
    lacks = isinstance(content, Instances) and len(content) and content.labels is None and content.features is None
    return (
        "needs classes, the instances have neither labels nor features" if lacks and not rules.class_agnostic else None
    )


def n_feature_dimensions(rules: ProtocolRules, content: Content) -> int | None:
    """The dimensions of the features that must be named; None where labels are there or the protocol needs none."""
    if rules.class_agnostic is not None or isinstance(content, VertexLabels) or rules.kind in NAMED_KINDS:
        return None
    if isinstance(content, VertexMasks):
        has_labels = content.class_numbers is not None
    else:
        compares = (
            rules.kind in ("queries", "retrieval") or rules.metric == "openlex3d-ranking"
        )  # with texts, whatever the labels
        has_labels = has_every_label(content) and not compares
    features = content.features
    return None if has_labels or features is None or not len(features) else int(features.shape[1])


def check_length(scene: str, content: Content, n_points: int) -> None:
    """``PredictionError`` where masks or labels are not over the points of the truth."""
    n = None
    if isinstance(content, VertexMasks):
        n = content.n_points
    elif isinstance(content, VertexLabels):
        n = len(content.class_ids)
    if n is not None and n != n_points:
        what = "masks are" if isinstance(content, VertexMasks) else "labels are"
        raise PredictionError(
            f"{scene}: the {what} of {n} points, the ground truth has {n_points}; both must be over the vertices of "
            "one mesh, in its order"
        )


def nothing_like(content: Content | None) -> Content:
    """An empty prediction of the same kind, for a scene that was not predicted; masks where no kind is known."""
    if isinstance(content, VertexLabels):
        return VertexLabels(np.zeros(0, np.int32))
    none = np.zeros(0, np.int32)
    return VertexMasks(np.zeros(1, np.int64), none, n_points=None, scores=np.zeros(0), class_numbers=none, keys=())


def score_on_vertices(
    rules: ProtocolRules, truth: TextTruth, scene: str, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome of masks or labels over points without coordinates: no neighbours, no coverage."""
    labels = truth.labels(scene)
    if isinstance(content, VertexLabels):
        class_ids = content.class_ids if len(content.class_ids) else np.zeros(len(labels), np.int32)
        ceiling = _semantic_score(rules, labels, labels)
        told = label_warnings(scene, rules, content.class_ids.astype(np.int64))
        return SceneOutcome(_semantic_score(rules, labels, class_ids), ceiling, None, None, tuple(told))
    assert isinstance(content, VertexMasks)
    values = truth.values[scene]
    if rules.class_agnostic is not None:
        is_scored = np.isin(labels, [entry.id for entry in rules.scored])
        values = encode_without_classes(rules.class_agnostic, values % instance_ap.INSTANCES_PER_CLASS, is_scored)
    ids = _ids_of_masks(rules, content, labels, encoder)
    facts = mask_facts(content, content.scores, len(values))
    told = [
        *empty_warnings(scene, facts, content, content.keys),
        *duplicate_warnings(scene, facts, content.keys),
        *class_warnings(scene, rules, content.class_numbers, ids),
    ]
    if (named := encoder_warning(rules, _instances(rules, content, np.zeros((0, 3), np.float32)), encoder)) is not None:
        told.append(named)
    return SceneOutcome(
        _instance_score(rules, values, content, content.scores, ids),
        _instance_ceiling(rules, truth, scene, values),
        _bound(rules, values, content, content.scores),
        facts,
        tuple(told),
    )


def _semantic_score(rules: ProtocolRules, labels: Int64Array, class_ids: np.ndarray) -> SceneScore:
    is_scored = scored_classes(rules)
    true_class = class_index_of_ids(rules, labels)
    counts = semantic.per_scene(true_class, class_index_of_ids(rules, class_ids), is_scored)
    return _score(rules, counts, len(np.unique(class_ids)), int((true_class >= 0).sum()))


def _instance_score(
    rules: ProtocolRules, values: Int64Array, masks: Masks, scores: Float64Array, ids: Int64Array
) -> SceneScore:
    assert rules.min_region_size is not None
    scores = np.ones(len(masks)) if rules.confidence == "ones" else scores
    class_ids = _class_ids(rules)
    counts = instance_ap.per_scene(
        values, masks.indptr, masks.indices, ids, scores, class_ids, rules.min_region_size, rules.thresholds
    )
    n_scored = int(np.isin(values // instance_ap.INSTANCES_PER_CLASS, class_ids).sum())
    return _score(rules, counts, len(masks), n_scored)


def _score(
    rules: ProtocolRules,
    counts: instance_ap.InstanceCounts | semantic.SemanticCounts,
    n_predictions: int,
    n_scored: int,
) -> SceneScore:
    nowhere = np.zeros(len(transfer.COVERAGE_RADII_M), np.int64)  # without coordinates nothing is known of distances
    return SceneScore(rules.name, rules.version, counts, n_predictions, n_scored, nowhere, ())


def _class_ids(rules: ProtocolRules) -> list[int]:
    return [OBJECT] if rules.class_agnostic is not None else [entry.id for entry in rules.scored]


def _ids_of_masks(rules: ProtocolRules, masks: VertexMasks, labels: Int64Array, encoder: Encoder | None) -> Int64Array:
    """The class id of each mask, 0 where it has none of the protocol's."""
    if rules.class_agnostic is not None:
        return np.full(len(masks), OBJECT, np.int64)
    if masks.class_numbers is not None:
        return _ids_of_numbers(rules, masks)
    is_present = present(class_index_of_ids(rules, labels), len(rules.classes)) & scored_classes(rules)
    instances = _instances(rules, masks, np.zeros((0, 3), np.float32))
    classes = classes_of_prediction(rules, instances, encoder, candidate_classes(rules, is_present))
    ids = np.array([entry.id for entry in rules.classes], np.int64)
    return np.where(classes >= 0, ids[classes], 0) if len(classes) else np.zeros(0, np.int64)


def _ids_of_numbers(rules: ProtocolRules, masks: VertexMasks) -> Int64Array:
    """Class ids from what the file has: ids already, or places in the list of the classes that are scored."""
    assert masks.class_numbers is not None
    numbers = masks.class_numbers.astype(np.int64)
    if masks.numbering == "id":
        return numbers
    ids = np.array([entry.id for entry in rules.scored], np.int64)
    is_known = (numbers >= 0) & (numbers < len(ids))
    return np.where(is_known, ids[np.where(is_known, numbers, 0)], 0)


def _instance_ceiling(rules: ProtocolRules, truth: TextTruth, scene: str, values: Int64Array) -> SceneScore:
    """What the annotated objects themselves score."""
    own = truth.values[scene]
    n_of_value = np.bincount(own, minlength=1)
    distinct = np.flatnonzero(n_of_value[instance_ap.INSTANCES_PER_CLASS :]) + instance_ap.INSTANCES_PER_CLASS
    row_of_value = np.full(len(n_of_value), -1, np.int64)
    row_of_value[distinct] = np.arange(len(distinct))
    masks = transfer.masks_of_partition(row_of_value[own], len(distinct))
    labels = distinct // instance_ap.INSTANCES_PER_CLASS
    ids = np.full(len(distinct), OBJECT) if rules.class_agnostic is not None else labels
    return _instance_score(rules, values, masks, np.ones(len(distinct)), ids.astype(np.int64))


def _bound(
    rules: ProtocolRules, values: Int64Array, masks: Masks, scores: np.ndarray
) -> instance_ap.InstanceCounts | None:
    if rules.class_agnostic is not None:
        return None
    assert rules.min_region_size is not None
    used = np.ones(len(masks)) if rules.confidence == "ones" else scores
    return instance_ap.per_scene(
        values,
        masks.indptr,
        masks.indices,
        None,
        used,
        _class_ids(rules),
        rules.min_region_size,
        rules.thresholds,
    )


def _instances(rules: ProtocolRules, masks: VertexMasks, points: Float32Array) -> Instances:
    """Masks over the truth's points as a map on these points."""
    k = len(masks)
    labels = None
    if masks.class_numbers is not None:
        name_of = {entry.id: entry.name for entry in rules.classes}
        ids = _ids_of_numbers(rules, masks)
        labels = tuple(name_of.get(int(one), f"class {one}") for one in ids)
    elif not k:
        labels = ()
    shown = masks if len(points) else Masks.of_sets([masks.indices[:0]] * k)
    return Instances.of(points, shown, masks.scores, masks.features, labels=labels, names=masks.keys)


def _map_of_labels(rules: ProtocolRules, content: VertexLabels, points: Float32Array) -> Instances:
    """One mask a predicted class over the truth's points."""
    distinct, row = np.unique(content.class_ids, return_inverse=True)
    masks = transfer.masks_of_partition(row, len(distinct))
    keys = tuple(f"class {one}" for one in distinct)
    of_classes = VertexMasks(
        masks.indptr,
        masks.indices,
        n_points=len(content.class_ids),
        scores=np.ones(len(distinct)),
        class_numbers=distinct.astype(np.int32),
        keys=keys,
    )
    return _instances(rules, of_classes, points)


def score_on_truth(
    rules: ProtocolRules, truth: GroundTruth, scene: str, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome against the truth of a dataset; what has no points of its own stands on those of the truth."""
    told: list[str] = []
    if isinstance(content, VertexMasks):
        prediction: Prediction = _instances(rules, content, truth.points)
        if content.class_numbers is not None:
            told += class_warnings(scene, rules, content.class_numbers, _ids_of_numbers(rules, content))
    elif isinstance(content, VertexLabels):
        prediction = _map_of_labels(rules, content, truth.points)
        told += label_warnings(scene, rules, content.class_ids.astype(np.int64))
    else:
        prediction = content
        told += check_cloud(scene, prediction.points, truth.points)
    facts = None
    masks, scores = _masks_and_scores(prediction)
    if masks is not None and not isinstance(content, VertexLabels):
        facts = mask_facts(masks, scores, len(prediction.points))
        told += empty_warnings(scene, facts, masks, getattr(prediction, "names", ()))
    return SceneOutcome(
        score_scene(rules, truth, prediction, encoder),
        _oracle_score(rules, truth),
        None if masks is None else _bound_on_truth(rules, truth, prediction, masks, scores),
        facts,
        tuple(told),
    )


def _masks_and_scores(prediction: Prediction) -> tuple[Masks | None, np.ndarray]:
    return (None, np.zeros(0)) if isinstance(prediction, DenseFeatures) else masks_and_scores(prediction)


def _bound_on_truth(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, masks: Masks, scores: np.ndarray
) -> instance_ap.InstanceCounts | None:
    if rules.kind != "instance" or rules.class_agnostic is not None:
        return None
    cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    moved = transfer.transfer_masks(prediction.points, masks, truth.points, cap_m, voxel_m)
    return _bound(rules, instance_ap.encode_ground_truth(truth.semantic, truth.instance), moved, scores)


def _oracle_score(rules: ProtocolRules, truth: GroundTruth) -> SceneScore | None:
    """What the truth itself scores through the same steps; None where it has no instances to hand over."""
    if not truth.instance.any():
        return None
    method_class = registry.load("method", "oracle")
    oracle = method_class(method_class.Config())
    oracle.receive_truth(truth)
    return score_scene(rules, truth, oracle.finish(), None)
