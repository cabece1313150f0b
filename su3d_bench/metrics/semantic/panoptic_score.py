"""Protocols of kind ``panoptic``: every point in one segment of a thing or of stuff."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.instance.score import masks_and_scores, named_classes, score_of_masks
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning, scored_classes
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore, Values
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic import panoptic_quality
from su3d_bench.metrics.semantic.panoptic_quality import QUALITIES, PanopticCounts, Rule, Segments
from su3d_bench.numerics.statistics import nan_mean


class PanopticMetric(Metric[PanopticCounts]):
    """Things one by one and stuff as a whole, each with a class: how many are found, and how well they fit."""

    truth = GroundTruth
    counts = PanopticCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        if truth.evaluation_points is not None:
            raise DataError(f"{rules.name}: the truth '{truth.variant}' has no instances on its evaluation points")
        ids = named_classes(rules, truth.semantic, prediction, encoder)
        masks, scores = masks_and_scores(prediction)
        cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
        moved = transfer.transfer_masks(prediction.points, masks, truth.points, cap_m, voxel_m)
        counts = count_segments(rules, truth.semantic, truth.instance, moved, scores, ids)
        wanted = _scored_index(rules, truth.semantic) >= 0
        warnings = [encoder_warning(rules, prediction, encoder), _shared_warning(moved, scores, len(truth.points))]
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.scored)}

    def pooled(self, counts: Sequence[PanopticCounts]) -> Pooled:
        table = self._classes(panoptic_quality.combine(counts))
        classes = {
            entry.name: {name: float(table[name][0, c]) for name in QUALITIES}
            for c, entry in enumerate(self.rules.scored)
        }
        return Pooled(self._values(table), classes, self._groups(classes))

    def _groups(self, classes: Mapping[str, Values]) -> dict[str, Values]:
        """The mean of each group over those of its classes that have a value."""
        members: dict[str, list[Values]] = {}
        for entry in self.rules.scored:
            if entry.group:
                members.setdefault(entry.group, []).append(classes[entry.name])
        return {
            group: {name: nan_mean(np.array([row[name] for row in rows])) for name in QUALITIES}
            for group, rows in members.items()
        }

    def combine(self, counts: Sequence[PanopticCounts]) -> Values:
        return self._values(self._classes(panoptic_quality.combine(counts)))

    def resampled(self, counts: Sequence[PanopticCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return self._means(self._classes(panoptic_quality.resampled(counts, weights)))

    def resampled_classes(
        self, counts: Sequence[PanopticCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        table = self._classes(panoptic_quality.resampled(counts, weights))
        whole = panoptic_quality.combine(counts)
        has_truth = whole.n_matched + whole.n_missed > 0
        return {
            entry.name: {name: table[name][:, c] for name in QUALITIES}
            for c, entry in enumerate(self.rules.scored)
            if has_truth[c]
        }

    def _classes(self, counts: PanopticCounts) -> dict[str, Float64Array]:
        qualities = panoptic_quality.class_qualities(counts, rule_of(self.rules))
        return {name: np.atleast_2d(values) for name, values in qualities.items()}

    def _means(self, table: dict[str, Float64Array]) -> dict[str, Float64Array]:
        return panoptic_quality.means(table, things_of(self.rules), rule_of(self.rules))

    def _values(self, table: dict[str, Float64Array]) -> Values:
        means = self._means(table)
        n_classes = int((~np.isnan(table["PQ"][0])).sum())
        return {name: float(value[0]) for name, value in means.items()} | {"n_classes": n_classes}


def things_of(rules: ProtocolRules) -> BoolArray:
    """Which scored classes are things (C,); the others are stuff."""
    return np.array([entry.name not in rules.stuff for entry in rules.scored], bool)


def rule_of(rules: ProtocolRules) -> Rule:
    return "panopticapi" if rules.metric == "panopticapi" else "semantic-kitti"


def told_truth(rules: ProtocolRules, truth: GroundTruth) -> GroundTruth:
    """The truth that a method is told under a protocol, if it is told any: as it stands, but for where stuff counts.

    There every labelled point belongs to a segment, and what the annotation gives a class and no instance, as
    ScanNet++'s does with walls, becomes one instance a class.

    >>> from su3d_bench.core.types import LabelSet
    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> names = LabelSet("replica", (93, 20), ("wall", "chair"))
    >>> ids = np.array([93, 20, 0, 93], np.int32), np.array([0, 5, 0, 0], np.int32)
    >>> truth = GroundTruth(np.zeros((4, 3), np.float32), *ids, names, "mesh-vertices", "by hand")
    >>> told_truth(load_protocol("rooms-panoptic"), truth).instance.tolist()
    [6, 5, 0, 6]
    """
    is_open = (truth.semantic > 0) & (truth.instance <= 0)
    if not rules.stuff or not is_open.any():
        return truth
    number = np.unique(truth.semantic[is_open], return_inverse=True)[1]
    instance = truth.instance.copy()
    instance[is_open] = truth.instance.max(initial=0) + 1 + number
    return replace(truth, instance=instance)


def count_segments(
    rules: ProtocolRules,
    semantic: NDArray[np.integer[Any]],
    instance: NDArray[np.integer[Any]],
    masks: Masks,
    scores: Float64Array,
    class_ids: Int64Array,
) -> PanopticCounts:
    """The counts of K masks on the N points of a truth with class ids (N,) and instance numbers (N,), 0 for none.

    A point in several masks belongs to that of the greatest score, the first of equals; masks whose class id (K,) is
    not scored take no point. Points of class -1 are left out of truth and masks.
    """
    called = _scored_index(rules, class_ids)
    order = np.argsort(-scores, kind="stable")
    order = order[called[order] >= 0]
    first = transfer.first_owner(transfer.select(masks, order), len(semantic))
    owner = np.where(first >= 0, order[first], -1) if len(order) else first
    predicted = Segments(np.where(np.asarray(semantic) < 0, -1, np.append(called, -1)[owner]), owner)
    truth = Segments(_scored_index(rules, semantic), np.asarray(instance, np.int64))
    size = rules.min_region_size or 1
    return panoptic_quality.per_scene(truth, predicted, things_of(rules), rule_of(rules), size)


def _scored_index(rules: ProtocolRules, ids: NDArray[np.integer[Any]]) -> Int64Array:
    """The place of each class id among the scored classes, -1 where it is none of them."""
    is_scored = scored_classes(rules)
    place = np.append(np.where(is_scored, np.cumsum(is_scored) - 1, -1), -1)
    return place[class_index_of_ids(rules, ids)]


def _shared_warning(masks: Masks, scores: Float64Array, n_points: int) -> str | None:
    n_covering = np.bincount(masks.indices, minlength=n_points)
    n_shared, n_covered = int((n_covering > 1).sum()), int((n_covering > 0).sum())
    if not n_shared:
        return None
    by = "the greatest confidence" if len(np.unique(scores)) > 1 else "equal confidence the first"
    share = f"{100 * n_shared / n_covered:.1f} %"
    return f"{share} of the points that masks cover are in several; each counts for that of {by}"
