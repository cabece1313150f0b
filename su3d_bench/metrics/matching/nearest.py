"""From predicted points to ground-truth points: nearest neighbours, the lowest index on ties."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from su3d_bench.core.geometry import voxel_coordinates
from su3d_bench.core.maps import Instances, Masks, Partition, starts_of
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array, IntArray

P = ParamSpec("P")
R = TypeVar("R")
Key = tuple[Any, ...]
_MAX_BYTES = 512 << 20  # of all cached results together: the oldest are dropped


class _Memory:
    def __init__(self) -> None:
        self._answers: dict[Key, Any] = {}
        self._n_bytes = 0
        self._met: dict[int, object] = {}  # kept alive, so that no other object gets the id of one in a key

    def answer(self, key: Key, ask: Callable[[], R]) -> R:
        if key not in self._answers:
            answer = ask()
            self._n_bytes += _n_bytes(answer)
            while self._answers and self._n_bytes > _MAX_BYTES:
                self._n_bytes -= _n_bytes(self._answers.pop(next(iter(self._answers))))
            self._answers[key] = answer
        found: R = self._answers[key]
        return found

    def key_of(self, value: object) -> object:
        """The identity of ``value`` in a cache key: its content, or if that is unknown the object itself."""
        if isinstance(value, np.ndarray):
            content = hashlib.blake2b(np.ascontiguousarray(value).data, digest_size=16).digest()
            return value.dtype.str, value.shape, content
        if isinstance(value, Masks):
            return "masks", self.key_of(value.indptr), self.key_of(value.indices)
        if isinstance(value, tuple | list):
            return tuple(map(self.key_of, value))
        if value is None or isinstance(value, str | int | float):
            return type(value), value
        self._met[id(value)] = value
        return "itself", id(value)


def _n_bytes(answer: object) -> int:
    if isinstance(answer, Masks):
        return answer.indptr.nbytes + answer.indices.nbytes
    if isinstance(answer, tuple):
        return sum(map(_n_bytes, answer))
    return int(getattr(answer, "nbytes", 0))


_memory: ContextVar[_Memory | None] = ContextVar("memory", default=None)


@contextmanager
def remembering() -> Iterator[None]:
    """A context in which ``remembered`` functions return the same object for equal arguments.

    >>> @remembered
    ... def twice(values):
    ...     return values * 2
    >>> with remembering():
    ...     first, second = twice(np.arange(3)), twice(np.arange(3))
    >>> first is second, twice(np.arange(3)) is first
    (True, False)
    """
    token = _memory.set(_Memory())
    try:
        yield
    finally:
        _memory.reset(token)


def is_remembering() -> bool:
    """Whether results are cached, so that computing more than requested may pay off."""
    return _memory.get() is not None


def remembered(function: Callable[P, R]) -> Callable[P, R]:
    """``function`` with its results cached inside ``remembering``; they must not be modified."""
    name = f"{function.__module__}.{function.__qualname__}"

    @wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        memory = _memory.get()
        if memory is None:
            return function(*arguments, **named)
        return memory.answer((name, _key(memory, arguments, named)), lambda: function(*arguments, **named))

    return call


def _key(memory: _Memory, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Key:
    return tuple(map(memory.key_of, arguments)), tuple((name, memory.key_of(named[name])) for name in sorted(named))


Points = Float32Array | Float64Array

COVERAGE_RADII_M = (0.025, 0.05, 0.1)
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


def reduce_to_voxels(points: Points, masks: Masks, voxel_m: float) -> Int64Array:
    """Ascending indices of the points that remain if each mask, and the background, keeps its first point per voxel."""
    voxel = voxel_coordinates(points, voxel_m)
    background = np.ones(len(points), bool)
    background[masks.indices] = False
    outside = np.flatnonzero(background)
    members = np.concatenate([masks.indices.astype(np.int64), outside])
    owner = np.concatenate([masks.owners, np.full(len(outside), len(masks), np.int64)])
    return np.unique(members[first_rows(np.column_stack([owner, voxel[members]]))])


def row_ids(rows: Int64Array | Float64Array) -> Int64Array:
    """One number, from 0, per distinct row, without the slow comparison of whole rows in numpy's unique.

    >>> row_ids(np.array([[1, 5], [0, 5], [1, 5], [0, 6]])).tolist()
    [1, 0, 1, 2]
    """
    if (keys := _packed(rows)) is not None:
        return np.unique(keys, return_inverse=True)[1]
    order = np.lexsort(rows.T)
    is_new = np.any(np.diff(rows[order], axis=0) != 0, axis=1)
    ids = np.zeros(len(rows), np.int64)
    ids[order[1:]] = np.cumsum(is_new)
    return ids


def rows_of(ids: IntArray, values: IntArray) -> Int64Array:
    """The row in ascending ``ids`` of each of ``values`` (N,), -1 if it is not among them.

    >>> rows_of(np.array([3, 7]), np.array([7, 0, 3, 9])).tolist()
    [1, -1, 0, -1]
    """
    known = np.append(ids, np.iinfo(np.int64).max).astype(np.int64)
    row = np.searchsorted(known, values)
    return np.where((known[row] == values) & (row < len(ids)), row, -1)


def _packed(rows: Int64Array | Float64Array) -> Int64Array | None:
    """One number per row of integers, in the order of the rows from the last column; None if 63 bits are too few."""
    if not len(rows) or rows.dtype.kind not in "iu":
        return None
    lows = [int(column.min()) for column in rows.T]  # column by column: numpy is slow along short rows
    spans = [int(column.max()) - low + 1 for column, low in zip(rows.T, lows, strict=True)]
    if math.prod(spans) >= 1 << 63:
        return None
    keys = np.zeros(len(rows), np.int64)
    for column, low, span in reversed(list(zip(rows.T, lows, spans, strict=True))):
        keys *= span
        keys += column - low
    return keys


def first_rows(rows: Int64Array) -> Int64Array:
    """The first of each distinct row, in the order of ``row_ids``.

    >>> first_rows(np.array([[1, 5], [0, 5], [1, 5], [0, 6]])).tolist()
    [1, 0, 3]
    """
    keys = _packed(rows)
    keys = row_ids(rows) if keys is None else keys
    n_bits = len(keys).bit_length()
    if int(keys.max(initial=0)).bit_length() + n_bits > 63:
        return np.unique(keys, return_index=True)[1]
    # a key and its index in one number: sorting plain numbers takes half the time of an argsort
    ordered = np.sort((keys << n_bits) | np.arange(len(keys)))
    is_first = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:] >> n_bits, ordered[:-1] >> n_bits, out=is_first[1:])
    return ordered[is_first] & ((1 << n_bits) - 1)


@remembered
def transfer_masks(
    points: Points, masks: Masks, targets: Points, cap_m: float | None = None, voxel_m: float = 0.0
) -> Masks:
    """The masks on ``targets``: a target belongs to mask k if the nearest of all ``points`` within the cap does.

    Masks that overlap still overlap; a target whose nearest point is in no mask is in none. On ``points`` themselves
    the masks do not change.

    >>> masks = Masks(np.array([0, 1, 3]), np.array([0, 0, 1]))
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> moved = transfer_masks(points, masks, np.array([[0.1, 0, 0], [1.9, 0, 0]]))
    >>> moved.indptr.tolist(), moved.indices.tolist()
    ([0, 1, 2], [0, 0])
    """
    if are_same_points(points, targets):
        return masks
    kept = reduce_to_voxels(points, masks, voxel_m) if voxel_m > 0 else np.arange(len(points))
    _, nearest_index = nearest(points[kept], targets, np.inf if cap_m is None else cap_m)
    reached = np.flatnonzero(nearest_index >= 0)
    from scipy.sparse import csr_array

    of_point = csr_array(
        (np.ones(len(masks.indices), np.int8), masks.indices, masks.indptr), shape=(len(masks), len(points))
    ).tocsc()
    moved = of_point[:, kept[nearest_index[reached]]].tocsr()  # column by column, so each row is ascending
    return Masks(moved.indptr.astype(np.int64), reached[moved.indices].astype(np.int32))


def first_owner(masks: Masks, n_points: int) -> Int64Array:
    """For each point the first mask that contains it, -1 if none does.

    >>> first_owner(Masks(np.array([0, 2, 4]), np.array([0, 1, 1, 2])), 4).tolist()
    [0, 0, 1, -1]
    """
    owner = np.full(n_points, -1, np.int64)
    owner[masks.indices[::-1]] = masks.owners[::-1]
    return owner


def transfer_values(
    points: Points, values: Int64Array, rank: Int64Array, targets: Points, wanted: BoolArray, cap_m: float = np.inf
) -> tuple[Int64Array, Float64Array]:
    """Value and distance in metres of the nearest point with a rank, for each wanted target; otherwise -1 and infinity.

    Points of rank -1 and those farther than ``cap_m`` are ignored. At equal distance the lower ``rank`` wins, then the
    lower index. On ``points`` themselves a point with a rank keeps its own value, even if others share its position.

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0]])
    >>> values, distance = transfer_values(
    ...     points, np.array([7, 8]), np.array([0, -1]), points, np.array([True, True])
    ... )
    >>> values.tolist(), distance.tolist()
    ([7, 7], [0.0, 1.0])
    """
    order = np.flatnonzero(rank >= 0)
    order = order[np.argsort(rank[order], kind="stable")]
    value, distance = np.full(len(targets), -1, np.int64), np.full(len(targets), np.inf)
    missing = wanted
    if are_same_points(points, targets):
        own = wanted & (rank >= 0)
        value[own], distance[own] = values[own], 0.0
        missing = wanted & ~own
    rows = np.flatnonzero(missing)
    if is_remembering():
        distance[rows], nearest_index = _asked(points[order], targets, cap_m).nearest(rows)
    else:
        distance[rows], nearest_index = nearest(points[order], targets[rows], cap_m)
    reached = rows[nearest_index >= 0]
    value[reached] = values[order][nearest_index[nearest_index >= 0]]
    return value, distance


class _Asked:
    """The nearest of some points for the targets of a scene, each searched only once."""

    def __init__(self, points: Points, targets: Points, cap_m: float) -> None:
        self._candidates, self._targets, self._cap_m = Candidates(points), targets, cap_m
        self._is_known = np.zeros(len(targets), bool)
        self._distance, self._index = np.empty(len(targets)), np.empty(len(targets), np.int64)
        self.nbytes = 17 * len(targets) + 64 * len(points)

    def nearest(self, rows: Int64Array) -> tuple[Float64Array, Int64Array]:
        """``nearest`` for the targets ``rows``."""
        new = rows[~self._is_known[rows]]
        self._distance[new], self._index[new] = self._candidates.nearest(self._targets[new], self._cap_m)
        self._is_known[new] = True
        return self._distance[rows], self._index[rows]


@remembered
def _asked(points: Points, targets: Points, cap_m: float) -> _Asked:
    return _Asked(points, targets, cap_m)


def n_farther(distance: Float64Array) -> Int64Array:
    """The number of distances above each coverage radius.

    >>> n_farther(np.array([0.0, 0.03, 0.2])).tolist()
    [2, 1, 1]
    """
    return np.array([(distance > radius).sum() for radius in COVERAGE_RADII_M], np.int64)


def select(masks: Masks, keep: IntArray) -> Masks:
    """The masks ``keep``, in that order.

    >>> select(Masks(np.array([0, 2, 3]), np.array([4, 5, 6])), np.array([1])).indices.tolist()
    [6]
    """
    return Masks.of_sets([masks.mask(k) for k in keep.tolist()])


def masks_of(prediction: Instances | Partition) -> Masks:
    """The masks of a map on its own points, one per row of features for a partition."""
    if isinstance(prediction, Instances):
        return prediction
    return masks_of_partition(prediction.instance, len(prediction.features))


def masks_of_partition(instance: IntArray, n_instances: int) -> Masks:
    """The masks from one instance id per point, -1 for none.

    >>> masks = masks_of_partition(np.array([1, -1, 0, 1]), 2)
    >>> masks.indptr.tolist(), masks.indices.tolist()
    ([0, 1, 3], [2, 0, 3])
    """
    order = np.flatnonzero(instance >= 0)
    # two-byte integers are sorted in one pass
    order = order[np.argsort(instance[order].astype(np.min_scalar_type(instance.max(initial=0))), kind="stable")]
    sizes = np.bincount(instance[order], minlength=n_instances)
    return Masks(starts_of(sizes), order.astype(np.int32))
