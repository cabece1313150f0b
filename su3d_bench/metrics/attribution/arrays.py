"""What a protocol's evaluator sees of a scene, as plain arrays: the masks with their classes, or the scored points.

The same steps as in scoring, up to where counts are formed; whoever uses them compares the counts with those stored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import (
    BoolArray,
    DenseFeatures,
    Float64Array,
    GroundTruth,
    Instances,
    Int64Array,
    Partition,
    Prediction,
)
from su3d_bench.metrics.attribution.overlaps import LabelledMasks, ScoringRules
from su3d_bench.metrics.attribution.points import LabelledPoints
from su3d_bench.metrics.instance.score import masks_and_scores, truth_and_labels
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching import votes as neighbours
from su3d_bench.metrics.matching.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    scored_classes,
)
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.metrics.scene_score import present
from su3d_bench.metrics.semantic.score import counted_classes, point_owners, points_and_owners, taking_part


def scored_masks(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> tuple[Int64Array, LabelledMasks, ScoringRules]:
    """The truth (N,) as label * 1000 + instance, and the masks on its points, under a protocol of kind ``instance``."""
    assert rules.min_region_size is not None
    values, scored_ids, labels = truth_and_labels(rules, truth, prediction, encoder)
    masks, scores = masks_and_scores(prediction)
    moved = transfer.transfer_masks(
        prediction.points, masks, truth.points, rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    )
    scores = np.ones(len(scores)) if rules.confidence == "ones" else scores
    scoring = ScoringRules(tuple(scored_ids), rules.min_region_size, rules.thresholds)
    return values, LabelledMasks(moved, labels.astype(np.int64), scores), scoring


@dataclass(frozen=True)
class ScoredPoints:
    """The points that a protocol of kind ``semantic`` counts; ``is_counted`` (C,) classes are in its matrix."""

    points: LabelledPoints
    is_counted: BoolArray
    has_masks: bool


def scored_points(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> ScoredPoints:
    """What each evaluation point is, is called, and by which mask.

    Where several neighbours vote, the mask is the one that most of them belong to.
    """
    class_of_label = class_index_of_ids(rules, truth.semantic)
    is_scored = scored_classes(rules)
    is_present = present(class_of_label, len(rules.classes)) & is_scored
    object_id = _object_ids(truth, class_of_label)
    targets, true_class = truth.points, class_of_label
    if truth.evaluation_points is not None:
        targets = truth.evaluation_points
        _, found = transfer.nearest(truth.points, targets)
        true_class = np.where(found >= 0, class_of_label[found], -1)
        object_id = object_id[found]
    counted = counted_classes(rules, is_scored, is_present)
    wanted = (true_class >= 0) & counted[true_class]
    classes = classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))
    predicted, mask, mask_distance_m = _called(rules, prediction, classes, is_scored, targets, wanted)
    map_distance_m = np.full(len(targets), np.inf)
    asked = np.flatnonzero(wanted)
    map_distance_m[asked], _ = transfer.nearest(prediction.points, targets[asked])
    points = LabelledPoints(
        true_class=true_class,
        predicted=predicted,
        is_scored=wanted & is_scored[true_class],
        object_id=object_id,
        mask=mask,
        map_distance_m=map_distance_m,
        mask_distance_m=mask_distance_m,
    )
    return ScoredPoints(points, counted, not isinstance(prediction, DenseFeatures))


def _object_ids(truth: GroundTruth, class_of_label: Int64Array) -> Int64Array:
    """One number an object: its instance, or where there is none one for all of its class."""
    instance = truth.instance.astype(np.int64)
    return np.where(instance > 0, instance, instance.max(initial=0) + 2 + class_of_label)


def _called(
    rules: ProtocolRules,
    prediction: Prediction,
    classes: Int64Array,
    is_scored: BoolArray,
    targets: transfer.Points,
    wanted: BoolArray,
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """The class of each wanted target, the mask (or row of features) that gives it, the distance of its point."""
    if rules.transfer.neighbours > 1:
        return _called_by_votes(rules, prediction, classes, targets, wanted)
    owner, rank = point_owners(prediction, taking_part(rules, classes, is_scored))
    mask, distance = transfer.transfer_values(prediction.points, owner, rank, targets, wanted)
    if rules.transfer.cap_m is not None:
        mask = np.where(distance <= rules.transfer.cap_m, mask, -1)
    return _class_of(mask, classes), mask, distance


def _called_by_votes(
    rules: ProtocolRules, prediction: Prediction, classes: Int64Array, targets: transfer.Points, wanted: BoolArray
) -> tuple[Int64Array, Int64Array, Float64Array]:
    point, owner = points_and_owners(prediction)
    votes = classes[owner] >= 0
    points, owner = prediction.points[point[votes]], owner[votes]
    cap_m = np.inf if rules.transfer.cap_m is None else rules.transfer.cap_m
    k = rules.transfer.neighbours
    predicted, distance = neighbours.transfer_votes(points, classes[owner], targets, wanted, k, cap_m)
    mask, _ = neighbours.transfer_votes(points, owner, targets, wanted, k, cap_m)
    return predicted, mask, distance


def _class_of(mask: Int64Array, classes: Int64Array) -> Int64Array:
    return np.where(mask >= 0, classes[mask], -1) if len(classes) else np.full(len(mask), -1, np.int64)
