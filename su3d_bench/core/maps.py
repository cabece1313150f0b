"""What a method makes: the map of a scene, as masks, as one instance a point, or as one feature a point."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    check_arrays,
)


def starts_of(sizes: Iterable[int]) -> Int64Array:
    """Where parts of these sizes begin in a list of all, and where the last ends.

    >>> starts_of([2, 0, 3]).tolist()
    [0, 2, 2, 5]
    """
    return np.cumsum([0, *sizes]).astype(np.int64)


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
    def of_sets(sets: Sequence[IntArray]) -> Masks:
        """The masks that hold these points, each list ascending."""
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
        """Whether ``indptr`` describes a list of the length of ``indices``."""
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

    ``points`` (N, 3) float32 m; ``scores`` (K,) float64, the best first is not implied; ``source`` says who made them.
    """

    points: Float32Array
    scores: Float64Array
    source: str


@dataclass(frozen=True, kw_only=True)
class Instances(Masks):
    """A map of K instances over M shared points, one mask an instance.

    ``points`` (M, 3) float32 m; ``scores`` (K,) float64; ``features`` (K, D) float32 where the method has features,
    ``labels`` one class name each where the method itself decides, '' for what it leaves to the feature, and
    ``further_labels`` equally many each, what else it may be, the likeliest first and '' for no more; ``boxes`` (K, 2,
    3) float32 axis-aligned minimum and maximum corners; ``centroids`` (K, 3) float32; ``views`` (V, 2) int32 rows
    (frame index, row of the file or image that the detection came from), those of instance k at
    ``view_indptr[k]:view_indptr[k + 1]``; where the method keeps them, ``view_names`` and ``view_scores`` (V,) float64
    are the names and prediction scores that perception gave in those views. Where the method makes a scene graph,
    ``edges`` (E, 2) int32 are rows of subject and object and ``edge_scores`` (E, P) float64 how well each of
    ``predicates`` fits.
    ``places``: floors and rooms, which files may have; they are not kept with a run.

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
        arrays = ("points", "indptr", "indices", "scores", "boxes", "centroids", "view_indptr", "views", "ids")
        check_arrays(self, "instances", arrays, PredictionError)
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
            raise PredictionError(f"instances: an edge names the instance {int(edges.max())} of {k} (0..{k - 1})")

    @classmethod
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
        """The map of ``masks`` over ``points`` (M, 3); ``views`` are those of each instance.

        ``masks``: of each instance the indices of its points, or a bool for each point; or of each point the number
        (M,) of its instance, from 0 without gaps, -1 for none. Scores are 1, names and captions empty where none are
        given; boxes and centroids are those of the points, zeros for an empty mask. A ``PredictionError`` where
        something has another shape or other values.

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
            views=_views(views or [()] * k, k),
            ids=np.array(ids, np.int64),
            view_names=view_names,
            view_scores=view_scores,
            further_labels=tuple(map(tuple, further_labels)) if further_labels else None,
        )


def _array(name: str, value: Any, shape: tuple[int | None, ...], kinds: str, expected: str) -> NDArray[Any]:
    """``value`` as an array of this shape, None for any length, and of values of these kinds."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:  # rows of several lengths
        raise PredictionError(f"instances: {name}: is no array: {error}") from error
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or (array.size and array.dtype.kind not in kinds):
        found = {"U": "texts", "O": "objects"}.get(array.dtype.kind, array.dtype.name)
        raise PredictionError(f"instances: {name} is {found} {array.shape}; {expected} is expected")
    return array


def _scores(scores: Any, k: int) -> Float64Array:
    array = _array("scores", scores, (k,), "fiub", f"one number for each of {k} masks")
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def _features(features: Any, k: int) -> Float32Array | None:
    if not k and np.ndim(features) == 1:
        return None
    return _array("features", features, (k, None), "f", f"floats ({k}, D), one row per mask,")


def _views(views: Sequence[Sequence[tuple[int, int]]], k: int) -> Int32Array:
    """The views (V, 2) of all instances, one after another."""
    if len(views) != k:
        raise PredictionError(f"instances: views of {len(views)} instances for {k} masks")
    rows = [view for of_instance in views for view in of_instance] or np.zeros((0, 2), np.int32)
    return _array("views", rows, (None, 2), "iu", "pairs of integers, frame index and row,").astype(np.int32)


def _sets(masks: Any, n_points: int) -> list[NDArray[Any]]:
    """The points of each mask, ascending and each once; ``Instances.of`` says what ``masks`` may be."""
    if not isinstance(masks, Iterable):
        raise PredictionError(
            f"instances: masks is {masks!r:.40}; a list of point indices or bools of each instance is expected"
        )
    if isinstance(masks, np.ndarray) and masks.ndim == 1:
        return _sets_of_owners(masks, n_points)
    return [_set(f"the mask of instance {k}", mask, n_points) for k, mask in enumerate(masks)]


def _sets_of_owners(masks: NDArray[Any], n_points: int) -> list[NDArray[Any]]:
    owners = _array(
        "masks", masks, (n_points,), "iu", f"a list of masks, or the instance of each of {n_points} points,"
    )
    if not len(owners):
        return []
    if owners.min() < -1 or owners.max() >= n_points:
        raise PredictionError(
            f"instances: masks holds numbers {owners.min()} to {owners.max()}; instances are numbered from 0 on "
            f"without gaps, -1 is none, and there are {n_points} points"
        )
    owners = owners.astype(np.int64)
    order = np.argsort(owners, kind="stable")
    sets: list[NDArray[Any]] = np.split(order, np.cumsum(np.bincount(owners + 1, minlength=1)))[1:-1]
    if empty := [k for k, members in enumerate(sets) if not len(members)]:
        raise PredictionError(
            f"instances: masks numbers no point {empty[0]}, but higher ones; number them without gaps"
        )
    return sets


def _set(name: str, mask: Any, n_points: int) -> NDArray[Any]:
    array = _array(name, mask, (None,), "iub", f"indices of points, or a bool for each of {n_points} points,")
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
            f"instance {masks.owner_at(worst)}: mask holds index {int(indices[worst])}, the map has {n_points} points "
            f"(0..{n_points - 1})"
        )


@dataclass(frozen=True)
class Partition:
    """One instance a point: ``instance`` (M,) int32 rows of ``features`` (K, D), -1 for none.

    >>> import numpy as np, su3d_bench as su3d
    >>> points, features = np.zeros((3, 3), np.float32), np.eye(2, 4, dtype=np.float32)
    >>> su3d.Partition(points, np.array([0, 1, -1], np.int32), features).features.shape
    (2, 4)
    """

    points: Float32Array
    instance: Int32Array
    features: Float32Array


@dataclass(frozen=True)
class DenseFeatures:
    """One feature a point: ``features`` (M, D) float16, usually memory-mapped; all-zero rows have no feature.

    >>> import numpy as np, su3d_bench as su3d
    >>> su3d.DenseFeatures(np.zeros((3, 3), np.float32), np.ones((3, 4), np.float16)).features.shape
    (3, 4)
    """

    points: Float32Array
    features: NDArray[np.float16]


Prediction = Instances | Partition | DenseFeatures
