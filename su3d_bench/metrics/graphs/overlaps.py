"""How much of two clouds lies together, which of them belong together, and what comes of it at each threshold.

Source: hovsg/utils/graph_utils.py and hovsg/eval/hm3dsem_evaluator.py of hovsg/HOV-SG at commit 71a8069.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.matching.nearest import row_ids

THRESHOLDS = np.linspace(0.0, 1.0, 11)  # a pair is found where its overlap is above
Pairs = tuple[Int64Array, Int64Array]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (N, D) in m, searched by their neighbours."""

    points: Float64Array

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def corners(self) -> Float64Array:
        """The lowest and the highest corner (2, D); there must be points."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])

    def n_near(self, other: Cloud, radius_m: float) -> int:
        """How many of its points have one of ``other`` nearer than ``radius_m``."""
        if not len(self.points) or not len(other.points):
            return 0
        low, high = other.corners
        around = self.points[((self.points >= low - radius_m) & (self.points <= high + radius_m)).all(axis=1)]
        if not len(around):
            return 0
        distance_m, _ = other._tree.query(around, distance_upper_bound=radius_m)
        return int(np.isfinite(distance_m).sum())


def larger_share(first: Cloud, second: Cloud, radius_m: float) -> float:
    """The share of either cloud's points that lie nearer than ``radius_m`` to the other, whichever is larger.

    >>> line = Cloud(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]))
    >>> larger_share(line, Cloud(line.points[:1] + 0.01), 0.02), larger_share(line, Cloud(np.zeros((0, 3))), 0.02)
    (1.0, 0.0)
    """
    if not len(first.points) or not len(second.points):
        return 0.0
    shares = (one.n_near(other, radius_m) / len(one.points) for one, other in ((first, second), (second, first)))
    return max(shares)


def covered_share(of: Cloud, by: Cloud, radius_m: float) -> float:
    """How many points of ``by`` lie nearer than ``radius_m`` to ``of``, over the number of points of ``of``, at most 1.

    The original counts the points of the one cloud and divides by those of the other.

    >>> covered_share(Cloud(np.zeros((4, 2))), Cloud(np.zeros((1, 2))), 0.05)
    0.25
    """
    return min(by.n_near(of, radius_m) / len(of.points), 1.0) if len(of.points) else 0.0


def voxel_ids(points: Float64Array, voxel_m: float) -> Int64Array:
    """A number from 0 for each voxel that holds points (N, D), of a grid around their lowest corner, as Open3D's."""
    corner = points.min(axis=0, initial=np.inf) - voxel_m * 0.5
    return row_ids(np.floor((points - corner) / voxel_m).astype(np.int64))


def voxel_means(values: Float64Array, voxel: Int64Array) -> Float64Array:
    """The mean (V, C) of ``values`` (N, C) over the points of each voxel (N,).

    >>> points = np.array([[0.0, 0], [0.02, 0], [0.03, 0], [0.05, 0]])
    >>> voxel_means(points, voxel_ids(points, 0.05))[:, 0].tolist()
    [0.01, 0.04]
    """
    n = np.bincount(voxel)
    return np.stack([np.bincount(voxel, weights=column) / n for column in values.T], axis=1)


def best_pairs(overlap: Float64Array) -> Pairs:
    """Rows and columns of the one-to-one assignment of greatest total ``overlap`` (P, T); min(P, T) pairs.

    Pairs without any overlap are among them: as many as there can be.
    """
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(overlap, maximize=True)
    return rows.astype(np.int64), columns.astype(np.int64)


def found_at(overlap: Float64Array) -> Int64Array:
    """How many of the best pairs' overlaps (T,) are above each of ``THRESHOLDS``."""
    return np.array([(overlap > threshold).sum() for threshold in THRESHOLDS], np.int64)


@dataclass(frozen=True)
class Rates:
    """Precision, recall and accuracy (R, T) at each threshold; accuracy is found / (found + false + missed)."""

    precision: Float64Array
    recall: Float64Array
    accuracy: Float64Array

    @property
    def area(self) -> Float64Array:
        """The area (R,) under precision over recall, as the original forms it: recalls are sorted, precisions are not.

        Precisions stand from the lowest threshold on, recalls from the smallest one on, so that the highest precision
        meets the lowest recall.
        """
        return trapezoid(self.precision, np.sort(self.recall, axis=1))


def rates(n_found: Float64Array, n_predicted: Float64Array, n_true: Float64Array) -> Rates:
    """The rates of numbers (R, T), (R,) and (R,); 0 where nothing is predicted, NaN where nothing is true.

    >>> table = rates(np.array([[2.0, 1.0]]), np.array([4.0]), np.array([2.0]))
    >>> table.precision.tolist(), table.recall.tolist(), table.accuracy.tolist()
    ([[0.5, 0.25]], [[1.0, 0.5]], [[0.5, 0.2]])
    """
    predicted, true = n_predicted[:, None], n_true[:, None]
    nothing = np.where(true > 0, 0.0, np.nan)
    return Rates(
        np.where((predicted > 0) & (true > 0), n_found / np.maximum(predicted, 1), nothing),
        np.where(true > 0, n_found / np.maximum(true, 1), np.nan),
        np.where(true > 0, n_found / np.maximum(predicted + true - n_found, 1), np.nan),
    )


def trapezoid(values: Float64Array, places: Float64Array) -> Float64Array:
    """The area (R,) under ``values`` (R, K) at ``places`` (R, K)."""
    return np.asarray(np.trapezoid(values, places, axis=1))


def summed(parts: Sequence[Float64Array | Int64Array], weights: Int64Array) -> Float64Array:
    """The sums (R, ...) of the parts of S scenes, each drawn ``weights`` (R, S) times."""
    return np.tensordot(weights.astype(np.float64), np.stack(parts).astype(np.float64), axes=1)
