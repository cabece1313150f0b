"""Identity over time of labelled points: STQ, segmentation and tracking quality.

Source: ``evaluation/numpy/segmentation_and_tracking_quality.py`` of google-research/deeplab2 at commit 64bc1c1, with
numpy 1: with numpy 2 it computes ratios in single precision.

AQ is counted by object: the mean over objects g of sum_p s(g, p) IoU(g, p) / |g| with the predicted ids p and the
number of points s(g, p) in both, over all steps. AQ by time counts each point of each step:
sum_g sum_p s(g, p) IoU(g, p) / sum_g |g|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.matching.rows import row_ids
from su3d_bench.metrics.matching.transfer import first_owner, select
from su3d_bench.metrics.metric import Counts, Values, axes
from su3d_bench.numerics.statistics import ratio

VOID = -1  # class of points that do not count


@dataclass(frozen=True)
class LabelledPoints:
    """The points of one time step: the class index (N,) and the id (N,) in the ground truth and the map.

    Classes count from 0, ``VOID`` is none. An object of a thing is a class and a ``true_id`` above 0; other points of
    things are a crowd, in which ids do not count.
    """

    true_class: Int64Array
    true_id: Int64Array
    class_index: Int64Array
    id: Int64Array


def labelled_points(
    true_class: Int64Array, true_id: Int64Array, masks: Masks, class_index: Int64Array, ids: Int64Array,
    scores: Float64Array | None = None,
) -> LabelledPoints:  # fmt: skip
    """The points (N,) of a step with K masks over them, their class indices (K,) and ids (K,).

    A point in several masks belongs to that of the greatest score, the first on ties; one in none is void.
    """
    order = np.arange(len(masks)) if scores is None else np.argsort(-scores, kind="stable")
    owner = np.append(order, -1)[first_owner(select(masks, order), len(true_class))]
    return LabelledPoints(true_class, true_id, np.append(class_index, VOID)[owner], np.append(ids, 0)[owner])


@dataclass(frozen=True)
class PointCounts(Counts):
    """The counts of a sequence: points by true class and predicted class, the last of which is void, int64 (C, C + 1);
    ``n_objects`` and their points over all steps ``n_points`` (1,); ``association`` (1,): the sum over objects of
    sum_p s(g, p) IoU(g, p) / |g|; ``association_points`` (1,): the same without the division."""

    stored_as = "tracked points"

    confusion: Int64Array = field(metadata=axes("classes", "predicted classes"))
    n_objects: Int64Array = field(metadata=axes("one"))
    n_points: Int64Array = field(metadata=axes("one"))
    association: Float64Array = field(metadata=axes("one"))
    association_points: Float64Array = field(metadata=axes("one"))


def count_points(steps: Sequence[LabelledPoints], is_thing: BoolArray) -> PointCounts:
    """The counts of one sequence; ``is_thing`` (C,) marks the classes with objects.

    As in the original, predicted things on void points make their instances larger, and the class of an instance is
    part of its id, but need not be that of the object.
    """
    n_classes = len(is_thing)
    tables = [np.zeros((0, 6), np.int64)]
    for t, step in enumerate(steps):
        table = np.column_stack([step.true_class, step.true_id, step.class_index, step.id]).astype(np.int64)
        _, first, n = np.unique(row_ids(table), return_index=True, return_counts=True)
        tables.append(np.column_stack([np.full(len(n), t), n, table[first]]))
    at, n, true_class, true_id, class_index, ids = np.concatenate(tables).T
    is_counted = true_class >= 0
    cell = true_class * (n_classes + 1) + np.where(class_index >= 0, class_index, n_classes)
    confusion = np.bincount(cell[is_counted], n[is_counted], n_classes * (n_classes + 1))
    of_thing = np.append(is_thing, False)
    is_object = of_thing[true_class] & (true_id > 0)
    is_found = of_thing[class_index] & ~(of_thing[true_class] & ~is_object)
    row, column = np.full(len(n), -1), np.full(len(n), -1)
    row[is_object] = _numbers(at[is_object], true_class[is_object], true_id[is_object])
    column[is_found] = _numbers(at[is_found], class_index[is_found], ids[is_found])
    size, found_size = np.bincount(row[is_object], n[is_object]), np.bincount(column[is_found], n[is_found])
    both = is_object & is_found
    pair, entry = np.unique(row[both] * max(1, len(found_size)) + column[both], return_inverse=True)
    shared = np.bincount(entry, n[both], len(pair))
    of_object, of_found = np.divmod(pair, max(1, len(found_size)))
    quality = shared * (shared / (size[of_object] + found_size[of_found] - shared))
    weighted = np.bincount(of_object, quality, len(size))  # one after another, as the original sums
    return PointCounts(
        confusion=confusion.astype(np.int64).reshape(n_classes, n_classes + 1),
        n_objects=np.array([len(size)]),
        n_points=np.array([int(size.sum())]),
        association=np.cumsum(np.append(0.0, 1.0 / size * weighted))[-1:],
        association_points=np.array([weighted.sum()]),
    )


def _numbers(at: Int64Array, class_index: Int64Array, ids: Int64Array) -> Int64Array:
    """One number, from 0, per class and id, in the order of their first step, then of the class, then of the id."""
    rows = row_ids(np.column_stack([ids, class_index])) if len(ids) else ids
    _, first = np.unique(rows, return_index=True)
    return np.argsort(np.argsort(at[first], kind="stable"))[rows]


def point_values(counts: PointCounts) -> Values:
    """STQ = sqrt(AQ SQ), its association quality AQ, its segmentation quality SQ (mean IoU of classes), and AQ by time.

    As in the original, AQ is 0 without an object, SQ is NaN without a point of a class, and void predicted on such a
    point is one more class, of IoU 0.

    >>> whole = LabelledPoints(np.array([0, 0, 1]), np.array([4, 4, 0]), np.array([0, 0, 1]), np.array([8, 8, 0]))
    >>> part = LabelledPoints(np.array([0, 0, 1]), np.array([4, 4, 0]), np.array([0, 1, 1]), np.array([9, 0, 0]))
    >>> values = point_values(count_points([whole, part], np.array([True, False])))
    >>> {name: round(value, 4) for name, value in values.items()}  # AQ: (2 * 2 / 4 + 1 * 1 / 4) / 4; SQ: 3 / 4, 2 / 3
    {'STQ': 0.4705, 'AQ': 0.3125, 'SQ': 0.7083, 'AQ by time': 0.3125}
    """
    n_classes = len(counts.confusion)
    confusion = np.zeros((n_classes + 1, n_classes + 1))
    confusion[:n_classes] = counts.confusion
    right = confusion.diagonal()
    union = confusion.sum(axis=0) + confusion.sum(axis=1) - right
    n_present = np.count_nonzero(union)
    quality = float(np.sum(right / np.maximum(union, 1)) / n_present) if n_present else float("nan")
    association = float(counts.association[0]) / max(1, int(counts.n_objects[0]))
    by_time = float(ratio(counts.association_points, counts.n_points)[0])
    return {"STQ": float(np.sqrt(association * quality)), "AQ": association, "SQ": quality, "AQ by time": by_time}
