"""One scene under a protocol of kind ``instance``: masks on the truth's points, and their counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Instances, Int64Array, Masks, Partition
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance.average_precision import (
    INSTANCES_PER_CLASS,
    InstanceCounts,
    count_class,
    intersections,
    stacked,
)
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    encoder_warning,
    scored_classes,
)
from su3d_bench.metrics.protocols import ProtocolRules, TransferRules
from su3d_bench.metrics.results.results import Counts
from su3d_bench.metrics.scene_score import SceneScore, n_predictions, present

IntArray = NDArray[np.integer[Any]]

DUPLICATE_IOU = 0.9  # pairs above it are the same object twice; duplicates can raise AP under constant confidences
OBJECT = 1  # the one label that all have where the protocol has no classes


def score_instances(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> SceneScore:
    """The additive counts of one scene: masks on the truth's points, each with a label unless class-agnostic."""
    assert rules.min_region_size is not None
    if truth.evaluation_points is not None:
        raise DataError(f"{rules.name}: the truth '{truth.variant}' has no instances on its evaluation points")
    values, scored_ids, labels = truth_and_labels(rules, truth, prediction, encoder)
    masks, scores = masks_and_scores(prediction)
    moved = transfer.transfer_masks(
        prediction.points, masks, truth.points, rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    )
    counts = instance_ap.per_scene(
        values,
        moved.indptr,
        moved.indices,
        labels,
        np.ones(len(scores)) if rules.confidence == "ones" else scores,
        scored_ids,
        rules.min_region_size,
        rules.thresholds,
    )
    wanted = np.isin(values // instance_ap.INSTANCES_PER_CLASS, scored_ids)
    told = None if rules.class_agnostic else encoder_warning(rules, prediction, encoder)
    warnings = _instance_warnings(rules, truth, moved, scores, told)
    return score_of_masks(rules, counts, prediction, masks, truth.points, wanted, warnings)


def truth_and_labels(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> tuple[Int64Array, list[int], Int64Array]:
    """The truth as label * 1000 + instance, the labels that are scored, and the label of each prediction."""
    scored_ids = [entry.id for entry in rules.scored]
    if rules.class_agnostic is not None:
        has_scored_class = np.isin(truth.semantic, scored_ids)
        values = encode_without_classes(rules.class_agnostic, truth.instance, has_scored_class)
        return values, [OBJECT], np.full(n_predictions(prediction), OBJECT)
    is_present = present(class_index_of_ids(rules, truth.semantic), len(rules.classes)) & scored_classes(rules)
    classes = classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))
    ids = np.array([entry.id for entry in rules.classes])
    values = instance_ap.encode_ground_truth(truth.semantic, truth.instance)
    return values, scored_ids, np.where(classes >= 0, ids[classes], 0)


def masks_and_scores(prediction: Instances | Partition) -> tuple[Masks, Float64Array]:
    """The masks on the prediction's own points and their confidences, 1 for those of a partition."""
    masks = transfer.masks_of(prediction)
    if isinstance(prediction, Instances):
        return masks, np.asarray(prediction.scores, np.float64)
    return masks, np.ones(len(masks))


def encode_without_classes(
    rule: Literal["scored", "annotated", "everything"], instance: IntArray, has_scored_class: BoolArray
) -> Int64Array:
    """One value a point, 1000 + instance, and 0 where it is void.

    ``scored``: what has no scored class is void. ``annotated``: only points without an instance are.
    ``everything``: nothing is; the points without an instance are one more instance, of the value 1000.

    >>> instance, has_scored_class = np.array([0, 1, 2]), np.array([False, False, True])
    >>> encode_without_classes("scored", instance, has_scored_class).tolist()
    [0, 0, 1002]
    >>> encode_without_classes("annotated", instance, has_scored_class).tolist()
    [0, 1001, 1002]
    >>> encode_without_classes("everything", instance, has_scored_class).tolist()
    [1000, 1001, 1002]
    """
    values = instance_ap.encode_ground_truth(np.full(len(instance), OBJECT), instance)
    if rule == "everything":
        values[np.asarray(instance) == 0] = OBJECT * instance_ap.INSTANCES_PER_CLASS
    elif rule == "scored":
        values[~has_scored_class] = 0
    return values


def score_of_masks(
    rules: ProtocolRules,
    counts: Counts,
    prediction: Instances | Partition,
    masks: Masks,
    targets: transfer.Points,
    wanted: BoolArray,
    warnings: Sequence[str],
) -> SceneScore:
    """The score, with how far the ``wanted`` (P,) of ``targets`` (P, 3) are from the nearest point of any mask."""
    covered = np.full(len(prediction.points), -1, np.int64)
    covered[masks.indices] = 0
    reach = max(transfer.COVERAGE_RADII_M)
    _, distance = transfer.transfer_values(prediction.points, covered, covered, targets, wanted, reach)
    return SceneScore(
        protocol=rules.name,
        version=rules.version,
        counts=counts,
        n_predictions=n_predictions(prediction),
        n_scored=int(wanted.sum()),
        n_farther=transfer.n_farther(distance[wanted]),
        warnings=tuple(warnings),
    )


def _instance_warnings(
    rules: ProtocolRules, truth: GroundTruth, moved: Masks, scores: Float64Array, encoder: str | None
) -> tuple[str, ...]:
    assert rules.min_region_size is not None
    warnings = [encoder] if encoder else []
    if rules.confidence == "prediction" and len(scores) > 1 and (scores == scores[0]).all():
        warnings.append(f"every confidence is {scores[0]:g}: AP of a class is then recall (1 + precision) / 2")
    large = np.flatnonzero(moved.sizes >= rules.min_region_size)
    pairs = transfer.duplicate_pairs(transfer.select(moved, large), len(truth.points), DUPLICATE_IOU)
    if pairs:
        first, second = large[list(pairs[0])]
        what = "1 pair of predictions overlaps" if len(pairs) == 1 else f"{len(pairs)} pairs of predictions overlap"
        warnings.append(
            f"{what} with IoU above {DUPLICATE_IOU} (first {first} and {second}); duplicates can raise or lower AP"
        )
    return tuple(warnings)


NO_OBJECT = 0


@dataclass(frozen=True)
class Covered:
    """``n_shared`` (K, O): truth vertices of object ``object_ids`` (O,) that instance k covers.

    A vertex is covered by the instances that own the map point nearest to it, where that is within the cap.
    """

    object_ids: Int64Array
    n_shared: Int64Array

    @property
    def main_object(self) -> Int64Array:
        """The object (K,) that each instance covers most vertices of, the lowest id of equals, 0 where it covers none.

        >>> Covered(np.array([3, 7]), np.array([[2, 5], [4, 4], [0, 0]])).main_object.tolist()
        [7, 3, 0]
        """
        if not len(self.object_ids):
            return np.full(len(self.n_shared), NO_OBJECT, np.int64)
        best = self.n_shared.argmax(axis=1)
        return np.where(self.n_shared.max(axis=1) > 0, self.object_ids[best], NO_OBJECT)


def covered_objects(rules: TransferRules, truth: GroundTruth, prediction: Instances | Partition) -> Covered:
    """What each instance, or row of features, covers of the truth's objects."""
    masks = transfer.masks_of(prediction)
    moved = transfer.transfer_masks(prediction.points, masks, truth.points, rules.cap_m, rules.evaluation_voxel_m)
    ids, column = np.unique(np.maximum(truth.instance, 0), return_inverse=True)
    shared = instance_ap.intersections(column, len(ids), moved.indptr, moved.indices, np.arange(len(masks)))
    is_object = ids > 0
    return Covered(ids[is_object].astype(np.int64), shared[:, is_object])


def every_class_counts(
    values: Int64Array,
    masks: Masks,
    scores: Float64Array,
    class_ids: Sequence[int],
    min_region_size: int,
    thresholds: Sequence[float],
) -> InstanceCounts:
    """The counts of one scene when every mask is listed once under each class; each mask is intersected once only.

    ``values`` (N,) are class id * 1000 + instance of each point, as the metric takes them.

    >>> truth = np.repeat([3001, 4001], 200)
    >>> masks = Masks(np.array([0, 200, 400]), np.arange(400, dtype=np.int32))
    >>> counts = every_class_counts(truth, masks, np.ones(2), [3, 4], 100, (0.5, 0.25))
    >>> counts.n_predictions.tolist(), counts.is_true.tolist()
    ([2, 2], [True, False, True, False, True, False, True, False])
    """
    n_of_value = np.bincount(values) if len(values) else np.zeros(0, np.int64)
    distinct = np.flatnonzero(n_of_value)
    size_of_segment = n_of_value[distinct]
    row_of_value = np.zeros(len(n_of_value), np.int64)
    row_of_value[distinct] = np.arange(len(distinct))
    size = masks.sizes
    kept = np.flatnonzero(size >= min_region_size)
    shared = intersections(row_of_value[values], len(distinct), masks.indptr, masks.indices, kept)
    label_of_segment = distinct // INSTANCES_PER_CLASS
    n_void = shared[:, ~np.isin(label_of_segment, class_ids)].sum(axis=1)
    n_points = size[kept]
    parts = []
    for index, class_id in enumerate(class_ids):
        columns = np.flatnonzero(label_of_segment == class_id)
        of_class, sizes = shared[:, columns], size_of_segment[columns]
        is_small = sizes < min_region_size
        parts.append(
            count_class(
                index,
                iou=of_class / (sizes[None, :] + n_points[:, None] - of_class),
                takes_part=~is_small,
                scores=scores[kept],
                ignored_share=(n_void + of_class[:, is_small].sum(axis=1)) / n_points,
                thresholds=thresholds,
            )
        )
    return stacked(parts)
