"""What a protocol's evaluator sees of a scene, as plain arrays: the masks with their classes, or the scored points.

They are those that scoring itself counts; whoever uses them compares the counts with those stored. ``EXPLAINED`` is
the one table of the kinds of protocols whose errors can be told apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import BoolArray, GroundTruth, Int64Array
from su3d_bench.metrics.attribution import masks as corrections
from su3d_bench.metrics.attribution.masks import LabelledPoints
from su3d_bench.metrics.attribution.overlaps import (
    LabelledMasks,
    Overlaps,
    ScoringRules,
    measure_overlaps,
    true_instances,
)
from su3d_bench.metrics.attribution.singles import Pool, SingleError, single_mask_errors, single_point_errors
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.instance.score import InstanceMetric, masks_on_truth
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic import confusion
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.metrics.semantic.score import SemanticMetric, call_points, transfer_votes

NO_CLASS = "none"


def scored_masks(
    rules: ProtocolRules, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> tuple[Int64Array, LabelledMasks, ScoringRules]:
    """The truth (N,) as label * 1000 + instance, and the masks on its points, under a protocol of kind ``instance``."""
    assert rules.min_region_size is not None
    scored = masks_on_truth(rules, truth, prediction, encoder)
    masks = LabelledMasks(scored.masks, scored.labels.astype(np.int64), scored.scores)
    class_ids, forgives_void = tuple(scored.class_ids), rules.void is None
    scoring = ScoringRules(class_ids, rules.min_region_size, rules.thresholds, forgives_void)
    return scored.values, masks, scoring


@dataclass(frozen=True)
class ScoredPoints:
    """The points that a protocol of kind ``semantic`` counts, at ``positions`` (N, 3) m.

    ``is_counted`` (C,) classes are in its matrix.
    """

    points: LabelledPoints
    positions: transfer.Points
    is_counted: BoolArray
    has_masks: bool


def scored_points(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> ScoredPoints:
    """What each evaluation point is, is called, and by which mask.

    Where several neighbours vote, the mask is the one that most of them belong to.
    """
    called = call_points(rules, truth, prediction, encoder)
    mask = called.mask
    if mask is None:
        mask, _ = transfer_votes(rules, prediction, called.classes, called.targets, called.is_wanted, of_masks=True)
    # a mask is part of the map: only beyond it can more of the map be nearer
    map_distance_m = called.distance_m.copy()
    far = np.flatnonzero(called.is_wanted & (called.distance_m > corrections.NEAR_M))
    map_distance_m[far], _ = transfer.nearest(prediction.points, called.targets[far], corrections.NEAR_M)
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
    """One number an object: its instance, or where there is none one for all of its class."""
    instance = truth.instance.astype(np.int64)
    return np.where(instance > 0, instance, instance.max(initial=0) + 2 + class_index_of_ids(rules, truth.semantic))


MendedScene = corrections.Mended | corrections.MendedPoints
Errors = tuple[int, Sequence[SingleError]]


class LookedAt(Protocol):
    """A scene as a protocol's evaluator sees it.

    ``points`` (N, 3) are those that errors are told of, ``instance`` (N,) the truth's at each, 0 for none;
    ``class_name`` says what a class of an error is called.
    """

    points: transfer.Points
    instance: Int64Array

    def mended(self) -> MendedScene: ...

    def errors(self, rules: ProtocolRules, counts: Any, others: Sequence[Any], most: int) -> Errors:
        """How many errors the scene has, and the ``most`` that cost most, the dearest first.

        ``counts`` of the protocol's kind are its own as they are, ``others`` those of the other scenes.
        """
        ...

    def class_name(self, number: int) -> str: ...


class SceneOfMasks:
    """A scene as an evaluator of masks sees it; ``evaluated``: the truth's values, the masks and the rules."""

    def __init__(
        self, rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
    ) -> None:
        assert not isinstance(prediction, DenseFeatures)
        self.points: transfer.Points = truth.points
        self.instance = truth.instance.astype(np.int64)
        self._values, self._masks, self._scoring = scored_masks(rules, truth, prediction, encoder)
        self.evaluated = self._values, self._masks, self._scoring
        self._has_classes = rules.class_agnostic is None
        self._names = {entry.id: entry.name for entry in rules.classes}

    @cached_property
    def overlaps(self) -> Overlaps:
        return measure_overlaps(true_instances(self._values, self._scoring), self._masks, self._scoring)

    def mended(self) -> MendedScene:
        mended = corrections.mend_scene(self._values, self._masks, self._scoring, self.overlaps)
        if not self._has_classes:
            return mended
        relabelled = corrections.with_true_labels(self.overlaps)
        return replace(mended, with_true_labels=corrections.count_masks(self._values, relabelled, self._scoring))

    def errors(self, rules: ProtocolRules, counts: Any, others: Sequence[Any], most: int) -> Errors:
        pool = Pool[InstanceCounts](InstanceMetric(rules), counts, others, instance_ap.concatenate)
        found = single_mask_errors(self._values, self.overlaps, self._scoring, pool)
        first = rules.headline[0]
        return len(found), sorted(found, key=lambda error: -error.gains[first])[:most]

    def class_name(self, number: int) -> str:
        return self._names.get(number, NO_CLASS) if self._has_classes else "object"


class SceneOfPoints:
    """A scene as an evaluator of points sees it; ``scored`` are the points that count."""

    def __init__(
        self, rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
    ) -> None:
        self.scored = scored_points(rules, truth, prediction, encoder)
        self.points: transfer.Points = self.scored.positions
        number = self.scored.points.object_id
        self.instance = np.where(number <= truth.instance.max(initial=0), number, 0)
        self._names = [entry.name for entry in rules.classes]

    def mended(self) -> MendedScene:
        scored = self.scored
        return corrections.mend_points(scored.points, scored.is_counted, has_masks=scored.has_masks)

    def errors(self, rules: ProtocolRules, counts: Any, others: Sequence[Any], most: int) -> Errors:
        scored = self.scored
        pool = Pool[SemanticCounts](SemanticMetric(rules), counts, others, confusion.concatenate)
        return single_point_errors(scored.points, scored.is_counted, pool, has_masks=scored.has_masks, most=most)

    def class_name(self, number: int) -> str:
        return self._names[number] if number >= 0 else NO_CLASS


# Of each kind the causes of its errors, and what looks at a scene.
Look = Callable[[ProtocolRules, GroundTruth, Prediction, Encoder | None], LookedAt]
EXPLAINED: dict[str, tuple[tuple[str, ...], Look]] = {
    "instance": (corrections.KINDS, SceneOfMasks),
    "semantic": (corrections.CAUSES, SceneOfPoints),
}
