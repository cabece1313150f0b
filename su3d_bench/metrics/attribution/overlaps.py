"""Overlaps of predicted masks with ground-truth instances, and the masks that make up each instance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS
from su3d_bench.metrics.protocols.model import VoidRule

HALF = 0.5  # of a mask or an instance; also the IoU above which a mask can match only one instance


@dataclass(frozen=True)
class LabelledMasks:
    """K masks on the ground-truth points, each with a class id (0 for no scored class) and a confidence."""

    masks: Masks
    class_ids: Int64Array
    scores: Float64Array


@dataclass(frozen=True)
class ScoringRules:
    """The evaluator's settings: the scored class ids, the minimum size in points, the IoU thresholds, and its rule for
    void masks."""

    class_ids: tuple[int, ...]
    min_region_size: int = instance_ap.MIN_REGION_SIZE
    thresholds: tuple[float, ...] = instance_ap.THRESHOLDS
    void: VoidRule | None = None


@dataclass(frozen=True)
class Parts:
    """The masks that lie in one instance: those that make it up, the best first, and those that repeat others."""

    parts: tuple[int, ...]
    duplicates: tuple[int, ...]


@dataclass(frozen=True)
class Overlaps:
    """The masks of a scene compared with its counted instances: of scored classes and at least the minimum size.

    ``shared`` (K, G) points of mask k and instance g; ``inside`` is that as a share of the mask, ``cover`` as a share
    of the instance; ``members`` are the points of each instance. ``is_merged``: holds several instances under the label
    of one. ``is_large``: has at least the minimum size; ``is_counted``: also has a scored class; ``is_ignored``: the
    evaluator ignores the mask at every threshold, because it is void there.
    """

    predicted: LabelledMasks
    members: tuple[Int32Array, ...]
    class_of_instance: Int64Array
    shared: Int64Array
    inside: Float64Array
    cover: Float64Array
    iou: Float64Array
    is_merged: BoolArray
    is_large: BoolArray
    is_counted: BoolArray
    is_ignored: BoolArray

    @property
    def n_instances(self) -> int:
        return len(self.members)

    def finds(self, k: int, g: int) -> bool:
        """Whether mask k matches instance g with the right class."""
        return bool(self.iou[k, g] > HALF and self.predicted.class_ids[k] == self.class_of_instance[g])

    def is_found(self, g: int) -> bool:
        """Whether any mask, a merged one included, matches instance g with the right class."""
        return bool(((self.iou[:, g] > HALF) & (self.predicted.class_ids == self.class_of_instance[g])).any())

    @cached_property
    def parts(self) -> tuple[Parts, ...]:
        """For each instance, the masks that make it up; merged masks are never parts."""
        return tuple(self._parts_of(g) for g in range(self.n_instances))

    @cached_property
    def missed(self) -> Int64Array:
        """The instances that are not split and that no mask of at least the minimum size lies in or holds."""
        touches = ((self.inside > HALF) | (self.cover > HALF)) & self.is_large[:, None]
        return np.setdiff1d(np.flatnonzero(~touches.any(axis=0)), self.split)

    @cached_property
    def split(self) -> Int64Array:
        """The instances whose several parts together match them, with their class, and that no merged mask finds."""
        return np.array([g for g in range(self.n_instances) if self._is_split(g)], np.int64)

    def _is_split(self, g: int) -> bool:
        parts = self.parts[g].parts
        if len(parts) < 2 or (self.is_found(g) and not self.finds(parts[0], g)):
            return False
        members = np.array(parts)
        labels = self.predicted.class_ids[members]
        label = labels[0]
        if self.iou[parts[0], g] <= HALF:
            distinct = np.unique(labels)
            label = distinct[np.argmax([self.shared[members[labels == each], g].sum() for each in distinct])]
        union = np.unique(np.concatenate([self.predicted.masks.mask(k) for k in parts]))
        n_common = len(np.intersect1d(union, self.members[g], assume_unique=True))
        matches = n_common > HALF * (len(union) + len(self.members[g]) - n_common)
        return bool(matches and label == self.class_of_instance[g])

    def _parts_of(self, g: int) -> Parts:
        inside = np.flatnonzero((self.inside[:, g] > HALF) & ~self.is_merged).tolist()
        order = sorted(inside, key=lambda k: self._rank(k, g))
        if not order:
            return Parts((), ())
        parts, duplicates = order[:1], []
        size = len(self.members[g])
        union, n_common = self.predicted.masks.mask(order[0]), int(self.shared[order[0], g])
        for k in order[1:]:
            mask = self.predicted.masks.mask(k)
            joined = np.union1d(union, mask)
            n_repeated = len(union) + len(mask) - len(joined)
            if 2 * n_repeated >= len(mask):
                duplicates.append(k)
                continue
            n_joined = len(np.intersect1d(joined, self.members[g], assume_unique=True))
            is_better = n_joined / (len(joined) + size - n_joined) > n_common / (len(union) + size - n_common)
            if is_better:
                parts.append(k)
                union, n_common = joined, n_joined
        return Parts(tuple(parts), tuple(duplicates))

    def _rank(self, k: int, g: int) -> tuple[bool, bool, float, int]:
        """Sort key: the match with the right class, then any match, each by IoU; the others by points in common."""
        matches = bool(self.iou[k, g] > HALF)
        return not self.finds(k, g), not matches, -float(self.iou[k, g] if matches else self.shared[k, g]), k


@dataclass(frozen=True)
class TrueInstances:
    """The ground truth of a scene: the segment of each point, and which segments are counted instances.

    ``size``, ``members`` and ``class_of_instance`` cover only the counted ones, in the order of their values.
    """

    segment_of_point: Int64Array
    is_instance: BoolArray
    size: Int64Array
    members: tuple[Int32Array, ...]
    class_of_instance: Int64Array


def true_instances(truth: Int64Array, rules: ScoringRules) -> TrueInstances:
    """The instances of one scene; ``truth`` (N,) is label * 1000 + instance, 0 if void."""
    segment_of_point, values, sizes = scene_counts.segments_of(truth)
    is_instance = np.isin(values // INSTANCES_PER_CLASS, rules.class_ids) & (sizes >= rules.min_region_size)
    order = np.argsort(segment_of_point, kind="stable").astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return TrueInstances(
        segment_of_point=segment_of_point,
        is_instance=is_instance,
        size=sizes[is_instance],
        members=tuple(order[starts[s] : starts[s + 1]] for s in np.flatnonzero(is_instance)),
        class_of_instance=(values[is_instance] // INSTANCES_PER_CLASS).astype(np.int64),
    )


def measure_overlaps(instances: TrueInstances, predicted: LabelledMasks, rules: ScoringRules) -> Overlaps:
    """The overlaps of the masks of one scene with its instances."""
    masks, size = predicted.masks, predicted.masks.sizes
    n_segments, every = len(instances.is_instance), np.arange(len(size))
    shared = scene_counts.intersections(instances.segment_of_point, n_segments, masks.indptr, masks.indices, every)
    n_ignored = shared[:, ~instances.is_instance].sum(axis=1)
    shared = shared[:, instances.is_instance]
    size_of_instance, class_of_instance = instances.size[None, :], instances.class_of_instance
    at_least_one = np.maximum(size, 1)[:, None]
    inside, cover = shared / at_least_one, shared / size_of_instance
    is_large = size >= rules.min_region_size
    has_own_class = predicted.class_ids[:, None] == class_of_instance[None, :]
    return Overlaps(
        predicted=predicted,
        members=instances.members,
        class_of_instance=class_of_instance,
        shared=shared,
        inside=inside,
        cover=cover,
        iou=shared / np.maximum(size[:, None] + size_of_instance - shared, 1),
        is_merged=((cover > HALF).sum(axis=1) > 1) & (has_own_class & (np.maximum(inside, cover) > HALF)).any(axis=1),
        is_large=is_large,
        is_counted=is_large & np.isin(predicted.class_ids, rules.class_ids),
        is_ignored=(rules.void != "false-positives") & (n_ignored > max(rules.thresholds) * at_least_one[:, 0]),
    )
