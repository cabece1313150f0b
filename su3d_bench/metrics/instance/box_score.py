"""Protocols of kind ``boxes``: the boxes of instances against the true, turned boxes of objects with classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array, OrientedBox
from su3d_bench.metrics.instance.box_counts import BoxCounts, class_values, count_boxes, share_values
from su3d_bench.metrics.instance.box_overlap import box_iou, smallest_box
from su3d_bench.metrics.instance.score import CONSTANT_CONFIDENCE, masks_and_scores
from su3d_bench.metrics.matching.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    encoder_warning,
    scored_classes,
)
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore, Values, present
from su3d_bench.metrics.protocols.model import BOX_AXES
from su3d_bench.numerics.statistics import row_means

_REACH = 3**0.5  # a box around points within r of a place, along whatever axes, is within this many r of it


class BoxMetric(Metric[BoxCounts]):
    """Are objects found as boxes, with the right class?"""

    truth = GroundTruth
    counts = BoxCounts

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.scored), "thresholds": len(self.rules.thresholds)}

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.min_region_size is not None
        if truth.boxes is None:
            raise DataError(f"{rules.name}: the truth '{truth.variant}' has no boxes")
        boxes = list(truth.boxes.boxes.values())
        ids = np.array([truth.boxes.class_of_instance[instance] for instance in truth.boxes.boxes], np.int64)
        known = class_index_of_ids(rules, ids)
        is_scored = scored_classes(rules)
        # of each class its place among the scored ones; -1 for one that is not, and at the end for no class
        place = np.append(np.where(is_scored, np.cumsum(is_scored) - 1, -1), -1)
        is_present = present(known, len(rules.classes)) & is_scored
        called = place[classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))]
        masks, scores = masks_and_scores(prediction)
        scores = np.ones(len(scores)) if rules.confidence == "ones" else scores
        kept = np.flatnonzero(masks.sizes >= rules.min_region_size)
        shapes = [_Shape.of(prediction.points[masks.mask(k)].astype(np.float64)) for k in kept.tolist()]
        wanted = np.flatnonzero(place[known] >= 0)
        iou, holds_centroid = _meet(shapes, [boxes[g] for g in wanted], rules.box_axes)
        counts = count_boxes(iou, holds_centroid, place[known[wanted]], called[kept], scores[kept], len(rules.scored))
        warnings = [encoder_warning(rules, prediction, encoder), _constant_warning(scores[kept])]
        # the sides of a box are no surface that a map should have: there is no coverage
        return self.score(counts, prediction, np.zeros(0), warnings)

    def pooled(self, counts: Sequence[BoxCounts]) -> Pooled:
        of_class = self._of_classes(counts, np.ones((1, len(counts)), np.int64))
        classes = {
            entry.name: {name: float(table[0, c]) for name, table in of_class.items()}
            for c, entry in enumerate(self.rules.scored)
        }
        return Pooled(self.combine(counts), classes)

    def combine(self, counts: Sequence[BoxCounts]) -> Values:
        once = np.ones((1, len(counts)), np.int64)
        return {name: float(value[0]) for name, value in self.resampled(counts, once).items()}

    def resampled(self, counts: Sequence[BoxCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        values = {name: row_means(table) for name, table in class_values(counts, weights).items()}
        for name, (part, whole) in share_values(counts, weights).items():
            values[name] = _share(part.sum(axis=1), whole.sum(axis=1))
        return {name: values[name] for name in self.rules.value_names}

    def resampled_classes(self, counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, dict[str, Float64Array]]:
        tables = self._of_classes(counts, weights)
        has_truth = np.any([of_scene.n_truth > 0 for of_scene in counts], axis=0)
        return {
            entry.name: {name: tables[name][:, c] for name in self.rules.headline}
            for c, entry in enumerate(self.rules.scored)
            if has_truth[c]
        }

    def _of_classes(self, counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, Float64Array]:
        """Each value (R, C) of each class alone; NaN where a draw has no true box of it."""
        tables = class_values(counts, weights)
        shares = {name: _share(*parts) for name, parts in share_values(counts, weights).items()}
        has_truth = weights @ np.stack([of_scene.n_truth for of_scene in counts]) > 0
        tables |= {name: np.where(has_truth, table, np.nan) for name, table in shares.items()}
        return {name: tables[name] for name in self.rules.value_names}


def _share(part: Int64Array, whole: Int64Array) -> Float64Array:
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _constant_warning(scores: Float64Array) -> str | None:
    if len(scores) < 2 or scores.min() != scores.max():
        return None
    return f"{CONSTANT_CONFIDENCE} {scores[0]:g}: AP of a class is then recall x precision"


@dataclass(frozen=True)
class _Shape:
    """The points (N, 3) of an instance, their mean, and a sphere around all of them."""

    points: Float64Array
    centroid: Float64Array
    middle: Float64Array
    radius_m: float

    @classmethod
    def of(cls, points: Float64Array) -> _Shape:
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        return cls(points, points.mean(axis=0), middle, float(np.linalg.norm(points - middle, axis=1).max()))


def _meet(
    shapes: Sequence[_Shape], boxes: Sequence[OrientedBox], axes: BOX_AXES | None
) -> tuple[Float64Array, BoolArray]:
    """The IoU (K, G) of the box of each shape with each true box, and of which each holds the centroid (K, G)."""
    iou = np.zeros((len(shapes), len(boxes)))
    centroids = np.array([shape.centroid for shape in shapes]).reshape(-1, 3)
    middles = np.array([shape.middle for shape in shapes]).reshape(-1, 3)
    radii = np.array([shape.radius_m for shape in shapes])
    holds_centroid = np.zeros(iou.shape, bool)
    straight = [smallest_box(shape.points, np.eye(3)) if axes == "world" else None for shape in shapes]
    for g, box in enumerate(boxes):
        holds_centroid[:, g] = box.distance_outside(centroids) <= 0
        is_near = np.linalg.norm(middles - box.centre, axis=1) <= _REACH * radii + np.linalg.norm(box.sizes) / 2
        for k in np.flatnonzero(is_near).tolist():
            iou[k, g] = box_iou(straight[k] or smallest_box(shapes[k].points, box.rotation), box)
    return iou, holds_centroid
