"""From points to their nearest neighbours: exact, the lowest index on ties."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from su3d_bench.core.maps import starts_of
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.matching.rows import first_rows, row_ids

Points = Float32Array | Float64Array
_MAX_NEIGHBOURS = 4_000_000  # candidates in memory at once while ties are broken
# Points at one place, up to rounding, beyond which only the first is searched: as exact, and bounded.
MAX_COINCIDENT = 16
MAX_TIED = 1000  # the same where the search of an original chooses among them: as the original up to this number
COINCIDENT_DECIMALS = 12  # a picometre
MIN_SORTED_CANDIDATES = 50_000  # candidates, below which sorting costs more time than it saves


class Candidates:
    """Points (N, 3) m with a search structure for repeated nearest-neighbour queries."""

    def __init__(self, points: Points) -> None:
        self._n = len(points)
        self._is_ordered = self._n >= MIN_SORTED_CANDIDATES
        if not self._n:
            return
        from scipy.spatial import cKDTree

        if self._is_ordered:
            self._low = np.array([column.min() for column in points.T])  # numpy is slow along short rows
            side_m = max(float(np.ptp(column)) for column in points.T)
            self._cells_a_metre = 32.0 / max(side_m, 1e-9)
        self._order = without_crowds(points)
        self._order = self._order[self._along_curve(points[self._order])]
        self._held = np.asarray(points, np.float64)[self._order]
        self._tree = cKDTree(self._held, balanced_tree=False, compact_nodes=False)

    def __len__(self) -> int:
        return self._n

    def nearest(self, queries: Points, cap_m: float = np.inf) -> tuple[Float64Array, Int64Array]:
        """``nearest`` among these points."""
        if not self._n or not len(queries):
            return np.full(len(queries), np.inf), np.full(len(queries), -1, np.int64)
        asking_order = self._along_curve(queries)
        ordered_queries = np.asarray(queries, np.float64)[asking_order]
        # the tree returns only neighbours nearer than its bound; a distance equal to the cap still counts
        bound = np.nextafter(cap_m, np.inf)
        distances, indices = self._tree.query(ordered_queries, k=2, distance_upper_bound=bound, workers=1)
        # the tree returns n and infinity if it found none
        nearest_index = self._order.take(indices[:, 0], mode="clip")
        tied = np.flatnonzero((distances[:, 0] == distances[:, 1]) & np.isfinite(distances[:, 0]))
        nearest_index[tied] = _lowest_of_equals(self._tree, self._held, ordered_queries[tied], self._order)
        distance, index = np.empty(len(ordered_queries)), np.empty(len(ordered_queries), np.int64)
        distance[asking_order], index[asking_order] = distances[:, 0], nearest_index
        too_far = ~np.isfinite(distance) | (distance > cap_m)
        distance[too_far], index[too_far] = np.inf, -1
        return distance, index

    def _along_curve(self, points: Points) -> Int64Array:
        """An order in which points that are near in space are near in memory, for faster searches.

        It follows a Z-order curve through 32 x 32 x 32 cells of a cube around the candidates; few are not reordered.
        """
        if not self._is_ordered:
            return np.arange(len(points))
        cell = np.clip((points - self._low) * self._cells_a_metre, 0, 31).astype(np.uint16)
        key = np.zeros(len(points), np.uint16)  # numpy sorts 16 bits in linear time
        for bit in range(5):
            for axis in range(3):
                key |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
        return np.argsort(key, kind="stable")


def without_crowds(points: Points, n_kept: int = 1) -> Int64Array:
    """The points, ascending, without all but the first ``n_kept`` of many at one place, which every search would visit.

    >>> len(without_crowds(np.zeros((600, 3)), 2)), len(without_crowds(np.zeros((10, 3))))
    (2, 10)
    """
    every, most = np.arange(len(points)), max(MAX_COINCIDENT, n_kept)
    rows = np.asarray(np.round(points.astype(np.float64), COINCIDENT_DECIMALS) + 0.0, np.float64)  # no -0.0
    hashes = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        hashes = (hashes + np.ascontiguousarray(column).view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
    in_order = np.sort(hashes)
    suspects = np.flatnonzero(np.isin(hashes, in_order[most:][in_order[most:] == in_order[:-most]]))
    place = row_ids(rows[suspects])
    sizes = np.bincount(place)
    order = np.argsort(place, kind="stable")
    rank = np.empty(len(place), np.int64)
    rank[order] = every[: len(place)] - starts_of(sizes)[place[order]]
    return np.delete(every, suspects[(sizes[place] > most) & (rank >= n_kept)])


def nearest(candidates: Points, queries: Points, cap_m: float = np.inf) -> tuple[Float64Array, Int64Array]:
    """Distance in metres and index of each query's nearest candidate; infinity and -1 if none is within ``cap_m``.

    Exact in float64; among candidates at the same squared distance the lowest index wins, so the result depends neither
    on the tree nor on the number of threads.

    >>> distance, index = nearest(np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 0]]), np.array([[1.0, 0, 0], [2, 0, 1]]))
    >>> distance.tolist(), index.tolist()
    ([1.0, 1.0], [0, 1])
    """
    return Candidates(candidates).nearest(queries, cap_m)


Search = Callable[[Points], Callable[[Points, int], IntArray]]  # of points: of queries (Q, 3) and k, rows (Q, k)
_MAX_EQUAL = 32  # positions at one distance among which values are compared; 24 of a cubic lattice can be
ROUNDING_M = 1e-9  # smaller differences of distances are ties, because a tree's bounds are rounded


def ball_tree(points: Points) -> Callable[[Points, int], IntArray]:
    """The search of HOV-SG and OpenLex3D, with scikit-learn's ball tree."""
    from sklearn.neighbors import BallTree

    return partial(BallTree(points).query, return_distance=False)


def kd_tree(points: Points) -> Callable[[Points, int], IntArray]:
    """The search of OVO, with SciPy's k-d tree."""
    from scipy.spatial import KDTree

    tree = KDTree(points)
    return lambda queries, k: tree.query(queries, k)[1]


def chosen_tree(points: Points) -> Callable[[Points, int], IntArray]:
    """The search of OpenLex3D's reader of maps: scikit-learn chooses it by the number of points."""
    from sklearn.neighbors import NearestNeighbors

    return partial(NearestNeighbors(n_neighbors=1).fit(points).kneighbors, return_distance=False)


def nearest_as_found(
    search: Search, points: Points, values: Int64Array, queries: Points, cap_m: float = np.inf
) -> tuple[Float64Array, Int64Array, int]:
    """``nearest``, except that ``search`` decides between points of different ``values`` (N,) at the same distance.

    Also the number of queries at which it does.

    >>> points, values = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 0]]), np.array([5, 7, 7])
    >>> [part for part in nearest_as_found(ball_tree, points, values, np.array([[2.0, 0, 1]]))]
    [array([1.]), array([1]), 0]
    """
    from scipy.spatial import cKDTree

    kept = first_rows(np.column_stack([points, values]))  # without the corners that faces of one object share
    tree = cKDTree(points[kept], balanced_tree=False, compact_nodes=False)
    distances, rows = tree.query(queries, k=2, distance_upper_bound=np.nextafter(cap_m, np.inf), workers=1)
    index = np.append(kept, -1)[rows[:, 0]]
    tied = np.flatnonzero(np.isfinite(distances[:, 1]) & (distances[:, 1] <= distances[:, 0] + ROUNDING_M))
    equal, rows = tree.query(queries[tied], k=_MAX_EQUAL, workers=1)
    of_row = np.append(values[kept], -1)[rows]
    tied = tied[((of_row != of_row[:, :1]) & (equal <= equal[:, :1] + ROUNDING_M)).any(axis=1)]
    if len(tied):
        rows = without_crowds(points, MAX_TIED)
        index[tied] = rows[search(points[rows])(queries[tied], 1)[:, 0]]
    return distances[:, 0], index, len(tied)


def _lowest_of_equals(tree: Any, candidates: Float64Array, queries: Float64Array, order: Int64Array) -> Int64Array:
    """The lowest index among the nearest candidates of queries that have several; ``order`` holds their indices."""
    answer = np.empty(len(queries), np.int64)
    open_rows = np.arange(len(queries))
    k = 8
    while len(open_rows):
        k = min(k, len(candidates))
        unfinished = []
        step = max(1, _MAX_NEIGHBOURS // k)
        for start in range(0, len(open_rows), step):
            rows = open_rows[start : start + step]
            _, neighbours = tree.query(queries[rows], k=k, workers=1)
            offset = candidates[neighbours] - queries[rows][:, None, :]
            squared = offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2
            is_nearest = squared == squared.min(axis=1, keepdims=True)
            answer[rows] = np.where(is_nearest, order[neighbours], np.iinfo(np.int64).max).min(axis=1)
            # there may be more ties beyond the last requested neighbour
            unfinished.append(rows[is_nearest[:, -1]] if k < len(candidates) else rows[:0])
        open_rows = np.concatenate(unfinished)
        k *= 8
    return answer


def are_same_points(left: Points, right: Points) -> bool:
    """Whether two clouds are the same list of points."""
    return left is right or (left.shape == right.shape and bool(np.array_equal(left, right)))
