"""Uncertainty of a number that is formed from several scenes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from su3d_bench.types import Float64Array, Int64Array

N_RESAMPLES = 1000
SEED = 0
LEVEL = 0.95


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
