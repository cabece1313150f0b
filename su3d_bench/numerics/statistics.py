"""Uncertainty of a number that is formed from several scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array

N_RESAMPLES = 1000
SEED = 0
LEVEL = 0.95
MAX_EXACT_PAIRS = 40  # two halves of 2^20 sums, 8 MB each
N_FLIPS = 100_000  # patterns drawn where there are more pairs
FLAT_EXPONENT = 0.1  # at most 7 % more for a size twice as large: what a reader of a plot calls flat
MIN_FIT = 8
LEAST_SPREAD = 1e-9  # of a resample's sizes, over that of all: below it a slope would be made of rounding


@lru_cache(maxsize=1)  # every method and protocol of a run asks for the same
def resample_weights(n_scenes: int, n_resamples: int = N_RESAMPLES, seed: int = SEED) -> Int64Array:
    """How often each scene is drawn (R, S) when as many scenes as there are, are drawn with replacement; read-only.

    >>> resample_weights(4, n_resamples=2).sum(axis=1).tolist()
    [4, 4]
    """
    shares = np.full(n_scenes, 1.0 / n_scenes)
    weights: Int64Array = np.random.default_rng(seed).multinomial(n_scenes, shares, size=n_resamples).astype(np.int64)
    weights.flags.writeable = False
    return weights


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


def nan_mean(values: Float64Array) -> float:
    """Mean of the values that are not NaN; NaN where there is none.

    >>> nan_mean(np.array([1.0, np.nan, 0.0]))
    0.5
    """
    is_nan = np.isnan(values)
    n = len(values) - np.count_nonzero(is_nan)
    return float(np.where(is_nan, 0.0, values).sum() / n) if n else float("nan")  # np.nanmean, which takes its time


def row_means(values: Float64Array) -> Float64Array:
    """Mean of each row without its NaN; NaN for a row without any number.

    >>> row_means(np.array([[1.0, np.nan, 0.0], [np.nan] * 3])).tolist()
    [0.5, nan]
    """
    is_number = ~np.isnan(values)
    n = is_number.sum(axis=1)
    return np.where(n > 0, np.where(is_number, values, 0.0).sum(axis=1) / np.maximum(n, 1), np.nan)


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
        is_plus = generator.integers(0, 2, (1000, n)).astype(np.float64)
        n_as_far += int((np.abs(2.0 * (is_plus @ pairs) - pairs.sum()) >= observed).sum())
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


@dataclass(frozen=True)
class Growth:
    """How a cost grows with a size: ``cost ~ size ** exponent``, with the 95 % interval of the exponent."""

    exponent: float
    low: float
    high: float

    @property
    def words(self) -> str:
        """``constant per update``, ``grows`` or ``not settled``, by the interval against ``FLAT_EXPONENT``."""
        if self.high <= FLAT_EXPONENT:
            return "constant per update"
        return "grows" if self.low > FLAT_EXPONENT else "not settled"


def growth_exponent(sizes: Float64Array, costs: Float64Array, n_resamples: int = N_RESAMPLES) -> Growth | None:
    """The slope of log cost on log size, with a moving-block bootstrap interval, since neighbours in time are alike.

    Sizes and costs (N,) are in the order of time; those that are not above 0 are left out. None where fewer than
    ``MIN_FIT`` remain, or where the largest size is not twice the smallest: nothing can be said of growth then.

    >>> sizes = np.linspace(1.0, 100.0, 50)
    >>> growth_exponent(sizes, 3.0 * sizes).words, growth_exponent(sizes, np.full(50, 7.0)).words
    ('grows', 'constant per update')
    """
    usable = (sizes > 0) & (costs > 0)
    if np.count_nonzero(usable) < MIN_FIT or sizes[usable].max() < 2.0 * sizes[usable].min():
        return None
    x, y = np.log(sizes[usable]), np.log(costs[usable])
    n = len(x)
    length = max(1, round(np.sqrt(n)))
    starts = np.random.default_rng(SEED).integers(0, n - length + 1, (n_resamples, -(-n // length)))
    lengths = np.full(starts.shape[1], length)
    lengths[-1] = n - length * (len(lengths) - 1)
    slopes = _slopes_of_blocks(x, y, starts, lengths)
    low, high = np.nanpercentile(slopes, [2.5, 97.5])
    return Growth(float(_slopes_of_blocks(x, y, np.zeros((1, 1), np.int64), np.array([n]))[0]), float(low), float(high))


def _slopes_of_blocks(x: Float64Array, y: Float64Array, starts: Int64Array, lengths: Int64Array) -> Float64Array:
    """The least-squares slope of ``y`` on ``x`` over each row's blocks of neighbours; NaN where ``x`` hardly varies.

    Row r takes the ``lengths[b]`` neighbours from ``starts[r, b]`` on. Sums of a block are differences of running sums.
    """
    x, y = x - x.mean(), y - y.mean()
    n = lengths.sum()
    sum_x, sum_y, sum_xx, sum_xy = (_block_sums(values, starts, lengths) for values in (x, y, x * x, x * y))
    spread = sum_xx - sum_x * sum_x / n
    varies = spread > LEAST_SPREAD * (x @ x)
    slopes: Float64Array = np.full(len(starts), np.nan)
    np.divide(sum_xy - sum_x * sum_y / n, spread, out=slopes, where=varies)
    return slopes


def _block_sums(values: Float64Array, starts: Int64Array, lengths: Int64Array) -> Float64Array:
    running = np.concatenate([[0.0], np.cumsum(values)])
    total: Float64Array = (running[starts + lengths] - running[starts]).sum(axis=1)
    return total
