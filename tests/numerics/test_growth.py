"""How a cost grows: the level of the interval, and the verdict at its limits."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.numerics.statistics import MIN_FIT, growth_exponent


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
