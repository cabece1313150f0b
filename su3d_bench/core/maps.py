"""The map of a scene that a method returns: masks, one instance per point, or one feature per point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.arguments import check_fields
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.types import (
    BoolArray,
    Float32Array,
    Float64Array,
    FloatArray,
    Int32Array,
    Int64Array,
    IntArray,
    Places,
)


def starts_of(sizes: Iterable[int]) -> Int64Array:
    """The start offsets of parts of these sizes in a concatenated list, and the end of the last.

    >>> starts_of([2, 0, 3]).tolist()
    [0, 2, 2, 5]
    """
    return np.cumsum([0, *sizes]).astype(np.int64)


@contextmanager
def _converting(what: str) -> Iterator[None]:
    """Raise failed conversions of a caller's values in the block as ``PredictionError``."""
    try:
        yield
    except (TypeError, ValueError, OverflowError) as error:
        raise PredictionError(f"{what}: {error}") from error


@dataclass(frozen=True)
class Masks:
    """K sets of points, which may overlap: mask k is ``indices[indptr[k]:indptr[k + 1]]``, ascending.

    >>> import numpy as np, su3d_bench as su3d
    >>> masks = su3d.Masks.of_sets([np.array([4, 5]), np.array([6])])
    >>> masks.indptr.tolist(), masks.mask(1).tolist()
    ([0, 2, 3], [6])
    """

    indptr: Int64Array
    indices: Int32Array

    @staticmethod
    @_converting("masks")
    def of_sets(sets: Sequence[IntArray]) -> Masks:
        """The masks of these point indices, each list ascending."""
        indices = np.concatenate([np.zeros(0, np.int32), *sets]).astype(np.int32, copy=False)
        return Masks(starts_of(map(len, sets)), indices)

    def __len__(self) -> int:
        return len(self.indptr) - 1

    @property
    def sizes(self) -> Int64Array:
        """The number of points (K,) of each mask."""
        return np.diff(self.indptr)

    @property
    def owners(self) -> Int64Array:
        """The mask of each entry of ``indices``."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    @property
    def is_whole(self) -> bool:
        """Whether ``indptr`` fits the length of ``indices``."""
        ends = self.indptr[0] == 0 and self.indptr[-1] == len(self.indices)
        return bool(ends and (self.sizes >= 0).all())

    def mask(self, k: int) -> Int32Array:
        """Point indices of mask ``k``."""
        return self.indices[self.indptr[k] : self.indptr[k + 1]]

    def sets(self) -> list[Int32Array]:
        """The point indices of each mask."""
        return np.split(self.indices, self.indptr[1:-1]) if len(self) else []

    def owner_at(self, entry: int) -> int:
        """The mask to which entry ``entry`` of ``indices`` belongs."""
        return int(np.searchsorted(self.indptr, entry, side="right") - 1)


@dataclass(frozen=True, kw_only=True)
class Proposals(Masks):
    """Class-agnostic masks over N points.

    ``points`` (N, 3) float32 m; ``scores`` (K,) float64, in any order; ``source`` names their origin.
    """

    points: Float32Array
    scores: Float64Array
    source: str


@dataclass(frozen=True, kw_only=True)
class Instances(Masks):
    """A map of K instances over M shared points, one mask per instance.

    ``points`` (M, 3) float32 m; ``scores`` (K,) float64; ``features`` (K, D) float32 if the method has features;
    ``labels``: one class name per instance if the method itself decides, '' to decide by the feature;
    ``further_labels``: alternative labels, the same number per instance, the most likely first and '' for no more;
    ``boxes`` (K, 2, 3) float32 axis-aligned minimum and maximum corners; ``centroids`` (K, 3) float32; ``views`` (V, 2)
    int32 rows (frame index, row of the detection in its file or image), those of instance k at
    ``view_indptr[k]:view_indptr[k + 1]``; ``view_names`` and ``view_scores`` (V,) float64: names and prediction scores
    from perception in those views, if the method stores them. If the method makes a scene graph, ``edges`` (E, 2) int32
    are rows of subject and object, and ``edge_scores`` (E, P) float64 rate each of ``predicates``.
    ``places``: floors and rooms, which files may have; they are not stored with a run.

    >>> import numpy as np, su3d_bench as su3d
    >>> points = np.array([[0, 0, 0], [1, 0, 0], [5, 5, 1]], np.float32)
    >>> instances = su3d.Instances.of(points, [[0, 1], [2]], labels=["chair", "lamp"])
    >>> len(instances), instances.mask(0).tolist(), instances.boxes[0].tolist()
    (2, [0, 1], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    """

    points: Float32Array
    scores: Float64Array
    features: Float32Array | None
    labels: tuple[str, ...] | None
    names: tuple[str, ...]
    captions: tuple[str, ...]
    boxes: Float32Array
    centroids: Float32Array
    view_indptr: Int64Array
    views: Int32Array
    ids: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    view_names: tuple[str, ...] | None = None
    view_scores: Float64Array | None = None
    further_labels: tuple[tuple[str, ...], ...] | None = None
    edges: Int32Array | None = None
    edge_scores: Float64Array | None = None
    predicates: tuple[str, ...] | None = None
    places: Places | None = None

    def __post_init__(self) -> None:
        check_fields(self, "instances", PredictionError)
        k, v = len(self.scores), len(self.views)
        if len(self.indptr) != k + 1 or len(self.names) != k or len(self.captions) != k:
            raise PredictionError(f"instances: {k} scores, {len(self.indptr) - 1} masks, {len(self.names)} names")
        if len(self.boxes) != k or len(self.centroids) != k or len(self.ids) not in (0, k):
            raise PredictionError(f"instances: {k} masks and {len(self.boxes)} boxes, {len(self.centroids)} centroids")
        if len(self.view_indptr) != k + 1 or not Masks(self.view_indptr, self.views).is_whole:
            raise PredictionError(f"instances: view_indptr does not describe {v} views of {k} instances")
        _check_masks(self, len(self.points))
        for name, n, of in (("features", k, "masks"), ("labels", k, "masks"), ("view_names", v, "views"),
                            ("view_scores", v, "views")):  # fmt: skip
            if (value := getattr(self, name)) is not None and len(value) != n:
                raise PredictionError(f"instances: {n} {of} and {len(value)} {name}")
        further = self.further_labels
        if further is not None and (self.labels is None or len(further) != k or len(set(map(len, further))) > 1):
            raise PredictionError(f"instances: {k} masks need labels and equally many further labels each")
        self._check_graph(k)

    def _check_graph(self, k: int) -> None:
        edges, scores, predicates = self.edges, self.edge_scores, self.predicates
        if edges is None or scores is None or predicates is None:
            if any(part is not None for part in (edges, scores, predicates)):
                raise PredictionError("instances: a scene graph needs edges, edge_scores and predicates, all three")
            return
        if edges.shape != (len(edges), 2) or scores.shape != (len(edges), len(predicates)) or not predicates:
            raise PredictionError(
                f"instances: edges {edges.shape} and edge_scores {scores.shape} do not fit {len(predicates)} predicates"
            )
        if len(set(predicates)) != len(predicates) or not np.isfinite(scores).all():
            raise PredictionError("instances: predicates must differ and edge_scores be finite")
        if len(edges) and not 0 <= int(edges.min()) <= int(edges.max()) < k:
            raise PredictionError(f"instances: an edge names instance {int(edges.max())} of {k} (0..{k - 1})")

    @classmethod
    @_converting("instances")
    def of(
        cls,
        points: Float32Array,
        masks: Masks | Sequence[IntArray | BoolArray | Sequence[int]] | IntArray | BoolArray,
        scores: FloatArray | Sequence[float] | None = None,
        features: FloatArray | None = None,
        *,
        labels: Sequence[str] | None = None,
        further_labels: Sequence[Sequence[str]] | None = None,
        names: Sequence[str] | None = None,
        captions: Sequence[str] | None = None,
        centroids: Float32Array | None = None,
        views: Sequence[Sequence[tuple[int, int]]] | None = None,
        view_names: tuple[str, ...] | None = None,
        view_scores: Float64Array | None = None,
        ids: Sequence[int] | IntArray = (),
    ) -> Instances:
        """The map of ``masks`` over ``points`` (M, 3); ``views`` has one entry per instance.

        ``masks``: for each instance its point indices, or one bool per point; or (M,) for each point its instance
        number, from 0 without gaps, -1 for none. By default scores are 1, names and captions empty; boxes and
        centroids are those of the points, zeros for an empty mask. Raises ``PredictionError`` for wrong shapes or
        values.

        >>> points = np.zeros((4, 3), np.float32)
        >>> whole = Instances.of(points, [np.array([True, True, False, False]), np.array([3])], [0.9, 0.4])
        >>> [mask.tolist() for mask in whole.sets()], Instances.of(points, np.array([0, 0, -1, 1])).indices.tolist()
        ([[0, 1], [3]], [0, 1, 3])
        """
        points = _array("points", points, (None, 3), "f", "floats (M, 3) in metres")
        masks = masks if isinstance(masks, Masks) else Masks.of_sets(_sets(masks, len(points)))
        _check_masks(masks, len(points))
        k = len(masks)
        boxes, means = np.zeros((k, 2, 3), np.float32), np.zeros((k, 3), np.float32)
        for row in np.flatnonzero(masks.sizes).tolist():
            members = points[masks.mask(row)]
            boxes[row] = members.min(axis=0), members.max(axis=0)
            means[row] = members.mean(axis=0, dtype=np.float64)
        return cls(
            masks.indptr,
            masks.indices,
            points=points,
            scores=np.ones(k) if scores is None else _scores(scores, k),
            features=None if features is None else _features(features, k),
            labels=None if labels is None else tuple(labels),
            names=("",) * k if names is None else tuple(names),
            captions=("",) * k if captions is None else tuple(captions),
            boxes=boxes,
            centroids=means if centroids is None else centroids,
            view_indptr=np.zeros(k + 1, np.int64) if views is None else starts_of(map(len, views)),
            views=_views([()] * k if views is None else views, k),
            ids=_array("ids", ids, (None,), "iu", "integers").astype(np.int64),
            view_names=view_names,
            view_scores=view_scores,
            further_labels=None if further_labels is None else tuple(map(tuple, further_labels)) or None,
        )


def _array(name: str, value: Any, shape: tuple[int | None, ...], kinds: str, expected: str) -> NDArray[Any]:
    """``value`` as an array of this shape (None: any length) and one of these dtype kinds."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:  # rows of different lengths
        raise PredictionError(f"instances: {name}: not an array: {error}") from error
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or (array.size and array.dtype.kind not in kinds):
        found = {"U": "texts", "O": "objects"}.get(array.dtype.kind, array.dtype.name)
        raise PredictionError(f"instances: {name} is {found} {array.shape}; expected {expected}")
    return array


def _scores(scores: Any, k: int) -> Float64Array:
    array = _array("scores", scores, (k,), "fiub", f"one number for each of {k} masks")
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def _features(features: Any, k: int) -> Float32Array | None:
    if not k and np.ndim(features) == 1:
        return None
    return _array("features", features, (k, None), "f", f"floats ({k}, D), one row per mask")


def _views(views: Sequence[Sequence[tuple[int, int]]], k: int) -> Int32Array:
    """The views (V, 2) of all instances, one after another."""
    if len(views) != k:
        raise PredictionError(f"instances: views of {len(views)} instances for {k} masks")
    rows = [view for of_instance in views for view in of_instance] or np.zeros((0, 2), np.int32)
    return _array("views", rows, (None, 2), "iu", "pairs of integers, frame index and row").astype(np.int32)


def _sets(masks: Any, n_points: int) -> list[NDArray[Any]]:
    """The points of each mask, ascending and without duplicates; for ``masks`` see ``Instances.of``."""
    if not isinstance(masks, Iterable):
        raise PredictionError(f"instances: masks is {masks!r:.40}; expected point indices or bools per instance")
    if isinstance(masks, np.ndarray) and masks.ndim == 1:
        return _sets_of_owners(masks, n_points)
    return [_set(f"the mask of instance {k}", mask, n_points) for k, mask in enumerate(masks)]


def _sets_of_owners(masks: NDArray[Any], n_points: int) -> list[NDArray[Any]]:
    owners = _array("masks", masks, (n_points,), "iu", f"a list of masks, or the instance of each of {n_points} points")
    if not len(owners):
        return []
    if owners.min() < -1 or owners.max() >= n_points:
        raise PredictionError(
            f"instances: masks has numbers {owners.min()} to {owners.max()} for {n_points} points; number instances "
            "from 0 without gaps, with -1 for none"
        )
    owners = owners.astype(np.int64)
    order = np.argsort(owners, kind="stable")
    sets: list[NDArray[Any]] = np.split(order, np.cumsum(np.bincount(owners + 1, minlength=1)))[1:-1]
    if empty := [k for k, members in enumerate(sets) if not len(members)]:
        raise PredictionError(
            f"instances: masks has no point of instance {empty[0]}, but higher numbers; number them without gaps"
        )
    return sets


def _set(name: str, mask: Any, n_points: int) -> NDArray[Any]:
    array = _array(name, mask, (None,), "iub", f"indices of points, or a bool for each of {n_points} points")
    if array.size and array.dtype.kind == "b":
        return np.flatnonzero(_array(name, array, (n_points,), "b", f"a bool for each of {n_points} points"))
    array = array if array.size else np.zeros(0, np.int32)
    return np.unique(array) if (array[1:] <= array[:-1]).any() else array


def _check_masks(masks: Masks, n_points: int) -> None:
    if not masks.is_whole:
        raise PredictionError("instances: indptr does not describe the list of point indices")
    indices = masks.indices
    if len(indices) and (indices.min() < 0 or indices.max() >= n_points):
        worst = int(np.flatnonzero((indices < 0) | (indices >= n_points))[0])
        raise PredictionError(
            f"instance {masks.owner_at(worst)}: mask has index {int(indices[worst])}, the map has {n_points} points "
            f"(0..{n_points - 1})"
        )


@dataclass(frozen=True)
class Partition:
    """One instance per point: ``instance`` (M,) int32 rows of ``features`` (K, D), -1 for none.

    >>> import numpy as np, su3d_bench as su3d
    >>> points, features = np.zeros((3, 3), np.float32), np.eye(2, 4, dtype=np.float32)
    >>> su3d.Partition(points, np.array([0, 1, -1], np.int32), features).features.shape
    (2, 4)
    """

    points: Float32Array
    instance: Int32Array
    features: Float32Array

    def __post_init__(self) -> None:
        check_fields(self, "partition", PredictionError)


@dataclass(frozen=True)
class DenseFeatures:
    """One feature per point: ``features`` (M, D) float16, usually memory-mapped; all-zero rows have no feature.

    >>> import numpy as np, su3d_bench as su3d
    >>> su3d.DenseFeatures(np.zeros((3, 3), np.float32), np.ones((3, 4), np.float16)).features.shape
    (3, 4)
    """

    points: Float32Array
    features: NDArray[np.float16]

    def __post_init__(self) -> None:
        check_fields(self, "dense features", PredictionError)


Prediction = Instances | Partition | DenseFeatures
