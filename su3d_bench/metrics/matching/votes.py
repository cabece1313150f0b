"""From predicted points to ground-truth points with more than the nearest point.

Votes of the nearest points, as in HOV-SG and OVO, and masks that include every point near one of their own, as in
OpenLex3D's queries.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.matching.nearest import MAX_TIED, ROUNDING_M, Points, Search, ball_tree, without_crowds
from su3d_bench.metrics.matching.rows import row_ids

_MAX_CELLS = 4_000_000  # neighbours in memory at once


def transfer_votes(
    points: Points,
    values: Int64Array,
    targets: Points,
    wanted: BoolArray,
    neighbours: int,
    cap_m: float = np.inf,
    search: Search = ball_tree,
) -> tuple[Int64Array, Float64Array]:
    """The majority value of the ``neighbours`` nearest points, and the distance of the nearest, for each wanted target.

    Each of ``points`` (V, 3) has one vote, ``values`` (V,) from 0; among points at the same distance those vote that
    ``search`` finds, among values with equal votes the smallest wins. -1 and infinity if no point is within ``cap_m``
    or the target is not wanted.

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]])
    >>> value, distance = transfer_votes(points, np.array([4, 7, 7, 4]), points[:1], np.array([True]), 3)
    >>> value.tolist(), distance.tolist()
    ([7], [0.0])
    """
    value, distance = np.full(len(targets), -1, np.int64), np.full(len(targets), np.inf)
    wanted_rows = np.flatnonzero(wanted)
    if not len(points) or not len(wanted_rows):
        return value, distance
    places, place_of_target = _distinct_places(targets[wanted_rows])
    of_place, nearest_m = np.empty(len(places), np.int64), np.empty(len(places))
    found = _Search(points, neighbours, search)
    step = max(1, _MAX_CELLS // (neighbours + 1))
    for start in range(0, len(places), step):
        rows = slice(start, start + step)
        distances, indices = found.nearest(places[rows])
        votes = np.where(distances <= cap_m, values[indices], -1)
        of_place[rows], nearest_m[rows] = _most_votes(votes), distances.min(axis=1)
    value[wanted_rows], distance[wanted_rows] = of_place[place_of_target], nearest_m[place_of_target]
    distance[distance > cap_m] = np.inf
    return value, distance


def _distinct_places(points: Points) -> tuple[Float64Array, Int64Array]:
    """The distinct positions, and the row of every point's position: corners of several faces share one."""
    rows = np.asarray(points, np.float64)
    ids = row_ids(rows)
    _, first = np.unique(ids, return_index=True)
    return rows[first], ids


def _most_votes(votes: Int64Array) -> Int64Array:
    """The value with most votes in each row (R, K), the smallest on ties; votes of -1 do not count.

    >>> _most_votes(np.array([[3, 1, 3, 1], [2, -1, -1, -1], [-1, -1, -1, -1]])).tolist()
    [1, 2, -1]
    """
    n = np.stack([(votes == column[:, None]).sum(axis=1) for column in votes.T], axis=1)
    n[votes < 0] = 0
    has_most = n == n.max(axis=1, keepdims=True)
    return np.asarray(np.where(has_most, votes, votes.max()).min(axis=1))


class _Search:
    """The ``k`` nearest of a list of points, exact in float64; those that ``search`` finds on ties.

    Of more points at one place than ``MAX_TIED``, only so many take part in ties.
    """

    def __init__(self, points: Points, k: int, search: Search = ball_tree) -> None:
        from scipy.spatial import cKDTree

        self.k = min(k, len(points))
        self.rows = without_crowds(points, self.k + 1)
        self.points = np.asarray(points, np.float64)
        self.tree: Any = cKDTree(self.points[self.rows], balanced_tree=False, compact_nodes=False)
        self.search = search

    @cached_property
    def found(self) -> Callable[[Points, int], IntArray]:
        rows = without_crowds(self.points, MAX_TIED)
        find = self.search(self.points[rows])
        return lambda queries, k: rows[find(queries, k)]

    def nearest(self, queries: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Distances in metres and indices (Q, k), in no particular order."""
        k, n = self.k, len(self.rows)
        distances, indices = self.tree.query(queries, k=min(k + 1, n), workers=1)
        distances, indices = distances.reshape(len(queries), -1), self.rows[indices.reshape(len(queries), -1)]
        if k < n:
            tied = np.flatnonzero(distances[:, k] <= distances[:, k - 1] + ROUNDING_M)
            indices = indices[:, :k]
            if len(tied):
                indices[tied] = self.found(queries[tied], k)
        return distances[:, :k], indices


def transfer_each_mask(points: Points, masks: Masks, targets: Points, cap_m: float) -> Masks:
    """The masks on ``targets``: a target is in every mask with a point nearer than ``cap_m``.

    >>> masks = Masks(np.array([0, 1, 2]), np.array([0, 1]))
    >>> moved = transfer_each_mask(np.array([[0.0, 0, 0], [1, 0, 0]]), masks, np.array([[0.4, 0, 0], [0.6, 0, 0]]), 0.5)
    >>> moved.indptr.tolist(), moved.indices.tolist()
    ([0, 1, 2], [0, 1])
    """
    from scipy.sparse import csr_array

    places, place_of_target = _distinct_places(targets)
    along_x = np.argsort(places[:, 0], kind="stable")
    x = places[along_x, 0]
    positions = np.asarray(points, np.float64)
    reached = []
    for k in range(len(masks)):
        own = positions[masks.mask(k)]
        reached.append(_within(own, places, along_x, x, cap_m) if len(own) else along_x[:0])
    indptr = np.concatenate([[0], np.cumsum([len(rows) for rows in reached])])
    indices = np.concatenate([along_x[:0], *reached])
    of_place = csr_array((np.ones(len(indices), np.int8), indices, indptr), shape=(len(masks), len(places)))
    moved = of_place.tocsc()[:, place_of_target].tocsr()  # column after column, so each row is ascending
    return Masks(moved.indptr.astype(np.int64), moved.indices.astype(np.int32))


def _within(own: Float64Array, places: Float64Array, along_x: Int64Array, x: Float64Array, cap_m: float) -> Int64Array:
    """The positions nearer than ``cap_m`` to one of the points ``own``, ascending; searched only in their box."""
    from scipy.spatial import cKDTree

    low, high = own.min(axis=0) - cap_m, own.max(axis=0) + cap_m
    near = along_x[np.searchsorted(x, low[0], "left") : np.searchsorted(x, high[0], "right")]
    near = np.sort(near[((places[near, 1:] >= low[1:]) & (places[near, 1:] <= high[1:])).all(axis=1)])
    own = own[without_crowds(own)]
    _, own_index = cKDTree(own).query(places[near], distance_upper_bound=np.nextafter(cap_m, np.inf), workers=1)
    near, own_index = near[own_index < len(own)], own_index[own_index < len(own)]
    offset = own[own_index] - places[near]
    squared = offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2
    return np.asarray(near[squared < cap_m * cap_m])
