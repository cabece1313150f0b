"""Average precision of text queries: for each text the masks are ranked, and only instances of that text can be met.

The curve is that of ``instance_ap`` with the single class ``object``; all queries of all scenes share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.maps import Masks
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.metric import Arrays, Counts

SPACE = "queries"
_SMALLEST_RANGE = 1e-8  # openlex3d's floor of the range over which similarities are stretched


@dataclass(frozen=True)
class TextQuery:
    """A text and the ids of the objects that it speaks of.

    ``groups``: those in which it is scored apart from others, such as ``unique``; ``name``: what the file calls the
    object, '' where it does not.
    """

    text: str
    object_ids: tuple[int, ...]
    groups: tuple[str, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        if len(set(self.object_ids)) != len(self.object_ids):
            raise DataError(f"query '{self.text[:60]}': an object stands there twice; name each once")


@dataclass(frozen=True)
class QueryTruth:
    """Objects of a scene and the texts that ask for them.

    ``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64, -1 for none. ``alignment`` (4, 4): the rigid motion
    into the frame whose axes are the walls, where the dataset has one that its points were not moved by.
    """

    points: Float32Array
    object_of_point: Int64Array
    queries: tuple[TextQuery, ...]
    variant: str
    source: str
    space: str = SPACE
    alignment: Float64Array | None = None

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.points.shape != (n, 3) or self.object_of_point.shape != (n,):
            raise DataError(
                f"ground truth '{self.variant}': points {self.points.shape} and objects {self.object_of_point.shape} "
                "do not agree"
            )


def confidences(similarity: Float64Array, rule: Literal["similarity", "similarity-min-max"]) -> Float64Array:
    """The confidence (K, Q) of each mask for each query: its cosine, or that stretched to 0..1 over the masks.

    Under ``similarity-min-max`` the best mask of every query has confidence 1, however little it resembles the text.

    >>> confidences(np.array([[0.5, 0.1], [0.0, 0.1], [-0.5, 0.1]]), "similarity-min-max").tolist()
    [[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]
    """
    if rule == "similarity" or not len(similarity):
        return similarity
    halved = (similarity + 1.0) / 2.0
    low, high = halved.min(axis=0), halved.max(axis=0)
    stretched: Float64Array = (halved - low) / np.maximum(high - low, _SMALLEST_RANGE)
    return stretched


def per_scene(
    object_of_point: Int64Array,
    queries: Sequence[TextQuery],
    masks: Masks,
    confidence: Float64Array,
    *,
    top_k: int | None = None,
    min_region_size: int = 1,
    thresholds: Sequence[float] = instance_ap.THRESHOLDS,
    matches_by_confidence: bool = True,
) -> InstanceCounts:
    """The additive counts of one scene: ``masks`` over its points with ``confidence`` (K, Q) for each query.

    The ``top_k`` masks of each query count, the first of equals, and of these those of the minimum size. Objects below
    it are no instances; a query that is left without one still has its false positives. An object is matched with the
    masks by falling confidence or, as ScanNet's script and those made from it do, in their own order.

    >>> masks = Masks(np.array([0, 2, 4]), np.array([0, 1, 2, 3]))
    >>> found = TextQuery("seat", (7,)), TextQuery("lamp", (8,))
    >>> objects = np.array([7, 7, 8, 8])
    >>> counts = per_scene(objects, found, masks, np.array([[0.9, 0.2], [0.1, 0.8]]))
    >>> instance_ap.combine([counts]).ap
    1.0
    """
    ids, segment_of_point, size_of_object = np.unique(object_of_point, return_inverse=True, return_counts=True)
    n_masks = len(masks)
    size = masks.sizes
    shared = scene_counts.intersections(segment_of_point, len(ids), masks.indptr, masks.indices, np.arange(n_masks))
    iou = shared / (size_of_object[None, :] + size[:, None] - shared)
    column_of = {int(object_id): column for column, object_id in enumerate(ids) if object_id >= 0}
    order = np.argsort(-confidence, axis=0, kind="stable")[:top_k]
    if not matches_by_confidence:
        order = np.sort(order, axis=0)
    parts = [_no_counts(thresholds)]
    for q, query in enumerate(queries):
        columns = [column_of[object_id] for object_id in query.object_ids if object_id in column_of]
        takes_part = size_of_object[columns] >= min_region_size
        rows = order[size[order[:, q]] >= min_region_size, q]
        of_query = scene_counts.count_class(
            0,
            iou=iou[np.ix_(rows, np.array(columns, np.int64)[takes_part])],
            takes_part=np.ones(int(takes_part.sum()), bool),
            scores=confidence[rows, q],
            ignored_share=np.zeros(len(rows)),
            thresholds=thresholds,
        )
        parts.append(of_query)
    return instance_ap.concatenate(parts)


def _no_counts(thresholds: Sequence[float]) -> InstanceCounts:
    none = np.zeros(0)
    return scene_counts.count_class(0, np.zeros((0, 0)), none.astype(bool), none, none, thresholds)


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
