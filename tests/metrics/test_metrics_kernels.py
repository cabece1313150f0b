"""From 20,000 counted predictions on, compiled loops form the curves: the same bits as one curve after another."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.instance import kernels, resampling
from su3d_bench.metrics.instance.average_precision import THRESHOLDS, InstanceCounts, combine, combine_each
from su3d_bench.metrics.instance.precision_recall import MANY_ROWS, average_precision, average_precisions, dot

N_CLASSES = 3


def many(rng: np.random.Generator, n: int, levels: int) -> InstanceCounts:
    """``n`` counted predictions of ``levels`` confidences: class 2 has no truth, class 1 no true positive."""
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
    """The table of classes and thresholds, each curve by itself."""
    table = np.full((N_CLASSES, len(THRESHOLDS)), np.nan)
    for c in np.flatnonzero(counts.n_truth):
        for t in range(len(THRESHOLDS)):
            own = (counts.class_index == c) & (counts.threshold_index == t)
            table[c, t] = average_precision(counts.score[own], counts.is_true[own], int(counts.n_missed[c, t]))
    return table


@pytest.mark.parametrize("levels", [1, 7, 40, 10**9])
def test_above_the_limit_every_curve_has_the_bits_of_the_curve_by_itself(levels: int) -> None:
    counts = many(np.random.default_rng(levels), MANY_ROWS + 500, levels)
    found = combine([counts])
    assert np.array_equal(found.table, one_by_one(counts), equal_nan=True)
    assert found.table[1].tolist() == [0.0] * len(THRESHOLDS)
    assert np.isnan(found.table[2]).all()
    assert 0 < found.ap < 1


@pytest.mark.parametrize("beyond", [-1, 0])
def test_at_the_limit_both_ways_agree(beyond: int) -> None:
    counts = many(np.random.default_rng(3), MANY_ROWS + beyond, 50)
    assert np.array_equal(combine([counts]).table, one_by_one(counts), equal_nan=True)


def test_scenes_side_by_side_above_the_limit_are_those_alone() -> None:
    rng = np.random.default_rng(5)
    scenes = [many(rng, n, 9) for n in (MANY_ROWS, 40, 0, 900)]
    for each, alone in zip(combine_each(scenes), scenes, strict=True):
        assert np.array_equal(each.table, one_by_one(alone), equal_nan=True)


def test_a_wanted_cell_without_rows_is_zero_and_an_unwanted_one_no_number() -> None:
    score, is_true = np.linspace(0, 1, MANY_ROWS), np.ones(MANY_ROWS, bool)
    cell = np.full(MANY_ROWS, 1)
    areas = average_precisions(cell, score, is_true, np.zeros(4, np.int64), np.array([True, True, False, True]))
    assert areas[[0, 1, 3]].tolist() == [0.0, average_precision(score, is_true, 0), 0.0]
    assert np.isnan(areas[2])


@pytest.mark.parametrize("n", [1, 5, 40])
def test_the_loops_stay_within_their_arrays(n: int) -> None:
    score, is_true = np.linspace(0, 1, n), np.arange(n) % 3 > 0
    of_cell = np.full(1, np.nan)
    # as Python runs them, which looks where the compiled loops write
    kernels.areas.py_func(score, is_true, np.array([0, n]), np.array([2]), np.array([True]), of_cell)
    assert of_cell.tolist() == [average_precision(score, is_true, 2)]


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 31, 32, 33, 47, 48, 63, 64, 65, 97, 1000])
def test_compiled_products_add_up_in_the_order_of_the_others(n: int) -> None:
    rng = np.random.default_rng(n)
    left, right = rng.random(n + 3), rng.random(n + 3) / 7
    assert kernels._dot(left, right, n) == dot(left[:n], right[:n])


@pytest.mark.parametrize("levels", [1, 6])
def test_resampled_curves_above_the_limit_are_those_of_the_scenes_drawn(levels: int) -> None:
    rng = np.random.default_rng(8)
    scenes = [many(rng, n, levels) for n in (MANY_ROWS, 700, 50)]
    drawn = np.array([[1, 1, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0], [2, 0, 1], [0, 0, 3], [0, 3, 0]])
    weights = np.tile(drawn, (2 * resampling.AT_ONCE // len(drawn), 1))[: 2 * resampling.AT_ONCE - 3]
    found = resampling.resampled_ap(scenes, weights)
    for row, weight in enumerate(drawn):
        whole = combine([scenes[s] for s in range(3) for _ in range(weight[s])])
        for name, expected in (("AP", whole.ap), ("AP50", whole.ap50), ("AP25", whole.ap25)):
            np.testing.assert_allclose(found[name][row :: len(drawn)], expected, rtol=0, atol=1e-12)
