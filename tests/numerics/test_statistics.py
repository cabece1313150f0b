"""Intervals over scenes and items, multiple tests, ranks: by hand, by SciPy, and by simulation."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
import scipy.special
import scipy.stats

import su3d_bench.numerics.statistics
from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.statistics import (
    MAX_GROUPS,
    MIN_FIT,
    growth_exponent,
    holm,
    jackknife_interval,
    leave_one_out,
    mean_interval,
    pseudo_values,
    rank_intervals,
    share_interval,
    t_quantile,
)


def test_statistics_docstring_examples_run() -> None:
    assert doctest.testmod(su3d_bench.numerics.statistics).failed == 0


def test_interval_of_a_mean_is_the_t_interval() -> None:
    values: Float64Array = np.random.default_rng(5).random(8)
    low, high = mean_interval(values) or (0, 0)
    expected = scipy.stats.t.interval(0.95, 7, values.mean(), scipy.stats.sem(values))
    np.testing.assert_allclose((low, high), expected, rtol=1e-12)


def test_pseudo_values_of_a_ratio_match_hand_worked_values() -> None:
    # 1 of 2, 3 of 3 and 0 of 5: together 4 of 10, without each 3 of 8, 1 of 7 and 4 of 5
    values = np.array([4 / 10, 3 / 8, 1 / 7, 4 / 5])
    expected = [3 * 0.4 - 2 * 3 / 8, 3 * 0.4 - 2 / 7, 3 * 0.4 - 2 * 4 / 5]
    np.testing.assert_allclose(pseudo_values(values), expected, rtol=1e-12)
    error = np.std(expected, ddof=1) / np.sqrt(3)
    half = 4.302652729911275 * error  # the quantile of a table of Student's t with 2 degrees of freedom
    assert jackknife_interval(values, bounds=(-9, 9)) == pytest.approx((0.4 - half, 0.4 + half), rel=1e-9)


def test_number_from_a_single_scene_has_no_interval() -> None:
    # without the first nothing can be scored
    assert jackknife_interval(np.array([0.5, np.nan, 0.5, 0.5])) is None


def test_non_contributing_scenes_do_not_narrow_the_interval() -> None:
    values = np.array([0.4, 0.3, 0.5])
    with_others = np.concatenate([values, [0.4, 0.4, 0.4]])  # without the others nothing changes
    has_value = np.array([True, True, False, False, False])
    assert jackknife_interval(with_others, has_value) == jackknife_interval(values, np.ones(2, bool))
    assert jackknife_interval(with_others, np.ones(5, bool)) != jackknife_interval(values, np.ones(2, bool))


@pytest.mark.parametrize(
    ("n_right", "n", "low", "high"), [(7, 10, 0.3968, 0.8922), (0, 10, 0.0, 0.2775), (1, 1, 0.2065, 1.0)]
)
def test_wilson_interval_equals_scipy(n_right: int, n: int, low: float, high: float) -> None:
    found = share_interval(n_right / n, n)
    assert found == pytest.approx((low, high), abs=1e-4)
    expected = scipy.stats.binomtest(n_right, n).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(found or (0, 0), (expected.low, expected.high), atol=1e-12)
    assert share_interval(0.5, 0) is None


def test_t_quantile_with_infinite_degrees_of_freedom_is_normal() -> None:
    assert t_quantile(0.975, np.inf) == pytest.approx(scipy.stats.norm.ppf(0.975), rel=1e-12)
    for n_free in range(1, 40):  # the first from a table; releases of scipy may differ in the last bit
        assert t_quantile(0.975, n_free) == pytest.approx(float(scipy.special.stdtrit(n_free, 0.975)), rel=4e-16)
    assert t_quantile(0.9, 5.5) == pytest.approx(scipy.stats.t.ppf(0.9, 5.5), rel=1e-9)


def test_many_scenes_are_left_out_in_groups_with_nearly_the_same_result() -> None:
    rng = np.random.default_rng(4)
    values = rng.random(1700)
    weights = leave_one_out(1700)
    assert weights.shape == (1 + MAX_GROUPS, 1700)
    assert ((weights == 0).sum(axis=0) == 1).all()  # each scene is left out once
    found = jackknife_interval(weights @ values / weights.sum(axis=1), np.ones(1700, bool))
    np.testing.assert_allclose(found or (0, 0), mean_interval(values) or (1, 1), atol=0.002)


# ---- multiple tests


def test_holm_values_match_the_paper() -> None:
    # the steps of the paper: the smallest of n is compared with alpha / n, the next with alpha / (n - 1)
    assert holm([0.01, 0.02, 0.03, 0.04]) == pytest.approx([0.04, 0.06, 0.06, 0.06])
    assert holm([0.5, None, 0.6]) == [1.0, None, 1.0]
    assert holm([]) == []


def test_holm_limits_false_positives() -> None:
    rng = np.random.default_rng(0)
    least = [min(p for p in holm(rng.random(20).tolist()) if p is not None) for _ in range(2000)]
    assert np.mean(np.array(least) < 0.05) == pytest.approx(0.05, abs=0.015)  # 3 standard errors


def test_rank_intervals_stay_wide_without_a_significant_difference() -> None:
    level = np.array([0.9, 0.5, 0.5, 0.1])[:, None] + np.random.default_rng(1).normal(0, 0.01, (4, 12))
    assert rank_intervals(list(level)) == [(1, 1), (2, 3), (2, 3), (4, 4)]
    few = level[:, :5]  # 2 of 32 patterns of five signs: no p below 0.05
    assert rank_intervals(list(few)) == [(1, 4)] * 4
    assert rank_intervals([level[0]]) == [(1, 1)]


def test_rank_intervals_of_equal_rows_have_95_percent_coverage() -> None:
    rng = np.random.default_rng(3)
    whole = [rank_intervals(list(rng.normal(0, 1, (4, 14)))) == [(1, 4)] * 4 for _ in range(200)]
    assert np.mean(whole) >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 200)


# ---- Shapley values and growth


def slope(x: np.ndarray, y: np.ndarray) -> float:
    return float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())


def test_growth_interval_covers_the_central_95_percent_of_slopes() -> None:
    rng = np.random.default_rng(2)
    sizes = np.cumsum(rng.integers(1, 9, 50)).astype(np.float64)
    costs = sizes**0.3 * np.exp(rng.normal(0, 0.4, 50))
    growth = growth_exponent(sizes, costs, n_resamples=2000)
    assert growth is not None
    # other draws of blocks of seven neighbours, concatenated to the length of the data
    x, y, n, length = np.log(sizes), np.log(costs), 50, 7
    slopes = []
    for _ in range(4000):
        drawn = np.concatenate([np.arange(start, start + length) for start in rng.integers(0, n - length + 1, 8)])[:n]
        slopes.append(slope(x[drawn], y[drawn]))
    assert growth.exponent == pytest.approx(slope(x, y), abs=1e-12)
    assert np.mean(np.array(slopes) < growth.low) == pytest.approx(0.025, abs=0.012)
    assert np.mean(np.array(slopes) > growth.high) == pytest.approx(0.025, abs=0.012)


def test_growth_is_none_for_few_points_or_similar_sizes() -> None:
    sizes = np.linspace(1.0, 2.0, MIN_FIT)
    assert growth_exponent(sizes, sizes) is not None
    assert growth_exponent(sizes[1:], sizes[1:]) is None
    assert growth_exponent(np.linspace(1.0, np.nextafter(2.0, 0), MIN_FIT), sizes) is None
    assert growth_exponent(np.linspace(10.0, 19.0, MIN_FIT), sizes) is None
    assert growth_exponent(np.append(sizes, 0.0), np.append(sizes, 1.0)) == growth_exponent(sizes, sizes)
    assert growth_exponent(np.append(sizes, 1.0), np.append(sizes, 0.0)) == growth_exponent(sizes, sizes)


def test_resamples_with_nearly_constant_sizes_are_ignored() -> None:
    sizes = np.array([1.0 + 1e-6 * k for k in range(30)])  # by a billionth of what the last one varies from them
    sizes[-1] = 1000.0
    growth = growth_exponent(sizes, np.append(sizes[:-1] ** 3, 1000.0))
    assert growth is not None
    assert (growth.exponent, growth.low, growth.high) == pytest.approx((1.0, 1.0, 1.0), abs=1e-3)
