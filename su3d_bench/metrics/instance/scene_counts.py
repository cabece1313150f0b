"""Matching of a scene's masks with its ground truth, as in the ScanNet evaluator, and the resulting counts.

Source: that of ``average_precision``, which computes the ratios.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.protocols.model import VoidRule

_MAX_VALUE = 10_000 * instance_ap.INSTANCES_PER_CLASS  # ScanNet's largest label is 1357


def per_scene(
    ground_truth: IntArray,
    indptr: IntArray,
    indices: IntArray,
    labels: IntArray | None,
    scores: Float64Array,
    class_ids: Sequence[int],
    min_region_size: int = instance_ap.MIN_REGION_SIZE,
    thresholds: Sequence[float] = instance_ap.THRESHOLDS,
    *,
    void: VoidRule | None = None,
) -> instance_ap.InstanceCounts:
    """The additive counts of one scene.

    ``ground_truth`` (N,) has label * 1000 + instance per point, 0 if unannotated; prediction k covers the points
    ``indices[indptr[k]:indptr[k + 1]]``, strictly ascending, and has ``labels[k]`` and ``scores[k]``. Their
    order matters for AP25 only, as in the original under Python 3. Points whose label is not in ``class_ids`` are void.
    Without ``labels`` every mask is listed once under each class. ``void``: with ``false-positives`` a mask without a
    match is one no matter how much of it is void or in small instances; with ``groups`` points of values 1 to 999 are
    void, those of a value with less than the minimum size twice.

    >>> from su3d_bench.metrics.instance.average_precision import combine
    >>> truth = np.array([3001] * 200 + [0] * 50)
    >>> counts = per_scene(truth, np.array([0, 150]), np.arange(150), np.array([3]), np.array([0.9]), [3, 4])
    >>> combine([counts]).table[0].tolist()  # IoU 0.75: nothing above it
    [1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    >>> combine([counts]).ap50, counts.n_truth.tolist()
    (1.0, [1, 0])
    >>> truth = np.repeat([3001, 4001], 200)
    >>> counts = per_scene(truth, np.array([0, 200, 400]), np.arange(400), None, np.ones(2), [3, 4], 100, (0.5, 0.25))
    >>> counts.n_predictions.tolist(), counts.is_true.tolist()
    ([2, 2], [True, False, True, False, True, False, True, False])
    """
    _check_predictions(len(ground_truth), indptr, indices, len(scores) if labels is None else len(labels), scores)
    classes = class_overlaps(ground_truth, indptr, indices, labels, class_ids, min_region_size, void)
    return instance_ap.stacked([one.counts(index, scores, thresholds) for index, one in enumerate(classes)])


@dataclass(frozen=True)
class ClassOverlaps:
    """One class of a scene: the indices of its ``predictions`` (R,) of at least the minimum size, and its instances.

    ``values`` (G,) are those of the instances, ascending; ``iou`` (R, G); ``takes_part`` (G,) marks those of at least
    the minimum size; ``ignored_share`` (R,): the share of a prediction that is void or in smaller instances, 0 if these
    are not forgiven.
    """

    predictions: Int64Array
    values: Int64Array
    iou: Float64Array
    takes_part: BoolArray
    ignored_share: Float64Array

    def counts(self, class_index: int, scores: Float64Array, thresholds: Sequence[float]) -> instance_ap.InstanceCounts:
        """The counts of the class; ``scores`` (K,) are those of all masks, in order."""
        return count_class(
            class_index,
            iou=self.iou,
            takes_part=self.takes_part,
            scores=scores[self.predictions],
            ignored_share=self.ignored_share,
            thresholds=thresholds,
        )


def class_overlaps(
    ground_truth: IntArray,
    indptr: IntArray,
    indices: IntArray,
    labels: IntArray | None,
    class_ids: Sequence[int],
    min_region_size: int,
    void: VoidRule | None = None,
) -> Iterator[ClassOverlaps]:
    """The classes of one scene in the order of ``class_ids``; the arrays are those of ``per_scene``."""
    if any(class_id < 1 for class_id in class_ids):
        raise DataError(f"class ids: {min(class_ids)} cannot be scored; class ids start at 1")
    segment_of_point, segment_value, segment_size = segments_of(ground_truth)
    size = np.diff(indptr)
    is_listed = np.ones((len(class_ids), len(size)), bool)
    if labels is not None:
        is_listed = labels == np.array(class_ids, np.int64)[:, None]
    kept = np.flatnonzero(is_listed.any(axis=0) & (size >= min_region_size))
    intersection = intersections(segment_of_point, len(segment_value), indptr, indices, kept)
    for c, class_id in enumerate(class_ids):
        rows = np.flatnonzero(is_listed[c, kept])
        yield overlaps_of_class(
            class_id, kept[rows], intersection[rows], size[kept[rows]], segment_value, segment_size, class_ids,
            min_region_size, void,
        )  # fmt: skip


def overlaps_of_class(
    class_id: int,
    predictions: Int64Array,
    intersection: Int64Array,
    n_points: Int64Array,
    segment_value: Int64Array,
    segment_size: Int64Array,
    class_ids: Sequence[int],
    min_region_size: int,
    void: VoidRule | None,
) -> ClassOverlaps:
    """The ``predictions`` (R,) of one class; ``intersection`` (R, S) with all segments, by ascending value."""
    segment_label = segment_value // instance_ap.INSTANCES_PER_CLASS
    columns = np.flatnonzero(segment_label == class_id)  # ascending value, as in the original's loop
    n_times = (~np.isin(segment_label, class_ids)).astype(np.int64)  # that a point of each segment counts as ignored
    is_small = segment_size < min_region_size
    if void == "groups":
        n_times += is_small & (segment_label == 0) & (segment_value > 0)
    n_times[columns] += is_small[columns]
    shared = intersection[:, columns]
    return ClassOverlaps(
        predictions=predictions,
        values=segment_value[columns],
        iou=shared / (segment_size[columns][None, :] + n_points[:, None] - shared),
        takes_part=~is_small[columns],
        ignored_share=(void != "false-positives") * (intersection @ n_times) / n_points,
    )


def count_class(
    class_index: int,
    iou: Float64Array,
    takes_part: BoolArray,
    scores: Float64Array,
    ignored_share: Float64Array,
    thresholds: Sequence[float],
) -> instance_ap.InstanceCounts:
    """The counts of one class: ``iou`` (R, G) of its predictions, in order, with its instances, ascending."""
    limits, n_objects = np.array(thresholds, np.float64)[:, None], int(takes_part.sum())
    # a prediction that overlaps any instance of its class, even a small or a matched one, is no false positive here
    is_unmet = ignored_share <= limits
    n_missed = [n_objects] * len(limits)
    rows: list[tuple[int, float, bool]] = []
    over = iou > limits[:, :, None]
    if over.any():
        is_unmet &= ~over.any(axis=2)
        for t in np.flatnonzero(over.any(axis=(1, 2))).tolist():
            hits, duplicates, n_missed[t] = _match(over[t], takes_part, scores)
            rows += [(t, score, True) for score in hits] + [(t, score, False) for score in duplicates]
    at, unmet = np.nonzero(is_unmet)
    score, is_true = scores[unmet], np.zeros(len(unmet), bool)
    if rows:  # before those of the same threshold without a match
        at = np.concatenate([np.array([t for t, _, _ in rows]), at])
        order = np.argsort(at, kind="stable")
        at, score = at[order], np.concatenate([np.array([score for _, score, _ in rows]), score])[order]
        is_true = np.concatenate([np.array([is_hit for _, _, is_hit in rows]), is_true])[order]
    return instance_ap.InstanceCounts(
        class_index=np.full(len(at), class_index, np.int32),
        threshold_index=at.astype(np.int32),
        score=score.astype(np.float64, copy=False),
        is_true=is_true,
        n_missed=np.array([n_missed], np.int64),
        n_truth=np.array([n_objects], np.int64),
        n_small_truth=np.array([len(takes_part) - n_objects], np.int64),
        n_predictions=np.array([len(scores)], np.int64),
    )


def _match(over: BoolArray, takes_part: BoolArray, scores: Float64Array) -> tuple[list[float], list[float], int]:
    """Scores of the true positives and of their duplicates, and the number of unmatched instances: greedy, in order."""
    hits: list[float] = []
    duplicates: list[float] = []
    n_met = 0
    for _, matching in met_instances(over, takes_part):
        n_met += 1
        *lower, best = np.sort(scores[matching]).tolist()
        hits.append(best)
        duplicates += lower
    return hits, duplicates, int(takes_part.sum()) - n_met


def met_instances(over: BoolArray, takes_part: BoolArray) -> Iterator[tuple[int, Int64Array]]:
    """The matched instances and their predictions; ``over`` (R, G) marks the pairs above the threshold.

    An instance uses up only its first prediction; the true positive gets the best score of all.
    """
    visited = np.zeros(len(over), bool)
    for column in np.flatnonzero(takes_part & over.any(axis=0)).tolist():
        matching = np.flatnonzero(over[:, column] & ~visited)
        if len(matching):
            visited[matching[0]] = True
            yield column, matching


def _check_predictions(
    n_points: int, indptr: IntArray, indices: IntArray, n_predictions: int, scores: Float64Array
) -> None:
    """``PredictionError`` for masks that no reader and no ``Instances.of`` can produce.

    The original ranks a confidence of infinity above all numbers; here it is treated as an overflow that lost the
    order (README.md).
    """
    if len(indptr) != n_predictions + 1 or len(scores) != n_predictions or not np.isfinite(scores).all():
        raise PredictionError(f"{n_predictions} masks: need as many labels, and confidences that are finite numbers")
    rises = np.diff(indices) > 0
    starts = indptr[1:-1]
    rises[starts[(starts > 0) & (starts < len(indices))] - 1] = True
    if not rises.all() or indices.min(initial=0) < 0 or indices.max(initial=-1) >= n_points:
        raise PredictionError(f"{n_predictions} masks: need ascending point indices, each once, below {n_points}")


def segments_of(ground_truth: IntArray) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Each point's row in the ascending list of distinct values, that list, and the number of points of each."""
    if not len(ground_truth):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    if ground_truth.min() < 0 or ground_truth.max() > _MAX_VALUE:
        worst = int(ground_truth.min() if ground_truth.min() < 0 else ground_truth.max())
        raise DataError(f"ground truth: contains the value {worst}; values are label * 1000 + instance")
    n_points_of_value = np.bincount(ground_truth)
    values = np.flatnonzero(n_points_of_value)
    row_of_value = np.zeros(len(n_points_of_value), np.int64)
    row_of_value[values] = np.arange(len(values))
    return row_of_value[ground_truth], values, n_points_of_value[values]


def intersections(
    segment_of_point: Int64Array,
    n_segments: int,
    indptr: IntArray,
    indices: IntArray,
    kept: Int64Array,
) -> Int64Array:
    """Points that prediction ``kept[r]`` shares with each segment, (R, n_segments), by one bincount."""
    size = np.diff(indptr)
    row_of_prediction = np.full(len(size), -1, np.int64)
    row_of_prediction[kept] = np.arange(len(kept))
    row = np.repeat(row_of_prediction, size)
    chosen = row >= 0
    key = row[chosen] * n_segments + segment_of_point[indices[chosen]]
    return np.bincount(key, minlength=len(kept) * n_segments).reshape(len(kept), n_segments).astype(np.int64)


@dataclass(frozen=True)
class Hits:
    """At one threshold: ``is_hit`` (K,) marks the true positives, ``values`` are those of the matched instances.

    A true positive is the mask whose confidence the instance takes, the first on ties. Below IoU 0.5 a mask may match
    two instances.
    """

    is_hit: BoolArray
    values: frozenset[int]


def hits(
    truth: Int64Array,
    masks: Masks,
    labels: Int64Array,
    scores: Float64Array,
    class_ids: Sequence[int],
    min_region_size: int,
    thresholds: Sequence[float],
) -> list[Hits]:
    """The hits at each of ``thresholds``; the arrays are those of ``scene_counts.per_scene``.

    >>> truth, masks = np.repeat([3001, 3002], 200), Masks.of_sets([np.arange(120), np.arange(200), np.arange(90)])
    >>> at_50, at_25 = hits(truth, masks, np.array([3, 3, 3]), np.array([0.5, 0.9, 1.0]), [3], 100, (0.5, 0.25))
    >>> at_50.is_hit.tolist(), sorted(at_50.values)
    ([False, True, False], [3001])
    """
    is_hit = np.zeros((len(thresholds), len(masks)), bool)
    values: list[set[int]] = [set() for _ in thresholds]
    for one in class_overlaps(truth, masks.indptr, masks.indices, labels, class_ids, min_region_size):
        for t, threshold in enumerate(thresholds):
            for column, matching in met_instances(one.iou > threshold, one.takes_part):
                own = one.predictions[matching]
                is_hit[t, own[scores[own].argmax()]] = True
                values[t].add(int(one.values[column]))
    return [Hits(of_one, frozenset(met)) for of_one, met in zip(is_hit, values, strict=True)]
