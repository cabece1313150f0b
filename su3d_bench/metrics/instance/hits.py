"""Which predictions of a scene are true positives and which instances are met, by the evaluator's own matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.instance.scene_counts import class_overlaps, met_instances


@dataclass(frozen=True)
class Hits:
    """At one threshold: ``is_hit`` (K,) masks that are true positives, the ``values`` of the instances that are met.

    A true positive is the mask whose confidence the instance takes, the first of equals. Below IoU 0.5 a mask may be
    that of two instances.
    """

    is_hit: BoolArray
    values: frozenset[int]


def hits(
    truth: Int64Array,
    masks: Masks,
    labels: Int64Array,
    scores: Float64Array,
    class_ids: Sequence[int],
    min_region_size: int,
    thresholds: Sequence[float],
) -> list[Hits]:
    """The hits at each of ``thresholds``; the arrays are those of ``scene_counts.per_scene``.

    >>> truth, masks = np.repeat([3001, 3002], 200), Masks.of_sets([np.arange(120), np.arange(200), np.arange(90)])
    >>> at_50, at_25 = hits(truth, masks, np.array([3, 3, 3]), np.array([0.5, 0.9, 1.0]), [3], 100, (0.5, 0.25))
    >>> at_50.is_hit.tolist(), sorted(at_50.values)
    ([False, True, False], [3001])
    """
    is_hit = np.zeros((len(thresholds), len(masks)), bool)
    values: list[set[int]] = [set() for _ in thresholds]
    for one in class_overlaps(truth, masks.indptr, masks.indices, labels, class_ids, min_region_size):
        for t, threshold in enumerate(thresholds):
            for column, matching in met_instances(one.iou > threshold, one.takes_part):
                own = one.predictions[matching]
                is_hit[t, own[scores[own].argmax()]] = True
                values[t].add(int(one.values[column]))
    return [Hits(of_one, frozenset(met)) for of_one, met in zip(is_hit, values, strict=True)]
