"""Where the points of a semantic score are lost: each wrong point has one cause.

In this order, the first that holds:

- ``geometry``: no point of the map lies within ``NEAR_M`` of it.
- ``background``: the map is there, but no point of any mask lies within ``NEAR_M``, or the point was called nothing.
- ``association``: the point took its class from a mask that belongs to another object. A mask belongs to the object
  that has most of the points which took their class from it (of equals, the one with the lowest number).
- ``label``: the mask is that of its object and has another class.

Sum rule: the points that are right and those of the four causes are all scored points. A mending gives the points of
one cause their true class; where the confusion matrix holds scored points alone, all four together give a perfect one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.metrics.semantic.confusion import SemanticCounts

CAUSES = ("geometry", "background", "association", "label")
NEAR_M = 0.05  # the middle one of the radii at which coverage is reported
RIGHT, NOT_SCORED = -1, -2


@dataclass(frozen=True)
class LabelledPoints:
    """The evaluation points (N,) of a scene.

    ``true_class`` and ``predicted`` are class indices, -1 for none; ``is_scored`` marks the points that count;
    ``object_id`` is one number an object of the truth; ``mask`` the mask that gave the class, -1 where none did;
    ``map_distance_m`` and ``mask_distance_m`` are to the nearest point of the map and of any mask, infinity for none;
    of those to the map it only counts whether they are above ``NEAR_M``.
    """

    true_class: Int64Array
    predicted: Int64Array
    is_scored: BoolArray
    object_id: Int64Array
    mask: Int64Array
    map_distance_m: Float64Array
    mask_distance_m: Float64Array


def causes_of(points: LabelledPoints, *, has_masks: bool = True) -> Int64Array:
    """Index into ``CAUSES`` (N,) of each wrong point, ``RIGHT`` or ``NOT_SCORED`` elsewhere.

    Without masks, as with one feature a point, what is near and wrong is a wrong label.

    >>> truth, called, objects = np.array([0, 1, 1]), np.array([0, 0, 1]), np.array([7, 8, 8])
    >>> mask, near = np.zeros(3, int), np.zeros(3)
    >>> three = LabelledPoints(truth, called, np.ones(3, bool), objects, mask, near, near)
    >>> causes_of(three).tolist()  # the mask belongs to 8, which has two of its points
    [-1, 3, -1]
    """
    is_wrong = points.is_scored & (points.predicted != points.true_class)
    cause = np.where(points.is_scored, RIGHT, NOT_SCORED).astype(np.int64)
    cause[is_wrong] = CAUSES.index("label")
    if has_masks:
        owner = object_of_mask(points)
        of_other = is_wrong & (points.mask >= 0)
        of_other[of_other] = owner[points.mask[of_other]] != points.object_id[of_other]
        cause[of_other] = CAUSES.index("association")
        cause[is_wrong & ((points.mask_distance_m > NEAR_M) | (points.mask < 0))] = CAUSES.index("background")
    cause[is_wrong & (points.map_distance_m > NEAR_M)] = CAUSES.index("geometry")
    return cause


def object_of_mask(points: LabelledPoints) -> Int64Array:
    """The object that each mask belongs to, in the order of masks; -1 where no point took its class from it."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    return _most_frequent(points.mask[taken], points.object_id[taken], int(points.mask.max(initial=-1)) + 1)


def _most_frequent(key: Int64Array, value: Int64Array, n_keys: int) -> Int64Array:
    """For each key from 0 the value that stands beside it most often, the lowest of equals; -1 where none does.

    >>> _most_frequent(np.array([0, 0, 0, 2]), np.array([5, 4, 4, 9]), 3).tolist()
    [4, -1, 9]
    """
    answer = np.full(n_keys, -1, np.int64)
    values = np.unique(value)
    pairs, n = np.unique(key * len(values) + np.searchsorted(values, value), return_counts=True)
    keys, places = np.divmod(pairs, max(1, len(values)))
    order = np.lexsort((-places, n))  # the most frequent last, of equals the lowest value last
    answer[keys[order]] = values[places[order]]
    return answer


@dataclass(frozen=True)
class MendedPoints:
    """A scene's counts as they are, after each cause alone is mended, after ``all``, and with the truth's labels.

    ``with_true_labels``: each mask called by the class that most of its points have, nothing else changed; None
    without masks. ``n`` points of each cause, ``n_scored`` in all.
    """

    as_is: SemanticCounts
    alone: Mapping[str, SemanticCounts]
    all: SemanticCounts
    with_true_labels: SemanticCounts | None
    n: Mapping[str, int]
    n_scored: int


def mend_points(points: LabelledPoints, is_counted: BoolArray, *, has_masks: bool = True) -> MendedPoints:
    """The counts of one scene with its errors mended; ``is_counted`` (C,) marks the classes of the confusion matrix."""
    cause = causes_of(points, has_masks=has_masks)

    def count(predicted: Int64Array) -> SemanticCounts:
        return semantic.per_scene(points.true_class, predicted, is_counted)

    return MendedPoints(
        as_is=count(points.predicted),
        alone={name: count(np.where(cause == k, points.true_class, points.predicted)) for k, name in enumerate(CAUSES)},
        all=count(np.where(cause >= 0, points.true_class, points.predicted)),
        with_true_labels=count(_true_labels(points)) if has_masks else None,
        n={name: int((cause == k).sum()) for k, name in enumerate(CAUSES)},
        n_scored=int(points.is_scored.sum()),
    )


def _true_labels(points: LabelledPoints) -> Int64Array:
    """The class of each point when its mask is called by the class that most of the scored points there have."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    n_masks = int(points.mask.max(initial=-1)) + 1
    class_of_mask = _most_frequent(points.mask[taken], points.true_class[taken], n_masks)
    has_class = points.mask >= 0
    has_class[has_class] = class_of_mask[points.mask[has_class]] >= 0
    predicted = points.predicted.copy()
    predicted[has_class] = class_of_mask[points.mask[has_class]]
    return predicted
