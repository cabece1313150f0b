"""How many were judged, how many of them are right, and how many would be by a guess, as additive counts a value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.metric import Arrays, Counts

ROUNDING = 1e-6  # by how much a sum of shares may pass what it is a sum over


@dataclass(frozen=True)
class ShareCounts(Counts):
    """What one scene adds: ``n_judged`` and ``n_right`` (V,) int64 for each of the protocol's V values.

    ``by_chance`` (V,) float64: how many a guess gets right; ``by_name``: how many who knows each object's name and no
    more; NaN where nobody can say.
    """

    stored_as = "shares"
    arrays: ClassVar[Arrays] = {
        "n_judged": ("i", ("values",)),
        "n_right": ("i", ("values",)),
        "by_chance": ("f", ("values",)),
        "by_name": ("f", ("values",)),
    }

    n_judged: Int64Array
    n_right: Int64Array
    by_chance: Float64Array
    by_name: Float64Array

    def contradiction(self) -> str | None:
        """More that is right, or that a guess gets right, than was judged."""
        for name in ("n_right", "by_chance", "by_name"):
            right = getattr(self, name)
            beyond = np.flatnonzero(~np.isnan(right) & ~((right >= 0) & (right <= self.n_judged + ROUNDING)))
            if len(beyond):
                return f"'{name}' has {right[beyond[0]]:g} of {self.n_judged[beyond[0]]} judged"
        return None


def combine(counts: Sequence[ShareCounts]) -> ShareCounts:
    """The counts of several scenes as one.

    >>> a, b = share_counts([2], [1]), share_counts([2], [2])
    >>> combine([a, b]).n_right.tolist()
    [3]
    """
    return ShareCounts(
        *(np.sum([getattr(of_scene, name) for of_scene in counts], axis=0) for name in ShareCounts.arrays)
    )


def share_counts(
    n_judged: Sequence[int],
    n_right: Sequence[int],
    by_chance: Sequence[float] | None = None,
    by_name: Sequence[float] | None = None,
) -> ShareCounts:
    """The counts of a scene; what a guess gets right is not known where it is not given."""
    unknown = np.full(len(n_judged), np.nan)
    return ShareCounts(
        np.array(n_judged, np.int64),
        np.array(n_right, np.int64),
        unknown if by_chance is None else np.array(by_chance, np.float64),
        unknown if by_name is None else np.array(by_name, np.float64),
    )


def shares(counts: ShareCounts) -> Float64Array:
    """The share (V,) that is right, NaN where nothing was judged.

    >>> shares(share_counts([4, 0], [3, 0])).tolist()
    [0.75, nan]
    """
    return _ratio(counts.n_right.astype(np.float64), counts.n_judged.astype(np.float64))


def baselines(counts: ShareCounts) -> tuple[Float64Array, Float64Array]:
    """The shares (V,) that a guess gets right, and who knows names alone; NaN where nobody can say."""
    n_judged = counts.n_judged.astype(np.float64)
    return _ratio(counts.by_chance, n_judged), _ratio(counts.by_name, n_judged)


def resampled(counts: Sequence[ShareCounts], weights: Int64Array) -> Float64Array:
    """The shares (R, V) over the scenes drawn ``weights`` (R, S) times, NaN where none of these was judged.

    >>> a, b = share_counts([2], [1]), share_counts([1], [1])
    >>> resampled([a, b], np.array([[2, 0], [0, 2]])).tolist()
    [[0.5], [1.0]]
    """
    drawn = weights.astype(np.float64)
    n_right = drawn @ np.stack([of_scene.n_right for of_scene in counts]).astype(np.float64)
    return _ratio(n_right, drawn @ np.stack([of_scene.n_judged for of_scene in counts]).astype(np.float64))


def _ratio(n_right: Float64Array, n_judged: Float64Array) -> Float64Array:
    return np.where(n_judged > 0, n_right / np.maximum(n_judged, 1.0), np.nan)
