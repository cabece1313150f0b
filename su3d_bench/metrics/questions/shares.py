"""How many were judged and how many of them are right, as additive counts a value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.metric import Arrays, Counts


@dataclass(frozen=True)
class ShareCounts(Counts):
    """What one scene adds: ``n_judged`` and ``n_right`` (V,) int64 for each of the protocol's V values."""

    stored_as = "shares"
    arrays: ClassVar[Arrays] = {"n_judged": ("i", ("values",)), "n_right": ("i", ("values",))}

    n_judged: Int64Array
    n_right: Int64Array


def combine(counts: Sequence[ShareCounts]) -> ShareCounts:
    """The counts of several scenes as one.

    >>> a, b = ShareCounts(np.array([2]), np.array([1])), ShareCounts(np.array([2]), np.array([2]))
    >>> combine([a, b])
    ShareCounts(n_judged=array([4]), n_right=array([3]))
    """
    return ShareCounts(
        np.sum([of_scene.n_judged for of_scene in counts], axis=0),
        np.sum([of_scene.n_right for of_scene in counts], axis=0),
    )


def shares(counts: ShareCounts) -> Float64Array:
    """The share (V,) that is right, NaN where nothing was judged.

    >>> shares(ShareCounts(np.array([4, 0]), np.array([3, 0]))).tolist()
    [0.75, nan]
    """
    return _ratio(counts.n_right.astype(np.float64), counts.n_judged.astype(np.float64))


def resampled(counts: Sequence[ShareCounts], weights: Int64Array) -> Float64Array:
    """The shares (R, V) over the scenes drawn ``weights`` (R, S) times, NaN where none of these was judged.

    >>> a, b = ShareCounts(np.array([2]), np.array([1])), ShareCounts(np.array([1]), np.array([1]))
    >>> resampled([a, b], np.array([[2, 0], [0, 2]])).tolist()
    [[0.5], [1.0]]
    """
    drawn = weights.astype(np.float64)
    n_right = drawn @ np.stack([of_scene.n_right for of_scene in counts]).astype(np.float64)
    return _ratio(n_right, drawn @ np.stack([of_scene.n_judged for of_scene in counts]).astype(np.float64))


def _ratio(n_right: Float64Array, n_judged: Float64Array) -> Float64Array:
    return np.where(n_judged > 0, n_right / np.maximum(n_judged, 1.0), np.nan)
