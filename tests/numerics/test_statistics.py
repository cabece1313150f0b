"""Intervals over scenes and items, tests of many at once, ranks: by hand, by SciPy, and by simulation."""

from __future__ import annotations

import doctest
import math
from itertools import permutations

import numpy as np
import pytest
import scipy.special
import scipy.stats

import su3d_bench.numerics.statistics
from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.statistics import (
    EXACT_STEPS,
    MAX_GROUPS,
    MIN_FIT,
    N_ORDERS,
    choices,
    growth_exponent,
    holm,
    jackknife_interval,
    leave_one_out,
    mean_interval,
    pseudo_values,
    rank_intervals,
    share_interval,
    shares,
    t_quantile,
)


def test_the_examples_in_the_docstrings_run() -> None:
    assert doctest.testmod(su3d_bench.numerics.statistics).failed == 0


def test_of_a_mean_the_interval_is_student_s() -> None:
    values: Float64Array = np.random.default_rng(5).random(8)
    low, high = mean_interval(values) or (0, 0)
    expected = scipy.stats.t.interval(0.95, 7, values.mean(), scipy.stats.sem(values))
    np.testing.assert_allclose((low, high), expected, rtol=1e-12)


def test_pseudo_values_of_a_ratio_are_those_worked_out_by_hand() -> None:
    # 1 of 2, 3 of 3 and 0 of 5: together 4 of 10, without each 3 of 8, 1 of 7 and 4 of 5
    values = np.array([4 / 10, 3 / 8, 1 / 7, 4 / 5])
    expected = [3 * 0.4 - 2 * 3 / 8, 3 * 0.4 - 2 / 7, 3 * 0.4 - 2 * 4 / 5]
    np.testing.assert_allclose(pseudo_values(values), expected, rtol=1e-12)
    error = np.std(expected, ddof=1) / np.sqrt(3)
    half = 4.302652729911275 * error  # the quantile of a table of Student's t with 2 degrees of freedom
    assert jackknife_interval(values, bounds=(-9, 9)) == pytest.approx((0.4 - half, 0.4 + half), rel=1e-9)


def test_a_number_that_rests_on_one_scene_has_no_interval() -> None:
    # without the first nothing can be scored
    assert jackknife_interval(np.array([0.5, np.nan, 0.5, 0.5])) is None


def test_scenes_without_a_part_in_a_number_do_not_narrow_its_interval() -> None:
    values = np.array([0.4, 0.3, 0.5])
    with_others = np.concatenate([values, [0.4, 0.4, 0.4]])  # without the others nothing changes
    has_value = np.array([True, True, False, False, False])
    assert jackknife_interval(with_others, has_value) == jackknife_interval(values, np.ones(2, bool))
    assert jackknife_interval(with_others, np.ones(5, bool)) != jackknife_interval(values, np.ones(2, bool))


@pytest.mark.parametrize(
    ("n_right", "n", "low", "high"), [(7, 10, 0.3968, 0.8922), (0, 10, 0.0, 0.2775), (1, 1, 0.2065, 1.0)]
)
def test_wilson_s_interval_is_that_of_scipy(n_right: int, n: int, low: float, high: float) -> None:
    found = share_interval(n_right / n, n)
    assert found == pytest.approx((low, high), abs=1e-4)
    expected = scipy.stats.binomtest(n_right, n).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(found or (0, 0), (expected.low, expected.high), atol=1e-12)
    assert share_interval(0.5, 0) is None


def test_a_quantile_of_infinite_freedom_is_the_normal_one() -> None:
    assert t_quantile(0.975, np.inf) == pytest.approx(scipy.stats.norm.ppf(0.975), rel=1e-12)
    for n_free in range(1, 40):  # the first from a table; releases of scipy may differ in the last bit
        assert t_quantile(0.975, n_free) == pytest.approx(float(scipy.special.stdtrit(n_free, 0.975)), rel=4e-16)
    assert t_quantile(0.9, 5.5) == pytest.approx(scipy.stats.t.ppf(0.9, 5.5), rel=1e-9)


def test_very_many_scenes_are_left_out_in_groups_and_give_nearly_the_same() -> None:
    rng = np.random.default_rng(4)
    values = rng.random(1700)
    weights = leave_one_out(1700)
    assert weights.shape == (1 + MAX_GROUPS, 1700)
    assert ((weights == 0).sum(axis=0) == 1).all()  # each scene is left out once
    found = jackknife_interval(weights @ values / weights.sum(axis=1), np.ones(1700, bool))
    np.testing.assert_allclose(found or (0, 0), mean_interval(values) or (1, 1), atol=0.002)


# ---- many at once


def test_holm_s_values_are_those_of_its_paper() -> None:
    # the steps of the paper: the least of n is held against alpha / n, the next against alpha / (n - 1)
    assert holm([0.01, 0.02, 0.03, 0.04]) == pytest.approx([0.04, 0.06, 0.06, 0.06])
    assert holm([0.5, None, 0.6]) == [1.0, None, 1.0]
    assert holm([]) == []


def test_holm_keeps_false_alarms_below_the_level() -> None:
    rng = np.random.default_rng(0)
    least = [min(p for p in holm(rng.random(20).tolist()) if p is not None) for _ in range(2000)]
    assert np.mean(np.array(least) < 0.05) == pytest.approx(0.05, abs=0.015)  # 3 standard errors


def test_ranks_stay_open_where_no_difference_is_shown() -> None:
    level = np.array([0.9, 0.5, 0.5, 0.1])[:, None] + np.random.default_rng(1).normal(0, 0.01, (4, 12))
    assert rank_intervals(list(level)) == [(1, 1), (2, 3), (2, 3), (4, 4)]
    few = level[:, :5]  # 2 of 32 patterns of five signs: no p below 0.05
    assert rank_intervals(list(few)) == [(1, 4)] * 4
    assert rank_intervals([level[0]]) == [(1, 1)]


def test_rank_intervals_of_equal_rows_hold_all_ranks_in_95_of_100() -> None:
    rng = np.random.default_rng(3)
    whole = [rank_intervals(list(rng.normal(0, 1, (4, 14)))) == [(1, 4)] * 4 for _ in range(200)]
    assert np.mean(whole) >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 200)


# ---- values over drawn scenes


def drawn_values(n_steps: int, seed: int = 1) -> list[float]:
    return list(map(float, np.random.default_rng(seed).random(1 << n_steps)))


@pytest.mark.parametrize("n_steps", [1, 2, 3, 5])
def test_a_share_is_the_mean_over_every_order(n_steps: int) -> None:
    values = drawn_values(n_steps)
    added: list[list[float]] = [[] for _ in range(n_steps)]
    for order in permutations(range(n_steps)):
        bits = 0
        for step in order:
            added[step].append(values[bits | 1 << step] - values[bits])
            bits |= 1 << step
    for found, of_step in zip(shares(n_steps, values.__getitem__), added, strict=True):
        assert found.share == pytest.approx(np.mean(of_step), abs=1e-14)
        assert (found.least, found.most) == (min(of_step), max(of_step))
        assert found.standard_error == 0.0


@pytest.mark.parametrize("n_steps", [EXACT_STEPS, EXACT_STEPS + 1, 12])
def test_shares_sum_to_the_difference(n_steps: int) -> None:
    values = drawn_values(n_steps)
    asked = []
    found = shares(n_steps, lambda bits: asked.append(bits) or values[bits])  # type: ignore[func-returns-value]
    assert math.fsum(one.share for one in found) == pytest.approx(values[-1] - values[0], abs=1e-12)
    assert set(asked) == set(choices(n_steps))


def test_drawn_shares_lie_about_those_of_all_orders_as_their_errors_say() -> None:
    # A step's share of a sum of its own part and of those of pairs is known without drawing.
    n_steps = 10
    generator = np.random.default_rng(0)
    alone, pairs = generator.normal(size=n_steps), np.triu(generator.normal(size=(n_steps, n_steps)), 1)

    def value(bits: int) -> float:
        has = np.array([bits >> step & 1 for step in range(n_steps)])
        return float(alone @ has + has @ pairs @ has)

    known = alone + (pairs.sum(axis=0) + pairs.sum(axis=1)) / 2
    found = shares(n_steps, value)
    errors = np.array([one.standard_error for one in found])
    assert (errors > 0).all() and errors.max() < 4 / math.sqrt(N_ORDERS)
    assert (np.abs([one.share for one in found] - known) < 4 * errors).all()
    assert shares(n_steps, value) == found
    assert shares(n_steps, value, seed=1) != found


def slope(x: np.ndarray, y: np.ndarray) -> float:
    return float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())


def test_the_interval_leaves_out_a_fortieth_of_the_slopes_on_either_side() -> None:
    rng = np.random.default_rng(2)
    sizes = np.cumsum(rng.integers(1, 9, 50)).astype(np.float64)
    costs = sizes**0.3 * np.exp(rng.normal(0, 0.4, 50))
    growth = growth_exponent(sizes, costs, n_resamples=2000)
    assert growth is not None
    # other draws of blocks of seven neighbours, one after another, until there are as many as the data
    x, y, n, length = np.log(sizes), np.log(costs), 50, 7
    slopes = []
    for _ in range(4000):
        drawn = np.concatenate([np.arange(start, start + length) for start in rng.integers(0, n - length + 1, 8)])[:n]
        slopes.append(slope(x[drawn], y[drawn]))
    assert growth.exponent == pytest.approx(slope(x, y), abs=1e-12)
    assert np.mean(np.array(slopes) < growth.low) == pytest.approx(0.025, abs=0.012)
    assert np.mean(np.array(slopes) > growth.high) == pytest.approx(0.025, abs=0.012)


def test_nothing_is_said_of_too_few_points_or_of_sizes_that_hardly_differ() -> None:
    sizes = np.linspace(1.0, 2.0, MIN_FIT)
    assert growth_exponent(sizes, sizes) is not None
    assert growth_exponent(sizes[1:], sizes[1:]) is None
    assert growth_exponent(np.linspace(1.0, np.nextafter(2.0, 0), MIN_FIT), sizes) is None
    assert growth_exponent(np.linspace(10.0, 19.0, MIN_FIT), sizes) is None
    assert growth_exponent(np.append(sizes, 0.0), np.append(sizes, 1.0)) == growth_exponent(sizes, sizes)
    assert growth_exponent(np.append(sizes, 1.0), np.append(sizes, 0.0)) == growth_exponent(sizes, sizes)


def test_resamples_whose_sizes_hardly_vary_have_no_part_in_the_interval() -> None:
    sizes = np.array([1.0 + 1e-6 * k for k in range(30)])  # by a billionth of what the last one varies from them
    sizes[-1] = 1000.0
    growth = growth_exponent(sizes, np.append(sizes[:-1] ** 3, 1000.0))
    assert growth is not None
    assert (growth.exponent, growth.low, growth.high) == pytest.approx((1.0, 1.0, 1.0), abs=1e-3)
