"""One scene under one protocol: its counts, those of the ceiling, and the warnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from su3d_bench.core import registry
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition, Prediction
from su3d_bench.core.types import Float32Array, Float64Array, GroundTruth, Int64Array
from su3d_bench.evaluation.ground_truth import DatasetTruths, SceneTruths, VertexTruth
from su3d_bench.evaluation.result import SceneOutcome
from su3d_bench.metrics.compatibility import ContentFacts, needs_map
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.score import (
    OBJECT,
    encode_without_classes,
    masks_and_scores,
    named_classes,
    without_labels,
)
from su3d_bench.metrics.matching import checks, transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning, scored_classes
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.protocols.loading import protocol_names
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import QuestionTruth, metric_of, score_located, score_scene
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.metrics.semantic.panoptic import PanopticCounts, count_segments, visible_truth
from su3d_bench.metrics.semantic.score import with_unnamed
from su3d_bench.predictions.base import Content, VertexLabels, VertexMasks, ids_of, named

NOTHING = Instances.of(np.zeros((0, 3), np.float32), [], labels=())


def with_confidences_of_files(rules: ProtocolRules) -> ProtocolRules:
    """The rules with the predictions' own confidences if a protocol sets 1 for every mask."""
    return rules.model_copy(update={"confidence": "prediction"}) if rules.confidence == "ones" else rules


def skips_missing_scenes(rules: ProtocolRules) -> bool:
    """Whether the original skips scenes without a prediction, so that their objects never count as missed.

    evaluate_semantic_instance.py, evaluate_semantic_label.py and their derivatives iterate over the prediction files,
    except OpenSUN3D's and those whose files have indices into a list of classes, which stop at the first scene without
    a prediction. Custom protocols and those of the generated scenes have no original.
    """
    stops = rules.class_agnostic == "numbered" or (rules.class_numbers == "lines" and rules.names_masks)
    if rules.metric != "scannet" or rules.name not in protocol_names() or stops:
        return False
    return not any(getattr(registry.load("dataset", name), "renders_frames", False) for name in rules.datasets)


def facts_of(content: Content) -> ContentFacts:
    """The facts that decide whether a protocol can score ``content``."""
    if isinstance(content, VertexLabels):
        n = len(content.class_ids)
        ids = content.class_ids if content.numbering == "id" else None
        return ContentFacts("vertex-labels", n, class_ids=ids, n_points=n)
    if not isinstance(content, VertexMasks):
        return ContentFacts.of(content)
    return ContentFacts(
        "vertex-masks",
        len(content),
        n_dimensions=None if content.features is None else content.features.shape[1],
        has_labels=content.class_numbers is not None,
        class_ids=content.class_numbers if content.numbering == "id" else None,
        n_points=content.n_points,
    )


def empty_like(content: Content | None) -> Content:
    """An empty prediction of the same kind, for a scene without a prediction; masks if the kind is unknown."""
    none = np.zeros(0, np.int32)
    if isinstance(content, VertexLabels):
        return VertexLabels(none)
    return VertexMasks(np.zeros(1, np.int64), none, n_points=None, scores=np.zeros(0), class_numbers=none, keys=())


def score_on_vertices(
    rules: ProtocolRules, truth: VertexTruth, scene: str, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome of masks or labels over points without coordinates: no neighbours, no coverage."""
    labels, values = truth.labels, truth.values
    if isinstance(content, VertexLabels):
        predicted = ids_of(content.class_ids, content.numbering, rules)
        class_ids = predicted if len(predicted) else np.zeros(len(labels), np.int64)
        warnings = checks.label_warnings(scene, rules, predicted)
        score, ceiling = (_semantic_score(rules, labels, called) for called in (class_ids, labels))
        return SceneOutcome(score, ceiling, warnings=tuple(warnings))
    assert isinstance(content, VertexMasks)
    if rules.class_agnostic is not None:
        values = encode_without_classes(rules, values)
    ids, encoded = _ids_of_masks(rules, content, labels, encoder)
    facts = checks.mask_facts(content, content.scores, len(values))
    score = _instance_score(rules, values, content, content.scores, ids)
    shared = checks.mask_warnings(rules, content, content.scores, content.keys)
    if not score.counts.has_match:
        is_object = truth.values >= instance_ap.INSTANCES_PER_CLASS
        shared += checks.overlap_warnings(content, np.where(is_object, truth.values, 0))
    warnings = [
        *checks.duplicate_warnings(scene, facts, content.keys),
        *checks.class_warnings(scene, rules, content.class_numbers, ids),
        *_melted(scene, rules, truth.values),
        *encoded,
    ]
    has_bound = rules.names_masks and bool(rules.confidences)
    return SceneOutcome(
        replace(score, warnings=tuple(shared)),
        _instance_ceiling(rules, truth, values),
        _instance_counts(rules, values, content, content.scores, None) if has_bound else None,
        facts,
        tuple(warnings),
    )


def _melted(scene: str, rules: ProtocolRules, values: Int64Array) -> list[str]:
    """A warning if a protocol, like its original, merges objects that share a number."""
    if rules.class_agnostic != "everything":
        return []
    objects = np.unique(values[values >= instance_ap.INSTANCES_PER_CLASS])
    n = len(objects) - len(np.unique(objects % instance_ap.INSTANCES_PER_CLASS))
    if not n:
        return []
    return [
        f"{scene}: instance numbers restart with each class, so {n} of {len(objects)} objects merge with another of the"
        " same number, as in the original (values modulo 1000); number the objects of a scene consecutively"
    ]


def _semantic_score(rules: ProtocolRules, labels: Int64Array, class_ids: np.ndarray) -> SceneScore:
    true_class = class_index_of_ids(rules, labels)
    called = class_index_of_ids(rules, class_ids)
    if class_ids.any():  # otherwise nothing was predicted
        called = with_unnamed(rules, called)
    counts = semantic.per_scene(true_class, called, scored_classes(rules))
    return _score(rules, counts, len(np.unique(class_ids)), int((true_class >= 0).sum()))


def _instance_score(
    rules: ProtocolRules, values: Int64Array, masks: Masks, scores: Float64Array, ids: Int64Array
) -> SceneScore:
    _, distinct, n_points = scene_counts.segments_of(values)
    n_scored = int(n_points[np.isin(distinct // instance_ap.INSTANCES_PER_CLASS, _class_ids(rules))].sum())
    count = _instance_counts if rules.confidences else _segment_counts
    return _score(rules, count(rules, values, masks, scores, ids), len(masks), n_scored)


def _segment_counts(
    rules: ProtocolRules, values: Int64Array, masks: Masks, scores: Float64Array, ids: Int64Array
) -> PanopticCounts:
    """The counts of masks with class ids (K,) if every point is in one segment."""
    semantic, instance = np.divmod(values, instance_ap.INSTANCES_PER_CLASS)
    return count_segments(rules, semantic, instance, masks, scores, ids)


def _instance_counts(
    rules: ProtocolRules, values: Int64Array, masks: Masks, scores: Float64Array, ids: Int64Array | None
) -> instance_ap.InstanceCounts:
    """The counts of masks with class ids (K,), or of each mask with every class if ``ids`` is None."""
    assert rules.min_region_size is not None
    used = np.ones(len(masks)) if rules.confidence == "ones" else scores
    return scene_counts.per_scene(
        values,
        masks.indptr,
        masks.indices,
        ids,
        used,
        _class_ids(rules),
        rules.min_region_size,
        rules.thresholds,
        void=rules.void,
    )


def _score(
    rules: ProtocolRules,
    counts: instance_ap.InstanceCounts | semantic.SemanticCounts | PanopticCounts,
    n_predictions: int,
    n_scored: int,
) -> SceneScore:
    nowhere = np.zeros(len(transfer.COVERAGE_RADII_M), np.int64)  # distances are unknown without coordinates
    return SceneScore(rules.name, rules.version, counts, n_predictions, n_scored, nowhere, ())


def _class_ids(rules: ProtocolRules) -> list[int]:
    return [OBJECT] if rules.class_agnostic is not None else [entry.id for entry in rules.scored]


def _ids_of_masks(
    rules: ProtocolRules, masks: VertexMasks, labels: Int64Array, encoder: Encoder | None
) -> tuple[Int64Array, list[str]]:
    """The class id of each mask, 0 if it has none of the protocol's; and warnings on the names."""
    if rules.class_agnostic is not None or not len(masks):
        return np.full(len(masks), OBJECT, np.int64), []
    if masks.class_numbers is not None:
        return masks.class_ids(rules), []
    assert masks.features is not None  # the protocol would not score masks without classes and features
    rows = Partition(NOTHING.points, np.zeros(0, np.int32), masks.features)
    warning = encoder_warning(rules, rows, encoder)
    return named_classes(rules, labels, rows, encoder), [] if warning is None else [warning]


def _instance_ceiling(rules: ProtocolRules, truth: VertexTruth, values: Int64Array) -> SceneScore:
    """The score of the annotated objects themselves."""
    row, distinct, _ = scene_counts.segments_of(truth.values)
    is_object = distinct >= instance_ap.INSTANCES_PER_CLASS
    n_void = int((~is_object).sum())
    masks = transfer.masks_of_partition(row - n_void, len(distinct) - n_void)
    labels = distinct[is_object] // instance_ap.INSTANCES_PER_CLASS
    ids = np.full(len(labels), OBJECT, np.int64) if rules.class_agnostic is not None else labels
    return _instance_score(rules, values, masks, np.ones(len(masks)), ids)


def score_on_truth(
    rules: ProtocolRules, truth: GroundTruth, scene: str, content: Content, encoder: Encoder | None
) -> SceneOutcome:
    """The outcome against a dataset's ground truth; content without its own points uses those of the ground truth."""
    prediction = map_of(content, truth.points, rules)
    with named(scene):
        score = score_located(rules, truth, prediction, encoder)
    warnings = list[str]()
    if isinstance(content, VertexMasks):
        warnings = checks.class_warnings(scene, rules, content.class_numbers, content.class_ids(rules))
    elif isinstance(content, VertexLabels):
        warnings = checks.label_warnings(scene, rules, ids_of(content.class_ids, content.numbering, rules))
    if warnings:  # these say the same of numbers
        score = replace(score, warnings=tuple(line for line in score.warnings if checks.NO_CLASSES not in line))
    facts = bound = None
    if not isinstance(prediction, DenseFeatures):
        masks, scores = masks_and_scores(prediction)
        if not isinstance(content, VertexLabels):
            facts = checks.mask_facts(masks, scores, len(prediction.points))
        if rules.names_masks and rules.confidences:
            values, moved, scores = without_labels(rules, truth, prediction)
            bound = _instance_counts(rules, values, moved, scores, None)
    return SceneOutcome(score, _oracle_score(rules, truth), bound, facts, tuple(warnings))


def map_of(content: Content, points: Float32Array, rules: ProtocolRules) -> Prediction:
    """The map of ``content``; content without its own points uses those of the ground truth."""
    return content.on(points, rules) if isinstance(content, VertexMasks | VertexLabels) else content


def vertices_for(rules: ProtocolRules, truths: SceneTruths, scene: str, content: Content) -> Float32Array | None:
    """The points of masks over vertices if a protocol scores them as a map; None for other content."""
    if not isinstance(truths, DatasetTruths) or not isinstance(content, VertexMasks) or not needs_map(rules):
        return None
    return truths.vertices(scene, content.n_points) if len(content) else None


def on_vertices(content: Content, points: Float32Array, rules: ProtocolRules) -> Instances:
    """The map of masks over these vertices; their class numbers mean nothing to a protocol without classes."""
    assert isinstance(content, VertexMasks)
    return (content if rules.classes else replace(content, class_numbers=None)).on(points, rules)


def _oracle_score(rules: ProtocolRules, truth: GroundTruth) -> SceneScore | None:
    """The score of the ground truth through the same steps; None if it has no instances."""
    visible = visible_truth(rules, truth)
    if not visible.instance.any():
        return None
    method_class = registry.load("method", "oracle")
    oracle = method_class(method_class.Config())
    oracle.receive_ground_truth(visible)
    return score_scene(rules, truth, oracle.finish(), None)


def score_on_objects(
    rules: ProtocolRules,
    truth: OpenLexTruth | QueryTruth | QuestionTruth,
    scene: str,
    content: Content,
    encoder: Encoder | None,
) -> SceneOutcome:
    """The outcome against objects with labels, queries or questions; an empty map if ``content`` has no points.

    Labels n' are those of the vote, because a file next to a run's map is not part of a prediction.
    """
    prediction: Prediction = NOTHING if isinstance(content, VertexMasks | VertexLabels) else content
    with named(scene):
        score = score_located(rules, truth, prediction, encoder)
    facts = None
    if isinstance(prediction, Instances):
        facts = checks.mask_facts(prediction, np.asarray(prediction.scores, np.float64), len(prediction.points))
    remark = metric_of(rules).ceiling_remark
    return SceneOutcome(score, facts=facts, warnings=() if remark is None else (remark,))
