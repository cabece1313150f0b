"""Uncertainty of a number that is formed from several scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from su3d_bench.types import Float64Array, Int64Array

N_RESAMPLES = 1000
SEED = 0
LEVEL = 0.95
MAX_EXACT_PAIRS = 40  # two halves of 2^20 sums, 8 MB each
N_FLIPS = 100_000  # patterns drawn where there are more pairs


def resample_weights(n_scenes: int, n_resamples: int = N_RESAMPLES, seed: int = SEED) -> Int64Array:
    """How often each scene is drawn (R, S) when as many scenes as there are, are drawn with replacement.

    >>> resample_weights(4, n_resamples=2).sum(axis=1).tolist()
    [4, 4]
    """
    shares = np.full(n_scenes, 1.0 / n_scenes)
    return np.random.default_rng(seed).multinomial(n_scenes, shares, size=n_resamples).astype(np.int64)


def bootstrap_interval(
    statistic: Callable[[Int64Array], Float64Array],
    n_scenes: int,
    n_resamples: int = N_RESAMPLES,
    seed: int = SEED,
    level: float = LEVEL,
) -> tuple[float, float] | None:
    """The percentile interval of ``statistic`` over resampled scenes; ``None`` for a single scene.

    ``statistic`` takes the weights (R, S) of ``resample_weights`` and gives one value a resample; NaN values, of
    resamples in which nothing could be scored, are left out. With nothing left the answer is ``None`` too.

    >>> values = np.array([0.2, 0.4, 0.9])
    >>> low, high = bootstrap_interval(lambda weights: weights @ values / 3, n_scenes=3)
    >>> 0.2 <= low < 0.5 < high <= 0.9
    True
    """
    if n_scenes < 2:
        return None
    return percentile_interval(statistic(resample_weights(n_scenes, n_resamples, seed)), level)


def percentile_interval(values: Float64Array, level: float = LEVEL) -> tuple[float, float] | None:
    """The central ``level`` of resampled values, without their NaN; ``None`` where nothing is left.

    >>> percentile_interval(np.array([0.0, 1.0, np.nan]), level=0.5)
    (0.25, 0.75)
    """
    numbers = values[~np.isnan(values)]
    if not len(numbers):
        return None
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(numbers, [tail, 1.0 - tail])
    return float(low), float(high)


@dataclass(frozen=True)
class SignFlipTest:
    """What the sign-flip test of ``n_pairs`` paired differences says.

    ``p`` is two-sided; ``smallest_p`` is the least that so many pairs can give, whatever their differences.
    ``is_exact``: all patterns of signs were counted; else so many were drawn as ``N_FLIPS`` says.
    """

    p: float
    smallest_p: float
    n_pairs: int
    is_exact: bool


def sign_flip_test(differences: Float64Array) -> SignFlipTest | None:
    """How often the mean of ``differences`` would be as far from 0 if each sign were a coin's; ``None`` without pairs.

    NaN are left out. Up to ``MAX_EXACT_PAIRS`` pairs all 2^n patterns of signs are counted; beyond, random ones.

    >>> sign_flip_test(np.array([0.1, 0.2, 0.3]))
    SignFlipTest(p=0.25, smallest_p=0.25, n_pairs=3, is_exact=True)
    """
    pairs = differences[~np.isnan(differences)].astype(np.float64)
    n = len(pairs)
    if n == 0:
        return None
    # sums in another order differ by rounding; equals must count as equals
    observed = abs(float(pairs.sum())) - 1e-12 * float(np.abs(pairs).sum())
    if n <= MAX_EXACT_PAIRS:
        p = 1.0 if observed <= 0 else _n_sums_from(pairs, observed) * 2 / 2**n
        return SignFlipTest(p, min(1.0, 2.0 ** (1 - n)), n, True)
    generator = np.random.default_rng(SEED)
    n_as_far = 0
    for _ in range(N_FLIPS // 1000):
        signs = generator.integers(0, 2, (1000, n)) * 2 - 1
        n_as_far += int((np.abs(signs @ pairs) >= observed).sum())
    return SignFlipTest((1 + n_as_far) / (1 + N_FLIPS), 1 / (1 + N_FLIPS), n, False)


def _n_sums_from(pairs: Float64Array, least: float) -> int:
    """How many of the 2^n signed sums of ``pairs`` are at least ``least``, by the sorted sums of two halves."""
    halves = []
    for part in (pairs[: len(pairs) // 2], pairs[len(pairs) // 2 :]):
        sums = np.zeros(1)
        for value in part:
            sums = np.concatenate([sums - value, sums + value])
        halves.append(np.sort(sums))
    below = np.searchsorted(halves[1], least - halves[0], side="left")
    return int((len(halves[1]) - below).sum())
