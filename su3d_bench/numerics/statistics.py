"""Statistics over scenes or items: confidence intervals, tests, ranks, power; growth of costs; Shapley values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, Interval

LEVEL = 0.95
ALPHA = 0.05  # a difference is significant if its two-sided p is below this
FEW_SCENES = 10  # with fewer, an interval is reported as rough: docs/numbers/interval-coverage.md shows its coverage
MAX_GROUPS = 500  # scenes that are left out one by one; the largest validation set in use has 312
MIN_ITEMS = 10  # with fewer, a t interval of a change or an agreement has a coverage below 90 %
NO_SPREAD = 1e-12  # smaller differences between pseudo-values of fractions are rounding
SEED = 0
N_RESAMPLES = 1000  # of the blocks for the slope of a growth
MAX_EXACT_PAIRS = 40  # two halves of 2^20 sums, 8 MB each
N_FLIPS = 100_000  # patterns drawn if there are more pairs
FLAT_EXPONENT = 0.1  # at most 7 % more for twice the size: flat in a plot
MIN_FIT = 8
MIN_SPREAD = 1e-9  # of a resample's sizes, relative to that of all: below it a slope would be rounding noise
SHARE, DIFFERENCE = (0.0, 1.0), (-1.0, 1.0)  # the range of a fraction, and of a difference of two
POWER = 0.8
MAX_SCENES = 100_000  # the search stops here
MIN_SEEDS = 3  # with two, if seeds matter, the interval over scenes and seeds has a coverage of only 85 %
MIN_SCENES = 6  # with fewer, no pattern of signs has a p below 0.05: 2 / 2^5 = 0.0625


def _group_of_scene(n_scenes: int) -> Int64Array:
    """The group (S,) with which each scene is left out: alone, or with every ``MAX_GROUPS``-th scene."""
    return np.arange(n_scenes) % min(n_scenes, MAX_GROUPS)


@lru_cache(maxsize=1)  # every method and protocol of a run uses the same
def leave_one_out(n_scenes: int) -> Int64Array:
    """The weight of each scene (1 + G, S): all scenes, then all except the first, and so on; read-only.

    More than ``MAX_GROUPS`` scenes are left out in ``MAX_GROUPS`` groups, each scene in one of them.

    >>> leave_one_out(2).tolist()
    [[1, 1], [0, 1], [1, 0]]
    """
    groups = np.arange(min(n_scenes, MAX_GROUPS))
    left_out = groups[:, None] == _group_of_scene(n_scenes)
    weights: Int64Array = np.concatenate([np.ones((1, n_scenes), bool), ~left_out]).astype(np.int64)
    weights.flags.writeable = False
    return weights


def has_part(values: Float64Array, has_value: BoolArray) -> BoolArray:
    """Which of the G scenes, or groups, contribute to a number, from its ``values`` (1 + G,): over all, without each.

    A group contributes if one of its scenes has a value, by ``has_value`` (S,), or if the number changes without it.
    """
    n_with_value = np.bincount(_group_of_scene(len(has_value)), weights=has_value, minlength=len(values) - 1)
    return np.asarray((n_with_value > 0) | (values[1:] != values[0]))


def pseudo_values(values: Float64Array, is_part: BoolArray | None = None) -> Float64Array:
    """Tukey's jackknife pseudo-values of a number, from its ``values`` (1 + G,): over all, then without each scene.

    Scenes that do not contribute, by ``is_part`` (G,), are omitted.
    Source: Miller, The jackknife: a review, Biometrika 61 (1974), equation 2.2, which also covers groups.

    >>> pseudo_values(np.array([0.5, 0.6, 0.4])).round(12).tolist()  # for a mean they are the values themselves
    [0.4, 0.6]
    """
    whole, left_out = values[0], values[1:]
    kept = left_out if is_part is None else left_out[is_part]
    return np.asarray(len(kept) * whole - (len(kept) - 1) * kept)


def jackknife_interval(
    values: Float64Array,
    has_value: BoolArray | None = None,
    *,
    bounds: Interval = SHARE,
    level: float = LEVEL,
) -> Interval | None:
    """The t interval around a number over scenes, its standard error from the pseudo-values of ``values`` (1 + G,).

    With ``has_value`` (S,), scenes that do not contribute to the number are ignored. The interval is centred on the
    value rather than on the mean of the pseudo-values, which has lower coverage with few scenes
    (``python benchmarks coverage_of_intervals`` has both), and is clipped to ``bounds``. It is for the number expected
    over as many scenes, because AP of rare classes is lower over very many. None for a single scene, if
    nothing can be scored without one scene, and if the scenes do not differ, which allows no estimate of the spread.
    Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11; the t quantile after Tukey.

    >>> means = np.array([0.5, 0.55, 0.5, 0.45])  # the mean of 0.4, 0.5 and 0.6, and the means without each of them
    >>> low, high = jackknife_interval(means)
    >>> round(low, 4), round(high, 4)
    (0.2516, 0.7484)
    """
    pseudo = pseudo_values(values, None if has_value is None else has_part(values, has_value))
    if len(pseudo) < 2 or not np.isfinite(pseudo).all():
        return None
    spread = float(pseudo.std(ddof=1))
    if spread <= NO_SPREAD:
        return None
    half = t_quantile((1.0 + level) / 2.0, len(pseudo) - 1) * spread / np.sqrt(len(pseudo))
    return max(bounds[0], float(values[0] - half)), min(bounds[1], float(values[0] + half))


def mean_interval(values: Float64Array, bounds: Interval = SHARE) -> Interval | None:
    """The t interval of a mean; None for fewer than two values, or if all are equal."""
    n = len(values)
    if n < 2:
        return None
    total = values.sum()
    return jackknife_interval(np.append(total / n, (total - values) / (n - 1)), bounds=bounds)


def share_interval(share: float, n: int, level: float = LEVEL) -> Interval | None:
    """Wilson's interval of the fraction ``share`` of ``n`` sampled items with a binary property.

    For items with fractional values, such as the share of several annotators, it is too wide rather than too narrow.
    None for n = 0. Source: Wilson, JASA 22 (1927); recommended by Brown, Cai and DasGupta, Stat. Science 16 (2001).

    >>> low, high = share_interval(1.0, 10)
    >>> round(low, 3), high
    (0.722, 1.0)
    """
    if n < 1:
        return None
    z = t_quantile((1.0 + level) / 2.0, np.inf)
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(max(0.0, share * (1 - share)) / n + z * z / (4 * n * n))
    # the ends 0 and 1 are exact; only rounding would change them
    return (0.0 if share <= 0 else float(middle - half)), (1.0 if share >= 1 else float(middle + half))


# Student's t at 0.975 with 1, 2, ... degrees of freedom, from scipy: for intervals over a few scenes, without the
# 0.25 s that scipy.special takes to load.
T_975 = (
    12.706204736174694, 4.302652729749462, 3.1824463052837078, 2.7764451051977934, 2.5705818356363146,
    2.4469118511449786, 2.364624251592784, 2.306004135204166, 2.262157162798205, 2.228138851986274, 2.200985160091639,
    2.1788128296672284, 2.1603686564627913, 2.144786687917804, 2.131449545559776, 2.1199052992212546,
    2.1098155778333156, 2.1009220402410382, 2.0930240544083087, 2.085963447265864, 2.0796138447276795,
    2.0738730679040254, 2.0686576104190486, 2.0638985616280245, 2.0595385527532972, 2.0555294386428735,
    2.0518305164802846, 2.0484071417952454, 2.045229642132703, 2.0422724563012378,
)  # fmt: skip


def t_quantile(level: float, n_free: float) -> float:
    """The quantile of Student's t with ``n_free`` degrees of freedom; of the normal distribution if infinite.

    >>> round(t_quantile(0.975, 3), 3), round(t_quantile(0.975, np.inf), 3)
    (3.182, 1.96)
    """
    if level == 0.975 and n_free in range(1, len(T_975) + 1):
        return T_975[int(n_free) - 1]
    from scipy.special import ndtri, stdtrit

    return float(ndtri(level) if np.isinf(n_free) else stdtrit(n_free, level))


def ratio(part: Float64Array | Int64Array, whole: Float64Array | Int64Array) -> Float64Array:
    """``part / whole``; NaN if ``whole`` is 0.

    >>> ratio(np.array([1, 0]), np.array([4, 0])).tolist()
    [0.25, nan]
    """
    quotient: Float64Array = np.full(part.shape, np.nan)
    return np.divide(part, whole, out=quotient, where=whole > 0)


def nan_mean(values: Float64Array) -> float:
    """Mean of the values that are not NaN; NaN if there are none.

    >>> nan_mean(np.array([1.0, np.nan, 0.0]))
    0.5
    """
    is_nan = np.isnan(values)
    n = len(values) - np.count_nonzero(is_nan)
    return float(np.where(is_nan, 0.0, values).sum() / n) if n else float("nan")  # as np.nanmean, but faster


def row_means(values: Float64Array) -> Float64Array:
    """Mean of each row, ignoring NaN; NaN for a row without any number.

    >>> row_means(np.array([[1.0, np.nan, 0.0], [np.nan] * 3])).tolist()
    [0.5, nan]
    """
    is_number = ~np.isnan(values)
    return ratio(np.where(is_number, values, 0.0).sum(axis=1), is_number.sum(axis=1))


@dataclass(frozen=True)
class SignFlipTest:
    """The result of the sign-flip test of ``n_pairs`` paired differences.

    ``p`` is two-sided; ``smallest_p`` is the smallest p possible with this number of pairs.
    ``is_exact``: all patterns of signs were counted; otherwise ``N_FLIPS`` were drawn.
    """

    p: float
    smallest_p: float
    n_pairs: int
    is_exact: bool


def sign_flip_test(differences: Float64Array) -> SignFlipTest | None:
    """The sign-flip test of the mean of ``differences`` against 0; ``None`` without pairs.

    It assumes that the differences of two equally good methods are symmetric around 0: at 5 %, skewed differences
    with mean 0 are rejected more often (docs/numbers/interval-coverage.md has how often). NaN are ignored. Up to
    ``MAX_EXACT_PAIRS`` pairs all 2^n patterns of signs are counted; otherwise random ones.

    >>> sign_flip_test(np.array([0.1, 0.2, 0.3]))
    SignFlipTest(p=0.25, smallest_p=0.25, n_pairs=3, is_exact=True)
    """
    pairs = differences[~np.isnan(differences)].astype(np.float64)
    n = len(pairs)
    if n == 0:
        return None
    # sums in another order differ by rounding; equal sums must count as equal
    observed = abs(float(pairs.sum())) - 1e-12 * float(np.abs(pairs).sum())
    if n <= MAX_EXACT_PAIRS:
        p = 1.0 if observed <= 0 else _n_sums_from(pairs, observed) * 2 / 2**n
        return SignFlipTest(p, 2.0 ** (1 - n), n, True)
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


def holm(values: Sequence[float | None]) -> list[float | None]:
    """The p values adjusted for multiple tests.

    None, for no test, stays None and is not counted.
    Source: Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6 (1979).

    >>> [None if p is None else round(p, 3) for p in holm([0.01, 0.04, None, 0.03])]
    [0.03, 0.06, None, 0.06]
    """
    known = sorted((p, index) for index, p in enumerate(values) if p is not None)
    adjusted: list[float | None] = [None] * len(values)
    largest = 0.0
    for rank, (p, index) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        adjusted[index] = largest
    return adjusted


def rank_intervals(values: Sequence[Float64Array], alpha: float = ALPHA) -> list[tuple[int, int]]:
    """The best and the worst possible rank of each of K rows, with ``values`` (S,) over the same scenes.

    A row ranks below each row that is better by the sign-flip test of their paired differences, corrected by Holm over
    all pairs; if differences of equally good rows are symmetric, all intervals together contain the true ranks with a
    probability of at least 1 - ``alpha``.
    Source: Mogstad, Romano, Shaikh and Wilhelm, Inference for Ranks, Review of Economic Studies 91 (2024).

    >>> far = [np.arange(10) / 100 + level for level in (0.8, 0.1)]
    >>> rank_intervals([*far, far[1] + 1e-3 * (-1) ** np.arange(10)])
    [(1, 1), (2, 3), (2, 3)]
    """
    pairs = list(combinations(range(len(values)), 2))
    differences = [values[j] - values[i] for i, j in pairs]
    tests = [sign_flip_test(of_pair) for of_pair in differences]
    corrected = holm([None if test is None else test.p for test in tests])
    n_better, n_worse = [0] * len(values), [0] * len(values)
    for (i, j), p, of_pair in zip(pairs, corrected, differences, strict=True):
        if p is not None and p < alpha:
            better, worse = (j, i) if np.nansum(of_pair) > 0 else (i, j)
            n_worse[better] += 1
            n_better[worse] += 1
    return [(1 + n_better[k], len(values) - n_worse[k]) for k in range(len(values))]


@dataclass(frozen=True)
class Growth:
    """The growth of a cost with a size: ``cost ~ size ** exponent``, with the 95 % interval of the exponent."""

    exponent: float
    low: float
    high: float

    @property
    def words(self) -> str:
        """``constant per update``, ``grows`` or ``not settled``, by comparing the interval with ``FLAT_EXPONENT``."""
        if self.high <= FLAT_EXPONENT:
            return "constant per update"
        return "grows" if self.low > FLAT_EXPONENT else "not settled"


def growth_exponent(sizes: Float64Array, costs: Float64Array, n_resamples: int = N_RESAMPLES) -> Growth | None:
    """The slope of log cost on log size, with a moving-block bootstrap interval, because successive values correlate.

    Sizes and costs (N,) are in the order of time; values that are not above 0 are ignored. None if fewer than
    ``MIN_FIT`` remain, or if the largest size is less than twice the smallest: growth cannot be estimated then.

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
    """The least-squares slope of ``y`` on ``x`` over each row's blocks; NaN if ``x`` hardly varies.

    Row r uses ``lengths[b]`` values from ``starts[r, b]``. The sum of a block is a difference of running sums.
    """
    x, y = x - x.mean(), y - y.mean()
    n = lengths.sum()
    sum_x, sum_y, sum_xx, sum_xy = (_block_sums(values, starts, lengths) for values in (x, y, x * x, x * y))
    spread = sum_xx - sum_x * sum_x / n
    varies = spread > MIN_SPREAD * (x @ x)
    slopes: Float64Array = np.full(len(starts), np.nan)
    np.divide(sum_xy - sum_x * sum_y / n, spread, out=slopes, where=varies)
    return slopes


def _block_sums(values: Float64Array, starts: Int64Array, lengths: Int64Array) -> Float64Array:
    running = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((running[starts + lengths] - running[starts]).sum(axis=1))


@dataclass(frozen=True)
class Variance:
    """The variance components of a difference per scene and seed: of scenes, of seeds, and the residual.

    ``of_seeds`` is None with only one seed; the variance of seeds within a scene is then part of ``of_scenes``.
    """

    of_scenes: float
    of_seeds: float | None
    of_rest: float
    n_scenes: int
    n_seeds: int

    def error(self, n_scenes: int, n_seeds: int) -> tuple[float, float]:
        """The standard error of a mean over ``n_scenes`` scenes with ``n_seeds`` seeds each, and degrees of freedom.

        Source of the latter: Satterthwaite, An approximate distribution of estimates of variance components,
        Biometrics Bulletin 2 (1946).
        """
        scenes = (self.of_scenes + self.of_rest / n_seeds) / n_scenes
        seeds = (self.of_seeds or 0.0) / n_seeds
        parts = scenes**2 / (n_scenes - 1) + (seeds**2 / (n_seeds - 1) if n_seeds > 1 else 0.0)
        total = scenes + seeds
        return float(np.sqrt(total)), total**2 / parts if parts > 0 else float(n_scenes - 1)

    def scaled(self, factor: float) -> Variance:
        """All components multiplied by ``factor``."""
        seeds = None if self.of_seeds is None else factor * self.of_seeds
        return Variance(factor * self.of_scenes, seeds, factor * self.of_rest, self.n_scenes, self.n_seeds)


def variance_of(differences: Float64Array) -> Variance:
    """The variance components of ``differences`` (R, S) of S >= 2 scenes with R seeds each, clipped at 0.

    Source: Searle, Casella and McCulloch, Variance Components (1992), chapter 4: the two-way crossed random model with
    one observation per cell.

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
    """The t interval of a difference over the measured scenes and seeds.

    None if nothing varies, and for two seeds, which are too few to estimate their variance.
    """
    if 1 < variance.n_seeds < MIN_SEEDS:
        return None
    error, n_free = variance.error(variance.n_scenes, variance.n_seeds)
    if error <= NO_SPREAD:
        return None
    half = t_quantile((1.0 + LEVEL) / 2.0, n_free) * error
    return max(DIFFERENCE[0], middle - half), min(DIFFERENCE[1], middle + half)


def power_of(variance: Variance, difference: float, n_scenes: int, n_seeds: int) -> float:
    """The probability that a two-sided t test at 5 % finds a true ``difference`` with the right sign.

    Source: Cohen, Statistical Power Analysis for the Behavioral Sciences (1988), chapter 2: the noncentral t.

    >>> round(power_of(Variance(1.0, None, 0.0, 8, 1), 0.5, 34, 1), 3)  # 34 scenes, half a deviation
    0.808
    """
    from scipy.stats import nct  # scipy.special's version has no value for large shifts

    error, n_free = variance.error(n_scenes, n_seeds)
    if error <= NO_SPREAD:
        return 1.0
    limit, shift = t_quantile(1.0 - ALPHA / 2.0, n_free), abs(difference) / error
    return float(nct.sf(limit, n_free, shift))


def scenes_needed(variance: Variance, difference: float, n_seeds: int, power: float = POWER) -> int | None:
    """The smallest number of scenes that finds a true ``difference`` with ``power``, with ``n_seeds`` seeds each.

    At least the number that allows the sign-flip test a p below 0.05. None if ``MAX_SCENES`` are too few, or if seeds
    affect the difference and only one is used: no number of scenes can separate the two then.

    >>> scenes_needed(Variance(1.0, None, 0.0, 8, 1), 0.5, 1)
    34
    """
    if n_seeds == 1 and variance.of_seeds:
        return None
    low = high = MIN_SCENES
    # by doubling: if seeds dominate, their few degrees of freedom reduce the power again
    while power_of(variance, difference, high, n_seeds) < power:
        if high >= MAX_SCENES:
            return None
        low, high = high + 1, min(2 * high, MAX_SCENES)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if power_of(variance, difference, middle, n_seeds) >= power else (middle + 1, high)
    return low


def variance_range(variance: Variance) -> tuple[Variance, Variance]:
    """The variance at the two ends of its 95 % interval, by chi squared over scenes; wide with few scenes."""
    from scipy.special import chdtri

    n_free = variance.n_scenes - 1
    ends = [n_free / float(chdtri(n_free, tail)) for tail in ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0)]
    return variance.scaled(ends[0]), variance.scaled(ends[1])
