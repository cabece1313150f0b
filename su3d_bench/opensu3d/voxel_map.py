"""The scene cloud P_scene: points with instance ids in a growing voxel hash, matched and counted without full scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import Density

NO_INSTANCE = 0
FORMS = {"points": "f8 N 3", "ids": "i4 N", "born": "i8 N", "n_inserted": "i8 1"}  # of ``VoxelMap.state``
# Larger coordinates indicate poses in the wrong unit; voxel coordinates stay exact integers far beyond.
FARTHEST_M = 1e7
ROWS_PER_THREAD = 20_000  # about 2 ms of work; starting a thread takes 0.1 ms


class VoxelMap:
    """Points (float64, metres) with ids, hashed by voxels of side ``eps``.

    Arrays double when full; the cost of every other step depends on the view, not on the size of the map. A deleted
    point's slot goes to the point that takes its voxel, so memory is bounded by the number of voxels observed unless
    ``density`` is ``all``.
    """

    def __init__(self, eps: float, density: Density = "scene") -> None:
        self.eps = eps
        self.density = density
        self._points = np.empty((1 << 12, 3))
        self._ids = np.empty(1 << 12, np.int32)
        self._born = np.empty(1 << 12, np.int64)
        self._following = np.empty(1 << 12, np.int32)
        self._keys = np.empty((1 << 6, 3), np.int64)
        self._heads = np.empty((1 << 6, 512), np.int32)
        self._table = np.full(1 << 8, -1, np.int32)
        self._counts = np.zeros(4, np.int64)
        self._pairs = np.empty((1 << 6, 6), np.int64)
        self._pair_table = np.full(1 << 8, -1, np.int32)
        self._first_pair = np.full(1 << 8, -1, np.int32)

    def __len__(self) -> int:
        return int(self._counts[0])

    @property
    def n_blocks(self) -> int:
        """Number of occupied blocks of 8x8x8 voxels."""
        return int(self._counts[1])

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        """The arrays passed to every kernel."""
        return self._points, self._following, self._keys, self._heads, self._table

    @property
    def _tallies(self) -> tuple[NDArray[Any], ...]:
        return self._pairs, self._pair_table, self._first_pair

    @property
    def n_bytes(self) -> int:
        """Size of the arrays in bytes, spare capacity included."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))

    @property
    def points(self) -> Float64Array:
        """Points (N, 3) in the order of their index; a view."""
        return self._points[: len(self)]

    @property
    def by_age(self) -> Int64Array:
        """Index of each point (N,), the oldest first."""
        return np.argsort(self._born[: len(self)], kind="stable")

    @property
    def ids(self) -> Int32Array:
        """Instance id of each point, NO_INSTANCE for none; a view."""
        return self._ids[: len(self)]

    def ids_of(self, indices: Int64Array) -> Int32Array:
        """Instance id of each map point (N,), NO_INSTANCE for index -1."""
        ids = np.full(len(indices), NO_INSTANCE, np.int32)
        is_there = indices >= 0
        ids[is_there] = self._ids[indices[is_there]]
        return ids

    def nearest(self, queries: Float64Array) -> Int64Array:
        """Index of the nearest point strictly within eps of each query, -1 if none; ties: the oldest."""
        return self.nearest_counted(queries)[0]

    def nearest_counted(self, queries: Float64Array) -> tuple[Int64Array, int]:
        """As ``nearest``, with the number of voxels visited."""
        from su3d_bench.opensu3d import kernels as _kernels

        queries = checked_points(queries)
        answer = np.empty(len(queries), np.int64)

        def look_up(part: slice) -> int:
            return int(_kernels.nearest(queries[part], self.eps, answer[part], self._born, *self._arrays))

        return answer, sum(in_threads(look_up, len(queries)))

    def count_inside(self, lower: Float64Array, upper: Float64Array, wanted: Int32Array) -> Int64Array:
        """Number of points of each wanted id, above NO_INSTANCE, inside the closed box from ``lower`` to ``upper``.

        The cost depends on the wanted instances and the box, not on the others: points are counted per instance and
        block as they are inserted.
        """
        return self.count_inside_counted(lower, upper, wanted)[0]

    def count_inside_counted(
        self, lower: Float64Array, upper: Float64Array, wanted: Int32Array
    ) -> tuple[Int64Array, int]:
        """As ``count_inside``, with the number of blocks visited."""
        from su3d_bench.opensu3d import kernels as _kernels

        inside = np.zeros(len(wanted), np.int64)
        self._reserve_ids(wanted)
        ends = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        visited = _kernels.count_inside(*ends, wanted, self.eps, inside, self._ids, *self._tallies, *self._arrays)
        return inside, int(visited)

    def insert(self, points: Float64Array, ids: Int32Array) -> Int64Array:
        """Add points in order; return the map index of each, -1 if dropped.

        In an occupied voxel ``density`` decides which point is dropped: the old one (``scene``), unless it has an
        instance and the new one has none; the new one (``frame``); neither (``all``).
        """
        from su3d_bench.opensu3d import kernels as _kernels

        points, ids = checked_points(points), np.ascontiguousarray(ids, np.int32)
        self._reserve_points(len(self) + len(points))
        self._reserve_ids(ids)
        placed = np.empty(len(points), np.int64)
        density = {"scene": _kernels.SCENE, "frame": _kernels.FRAME, "all": _kernels.ALL}[self.density]
        done = 0
        while True:
            arrays = placed, self._ids, self._born, self._counts, *self._tallies, *self._arrays
            done = _kernels.insert(points, ids, done, self.eps, density, *arrays)
            if done == len(points):
                return placed
            if self._counts[3] == len(self._pairs):
                self._renew_pairs()
            else:
                self._double_blocks()

    def state(self) -> dict[str, NDArray[Any]]:
        """The arrays from which ``restore`` recreates the map."""
        born = self._born[: len(self)]
        return {"points": self.points, "ids": self.ids, "born": born, "n_inserted": self._counts[2:3]}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Fill this empty map with the points of a ``state``.

        A slot never changes its voxel, so inserting the points in the order of their slots recreates the hash.
        """
        assert not len(self), "only an empty map can be restored"
        density, self.density = self.density, "all"
        self.insert(state["points"], state["ids"])
        self.density = density
        self._born[: len(self)] = state["born"]
        self._counts[2] = state["n_inserted"][0]

    def _reserve_points(self, n: int) -> None:
        capacity = doubled(len(self._ids), n)
        if capacity == len(self._ids):
            return
        self._points = _grown(self._points, capacity, len(self))
        self._ids = _grown(self._ids, capacity, len(self))
        self._born = _grown(self._born, capacity, len(self))
        self._following = _grown(self._following, capacity, len(self))

    def _reserve_ids(self, ids: Int32Array) -> None:
        capacity = doubled(len(self._first_pair), int(ids.max(initial=0)) + 1)
        if capacity > len(self._first_pair):
            self._first_pair = np.append(self._first_pair, np.full(capacity - len(self._first_pair), -1, np.int32))

    def _renew_pairs(self) -> None:
        """Remove pairs without points; double the capacity if more than half have points."""
        from su3d_bench.opensu3d import kernels as _kernels

        old = self._pairs
        capacity = doubled(len(old), 2 * int(np.count_nonzero(old[:, _kernels.N_POINTS])))
        self._pairs = np.empty((capacity, old.shape[1]), np.int64)
        self._pair_table = np.full(4 * capacity, -1, np.int32)
        self._first_pair[:] = -1
        self._counts[3] = 0
        _kernels.copy_pairs(old, self._counts, *self._tallies)

    def _double_blocks(self) -> None:
        from su3d_bench.opensu3d import kernels as _kernels

        capacity = 2 * len(self._keys)
        self._keys = _grown(self._keys, capacity, self.n_blocks)
        self._heads = _grown(self._heads, capacity, self.n_blocks)
        self._table = np.full(4 * capacity, -1, np.int32)
        _kernels.rehash(self._table, self._keys, self.n_blocks)


def in_threads(work: Callable[[slice], int], n: int) -> list[int]:
    """Results of ``work`` on chunks of ``n`` rows, one per thread; independent of the number of threads.

    Uses NUMBA_NUM_THREADS threads (default: the number of cores), and only one for few rows.
    """
    from numba import config

    allowed = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]  # set when numba is imported
    n_parts = max(1, min(allowed, n // ROWS_PER_THREAD))
    ends = [n * k // n_parts for k in range(n_parts + 1)]
    parts = [slice(first, last) for first, last in pairwise(ends)]
    if n_parts == 1:
        return [work(parts[0])]
    with ThreadPoolExecutor(n_parts) as pool:
        return list(pool.map(work, parts))


def _grown(array: NDArray[Any], capacity: int, used: int) -> NDArray[Any]:
    larger = np.empty((capacity, *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger


def doubled(capacity: int, n: int) -> int:
    """``capacity``, doubled until it is at least ``n``."""
    while capacity < n:
        capacity *= 2
    return capacity


def checked_points(points: Float64Array) -> Float64Array:
    """``points`` (N, 3) as the map stores them; ``DataError`` if one is not finite or beyond FARTHEST_M."""
    points = np.ascontiguousarray(points, np.float64)
    # min and max are NaN or infinite if any coordinate is
    if len(points) and not (points.min() >= -FARTHEST_M and points.max() <= FARTHEST_M):
        worst = points[np.argmax(~(np.abs(points) <= FARTHEST_M).all(axis=1))]
        raise DataError(
            f"point cloud: point at {worst.tolist()} m; coordinates must be finite and within {FARTHEST_M:.0e} m"
            " (are poses and depth in metres?)"
        )
    return points
