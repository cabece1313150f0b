"""What every mask under every class would score: how much of an AP masks alone can earn when labels cost nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance.average_precision import (
    INSTANCES_PER_CLASS,
    InstanceCounts,
    count_class,
    intersections,
    stacked,
)
from su3d_bench.metrics.matching.nearest import Masks


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
    size = np.diff(masks.indptr)
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
