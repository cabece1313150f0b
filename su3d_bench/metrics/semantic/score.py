"""One scene under a protocol of kind ``semantic``: which points count, and what the prediction is called there."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, DenseFeatures, Float64Array, GroundTruth, Int64Array, Partition, Prediction
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching import votes as neighbours
from su3d_bench.metrics.matching.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    encoder_warning,
    scored_classes,
)
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.metrics.scene_score import SceneScore, n_predictions, present
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.store.scratch import row_blocks


def score_semantic(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> SceneScore:
    """The additive counts of one scene: a confusion matrix of the scored points."""
    class_of_label = class_index_of_ids(rules, truth.semantic)
    is_scored = scored_classes(rules)
    is_present = present(class_of_label, len(rules.classes)) & is_scored
    targets, true_class = truth.points, class_of_label
    if truth.evaluation_points is not None:
        targets = truth.evaluation_points
        _, found = transfer.nearest(truth.points, targets)
        true_class = np.where(found >= 0, class_of_label[found], -1)
    counted = counted_classes(rules, is_scored, is_present)
    wanted = (true_class >= 0) & counted[true_class]

    classes = classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))
    predicted, distance = _predicted_classes(rules, prediction, classes, is_scored, targets, wanted)
    scored = wanted & is_scored[true_class]
    warnings = [encoder_warning(rules, prediction, encoder)]
    without_points = np.flatnonzero(is_present & ~present(true_class[wanted], len(rules.classes)))
    if len(without_points):
        names = ", ".join(f"'{rules.classes[index].name}'" for index in without_points)
        warnings.append(f"the ground truth has {names}, but no scored point does; such a class counts 0 in this scene")
    return SceneScore(
        protocol=rules.name,
        version=rules.version,
        counts=semantic.per_scene(true_class, predicted, counted),
        n_predictions=n_predictions(prediction),
        n_scored=int(scored.sum()),
        n_farther=transfer.n_farther(distance[scored]),
        warnings=tuple(warning for warning in warnings if warning),
    )


def counted_classes(rules: ProtocolRules, is_scored: BoolArray, is_present: BoolArray) -> BoolArray:
    """The classes whose points enter the confusion matrix.

    Those that the scene contains for ConceptGraphs, all scored ones for ScanNet, and for HOV-SG the ignored ones too,
    because what is predicted there is a false positive.
    """
    if rules.metric == "hovsg":
        return np.ones(len(is_scored), bool)
    return is_present if rules.metric == "conceptgraphs" else is_scored


def _predicted_classes(
    rules: ProtocolRules,
    prediction: Prediction,
    classes: Int64Array,
    is_scored: BoolArray,
    targets: transfer.Points,
    wanted: BoolArray,
) -> tuple[Int64Array, Float64Array]:
    """The class of each wanted target, -1 for none, and how far the nearest point that takes part is from it."""
    if rules.transfer.neighbours > 1:
        point, owner = points_and_owners(prediction)
        votes = classes[owner]  # objects without a class do not vote
        points, votes = prediction.points[point[votes >= 0]], votes[votes >= 0]
        cap_m = np.inf if rules.transfer.cap_m is None else rules.transfer.cap_m
        return neighbours.transfer_votes(points, votes, targets, wanted, rules.transfer.neighbours, cap_m)
    owner, rank = point_owners(prediction, taking_part(rules, classes, is_scored))
    values = np.where(owner >= 0, classes[owner], -1) if len(classes) else owner
    predicted, distance = transfer.transfer_values(prediction.points, values, rank, targets, wanted)
    if rules.transfer.cap_m is not None:
        predicted = np.where(distance <= rules.transfer.cap_m, predicted, -1)
    return predicted, distance


def points_and_owners(prediction: Prediction) -> tuple[Int64Array, Int64Array]:
    """The points of all objects, one object after another, and the object (or row of features) of each."""
    if isinstance(prediction, DenseFeatures):
        point = np.flatnonzero(has_feature(prediction))
        return point, point
    if isinstance(prediction, Partition):
        point = np.flatnonzero(prediction.instance >= 0)
        return point, prediction.instance[point].astype(np.int64)
    return prediction.indices.astype(np.int64), prediction.owners


def taking_part(rules: ProtocolRules, classes: Int64Array, is_scored: BoolArray) -> BoolArray:
    """Which objects take part: what was named as an ignored class is left out, as ConceptGraphs does not load its
    background objects; HOV-SG has all."""
    if rules.metric == "hovsg":
        return np.ones(len(classes), bool)
    return (classes < 0) | is_scored[classes]


def point_owners(prediction: Prediction, takes_part: BoolArray) -> tuple[Int64Array, Int64Array]:
    """The object (or row of features) of each point of the prediction, and its rank among points at one distance.

    Both are -1 where a point takes no part. A point that several instances share belongs to the first.
    """
    if isinstance(prediction, DenseFeatures):
        rows = np.arange(len(prediction.points))
        return rows, np.where(takes_part & has_feature(prediction), 0, -1)
    if isinstance(prediction, Partition):
        owner = prediction.instance.astype(np.int64)
        owner[(owner >= 0) & ~takes_part[owner]] = -1
        return owner, owner
    kept = np.flatnonzero(takes_part)
    first = transfer.first_owner(transfer.select(prediction, kept), len(prediction.points))
    owner = np.where(first >= 0, kept[first], -1) if len(kept) else first
    return owner, owner


def has_feature(prediction: DenseFeatures) -> BoolArray:
    """Which points have a feature: those whose row is not all zero."""
    answer = np.empty(len(prediction.points), bool)
    for rows, block in row_blocks(prediction.features, 65536):  # the table may be larger than memory
        answer[rows] = np.any(block, axis=1)
    return answer
