"""The area under raw precision-recall polylines, to the bit that the official ScanNet evaluator gives."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array

_SPLITTER = 134217729.0  # 2**27 + 1: Veltkamp's constant, cuts a double into two halves of 26 bits


# numpy hands ``np.dot`` to the BLAS, whose order of additions differs between processors: the same curve ends in
# another last bit on AVX2 than on AVX-512. The reference answers of the original evaluators come from OpenBLAS's
# AVX-512 kernel (kernel/x86_64/ddot_microk_skylakex-2.c, and the tail loop of ddot.c): we add in that order,
# in plain double arithmetic.
def dot(left: Float64Array, right: Float64Array) -> float:
    """The sum of products, added as OpenBLAS's AVX-512 kernel adds them with fused multiply-adds.

    Values must be far from overflow and underflow, as precisions and recall steps are.

    >>> dot(np.array([1.0, 0.5, 0.25]), np.array([0.5, 0.25, 0.25]))
    0.6875
    """
    product, error = _exact_products(np.asarray(left, np.float64), np.asarray(right, np.float64))
    n = len(product)
    n_blocked = n - n % 16
    total = 0.0
    if n_blocked:
        n_wide = n_blocked - n_blocked % 32
        wide = [_chain(product[lane:n_wide:32], error[lane:n_wide:32], 0.0) for lane in range(32)]
        # the halves of each 512-bit register fold into one of 256 bits, which takes the last block of 16
        lanes = [wide[8 * register + i] + wide[8 * register + i + 4] for register in range(4) for i in range(4)]
        lanes = [
            _chain(product[n_wide + i : n_blocked : 16], error[n_wide + i : n_blocked : 16], lane)
            for i, lane in enumerate(lanes)
        ]
        four = [((lanes[i] + lanes[4 + i]) + lanes[8 + i]) + lanes[12 + i] for i in range(4)]
        total = (four[0] + four[2]) + (four[1] + four[3])
    return _chain(product[n_blocked:], error[n_blocked:], total)


def _chain(products: list[float], errors: list[float], start: float) -> float:
    """``start`` plus each exact product in turn, rounded once a step, as a fused add does (fsum rounds right)."""
    total = start
    for product, error in zip(products, errors, strict=True):
        total = math.fsum((product, error, total))
    return total


def _exact_products(left: Float64Array, right: Float64Array) -> tuple[list[float], list[float]]:
    """Dekker's product: rounded products and what rounding took from them; the two add up to the exact products."""
    product = left * right
    left_high, left_low = _halves(left)
    right_high, right_low = _halves(right)
    error = left_low * right_low - (
        ((product - left_high * right_high) - left_low * right_high) - left_high * right_low
    )
    return product.tolist(), error.tolist()


def _halves(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    scaled = _SPLITTER * values
    high = scaled - (scaled - values)
    return high, values - high


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
    values = np.full(len(n_missed), np.nan)
    if len(cell) >= MANY_ROWS:
        from su3d_bench.metrics.instance import kernels as kernels

        kernels.areas(score, is_true, bounds, n_missed, is_wanted, values)
        return values
    for index in np.flatnonzero(is_wanted):
        rows = slice(bounds[index], bounds[index + 1])
        values[index] = average_precision(score[rows], is_true[rows], int(n_missed[index]))
    return values
