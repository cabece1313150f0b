"""Protocols based on average precision; those of kind ``instance``, from masks on the ground-truth points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array, IntArray
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceAP, InstanceCounts, resampled_ap
from su3d_bench.metrics.matching import labelling, transfer
from su3d_bench.metrics.matching.checks import duplicate_pairs
from su3d_bench.metrics.matching.nearest import Points
from su3d_bench.metrics.metric import C, Metric, Pooled, SceneScore, Values, present
from su3d_bench.metrics.protocols.kinds import AP_NAMES
from su3d_bench.metrics.protocols.model import ProtocolRules, TransferRules

CONSTANT_CONFIDENCE = "all confidences are"
DUPLICATE_IOU = 0.9  # pairs above it are the same object twice; duplicates can raise AP under constant confidences
OBJECT = 1  # the label of all masks if the protocol has no classes
NO_OBJECT = 0
AP_COLUMNS = {name: name for name in AP_NAMES}


class CurveMetric(Metric[InstanceCounts]):
    """The common part of kinds whose counts are rows of precision-recall curves."""

    counts = InstanceCounts

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.curve_names), "thresholds": len(self.rules.thresholds)}

    def pooled(self, counts: Sequence[InstanceCounts]) -> Pooled:
        curve = instance_ap.combine(counts, self.rules.thresholds)
        classes = {name: _named(curve.of_class(index)) for index, name in enumerate(self.rules.curve_names)}
        groups = self.group_means(classes, AP_COLUMNS) if self.rules.class_agnostic is None else {}
        n_truth, n_small_truth = (sum(getattr(c, name) for c in counts) for name in ("n_truth", "n_small_truth"))
        small = np.flatnonzero((n_truth == 0) & (n_small_truth > 0))
        names = ", ".join(f"'{self.rules.curve_names[index]}'" for index in small)
        warning = f"not scored, because no scene has an instance of {self.rules.min_region_size} points: {names}"
        return Pooled(self.combine(counts), classes, groups, (warning,) if names else ())

    def combine(self, counts: Sequence[InstanceCounts]) -> Values:
        return self.combine_each([InstanceCounts.joined(counts)])[0]

    def combine_each(self, counts: Sequence[InstanceCounts]) -> list[Values]:
        return [self.values_of(curve) for curve in instance_ap.combine_each(counts, self.rules.thresholds)]

    def values_of(self, curve: InstanceAP) -> Values:
        """AP, AP50 and AP25, and the headline values of groups: means over their classes with ground truth."""
        values = _ap_values(curve)
        for name, (value, of_group) in self.rules.group_headline.items():
            values[name] = _ap_values(instance_ap.of_table(curve.table[of_group], curve.thresholds))[value]
        return values

    def resampled(self, counts: Sequence[InstanceCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        values = dict(resampled_ap(counts, weights, self.rules.thresholds))
        for name, (value, of_group) in self.rules.group_headline.items():
            own = [instance_ap.only(of_scene, of_group) for of_scene in counts]
            values[name] = resampled_ap(own, weights, self.rules.thresholds)[value]
        return values

    def resampled_classes(
        self, counts: Sequence[InstanceCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        columns = [name for name in AP_NAMES if name in self.rules.headline]
        answer = {}
        for index, name in enumerate(self.rules.curve_names):
            if any(of_scene.n_truth[index] for of_scene in counts):
                own = [instance_ap.only(of_scene, [index]) for of_scene in counts]
                values = resampled_ap(own, weights, self.rules.thresholds)
                answer[name] = {column: values[column] for column in columns}
        return answer


def _named(values: tuple[float, float, float]) -> Values:
    return dict(zip(AP_NAMES, values, strict=True))


def _ap_values(curve: InstanceAP) -> Values:
    return _named((curve.ap, curve.ap50, curve.ap25))


class InstanceMetric(CurveMetric):
    """Masks on the ground-truth points, each with a label unless class-agnostic."""

    truth = GroundTruth

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.min_region_size is not None
        if truth.evaluation_points is not None:
            raise DataError(f"{rules.name}: ground truth '{truth.variant}' has no instances on its evaluation points")
        scored = masks_on_truth(rules, truth, prediction, encoder)
        counts = scene_counts.per_scene(
            scored.values,
            scored.masks.indptr,
            scored.masks.indices,
            scored.labels,
            scored.scores,
            scored.class_ids,
            rules.min_region_size,
            rules.thresholds,
            void=rules.void,
        )
        wanted = np.isin(scored.values // instance_ap.INSTANCES_PER_CLASS, scored.class_ids)
        warnings = [None if rules.class_agnostic else labelling.encoder_warning(rules, prediction, encoder)]
        warnings += _mask_warnings(rules, truth, scored)
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)


@dataclass(frozen=True)
class ScoredMasks:
    """The evaluator's input: ground-truth ``values`` (N,) as label * 1000 + instance, and the scored labels.

    ``masks`` are K masks on the ground-truth points with ``labels`` (K,) and ``scores`` (K,), the used confidences.
    """

    values: Int64Array
    class_ids: list[int]
    masks: Masks
    labels: Int64Array
    scores: Float64Array


def masks_on_truth(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> ScoredMasks:
    """The masks of a prediction as a protocol of kind ``instance`` scores them."""
    values, moved, scores = without_labels(rules, truth, prediction)
    class_ids, labels = [OBJECT], np.full(len(moved), OBJECT)
    if rules.class_agnostic is None:
        class_ids, labels = (
            [entry.id for entry in rules.scored],
            named_classes(rules, truth.semantic, prediction, encoder),
        )
    return ScoredMasks(values, class_ids, moved, labels, np.ones(len(moved)) if rules.confidence == "ones" else scores)


def without_labels(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition
) -> tuple[Int64Array, Masks, Float64Array]:
    """Ground truth (N,) as label * 1000 + instance, the masks on its points, and the prediction's confidences (K,).

    Points excluded from the ground truth (class -1) are void and in no mask.
    """
    masks, scores = masks_and_scores(prediction)
    cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    moved = transfer.transfer_masks(prediction.points, masks, truth.points, cap_m, voxel_m)
    is_left_out = truth.semantic < 0
    if not is_left_out.any():
        return encode_truth(rules, truth.semantic, truth.instance), moved, scores
    values = encode_truth(rules, np.maximum(truth.semantic, 0), np.where(is_left_out, 0, truth.instance))
    values[is_left_out] = 0  # if unannotated points form an object, these are not part of it
    is_kept = ~is_left_out[moved.indices]
    before = np.append(0, np.cumsum(is_kept))
    return values, Masks(before[moved.indptr], moved.indices[is_kept]), scores


def masks_and_scores(prediction: Instances | Partition) -> tuple[Masks, Float64Array]:
    """The masks on the prediction's own points and their confidences, 1 for those of a partition."""
    masks = transfer.masks_of(prediction)
    if isinstance(prediction, Instances):
        return masks, np.asarray(prediction.scores, np.float64)
    return masks, np.ones(len(masks))


def encode_truth(rules: ProtocolRules, semantic: IntArray, instance: IntArray) -> Int64Array:
    """One value per point, label * 1000 + instance, or 0 if void."""
    values = instance_ap.encode_ground_truth(semantic, instance)
    return values if rules.class_agnostic is None else encode_without_classes(rules, values)


def named_classes(
    rules: ProtocolRules, semantic: IntArray, prediction: Instances | Partition, encoder: Encoder | None
) -> Int64Array:
    """The class id (K,) assigned to each mask in a scene with the class ids ``semantic`` (N,), 0 for none."""
    is_present = present(labelling.class_index_of_ids(rules, semantic), len(rules.classes))
    classes = labelling.classes_of_prediction(rules, prediction, encoder, is_present)
    ids = np.array([entry.id for entry in rules.classes], np.int64)
    return np.where(classes >= 0, ids[classes], 0)


def encode_without_classes(rules: ProtocolRules, values: Int64Array) -> Int64Array:
    """One value per point, 1000 + its object number, or below 1000 if void, by the rule ``class_agnostic``.

    ``values`` (N,) are label * 1000 + instance, 0 for none. ``scored``: points without a scored class are void, 0.
    ``annotated``: only values below 1000 are void, and are kept. Both number the objects from 1 by class and then by
    instance number, the order in which the originals match them; equal instance numbers of two classes are two objects.
    ``numbered``: equal instance numbers are one object, and objects are ordered by number. ``everything``: the same,
    because the original takes values modulo 1000, and nothing is void, because points without an instance are one more
    object, of the value 1000.

    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> values = np.array([0, 1001, 5001, 2003, 5002, 7])  # 1 is the wall
    >>> names = ("open3dis", "segment3d", "maskclustering")
    >>> each = [load_protocol(f"class-agnostic-{name}") for name in names]
    >>> [encode_without_classes(rules, values).tolist() for rules in each]
    [[0, 0, 1002, 1001, 1003, 0], [0, 1001, 1003, 1002, 1004, 7], [1000, 1001, 1001, 1003, 1002, 1007]]
    """
    label, number = np.divmod(values, instance_ap.INSTANCES_PER_CLASS)
    coded = number + OBJECT * instance_ap.INSTANCES_PER_CLASS
    if rules.class_agnostic in {"everything", "numbered"}:
        return coded if rules.class_agnostic == "everything" else np.where(number > 0, coded, 0)
    coded = np.where(label == 0, values, 0)
    is_object = label > 0
    if rules.class_agnostic == "scored":
        label, coded = labelling.class_index_of_ids(rules, label), np.zeros_like(coded)
        is_object = np.append(labelling.scored_classes(rules), False)[label]
    key = label[is_object] * instance_ap.INSTANCES_PER_CLASS + number[is_object]
    distinct, row = np.unique(key, return_inverse=True)
    if len(distinct) >= instance_ap.INSTANCES_PER_CLASS:
        most = instance_ap.INSTANCES_PER_CLASS - 1
        raise DataError(f"ground truth: has {len(distinct)} objects; without classes a scene may have {most}")
    coded[is_object] = OBJECT * instance_ap.INSTANCES_PER_CLASS + 1 + row
    return coded


def score_of_masks(
    metric: Metric[C],
    counts: C,
    prediction: Instances | Partition,
    targets: Points,
    wanted: BoolArray,
    warnings: Sequence[str | None],
) -> SceneScore:
    """The score, with the distances of the ``wanted`` (P,) of ``targets`` (P, 3) to the nearest point of any mask."""
    covered = np.full(len(prediction.points), -1, np.int64)
    covered[transfer.masks_of(prediction).indices] = 0
    reach = max(transfer.COVERAGE_RADII_M)
    _, distance = transfer.transfer_values(prediction.points, covered, covered, targets, wanted, reach)
    return metric.score(counts, prediction, distance[wanted], warnings)


def _mask_warnings(rules: ProtocolRules, truth: GroundTruth, scored: ScoredMasks) -> list[str]:
    assert rules.min_region_size is not None
    warnings, scores = list[str](), scored.scores
    if rules.confidence == "prediction" and len(scores) > 1 and scores.min() == scores.max():
        warnings.append(f"{CONSTANT_CONFIDENCE} {scores[0]:g}: AP per class is recall x (1 + precision) / 2")
    large = np.flatnonzero(scored.masks.sizes >= rules.min_region_size)
    pairs = duplicate_pairs(transfer.select(scored.masks, large), len(truth.points), DUPLICATE_IOU)
    if pairs:
        first, second = large[list(pairs[0])]
        what = "1 pair of predictions overlaps" if len(pairs) == 1 else f"{len(pairs)} pairs of predictions overlap"
        warnings.append(
            f"{what} with IoU above {DUPLICATE_IOU} (first {first} and {second}); duplicates can raise or lower AP"
        )
    return warnings


@dataclass(frozen=True)
class CoveredObjects:
    """``n_shared`` (K, O): ground-truth vertices of object ``object_ids`` (O,) that instance k covers.

    A vertex is covered by the instances that contain the map point nearest to it, if that is within the cap.
    """

    object_ids: Int64Array
    n_shared: Int64Array

    @property
    def main_object(self) -> Int64Array:
        """The object (K,) of which each instance covers most vertices, the lowest id on ties, 0 if it covers none.

        >>> CoveredObjects(np.array([3, 7]), np.array([[0, 1], [4, 4], [0, 0]])).main_object.tolist()
        [7, 3, 0]
        """
        if not len(self.object_ids):
            return np.full(len(self.n_shared), NO_OBJECT, np.int64)
        best = self.n_shared.argmax(axis=1)
        return np.where(self.n_shared.max(axis=1) > 0, self.object_ids[best], NO_OBJECT)


def covered_objects(rules: TransferRules, truth: GroundTruth, prediction: Instances | Partition) -> CoveredObjects:
    """The coverage of the true objects by each instance or row of features."""
    masks = transfer.masks_of(prediction)
    moved = transfer.transfer_masks(prediction.points, masks, truth.points, rules.cap_m, rules.evaluation_voxel_m)
    ids, column = np.unique(np.maximum(truth.instance, 0), return_inverse=True)
    shared = scene_counts.intersections(column, len(ids), moved.indptr, moved.indices, np.arange(len(masks)))
    is_object = ids > 0
    return CoveredObjects(ids[is_object].astype(np.int64), shared[:, is_object])
