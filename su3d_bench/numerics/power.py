"""How many scenes and seeds show a paired difference, from how it varied over those that were measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array, Interval
from su3d_bench.numerics.statistics import ALPHA, DIFFERENCE, LEVEL, NO_SPREAD, t_quantile

POWER = 0.8
MOST_SCENES = 100_000  # more are not looked for
LEAST_SEEDS = 3  # of two, where seeds matter, the interval over scenes and seeds holds the truth in 85 of 100 sets
LEAST_SCENES = 6  # of fewer, no pattern of signs has a p below 0.05: 2 of 2^5 are 0.0625


@dataclass(frozen=True)
class Variance:
    """How the difference of a scene under a seed varies: the variance of scenes, of seeds, and of what is left.

    ``of_seeds`` is None where there was one seed alone; what seeds move in a scene is then part of ``of_scenes``.
    """

    of_scenes: float
    of_seeds: float | None
    of_rest: float
    n_scenes: int
    n_seeds: int

    def error(self, n_scenes: int, n_seeds: int) -> tuple[float, float]:
        """The standard error of a mean over so many scenes, each under so many seeds, and its degrees of freedom.

        Source of the latter: Satterthwaite, An approximate distribution of estimates of variance components,
        Biometrics Bulletin 2 (1946).
        """
        scenes = (self.of_scenes + self.of_rest / n_seeds) / n_scenes
        seeds = (self.of_seeds or 0.0) / n_seeds
        parts = scenes**2 / (n_scenes - 1) + (seeds**2 / (n_seeds - 1) if n_seeds > 1 else 0.0)
        total = scenes + seeds
        return float(np.sqrt(total)), total**2 / parts if parts > 0 else float(n_scenes - 1)

    def scaled(self, factor: float) -> Variance:
        """All of it so many times as large."""
        seeds = None if self.of_seeds is None else factor * self.of_seeds
        return Variance(factor * self.of_scenes, seeds, factor * self.of_rest, self.n_scenes, self.n_seeds)


def variance_of(differences: Float64Array) -> Variance:
    """The parts of the variance of ``differences`` (R, S) of S >= 2 scenes, each under R seeds; none is below 0.

    Source: Searle, Casella and McCulloch, Variance Components (1992), chapter 4: the two-way crossed random model with
    one observation a cell.

    >>> variance_of(np.array([[0.0, 2.0], [0.0, 2.0]]))
    Variance(of_scenes=2.0, of_seeds=0.0, of_rest=0.0, n_scenes=2, n_seeds=2)
    """
    n_seeds, n_scenes = differences.shape
    if n_seeds == 1:
        return Variance(float(differences.var(ddof=1)), None, 0.0, n_scenes, 1)
    of_scene, of_seed, mean = differences.mean(axis=0), differences.mean(axis=1), differences.mean()
    rest = differences - of_scene - of_seed[:, None] + mean
    of_rest = float((rest**2).sum()) / ((n_seeds - 1) * (n_scenes - 1))
    return Variance(
        of_scenes=max(0.0, float(of_scene.var(ddof=1)) - of_rest / n_seeds),
        of_seeds=max(0.0, float(of_seed.var(ddof=1)) - of_rest / n_scenes),
        of_rest=of_rest,
        n_scenes=n_scenes,
        n_seeds=n_seeds,
    )


def crossed_interval(middle: float, variance: Variance) -> Interval | None:
    """The t interval of a difference over the scenes and the seeds that were measured.

    None where nothing varied, and of two seeds, which tell too little of seeds.
    """
    if 1 < variance.n_seeds < LEAST_SEEDS:
        return None
    error, n_free = variance.error(variance.n_scenes, variance.n_seeds)
    if error <= NO_SPREAD:
        return None
    half = t_quantile((1.0 + LEVEL) / 2.0, n_free) * error
    return max(DIFFERENCE[0], middle - half), min(DIFFERENCE[1], middle + half)


def power_of(variance: Variance, difference: float, n_scenes: int, n_seeds: int) -> float:
    """How likely a true ``difference`` is found, the right way round, by a two-sided t test at 5 %.

    Source: Cohen, Statistical Power Analysis for the Behavioral Sciences (1988), chapter 2: the noncentral t.

    >>> round(power_of(Variance(1.0, None, 0.0, 8, 1), 0.5, 34, 1), 3)  # 34 scenes, half a deviation
    0.808
    """
    from scipy.stats import nct  # scipy.special's has no number where the shift is large

    error, n_free = variance.error(n_scenes, n_seeds)
    if error <= NO_SPREAD:
        return 1.0
    limit, shift = t_quantile(1.0 - ALPHA / 2.0, n_free), abs(difference) / error
    return float(nct.sf(limit, n_free, shift))


def scenes_needed(variance: Variance, difference: float, n_seeds: int, power: float = POWER) -> int | None:
    """The least number of scenes that find a true ``difference`` with ``power``, each under ``n_seeds`` seeds.

    At least as many as give the sign-flip test a p below 0.05. None where ``MOST_SCENES`` are too few, or where seeds
    move the difference as such and there is one alone: no number of scenes tells the two apart then.

    >>> scenes_needed(Variance(1.0, None, 0.0, 8, 1), 0.5, 1)
    34
    """
    if n_seeds == 1 and variance.of_seeds:
        return None
    low = high = LEAST_SCENES
    # by doubling: where seeds outweigh scenes, their few degrees of freedom take power away again
    while power_of(variance, difference, high, n_seeds) < power:
        if high >= MOST_SCENES:
            return None
        low, high = high + 1, min(2 * high, MOST_SCENES)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if power_of(variance, difference, middle, n_seeds) >= power else (middle + 1, high)
    return low


def variance_range(variance: Variance) -> tuple[Variance, Variance]:
    """The variance at the two ends of its 95 % interval, which so few scenes leave wide: by chi squared, of scenes."""
    from scipy.special import chdtri

    n_free = variance.n_scenes - 1
    ends = [n_free / float(chdtri(n_free, tail)) for tail in ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0)]
    return variance.scaled(ends[0]), variance.scaled(ends[1])
