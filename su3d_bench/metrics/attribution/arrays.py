"""The inputs of a protocol's evaluator for one scene as arrays: masks with their classes, or the scored points.

They are the same as in scoring; callers compare the counts with the stored ones. ``EXPLAINED`` lists the kinds of
protocols whose errors can be attributed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import BoolArray, GroundTruth, Int64Array, IntArray
from su3d_bench.metrics.attribution import masks as corrections
from su3d_bench.metrics.attribution.masks import CAUSES, LabelledPoints, MaskError, causes_of, find_errors, repaired
from su3d_bench.metrics.attribution.overlaps import (
    LabelledMasks,
    Overlaps,
    ScoringRules,
    measure_overlaps,
    true_instances,
)
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.instance.score import CurveMetric, InstanceMetric, masks_on_truth
from su3d_bench.metrics.matching.labelling import class_index_of_ids
from su3d_bench.metrics.matching.nearest import Points, nearest
from su3d_bench.metrics.metric import C, Metric, Values
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.metrics.semantic.score import SemanticMetric, call_points, transfer_votes


@dataclass(frozen=True)
class SingleError:
    """An error with its ``gains`` in the headline metrics, as fractions.

    ``true`` and ``called`` are class ids for masks and class indices for points, without repeats, first the one that
    identifies the error; ``masks`` are rows of the prediction. ``score`` is the confidence of the first mask, ``iou``
    that of mask and instance, or the highest if one of them is missing; both are None for points. ``predicted`` are the
    points of each mask, or the wrong points, ``truth`` those of each instance.
    """

    kind: str
    true: tuple[int, ...]
    called: tuple[int, ...]
    masks: tuple[int, ...]
    score: float | None
    iou: float | None
    gains: Values
    predicted: tuple[IntArray, ...]
    truth: tuple[IntArray, ...]


class Pool(Generic[C]):
    """The counts of all scenes under a protocol, in which those of one scene can be replaced."""

    def __init__(self, metric: Metric[C], mine: C, others: Sequence[C]) -> None:
        self.metric, self.mine, self._others = metric, mine, others
        self.is_pooled = metric.rules.aggregate == "pooled"
        self.before = self.values(mine)

    def values(self, mine: C) -> Values:
        """The headline metrics with counts ``mine`` for the scene: over all scenes, or of this scene if the protocol
        reports the mean over scenes."""
        found = self.metric.combine([mine, *self.others])
        return {name: found[name] for name in self.metric.rules.headline}

    @cached_property
    def others(self) -> Sequence[C]:
        """The counts pooled with those of the scene: all other scenes joined into one, or nothing."""
        return [type(self.mine).joined(self._others)] if self.is_pooled and self._others else []

    @cached_property
    def _n_scenes(self) -> Mapping[str, int]:
        """The number of scenes that each metric is averaged over."""
        if self.is_pooled:
            return dict.fromkeys(self.before, 1)
        rows = [*self.metric.combine_each(self._others), self.before] if self._others else [self.before]
        return {name: max(1, sum(not np.isnan(row[name]) for row in rows)) for name in self.before}

    def gains(self, after: Values) -> Values:
        """The gain of each reported metric if the values change from ``before`` to ``after``."""
        return {name: (after[name] - value) / self._n_scenes[name] for name, value in self.before.items()}


def single_mask_errors(
    truth: Int64Array, overlaps: Overlaps, rules: ScoringRules, pool: Pool[InstanceCounts]
) -> list[SingleError]:
    """The errors of the masks of a scene; ``truth`` (N,) is label * 1000 + instance, 0 if void."""
    errors = find_errors(overlaps)
    corrected = _CorrectedClasses(truth, overlaps, rules)
    classes = [corrected.of_error(error) for error in errors]
    gains = [pool.gains(after) for after in _values_after(pool, classes)]
    return [_single_error(error, overlaps, gain) for error, gain in zip(errors, gains, strict=True)]


class _CorrectedClasses:
    """The counts of the classes of a scene that one error affects; masks of other classes do not change."""

    def __init__(self, truth: Int64Array, overlaps: Overlaps, rules: ScoringRules) -> None:
        self._overlaps, self._rules = overlaps, rules
        self._segment_of_point, self._value, self._size = scene_counts.segments_of(truth)
        masks = overlaps.predicted.masks
        self._shared = scene_counts.intersections(
            self._segment_of_point, len(self._value), masks.indptr, masks.indices, np.arange(len(masks))
        )

    def of_error(self, error: MaskError) -> dict[int, InstanceCounts]:
        """The counts of each class that correcting ``error`` affects, by its index among the scored classes."""
        rules, predicted = self._rules, self._overlaps.predicted
        repair = repaired(self._overlaps, [error])
        touched, shared, size = repair.is_changed, self._shared, predicted.masks.sizes
        if repair.points or repair.added:
            shared, size = shared.copy(), size.copy()
        for k, points in repair.points.items():
            shared[k], size[k] = self._shared_by(points), len(points)
        moved = {*predicted.class_ids[touched].tolist(), *repair.class_ids[touched].tolist()}
        moved |= {class_id for _, class_id, _ in repair.added}
        kept = repair.is_kept
        if repair.added:
            shared = np.concatenate([shared[kept], [self._shared_by(points) for points, _, _ in repair.added]])
        else:
            shared = shared[kept]
        corrected = LabelledMasks(
            predicted.masks,
            np.append(repair.class_ids[kept], np.array([one for _, one, _ in repair.added], np.int64)),
            np.append(repair.scores[kept], np.array([one for _, _, one in repair.added], np.float64)),
        )
        size = np.append(size[kept], np.array([len(points) for points, _, _ in repair.added], np.int64))
        is_large = size >= rules.min_region_size
        answer = {}
        for index in (index for index, class_id in enumerate(rules.class_ids) if class_id in moved):
            rows = np.flatnonzero(is_large & (corrected.class_ids == rules.class_ids[index]))
            one = scene_counts.overlaps_of_class(
                rules.class_ids[index], rows, shared[rows], size[rows], self._value, self._size, rules.class_ids,
                rules.min_region_size, rules.void,
            )  # fmt: skip
            answer[index] = one.counts(index, corrected.scores, rules.thresholds)
        return answer

    def _shared_by(self, points: IntArray) -> Int64Array:
        return np.bincount(self._segment_of_point[points], minlength=len(self._value)).astype(np.int64)


def _values_after(pool: Pool[InstanceCounts], corrected: Sequence[Mapping[int, InstanceCounts]]) -> Iterator[Values]:
    """The metrics after each correction: only the curves of the affected classes are computed again."""
    metric, thresholds = pool.metric, pool.metric.rules.thresholds
    assert isinstance(metric, CurveMetric)
    before = instance_ap.combine([pool.mine, *pool.others], thresholds).table
    others: dict[int, list[InstanceCounts]] = {}
    changed = []
    for of_classes in corrected:
        for index, counts in of_classes.items():
            if index not in others:
                others[index] = [instance_ap.only(one, [index]) for one in pool.others]
            alone = replace(counts, class_index=np.zeros_like(counts.class_index))
            changed.append(InstanceCounts.joined([alone, *others[index]]))
    curves = iter(instance_ap.combine_each(changed, thresholds) if changed else [])
    for of_classes in corrected:
        table = before.copy()
        for index in of_classes:
            table[index] = next(curves).table[0]
        named = metric.values_of(instance_ap.of_table(table, thresholds))
        yield {name: named[name] for name in pool.before}


def _single_error(error: MaskError, overlaps: Overlaps, gains: Values) -> SingleError:
    predicted = overlaps.predicted
    first = error.masks[0] if error.masks else None
    score = None if first is None else float(predicted.scores[first])
    # a split object is shown with all its parts, a duplicate with the repeated mask only
    shown = error.masks if error.kind == "split" else error.masks[:1]
    of_masks = tuple(predicted.masks.mask(k) for k in shown)
    of_truth = tuple(overlaps.members[g] for g in error.instances)
    if first is not None:
        iou = float(overlaps.iou[first, error.instances[0]] if error.instances else overlaps.iou[first].max(initial=0))
    else:
        iou = float(overlaps.iou[:, error.instances[0]].max(initial=0))
    true = dict.fromkeys(int(overlaps.class_of_instance[g]) for g in error.instances)
    called = dict.fromkeys(int(predicted.class_ids[k]) for k in shown)
    return SingleError(error.kind, tuple(true), tuple(called), shown, score, iou, gains, of_masks, of_truth)


def single_point_errors(
    points: LabelledPoints, is_counted: BoolArray, pool: Pool[SemanticCounts], *, has_masks: bool, most: int
) -> tuple[int, list[SingleError]]:
    """The number of errors of a scene's points, and the ``most`` that cost most of the first headline metric."""
    cause = causes_of(points, has_masks=has_masks)
    wrong = np.flatnonzero((cause >= 0) & is_counted[points.true_class])
    n_classes = len(is_counted)
    keys = np.stack([points.object_id[wrong], points.true_class[wrong], cause[wrong], points.predicted[wrong]], axis=1)
    groups, of_group = np.unique(keys, axis=0, return_inverse=True) if len(keys) else (keys, np.zeros(0, np.int64))
    of_group = of_group.reshape(-1)
    n_points = np.bincount(of_group, minlength=len(groups))
    gains = []
    for (_, true, _, called), n in zip(groups.tolist(), n_points.tolist(), strict=True):
        confusion = pool.mine.confusion.copy()
        confusion[true, called if called >= 0 else n_classes] -= n
        confusion[true, true] += n
        gains.append(pool.gains(pool.values(SemanticCounts(confusion, pool.mine.is_present))))
    headline = pool.metric.rules.headline
    first = np.array([gain[headline[0]] for gain in gains])
    order = np.lexsort((np.arange(len(groups)), -n_points, -first))[:most].tolist()
    answer = []
    for k in order:
        object_id, true, kind, called = groups[k].tolist()
        predicted = wrong[of_group == k]
        truth = np.flatnonzero(points.is_scored & (points.object_id == object_id) & (points.true_class == true))
        answer.append(
            SingleError(
                kind=CAUSES[kind],
                true=(true,),
                called=(called,),
                masks=tuple(np.unique(points.mask[predicted][points.mask[predicted] >= 0]).tolist()),
                score=None,
                iou=None,
                gains=gains[k],
                predicted=(predicted,),
                truth=(truth,),
            )
        )
    return len(groups), answer


NO_CLASS = "none"


def scored_masks(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> tuple[Int64Array, LabelledMasks, ScoringRules]:
    """Ground truth (N,) as label * 1000 + instance, and the masks on its points (kind ``instance``)."""
    assert rules.min_region_size is not None
    scored = masks_on_truth(rules, truth, prediction, encoder)
    masks = LabelledMasks(scored.masks, scored.labels.astype(np.int64), scored.scores)
    scoring = ScoringRules(tuple(scored.class_ids), rules.min_region_size, rules.thresholds, rules.void)
    return scored.values, masks, scoring


@dataclass(frozen=True)
class ScoredPoints:
    """The points that a protocol of kind ``semantic`` counts, at ``positions`` (N, 3) m.

    ``is_counted`` (C,) classes are in its matrix.
    """

    points: LabelledPoints
    positions: Points
    is_counted: BoolArray
    has_masks: bool


def scored_points(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> ScoredPoints:
    """The true and predicted class of each evaluation point, and the mask that gave it.

    If several neighbours vote, the mask is the one that most of them belong to.
    """
    called = call_points(rules, truth, prediction, encoder)
    mask = called.mask
    if mask is None:
        mask, _ = transfer_votes(rules, prediction, called.classes, called.targets, called.is_wanted, of_masks=True)
    # masks are part of the map: only points far from any mask can be nearer to another part of it
    map_distance_m = called.distance_m.copy()
    far = np.flatnonzero(called.is_wanted & (called.distance_m > corrections.NEAR_M))
    map_distance_m[far], _ = nearest(prediction.points, called.targets[far], corrections.NEAR_M)
    points = LabelledPoints(
        true_class=called.true_class,
        predicted=called.predicted,
        is_scored=called.is_scored,
        object_id=_object_ids(rules, truth)[called.source],
        mask=mask,
        map_distance_m=map_distance_m,
        mask_distance_m=called.distance_m,
    )
    return ScoredPoints(points, called.targets, called.is_counted, not isinstance(prediction, DenseFeatures))


def _object_ids(rules: ProtocolRules, truth: GroundTruth) -> Int64Array:
    """One number per object: its instance, or one for all points of its class if there is no instance."""
    instance = truth.instance.astype(np.int64)
    return np.where(instance > 0, instance, instance.max(initial=0) + 2 + class_index_of_ids(rules, truth.semantic))


CorrectedScene = corrections.CorrectedCounts[InstanceCounts] | corrections.CorrectedCounts[SemanticCounts]
Errors = tuple[int, Sequence[SingleError]]


class SceneOfMasks:
    """The evaluator's view of a scene with masks; ``evaluated``: ground-truth values, masks and rules.

    ``points`` (N, 3) are those that errors refer to, ``instance`` (N,) the true instance of each, 0 for none.
    """

    def __init__(
        self, rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
    ) -> None:
        assert not isinstance(prediction, DenseFeatures)
        self.points: Points = truth.points
        self.instance = truth.instance.astype(np.int64)
        self._values, self._masks, self._scoring = scored_masks(rules, truth, prediction, encoder)
        self.evaluated = self._values, self._masks, self._scoring
        self._has_classes = rules.class_agnostic is None
        self._names = {entry.id: entry.name for entry in rules.classes}

    @cached_property
    def overlaps(self) -> Overlaps:
        return measure_overlaps(true_instances(self._values, self._scoring), self._masks, self._scoring)

    def corrected(self) -> CorrectedScene:
        corrected = corrections.correct_scene(self._values, self._masks, self._scoring, self.overlaps)
        if not self._has_classes:
            return corrected
        relabelled = corrections.with_true_labels(self.overlaps)
        return replace(corrected, with_true_labels=corrections.count_masks(self._values, relabelled, self._scoring))

    def errors(self, rules: ProtocolRules, counts: Any, others: Sequence[Any], most: int) -> Errors:
        """The number of errors of the scene, and the ``most`` that cost most, the most costly first.

        ``counts`` are the stored ones of this scene, ``others`` those of the other scenes.
        """
        pool = Pool[InstanceCounts](InstanceMetric(rules), counts, others)
        found = single_mask_errors(self._values, self.overlaps, self._scoring, pool)
        first = rules.headline[0]
        return len(found), sorted(found, key=lambda error: -error.gains[first])[:most]

    def class_name(self, number: int) -> str:
        """The name of a class of an error."""
        return self._names.get(number, NO_CLASS) if self._has_classes else "object"


class SceneOfPoints:
    """The evaluator's view of a scene with points; ``scored`` are the points that count."""

    def __init__(
        self, rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
    ) -> None:
        self.scored = scored_points(rules, truth, prediction, encoder)
        self.points: Points = self.scored.positions
        number = self.scored.points.object_id
        self.instance = np.where(number <= truth.instance.max(initial=0), number, 0)
        self._names = [entry.name for entry in rules.classes]

    def corrected(self) -> CorrectedScene:
        scored = self.scored
        return corrections.correct_points(scored.points, scored.is_counted, has_masks=scored.has_masks)

    def errors(self, rules: ProtocolRules, counts: Any, others: Sequence[Any], most: int) -> Errors:
        scored = self.scored
        pool = Pool[SemanticCounts](SemanticMetric(rules), counts, others)
        return single_point_errors(scored.points, scored.is_counted, pool, has_masks=scored.has_masks, most=most)

    def class_name(self, number: int) -> str:
        return self._names[number] if number >= 0 else NO_CLASS


EvaluatedScene = SceneOfMasks | SceneOfPoints
# For each kind of protocol: the causes of its errors, and the class that reads a scene.
Look = Callable[[ProtocolRules, GroundTruth, Prediction, Encoder | None], EvaluatedScene]
EXPLAINED: dict[str, tuple[tuple[str, ...], Look]] = {
    "instance": (corrections.KINDS, SceneOfMasks),
    "semantic": (corrections.CAUSES, SceneOfPoints),
}
