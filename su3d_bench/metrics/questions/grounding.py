"""Protocols of kind ``grounding``: does the box of the instance ranked first meet the box of the object meant?

Source: ``eval_ref_one_sample`` of lib/eval_helper.py and ``box3d_iou`` of utils/box_util.py (daveredrum/ScanRefer at
9d74830): boxes along the axes of the world, right from an IoU of 0.25 or 0.5 on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.instance.score import score_of_masks
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import encoder_warning
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery
from su3d_bench.metrics.questions.score import ShareMetric, first_instances
from su3d_bench.metrics.questions.shares import share_counts

THRESHOLDS = (0.25, 0.5)
_SMALLEST_VOLUME = 1e-8  # the original adds it to the union


class GroundingMetric(ShareMetric):
    """Of the instance ranked first for each text, does its box overlap that of an object that the text means?"""

    truth = QueryTruth

    def per_scene(self, truth: QueryTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        first = first_instances(self.rules, [query.text for query in truth.queries], prediction, encoder)
        masks = transfer.masks_of(prediction)
        iou = np.zeros(len(truth.queries))
        for row, (k, query) in enumerate(zip(first.tolist(), truth.queries, strict=True)):
            if k >= 0 and len(masks.mask(k)):
                box = box_around(prediction.points[masks.mask(k)])
                iou[row] = max((box_iou(box, true) for true in _boxes_of(query, truth)), default=0.0)
        n_right = [int((iou >= threshold).sum()) for threshold in THRESHOLDS]
        counts = share_counts([len(iou)] * len(THRESHOLDS), n_right)
        asked_for = [object_id for query in truth.queries for object_id in query.object_ids]
        wanted = np.isin(truth.object_of_point, np.array(asked_for, np.int64))
        warnings = [encoder_warning(self.rules, prediction, encoder)]
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)


def _boxes_of(query: TextQuery, truth: QueryTruth) -> Sequence[Float64Array]:
    return [box_around(truth.points[truth.object_of_point == object_id]) for object_id in query.object_ids]


def box_around(points: transfer.Points) -> Float64Array:
    """The lowest and the highest corner (2, 3) of the smallest box around points (N, 3) along the axes of the world."""
    known = np.asarray(points, np.float64)
    return np.stack([known.min(axis=0), known.max(axis=0)])


def box_iou(first: Float64Array, second: Float64Array) -> float:
    """The volume in both boxes (2, 3) over that in either, as the original rounds it.

    >>> unit = np.array([[0.0, 0, 0], [1, 1, 1]])
    >>> round(box_iou(unit, unit + [0.5, 0, 0]), 6), box_iou(unit, unit + 2.0)
    (0.333333, 0.0)
    """
    sides = np.maximum(np.minimum(first[1], second[1]) - np.maximum(first[0], second[0]), 0.0)
    shared, (one, other) = _volume(sides), (_volume(box[1] - box[0]) for box in (first, second))
    return shared / (one + other - shared + _SMALLEST_VOLUME)


def _volume(sides: Float64Array) -> float:
    return float(sides[0] * sides[1] * sides[2])
