"""The area under raw precision-recall polylines, to the bit that the official ScanNet evaluator gives."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.instance.dot_product import dot

MOST_REMEMBERED_ROWS = 12  # small curves repeat from scene to scene, longer ones hardly ever
MANY_ROWS = 20_000  # from there on compiled loops win back the time that they take to load


def average_precision(scores: Float64Array, is_true: BoolArray, n_missed: int) -> float:
    """Area under the raw precision-recall polyline, one vertex a distinct score and the vertex (recall 0, precision 1).

    Rows are the counted predictions of one class; 0 where there is none (pull request 26).

    >>> average_precision(np.array([1.0, 1.0, 1.0]), np.array([True, True, False]), 2)  # recall (1 + precision) / 2
    0.41666666666666663
    """
    if not len(scores):
        return 0.0
    if len(scores) <= MOST_REMEMBERED_ROWS:
        values = scores.tolist()
        rank_of = {value: rank for rank, value in enumerate(sorted(set(values)))}  # the curve depends on order alone
        return _remembered(tuple(rank_of[value] for value in values), tuple(is_true.tolist()), n_missed)
    return _area(scores, is_true, n_missed)


@lru_cache(maxsize=1 << 16)
def _remembered(ranks: tuple[int, ...], is_true: tuple[bool, ...], n_missed: int) -> float:
    return _area(np.array(ranks, np.float64), np.array(is_true, bool), n_missed)


def _area(scores: Float64Array, is_true: BoolArray, n_missed: int) -> float:
    order = np.argsort(scores, kind="stable")
    n_true_up_to = np.cumsum(is_true[order])
    _, first = np.unique(scores[order], return_index=True)
    n_true_below = np.where(first > 0, n_true_up_to[first - 1], 0)
    true_positives = n_true_up_to[-1] - n_true_below
    precision = true_positives / (len(scores) - first)
    # every instance is either a true positive at some score or missed, so the denominator is one constant
    recall = true_positives / (true_positives + n_true_below + n_missed)
    precision = np.append(precision, 1.0)
    padded = np.concatenate([recall[:1], recall, [0.0, 0.0]])
    # convolution with (-1/2, 0, 1/2): halving is exact, so this equals numpy.convolve in every bit
    width = 0.5 * (padded[:-2] - padded[2:])
    return dot(precision, width)


def average_precisions(
    cell: Int64Array, score: Float64Array, is_true: BoolArray, n_missed: Int64Array, is_wanted: BoolArray
) -> Float64Array:
    """``average_precision`` of the rows of each cell, NaN where it is not wanted.

    ``cell`` (E,), ``score`` (E,) and ``is_true`` (E,) are one row a counted prediction, ``n_missed`` and ``is_wanted``
    one value a cell. Many rows go through compiled loops, which give the same bits.
    """
    order = np.lexsort((score, cell))
    bounds = np.searchsorted(cell[order], np.arange(len(n_missed) + 1))
    score, is_true = score[order], is_true[order]
    found = np.full(len(n_missed), np.nan)
    if len(cell) >= MANY_ROWS:
        from su3d_bench.metrics.instance import kernels as kernels

        kernels.areas(score, is_true, bounds, n_missed, is_wanted, found)
        return found
    for index in np.flatnonzero(is_wanted):
        rows = slice(bounds[index], bounds[index + 1])
        found[index] = average_precision(score[rows], is_true[rows], int(n_missed[index]))
    return found
