"""Average precision of many resamples of the scenes at once, straight from the additive counts of each scene."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.instance.average_precision import THRESHOLDS, InstanceCounts, ap_columns
from su3d_bench.numerics.statistics import row_means

MANY_ROWS = 20_000  # from there on compiled loops win back the time that they take to load
AT_ONCE = 64  # resamples that go through the rows side by side: their counts stay in the nearest cache
_MAX_CELLS = 4_000_000  # of a (resamples, rows) block: 32 MB of float64


def resampled_ap(
    counts: Sequence[InstanceCounts], weights: Int64Array, thresholds: Sequence[float] = THRESHOLDS
) -> dict[str, Float64Array]:
    """AP, AP50 and AP25 (R,) of the scenes drawn ``weights`` (R, S) times, equal to ``combine`` up to rounding.

    >>> from su3d_bench.metrics.instance.scene_counts import per_scene
    >>> hit = per_scene(np.full(120, 7004), np.array([0, 120]), np.arange(120), np.array([7]), np.ones(1), [7])
    >>> miss = per_scene(np.full(120, 7009), np.array([0]), np.arange(0), np.zeros(0, int), np.ones(0), [7])
    >>> resampled_ap([hit, miss], np.array([[2, 0], [1, 1], [0, 2]]))["AP"].tolist()
    [1.0, 0.5, 0.0]
    """
    n_classes, n_thresholds = counts[0].n_missed.shape
    scene = np.concatenate([np.full(len(c.score), s, np.int64) for s, c in enumerate(counts)])
    score = np.concatenate([c.score for c in counts])
    is_true = np.concatenate([c.is_true for c in counts])
    cell = np.concatenate([c.class_index.astype(np.int64) * n_thresholds + c.threshold_index for c in counts])
    order = np.lexsort((-score, cell))
    rows = _Rows(scene[order], score[order], is_true[order])
    bounds = np.searchsorted(cell[order], np.arange(n_classes * n_thresholds + 1))
    n_truth = weights @ np.stack([c.n_truth for c in counts])
    resampled_areas = _compiled_areas if len(score) >= MANY_ROWS else _areas
    table = resampled_areas(rows, bounds, n_truth, weights).reshape(len(weights), n_classes, n_thresholds)
    table[n_truth == 0] = np.nan
    return {
        "AP": row_means(table[:, :, ap_columns(thresholds)].reshape(len(weights), -1)),
        "AP50": row_means(table[:, :, tuple(thresholds).index(0.5)]),
        "AP25": row_means(table[:, :, tuple(thresholds).index(0.25)]),
    }


@dataclass(frozen=True)
class _Rows:
    """The counted predictions of one class and threshold after another, with falling score in each."""

    scene: Int64Array
    score: Float64Array
    is_true: BoolArray


def _areas(rows: _Rows, bounds: Int64Array, n_truth: Int64Array, weights: Int64Array) -> Float64Array:
    """Area (R, cells) under each resample's polylines; ``bounds`` of the cells' rows, ``n_truth`` (R, C)."""
    areas = np.zeros((len(weights), len(bounds) - 1))
    n_thresholds = areas.shape[1] // n_truth.shape[1]
    for c in np.flatnonzero(n_truth.any(axis=0)):
        for cell in range(c * n_thresholds, (c + 1) * n_thresholds):
            own = slice(bounds[cell], bounds[cell + 1])
            areas[:, cell] = _weighted_areas(
                rows.score[own], rows.is_true[own], rows.scene[own], n_truth[:, c], weights
            )
    return areas


def _compiled_areas(rows: _Rows, bounds: Int64Array, n_truth: Int64Array, weights: Int64Array) -> Float64Array:
    """``_areas`` of many rows, up to rounding, by compiled loops on all cores."""
    from su3d_bench.metrics.instance.kernels import resampled_areas

    areas = np.zeros((len(bounds) - 1, len(weights)))
    class_of_cell = np.repeat(np.arange(n_truth.shape[1]), len(areas) // n_truth.shape[1])
    is_last = np.diff(rows.score, append=np.nan) != 0
    is_last[bounds[1:][bounds[1:] > 0] - 1] = True
    scene = rows.scene.astype(np.int32)

    def fill(start: int) -> None:
        own = slice(start, start + AT_ONCE)
        drawn = np.ascontiguousarray(weights[own].T, np.int32)
        instances = np.ascontiguousarray(n_truth[own].T, np.int32)
        areas_of_block = np.empty((len(areas), drawn.shape[1]))
        resampled_areas(scene, rows.is_true, is_last, bounds, class_of_cell, instances, drawn, areas_of_block)
        areas[:, own] = areas_of_block

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(fill, range(0, len(weights), AT_ONCE)))  # raises what a thread raised
    return np.ascontiguousarray(areas.T)  # the order of later sums follows the layout; so does the last bit


def _weighted_areas(
    score: Float64Array, is_true: BoolArray, scene: Int64Array, n_truth: Int64Array, weights: Int64Array
) -> Float64Array:
    """Area under each resample's precision-recall polyline; rows come with falling score.

    A vertex without weight repeats its neighbour and adds no area, so all resamples share the vertices of the whole.
    """
    if not len(score):
        return np.zeros(len(weights))
    last_of_score = np.flatnonzero(np.append(np.diff(score) != 0, True))
    areas = np.empty(len(weights))
    step = max(1, _MAX_CELLS // len(score))
    for start in range(0, len(weights), step):
        drawn = weights[start : start + step][:, scene]
        n_counted = np.cumsum(drawn, axis=1)[:, last_of_score].astype(np.float64)
        n_hit = np.cumsum(drawn * is_true, axis=1)[:, last_of_score].astype(np.float64)
        precision = np.divide(n_hit, n_counted, out=np.ones_like(n_hit), where=n_counted > 0)
        recall = n_hit / np.maximum(n_truth[start : start + step, None], 1)
        precision = np.concatenate([np.ones((len(drawn), 1)), precision], axis=1)
        recall = np.concatenate([np.zeros((len(drawn), 1)), recall], axis=1)
        areas[start : start + step] = (np.diff(recall, axis=1) * (precision[:, 1:] + precision[:, :-1]) / 2).sum(axis=1)
    return areas
