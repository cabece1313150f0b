"""What a protocol's evaluator sees of a scene, as plain arrays: the masks with their classes, or the scored points.

They are those that scoring itself counts; whoever uses them compares the counts with those stored. ``EXPLAINED`` is
the one table of the kinds of protocols whose errors can be told apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import BoolArray, GroundTruth, Int64Array
from su3d_bench.metrics.attribution import masks as instances
from su3d_bench.metrics.attribution import points as semantic
from su3d_bench.metrics.attribution.overlaps import LabelledMasks, ScoringRules, measure_overlaps, true_instances
from su3d_bench.metrics.attribution.points import LabelledPoints
from su3d_bench.metrics.instance.score import masks_on_truth
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.score import call_points, transfer_votes


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
    called = call_points(rules, truth, prediction, encoder)
    mask = called.mask
    if mask is None:
        mask, _ = transfer_votes(rules, prediction, called.classes, called.targets, called.is_wanted, of_masks=True)
    # a mask is part of the map: only beyond it can more of the map be nearer
    map_distance_m = called.distance_m.copy()
    far = np.flatnonzero(called.is_wanted & (called.distance_m > semantic.NEAR_M))
    map_distance_m[far], _ = transfer.nearest(prediction.points, called.targets[far], semantic.NEAR_M)
    points = LabelledPoints(
        true_class=called.true_class,
        predicted=called.predicted,
        is_scored=called.is_scored,
        object_id=_object_ids(rules, truth)[called.source],
        mask=mask,
        map_distance_m=map_distance_m,
        mask_distance_m=called.distance_m,
    )
    return ScoredPoints(points, called.is_counted, not isinstance(prediction, DenseFeatures))


def _object_ids(rules: ProtocolRules, truth: GroundTruth) -> Int64Array:
    """One number an object: its instance, or where there is none one for all of its class."""
    instance = truth.instance.astype(np.int64)
    return np.where(instance > 0, instance, instance.max(initial=0) + 2 + class_index_of_ids(rules, truth.semantic))


MendedScene = instances.Mended | semantic.MendedPoints
Mend = Callable[[ProtocolRules, GroundTruth, Prediction, Encoder | None], MendedScene]


def _mended_masks(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> MendedScene:
    assert not isinstance(prediction, DenseFeatures)
    values, masks, scoring = scored_masks(rules, truth, prediction, encoder)
    mended = instances.mend_scene(values, masks, scoring)
    if rules.class_agnostic is not None:
        return mended
    relabelled = instances.with_true_labels(measure_overlaps(true_instances(values, scoring), masks, scoring))
    return replace(mended, with_true_labels=instances.count_masks(values, relabelled, scoring))


def _mended_points(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> MendedScene:
    scored = scored_points(rules, truth, prediction, encoder)
    return semantic.mend_points(scored.points, scored.is_counted, has_masks=scored.has_masks)


# Of each kind the causes of its errors, and what mends a scene.
EXPLAINED: dict[str, tuple[tuple[str, ...], Mend]] = {
    "instance": (instances.KINDS, _mended_masks),
    "semantic": (semantic.CAUSES, _mended_points),
}
