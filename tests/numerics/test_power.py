"""How many scenes and seeds a difference needs: by simulation, by SciPy, and at the ends."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from su3d_bench.numerics.statistics import (
    ALPHA,
    MAX_SCENES,
    MIN_SCENES,
    Variance,
    crossed_interval,
    power_of,
    scenes_needed,
    variance_of,
    variance_range,
)


def drawn(rng: np.random.Generator, n_seeds: int, n_scenes: int, mean: float = 0.0) -> np.ndarray:
    """Differences (R, S) with the standard deviations 3 of scenes, 1 of seeds and 2 of the rest."""
    rest = rng.normal(0, 2, (n_seeds, n_scenes))
    return mean + rng.normal(0, 3, n_scenes) + rng.normal(0, 1, (n_seeds, 1)) + rest


def test_the_interval_over_scenes_and_seeds_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    n_hold = 0
    for _ in range(600):
        values = drawn(rng, 4, 10) / 100
        low, high = crossed_interval(float(values.mean()), variance_of(values)) or (1, 1)
        n_hold += low <= 0 <= high
    assert 0.92 <= n_hold / 600 <= 0.98
    assert crossed_interval(0.1, variance_of(np.zeros((3, 3)))) is None


def test_of_two_seeds_no_interval_is_told_and_of_three_one_that_holds() -> None:
    rng = np.random.default_rng(2)
    # scenes, seeds and the rest as where the interval of two seeds holds the truth in 86 of 100
    every = [rng.normal(0, 0.3, (3, 20)) + rng.normal(0, 0.6, 20) + rng.normal(0, 1, (3, 1)) for _ in range(600)]
    intervals = [crossed_interval(float(one.mean()) / 100, variance_of(one / 100)) for one in every]
    assert np.mean([one is not None and one[0] <= 0 <= one[1] for one in intervals]) >= 0.9
    assert all(crossed_interval(float(one[:2].mean()), variance_of(one[:2])) is None for one in every)


def test_power_is_the_share_of_samples_in_which_a_t_test_finds_the_difference() -> None:
    rng = np.random.default_rng(2)
    samples = rng.normal(1.0, 2.0, (4000, 20))
    found = (scipy.stats.ttest_1samp(samples, 0, axis=1).pvalue < ALPHA) & (samples.mean(axis=1) > 0)
    assert power_of(Variance(4.0, None, 0.0, 8, 1), 1.0, 20, 1) == pytest.approx(found.mean(), abs=0.025)


def test_one_scene_fewer_has_not_the_power() -> None:
    variance = Variance(0.04, 0.001, 0.01, 8, 3)
    for n_seeds in (3, 5, 10):
        n_scenes = scenes_needed(variance, 0.1, n_seeds) or 0
        assert power_of(variance, 0.1, n_scenes, n_seeds) >= 0.8
        assert n_scenes == MIN_SCENES or power_of(variance, 0.1, n_scenes - 1, n_seeds) < 0.8


def test_no_number_of_scenes_averages_out_what_one_seed_moves() -> None:
    assert scenes_needed(Variance(0.01, 0.001, 0.0, 8, 3), 0.1, 1) is None
    assert scenes_needed(Variance(0.01, 0.0, 0.0, 8, 3), 0.1, 1) == scenes_needed(Variance(0.01, None, 0, 8, 1), 0.1, 1)
    assert scenes_needed(Variance(100.0, None, 0.0, 8, 1), 0.01, 1) is None
    assert scenes_needed(Variance(0.5**2, None, 0.0, 8, 1), 0.005, 1) in range(MIN_SCENES, MAX_SCENES)


def test_the_range_of_the_variance_is_that_of_chi_squared() -> None:
    low, high = variance_range(Variance(2.0, None, 0.0, 8, 1))
    expected = 7 * 2.0 / scipy.stats.chi2.ppf([0.975, 0.025], 7)
    np.testing.assert_allclose((low.of_scenes, high.of_scenes), expected)
