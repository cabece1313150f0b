"""Batched curves equal single curves, computed with exact sums, in every bit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.metrics.instance import average_precision as curves
from su3d_bench.metrics.instance.average_precision import (
    MANY_ROWS,
    THRESHOLDS,
    InstanceCounts,
    average_precision,
    average_precisions,
    combine,
    dots,
)

N_CLASSES = 3


def many(rng: np.random.Generator, n: int, levels: int) -> InstanceCounts:
    """``n`` counted predictions of ``levels`` confidences: class 2 has no ground truth, class 1 no true positive."""
    class_index = rng.integers(0, N_CLASSES, n).astype(np.int32)
    threshold_index = rng.integers(0, len(THRESHOLDS), n).astype(np.int32)
    is_true = (rng.random(n) < 0.6) & (class_index == 0)
    n_hit = np.bincount(threshold_index[is_true], minlength=len(THRESHOLDS))
    n_truth = np.array([n_hit.max() + 3, 5, 0])
    return InstanceCounts(
        class_index=class_index,
        threshold_index=threshold_index,
        score=rng.integers(0, levels, n) / levels,
        is_true=is_true,
        n_missed=n_truth[:, None] - np.stack([n_hit, np.zeros_like(n_hit), np.zeros_like(n_hit)]),
        n_truth=n_truth,
        n_small_truth=np.zeros(N_CLASSES, np.int64),
        n_predictions=np.full(N_CLASSES, n),
    )


def one_by_one(counts: InstanceCounts) -> Float64Array:
    """The table of classes and thresholds, one curve at a time."""
    table = np.full((N_CLASSES, len(THRESHOLDS)), np.nan)
    for c in np.flatnonzero(counts.n_truth):
        for t in range(len(THRESHOLDS)):
            own = (counts.class_index == c) & (counts.threshold_index == t)
            table[c, t] = area(counts.score[own], counts.is_true[own], int(counts.n_missed[c, t]))
    return table


def area(score: Float64Array, is_true: BoolArray, n_missed: int) -> float:
    """The area of one curve as in the official script, with products added in OpenBLAS's order: sums by ``fsum``."""
    order = np.argsort(score, kind="stable")
    n_true_up_to = np.cumsum(is_true[order])
    _, first = np.unique(score[order], return_index=True)
    if not len(first):
        return 0.0
    n_true_below = np.where(first > 0, n_true_up_to[first - 1], 0)
    hits = n_true_up_to[-1] - n_true_below
    precision = np.append(hits / (len(score) - first), 1.0)
    recall = hits / (hits + n_true_below + n_missed)
    width = np.convolve(np.concatenate([recall[:1], recall, [0.0, 0.0]]), [-0.5, 0, 0.5], "valid")
    return exact_dot(precision, width)


def exact_dot(left: Float64Array, right: Float64Array) -> float:
    """The products in 32 lanes, then 16, then one by one: each added with a single rounding."""
    product, error = (each.tolist() for each in curves._exact_products(left, right))
    n = len(product)
    n16, n32 = n - n % 16, n - n % 32
    wide = [0.0] * 32
    for i in range(n32):
        wide[i % 32] = math.fsum((product[i], error[i], wide[i % 32]))
    lanes = [wide[8 * r + i] + wide[8 * r + i + 4] for r in range(4) for i in range(4)]
    for i in range(n32, n16):
        lanes[i % 16] = math.fsum((product[i], error[i], lanes[i % 16]))
    four = [((lanes[i] + lanes[i + 4]) + lanes[i + 8]) + lanes[i + 12] for i in range(4)]
    total = (four[0] + four[2]) + (four[1] + four[3])
    for i in range(n16, n):
        total = math.fsum((product[i], error[i], total))
    return total


@pytest.mark.parametrize("levels", [1, 7, 40, 10**9])
def test_batched_curves_equal_single_curves_in_every_bit(levels: int) -> None:
    counts = many(np.random.default_rng(levels), 20_500, levels)
    found = combine([counts])
    assert np.array_equal(found.table, one_by_one(counts), equal_nan=True)
    assert found.table[1].tolist() == [0.0] * len(THRESHOLDS)
    assert np.isnan(found.table[2]).all()
    assert 0 < found.ap < 1


def test_wanted_cell_without_rows_is_zero_and_unwanted_one_nan() -> None:
    score, is_true = np.linspace(0, 1, 500), np.ones(500, bool)
    cell = np.full(500, 1)
    areas = average_precisions(cell, score, is_true, np.zeros(4, np.int64), np.array([True, True, False, True]))
    assert areas[[0, 1, 3]].tolist() == [0.0, average_precision(score, is_true, 0), 0.0]
    assert np.isnan(areas[2])
    nothing = np.zeros(0)
    assert average_precision(nothing, nothing.astype(bool), 2) == 0.0


def test_batched_sums_of_products_equal_single_ones() -> None:
    rng = np.random.default_rng(0)
    lengths = np.array([0, 1, 15, 16, 17, 31, 32, 33, 47, 48, 63, 64, 65, 97, 1000])
    starts = np.cumsum(lengths) - lengths
    left, right = rng.random(lengths.sum()), rng.standard_normal(lengths.sum()) / 7
    expected = [exact_dot(left[at : at + n], right[at : at + n]) for at, n in zip(starts, lengths, strict=True)]
    assert dots(left, right, starts, lengths).tolist() == expected


@pytest.mark.parametrize("levels", [1, 6])
def test_resampled_curves_above_the_limit_equal_the_drawn_scenes(levels: int) -> None:
    rng = np.random.default_rng(8)
    scenes = [many(rng, n, levels) for n in (MANY_ROWS, 700, 50)]
    drawn = np.array([[1, 1, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0], [2, 0, 1], [0, 0, 3], [0, 3, 0]])
    weights = np.tile(drawn, (2 * curves.AT_ONCE // len(drawn), 1))[: 2 * curves.AT_ONCE - 3]
    found = curves.resampled_ap(scenes, weights)
    for row, weight in enumerate(drawn):
        whole = combine([scenes[s] for s in range(3) for _ in range(weight[s])])
        for name, expected in (("AP", whole.ap), ("AP50", whole.ap50), ("AP25", whole.ap25)):
            np.testing.assert_allclose(found[name][row :: len(drawn)], expected, rtol=0, atol=1e-12)
