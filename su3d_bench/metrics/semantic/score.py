"""Protocols of kind ``semantic``: the scored points, their predicted classes, and the metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.files.atomic import row_blocks
from su3d_bench.core.geometry import voxel_coordinates
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Partition, Prediction
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.matching import labelling, transfer
from su3d_bench.metrics.matching import votes as neighbours
from su3d_bench.metrics.matching.nearest import Points, are_same_points, ball_tree, kd_tree, nearest
from su3d_bench.metrics.matching.rows import first_rows
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore, Values, first_row, present
from su3d_bench.metrics.protocols.model import ClassEntry, ProtocolRules
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.metrics.semantic.confusion import SemanticCounts, SemanticMetrics
from su3d_bench.numerics.statistics import row_means

GROUP_COLUMNS = {"mAcc": "recall", "mIoU": "IoU"}  # name of a group's value, and the class value that it averages


class SemanticMetric(Metric[SemanticCounts]):
    """One class per point, counted in a confusion matrix of the scored points.

    ConceptGraphs' rows differ: the pooled one averages over the classes with scored points, that of a scene over the
    classes that its ground truth contains.
    """

    truth = GroundTruth
    counts = SemanticCounts

    def per_scene(self, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        called = call_points(rules, truth, prediction, encoder)
        warnings = [labelling.encoder_warning(rules, prediction, encoder)]
        has_points = present(called.true_class[called.is_wanted], len(rules.classes))
        without_points = np.flatnonzero(called.is_present & ~has_points)
        if len(without_points):
            names = ", ".join(f"'{rules.classes[index].name}'" for index in without_points)
            warnings.append(
                f"the ground truth has {names}, but no scored point does; such a class counts 0 in this scene"
            )
        counts = semantic.per_scene(called.true_class, called.predicted, called.is_counted)
        return self.score(counts, prediction, called.distance_m[called.is_scored], warnings)

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.classes), "columns": len(self.rules.classes) + 1}

    def pooled(self, counts: Sequence[SemanticCounts]) -> Pooled:
        metrics = self._metrics(SemanticCounts.joined(counts), pooled=True)
        classes = {
            self._entries[index].name: {
                "recall": float(metrics.recall[row]),
                "precision": float(metrics.precision[row]),
                "IoU": float(metrics.iou[row]),
                "F1": float(metrics.f1[row]),
                "F1-conceptgraphs": float(metrics.f1_conceptgraphs[row]),
            }
            for row, index in enumerate(metrics.class_index)
        }
        values = self._values(metrics) | first_row(self._of_groups(counts, np.ones((1, len(counts)), np.int64)))
        return Pooled(values, classes, self.group_means(classes, GROUP_COLUMNS))

    def combine_each(self, counts: Sequence[SemanticCounts]) -> list[Values]:
        rows = [self._values(self._metrics(of_scene, pooled=False)) for of_scene in counts]
        of_groups = self._of_groups(counts, np.eye(len(counts), dtype=np.int64))
        return [row | {name: float(each[k]) for name, each in of_groups.items()} for k, row in enumerate(rows)]

    def resampled(self, counts: Sequence[SemanticCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        is_scored = labelling.scored_classes(self.rules) if self.rules.metric == "hovsg" else None
        values = semantic.resampled_semantic(counts, weights, self.rules.metric, is_scored)
        return values | self._of_groups(counts, weights)

    def _of_groups(self, counts: Sequence[SemanticCounts], weights: Int64Array) -> dict[str, Float64Array]:
        """The headline values (R,) of groups: means over their classes with ground truth in the drawn scenes."""
        wanted = self.rules.group_headline
        classes = self.resampled_classes(counts, weights) if wanted else {}
        values, scored = {}, self.rules.scored
        for name, (value, of_group) in wanted.items():
            names = [scored[position].name for position in of_group]
            table = [classes[one][GROUP_COLUMNS[value]] for one in names if one in classes]
            missing = np.full((len(weights), 1), np.nan)
            values[name] = row_means(np.column_stack([missing, *table]))
        return values

    def resampled_classes(
        self, counts: Sequence[SemanticCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        hit, n_true, n_predicted = semantic.resampled_points(counts, weights)
        counted = n_true > 0
        if self.rules.metric == "conceptgraphs":
            n_true = n_true - semantic.resampled_points_sliced_away(counts, weights, n_true)
        recall = np.where(counted, hit / np.maximum(n_true, 1), np.nan)
        iou = np.where(counted, hit / np.maximum(n_true + n_predicted - hit, 1), np.nan)
        return {
            self.rules.classes[index].name: {"recall": recall[:, index], "IoU": iou[:, index]}
            for index in np.flatnonzero(labelling.scored_classes(self.rules))
            if any(of_scene.confusion[index].any() for of_scene in counts)
        }

    @property
    def _entries(self) -> tuple[ClassEntry, ...]:
        """The classes that the metrics index."""
        return self.rules.scored if self.rules.metric in {"scannet", "ovo"} else self.rules.classes

    def _values(self, metrics: SemanticMetrics) -> Values:
        return {
            "mAcc": metrics.mean_accuracy,
            "mIoU": metrics.mean_iou,
            "F-mIoU": metrics.frequency_weighted_iou,
            **({"pAcc": metrics.point_accuracy} if self.rules.metric in {"hovsg", "ovo"} else {}),
            "mPrecision": metrics.mean_precision,
            "mF1": metrics.mean_f1,
            "mF1-conceptgraphs": metrics.mean_f1_conceptgraphs,
            "n_classes": len(metrics.class_index),
            **{f"n_IoU>{level:.2f}": n for level, n in zip(semantic.IOU_LEVELS, metrics.n_classes_above, strict=True)},
        }

    def _metrics(self, whole: SemanticCounts, *, pooled: bool) -> SemanticMetrics:
        is_scored = labelling.scored_classes(self.rules)
        if self.rules.metric == "hovsg":
            return semantic.hovsg_metrics(whole.confusion, is_scored)
        if self.rules.metric in {"scannet", "ovo"}:
            scored = np.flatnonzero(is_scored)
            confusion = _keep_columns(whole.confusion, scored)[scored]
            return semantic.scannet_metrics(confusion, counts_unseen=self.rules.metric == "ovo")
        has_points = whole.confusion.sum(axis=1) > 0
        keep = np.flatnonzero(has_points if pooled else whole.is_present)
        confusion = whole.confusion.copy()
        if pooled:
            # The original slices away the predictions of a class of the ground-truth cloud without scored points
            confusion[:, np.flatnonzero(whole.is_present & ~has_points)] = 0
        folded = np.zeros_like(confusion)
        folded[:, [*keep, -1]] = _keep_columns(confusion, keep)
        return semantic.conceptgraphs_metrics(folded, keep)


def _keep_columns(confusion: Int64Array, keep: Int64Array) -> Int64Array:
    """The columns ``keep`` and a last one with all others: any other prediction is wrong."""
    n_elsewhere = confusion.sum(axis=1) - confusion[:, keep].sum(axis=1)
    return np.concatenate([confusion[:, keep], n_elsewhere[:, None]], axis=1)


@dataclass(frozen=True)
class PredictedPoints:
    """The P points that a protocol of kind ``semantic`` evaluates, with their predicted classes.

    ``source`` (P,): the ground-truth point that each takes its class from. ``true_class`` and ``predicted`` (P,) are -1
    for none; ``mask`` (P,) is the object, or row of features, that gives the predicted class, None with votes on
    classes; ``distance_m`` (P,) is that of its point. ``is_wanted`` (P,) points are in the matrix, ``is_scored`` (P,)
    ones of a scored class. ``is_present`` (C,) scored classes are in the scene, ``is_counted`` (C,) ones in the matrix;
    ``classes`` are those of the prediction's objects.
    """

    targets: Points
    source: Int64Array
    true_class: Int64Array
    is_wanted: BoolArray
    is_scored: BoolArray
    is_present: BoolArray
    is_counted: BoolArray
    classes: Int64Array
    predicted: Int64Array
    mask: Int64Array | None
    distance_m: Float64Array


def call_points(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> PredictedPoints:
    """The true and the predicted class of each evaluation point."""
    class_of_label = labelling.class_index_of_ids(rules, truth.semantic)
    is_scored = labelling.scored_classes(rules)
    is_present = present(class_of_label, len(rules.classes)) & is_scored
    targets, source = truth.points, np.arange(len(truth.points))
    true_class = class_of_label
    if truth.evaluation_points is not None:
        targets = truth.evaluation_points
        _, source = nearest(truth.points, targets)
        true_class = np.where(source >= 0, class_of_label[source], -1)
    # those that the scene contains for ConceptGraphs, all scored ones for ScanNet, and for HOV-SG the ignored ones too,
    # because predictions there are false positives
    is_counted = is_present if rules.metric == "conceptgraphs" else is_scored | (rules.metric == "hovsg")
    is_wanted = (true_class >= 0) & is_counted[true_class]
    classes = with_unnamed(rules, labelling.classes_of_prediction(rules, prediction, encoder, is_present))
    votes_for_masks = rules.transfer.votes == "masks" and not isinstance(prediction, DenseFeatures)
    mask: Int64Array | None = None
    if votes_for_masks and not are_same_points(prediction.points, targets):
        mask, distance_m = transfer_votes(rules, prediction, classes, targets, is_wanted, of_masks=True)
    elif rules.transfer.neighbours > 1 and not votes_for_masks:
        predicted, distance_m = transfer_votes(rules, prediction, classes, targets, is_wanted)
    else:
        # ConceptGraphs does not load objects that it calls background; HOV-SG has all
        takes_part = (classes < 0) | is_scored[classes] | (rules.metric == "hovsg")
        mask, distance_m = owners_at(rules, prediction, takes_part, targets, is_wanted)
    if mask is not None:
        predicted = np.append(classes, -1)[mask]
    if len(classes):
        predicted = with_unnamed(rules, predicted)
    return PredictedPoints(
        targets=targets,
        source=source,
        true_class=true_class,
        is_wanted=is_wanted,
        is_scored=is_wanted & is_scored[true_class],
        is_present=is_present,
        is_counted=is_counted,
        classes=classes,
        predicted=predicted,
        mask=mask,
        distance_m=distance_m,
    )


def with_unnamed(rules: ProtocolRules, class_index: Int64Array) -> Int64Array:
    """The class indices of objects, or of points with a prediction, with ``unnamed`` in place of -1.

    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> [with_unnamed(load_protocol(f"scannet-{name}"), np.array([-1, 3])).tolist() for name in ("semantic", "ovo20")]
    [[-1, 3], [20, 3]]
    """
    if rules.unnamed is None:
        return class_index
    named = next(index for index, entry in enumerate(rules.classes) if entry.name == rules.unnamed)
    return np.where(class_index < 0, named, class_index)


def owners_at(
    rules: ProtocolRules,
    prediction: Prediction,
    takes_part: BoolArray,
    targets: Points,
    wanted: BoolArray,
) -> tuple[Int64Array, Float64Array]:
    """The object, or row of features, whose point is nearest to each wanted target, -1 for none, and the distance.

    Only the objects marked by ``takes_part`` (K,) are considered.
    """
    owner, rank = _point_owners(prediction, takes_part)
    if rules.transfer.evaluation_voxel_m > 0 and not are_same_points(prediction.points, targets):
        rank = _one_per_voxel(prediction.points, owner, rank, rules.transfer.evaluation_voxel_m)
    mask, distance_m = transfer.transfer_values(prediction.points, owner, rank, targets, wanted)
    if rules.transfer.cap_m is not None:
        mask = np.where(distance_m <= rules.transfer.cap_m, mask, -1)
    return mask, distance_m


def transfer_votes(
    rules: ProtocolRules,
    prediction: Prediction,
    classes: Int64Array,
    targets: Points,
    wanted: BoolArray,
    *,
    of_masks: bool = False,
) -> tuple[Int64Array, Float64Array]:
    """The majority class, or with ``of_masks`` mask, of each wanted target's neighbours, and the nearest distance.

    Objects without a class do not vote.
    """
    point, owner = _points_and_owners(prediction)
    votes = np.flatnonzero(classes[owner] >= 0)
    is_one_cloud = rules.transfer.votes == "masks"  # as in OVO; HOV-SG has the clouds of all objects one after another
    votes = votes[np.argsort((point if is_one_cloud else owner)[votes], kind="stable")]
    points, owner = prediction.points[point[votes]], owner[votes]
    cap_m = np.inf if rules.transfer.cap_m is None else rules.transfer.cap_m
    values = owner if of_masks else classes[owner]
    search = kd_tree if is_one_cloud else ball_tree
    return neighbours.transfer_votes(points, values, targets, wanted, rules.transfer.neighbours, cap_m, search)


def _points_and_owners(prediction: Prediction) -> tuple[Int64Array, Int64Array]:
    """The concatenated points of all objects, and the object (or row of features) of each."""
    if isinstance(prediction, DenseFeatures):
        point = np.flatnonzero(has_feature(prediction))
        return point, point
    if isinstance(prediction, Partition):
        point = np.flatnonzero(prediction.instance >= 0)
        return point, prediction.instance[point].astype(np.int64)
    return prediction.indices.astype(np.int64), prediction.owners


def _point_owners(prediction: Prediction, takes_part: BoolArray) -> tuple[Int64Array, Int64Array]:
    """The object (or row of features) of each predicted point, and its rank among points at equal distance.

    Both are -1 for points that are not considered. A point that several instances share belongs to the first.
    """
    if isinstance(prediction, DenseFeatures):
        rows = np.arange(len(prediction.points))
        return rows, np.where(takes_part & has_feature(prediction), 0, -1)
    if isinstance(prediction, Partition):
        owner = prediction.instance.astype(np.int64)
        owner[(owner >= 0) & ~np.append(takes_part, True)[owner]] = -1  # without any rows there is no last one
        return owner, owner
    kept = np.flatnonzero(takes_part)
    first = transfer.first_owner(transfer.select(prediction, kept), len(prediction.points))
    owner = np.where(first >= 0, kept[first], -1) if len(kept) else first
    return owner, owner


def _one_per_voxel(points: Points, owner: Int64Array, rank: Int64Array, voxel_m: float) -> Int64Array:
    """``rank`` (N,) if each object keeps its first point per voxel, -1 for all others."""
    taking = np.flatnonzero(rank >= 0)
    voxel = voxel_coordinates(points[taking], voxel_m)
    first = first_rows(np.column_stack([owner[taking], voxel]))
    kept = np.full(len(rank), -1, np.int64)
    kept[taking[first]] = rank[taking[first]]
    return kept


def has_feature(prediction: DenseFeatures) -> BoolArray:
    """Which points have a feature: those whose row is not all zero."""
    answer = np.empty(len(prediction.points), bool)
    for rows, block in row_blocks(prediction.features, 65536):  # the table may be larger than memory
        answer[rows] = np.any(block, axis=1)
    return answer
