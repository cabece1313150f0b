"""Values that are averaged over objects, each object with the same weight however many points it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.metric import Arrays, Counts

ROUNDING = 1e-6  # by how much a sum of shares may leave what it is a sum over


@dataclass(frozen=True)
class ObjectCounts(Counts):
    """What one scene, or several, adds: a row for each object that has scored points.

    ``n_points`` (O,) int64; ``totals`` (O, V) float64, V values summed over the points, NaN where the object has none.
    """

    stored_as = "objects"
    arrays: ClassVar[Arrays] = {"n_points": ("i", ("objects",)), "totals": ("f", ("objects", "values"))}

    n_points: Int64Array
    totals: Float64Array

    def contradiction(self) -> str | None:
        """An object without points, or a total of shares that is more than its points."""
        if not (self.n_points > 0).all():
            return "'n_points' has an object without points"
        most = self.n_points[:, None] * (1 + ROUNDING)
        beyond = np.argwhere(~np.isnan(self.totals) & ~((self.totals >= -ROUNDING) & (self.totals <= most)))
        if not len(beyond):
            return None
        row, column = beyond[0]
        return f"'totals' has {self.totals[row, column]:g} over {self.n_points[row]} points"


def concatenate(counts: Sequence[ObjectCounts]) -> ObjectCounts:
    """The counts of several scenes as one: rows one after another."""
    return ObjectCounts(
        np.concatenate([of_scene.n_points for of_scene in counts]),
        np.concatenate([of_scene.totals for of_scene in counts]),
    )


def combine(counts: Sequence[ObjectCounts]) -> Float64Array:
    """The mean (V,) over the objects of the mean over each one's points; NaN rows are left out.

    >>> combine([ObjectCounts(np.array([4, 1]), np.array([[2.0, np.nan], [1.0, 0.25]]))]).tolist()
    [0.75, 0.25]
    """
    whole = concatenate(counts)
    return _means(*_sums(whole))


def _sums(counts: ObjectCounts) -> tuple[Float64Array, Int64Array]:
    """The sum (V,) of the objects' means and the number (V,) of objects that have one."""
    of_object = counts.totals / counts.n_points[:, None]
    has_value = ~np.isnan(of_object)
    return np.where(has_value, of_object, 0.0).sum(axis=0), has_value.sum(axis=0)


def _means(sums: Float64Array, n_objects: Int64Array) -> Float64Array:
    return np.where(n_objects > 0, sums / np.maximum(n_objects, 1), np.nan)


def resampled(counts: Sequence[ObjectCounts], weights: Int64Array) -> Float64Array:
    """The means (R, V) over the objects of the scenes drawn ``weights`` (R, S) times.

    >>> a, b = ObjectCounts(np.array([2]), np.array([[2.0]])), ObjectCounts(np.array([2]), np.array([[1.0]]))
    >>> resampled([a, b], np.array([[2, 0], [1, 1]])).tolist()
    [[1.0], [0.75]]
    """
    per_scene = [_sums(of_scene) for of_scene in counts]
    sums: Float64Array = weights.astype(np.float64) @ np.stack([total for total, _ in per_scene])
    return _means(sums, weights @ np.stack([n for _, n in per_scene]))
