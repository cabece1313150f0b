"""The ScanNet instance average precision, equal to the official evaluator in every bit.

Source: BenchmarkScripts/3d_evaluation/evaluate_semantic_instance.py of ScanNet at commit 3830fce, with the one-line
mend of its pull request 26 (a class whose predictions are all ignored scores 0 instead of raising IndexError).
A scene gives a table of counted predictions, tables of scenes are concatenated, and only ``combine`` forms ratios.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.instance.precision_recall import average_precisions
from su3d_bench.metrics.metric import Arrays, Counts

# arange(0.5, 0.95, 0.05) excludes its end: nine thresholds up to 0.90, as these doubles; then 0.25
THRESHOLDS: tuple[float, ...] = (*(float(t) for t in np.arange(0.5, 0.95, 0.05)), 0.25)
MIN_REGION_SIZE = 100  # points; the official script's --min_region_size, opt.min_region_sizes
INSTANCES_PER_CLASS = 1000  # ground truth is label * 1000 + instance
_MAX_VALUE = 10_000 * INSTANCES_PER_CLASS  # ScanNet's largest label is 1357

IntArray = NDArray[np.integer[Any]]


@dataclass(frozen=True)
class InstanceCounts(Counts):
    """What one scene, or several, adds to AP: one row for each counted prediction, class and threshold.

    ``class_index`` (E,) int32 and ``threshold_index`` (E,) int32 say where row e counts, ``score`` (E,) float64 its
    confidence, ``is_true`` (E,) whether it is a true positive; ``n_missed`` (C, T) int64 counts the ground-truth
    instances that nothing matched, ``n_truth`` (C,) those that take part, ``n_small_truth`` (C,) those below the
    minimum size, ``n_predictions`` (C,) the predictions of at least that size, ignored ones included.
    """

    stored_as = "instance"
    arrays: ClassVar[Arrays] = {
        "class_index": ("i", ("rows",)),
        "threshold_index": ("i", ("rows",)),
        "score": ("f", ("rows",)),
        "is_true": ("b", ("rows",)),
        "n_missed": ("i", ("classes", "thresholds")),
        "n_truth": ("i", ("classes",)),
        "n_small_truth": ("i", ("classes",)),
        "n_predictions": ("i", ("classes",)),
    }

    class_index: Int32Array
    threshold_index: Int32Array
    score: Float64Array
    is_true: BoolArray
    n_missed: Int64Array
    n_truth: Int64Array
    n_small_truth: Int64Array
    n_predictions: Int64Array

    def contradiction(self) -> str | None:
        """Rows beyond the classes or thresholds, scores without an order, other instances than met and missed ones."""
        for name, axis in (("class_index", "classes"), ("threshold_index", "thresholds")):
            if getattr(self, name).max(initial=-1) >= self.sizes[axis]:
                return f"'{name}' counts beyond the {self.sizes[axis]} {axis}"
        if not np.isfinite(self.score).all():
            return "'score' has values that are NaN or infinite"
        known = self.n_missed.copy()
        np.add.at(known, (self.class_index[self.is_true], self.threshold_index[self.is_true]), 1)
        wrong = np.argwhere(known != self.n_truth[:, None])
        if not len(wrong):
            return None
        row, column = wrong[0]
        return f"'n_truth' of class {row} is {self.n_truth[row]}, met and missed are {known[row, column]}"


_ROWS = [name for name, (_, axes) in InstanceCounts.arrays.items() if axes == ("rows",)]


@dataclass(frozen=True)
class InstanceAP:
    """Average precision: ``table`` (C, T) for each class and threshold, NaN where a class has no ground truth.

    ``ap`` averages over all thresholds but 0.25.
    """

    thresholds: tuple[float, ...]
    table: Float64Array
    ap: float
    ap50: float
    ap25: float

    def of_class(self, index: int) -> tuple[float, float, float]:
        """AP, AP50 and AP25 of one class."""
        row = self.table[index]
        at_50, at_25 = self.thresholds.index(0.5), self.thresholds.index(0.25)
        return float(np.average(row[ap_columns(self.thresholds)][None, :])), float(row[at_50]), float(row[at_25])

    def of_group(self, members: Sequence[int]) -> tuple[float, float, float]:
        """AP, AP50 and AP25 averaged over the classes ``members`` that have ground truth; NaN where none has."""
        rows = np.array([self.of_class(index) for index in members]).reshape(-1, 3)
        return _nanmean(rows[:, 0]), _nanmean(rows[:, 1]), _nanmean(rows[:, 2])


def ap_columns(thresholds: Sequence[float]) -> Int64Array:
    """Where the thresholds stand over which AP is averaged: all but 0.25.

    >>> ap_columns((0.5, 0.75, 0.25)).tolist()
    [0, 1]
    """
    return np.flatnonzero(~np.isclose(thresholds, 0.25)).astype(np.int64)


def encode_ground_truth(semantic: IntArray, instance: IntArray) -> Int64Array:
    """One value a point, label * 1000 + instance, and 0 (unannotated) where either is 0.

    >>> encode_ground_truth(np.array([5, 5, 0, 7]), np.array([1, 2, 3, 0])).tolist()
    [5001, 5002, 0, 0]
    """
    if len(instance) and (instance.min() < 0 or semantic.min() < 0):
        worst = min(int(instance.min()), int(semantic.min()))
        raise DataError(f"ground truth: holds the id {worst}; ids are 0 for none, else positive")
    if len(instance) and instance.max() >= INSTANCES_PER_CLASS:
        raise DataError(
            f"ground truth: instance id {int(instance.max())} would spill into the next class; "
            f"number the instances of a scene from 1 to {INSTANCES_PER_CLASS - 1}"
        )
    value = np.asarray(semantic, np.int64) * INSTANCES_PER_CLASS + instance
    value[(np.asarray(instance) == 0) | (np.asarray(semantic) == 0)] = 0
    return value


def last_line_of_each_mask_file(files: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs (line of first occurrence, line of last occurrence), one a distinct mask file, in order of the first.

    The official reader keys predictions by file path: a file named twice stays at its first position with the label and
    confidence of its last line.

    >>> last_line_of_each_mask_file(["a.txt", "b.txt", "a.txt", "c.txt"])
    [(0, 2), (1, 1), (3, 3)]
    """
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    for line, file in enumerate(files):
        first.setdefault(file, line)
        last[file] = line
    return [(first[file], last[file]) for file in first]


def per_scene(
    ground_truth: IntArray,
    indptr: IntArray,
    indices: IntArray,
    labels: IntArray | None,
    scores: Float64Array,
    class_ids: Sequence[int],
    min_region_size: int = MIN_REGION_SIZE,
    thresholds: Sequence[float] = THRESHOLDS,
    *,
    forgives_void: bool = True,
) -> InstanceCounts:
    """The additive counts of one scene.

    ``ground_truth`` (N,) holds label * 1000 + instance a point, 0 where unannotated; prediction k covers the points
    ``indices[indptr[k]:indptr[k + 1]]``, strictly ascending, and has ``labels[k]`` and ``scores[k]``. Their
    order counts for AP25 alone, as in the original under Python 3. Points whose label is not in ``class_ids`` are void.
    Without ``labels`` every mask is listed once under each class. Unless it ``forgives_void``, a mask that meets no
    instance is a false positive however much of it is void or in small instances.

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
    _check_predictions(ground_truth, indptr, indices, len(scores) if labels is None else len(labels), scores)
    classes = class_overlaps(ground_truth, indptr, indices, labels, class_ids, min_region_size)
    return stacked(
        [one.counts(index, scores, thresholds, forgives_void=forgives_void) for index, one in enumerate(classes)]
    )


@dataclass(frozen=True)
class ClassOverlaps:
    """One class of a scene: its ``predictions`` (R,) of the minimum size, by their place in line, and its instances.

    ``values`` (G,) are those of the instances, ascending; ``iou`` (R, G); ``takes_part`` (G,) marks those of the
    minimum size; ``ignored_share`` (R,) of a prediction is void or in smaller instances.
    """

    predictions: Int64Array
    values: Int64Array
    iou: Float64Array
    takes_part: BoolArray
    ignored_share: Float64Array

    def counts(
        self, class_index: int, scores: Float64Array, thresholds: Sequence[float], *, forgives_void: bool
    ) -> InstanceCounts:
        """The counts of the class; ``scores`` (K,) are those of all masks in line."""
        return count_class(
            class_index,
            iou=self.iou,
            takes_part=self.takes_part,
            scores=scores[self.predictions],
            ignored_share=forgives_void * self.ignored_share,
            thresholds=thresholds,
        )


def class_overlaps(
    ground_truth: IntArray,
    indptr: IntArray,
    indices: IntArray,
    labels: IntArray | None,
    class_ids: Sequence[int],
    min_region_size: int,
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
            min_region_size,
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
) -> ClassOverlaps:
    """The ``predictions`` (R,) of one class; ``intersection`` (R, S) with all segments, by ascending value."""
    segment_label = segment_value // INSTANCES_PER_CLASS
    columns = np.flatnonzero(segment_label == class_id)  # ascending value, as the original walks them
    n_void = intersection[:, ~np.isin(segment_label, class_ids)].sum(axis=1)
    shared, is_small = intersection[:, columns], segment_size[columns] < min_region_size
    return ClassOverlaps(
        predictions=predictions,
        values=segment_value[columns],
        iou=shared / (segment_size[columns][None, :] + n_points[:, None] - shared),
        takes_part=~is_small,
        ignored_share=(n_void + shared[:, is_small].sum(axis=1)) / n_points,
    )


def stacked(parts: Sequence[InstanceCounts]) -> InstanceCounts:
    """The counts of classes one after another."""
    names = InstanceCounts.arrays
    return InstanceCounts(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def count_class(
    class_index: int,
    iou: Float64Array,
    takes_part: BoolArray,
    scores: Float64Array,
    ignored_share: Float64Array,
    thresholds: Sequence[float],
) -> InstanceCounts:
    """The counts of one class: ``iou`` (R, G) of its predictions, in line order, with its instances, ascending."""
    limits, n_objects = np.array(thresholds, np.float64)[:, None], int(takes_part.sum())
    # a prediction that met any instance of its class, even a small or a taken one, is no false positive here
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
    if rows:  # before those of their threshold that met nothing
        at = np.concatenate([np.array([t for t, _, _ in rows]), at])
        order = np.argsort(at, kind="stable")
        at, score = at[order], np.concatenate([np.array([score for _, score, _ in rows]), score])[order]
        is_true = np.concatenate([np.array([is_hit for _, _, is_hit in rows]), is_true])[order]
    return InstanceCounts(
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
    """Scores of the true positives and of their duplicates, and how many instances nothing met: greedy, in order."""
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
    """The instances that are met, and by which predictions; ``over`` (R, G) says who is above the threshold with whom.

    Only the first in line is used up by an instance; the best score of all stays with the true positive.
    """
    visited = np.zeros(len(over), bool)
    for column in np.flatnonzero(takes_part & over.any(axis=0)).tolist():
        matching = np.flatnonzero(over[:, column] & ~visited)
        if len(matching):
            visited[matching[0]] = True
            yield column, matching


def concatenate(counts: Sequence[InstanceCounts]) -> InstanceCounts:
    """The counts of several scenes as one: rows one after another, numbers summed."""
    columns = {name: [getattr(of_scene, name) for of_scene in counts] for name in InstanceCounts.arrays}
    return InstanceCounts(
        **{name: np.concatenate(each) if name in _ROWS else np.sum(each, axis=0) for name, each in columns.items()}
    )


def only(counts: InstanceCounts, index: int) -> InstanceCounts:
    """The counts of one class alone."""
    rows = np.flatnonzero(counts.class_index == index)
    own = {name: getattr(counts, name)[rows if name in _ROWS else [index]] for name in InstanceCounts.arrays}
    return InstanceCounts(**own | {"class_index": np.zeros(len(rows), np.int32)})


def combine(counts: Sequence[InstanceCounts], thresholds: Sequence[float] = THRESHOLDS) -> InstanceAP:
    """AP of the scenes together: their predictions share one curve a class, and classes are averaged.

    Classes without a ground-truth instance are NaN and leave the mean; with no class left the means are NaN.

    >>> hit = per_scene(np.full(120, 7004), np.array([0, 120]), np.arange(120), np.array([7]), np.ones(1), [7])
    >>> miss = per_scene(np.full(120, 7009), np.array([0]), np.arange(0), np.zeros(0, int), np.ones(0), [7])
    >>> combine([hit, miss]).ap
    0.5
    """
    if not counts:
        raise ValueError("combine needs the counts of at least one scene")
    return combine_each([concatenate(counts)], thresholds)[0]


def combine_each(counts: Sequence[InstanceCounts], thresholds: Sequence[float] = THRESHOLDS) -> list[InstanceAP]:
    """AP of each scene alone, or of each group of scenes whose counts are one."""
    n_classes, n_thresholds = counts[0].n_missed.shape
    n_cells = n_classes * n_thresholds
    cell = [
        i * n_cells + c.class_index.astype(np.int64) * n_thresholds + c.threshold_index for i, c in enumerate(counts)
    ]
    areas = average_precisions(
        np.concatenate(cell),
        np.concatenate([c.score for c in counts]),
        np.concatenate([c.is_true for c in counts]),
        np.concatenate([c.n_missed.ravel() for c in counts]),
        np.repeat(np.concatenate([c.n_truth > 0 for c in counts]), n_thresholds),
    )
    return [of_table(table, thresholds) for table in areas.reshape(-1, n_classes, n_thresholds)]


def of_table(table: Float64Array, thresholds: Sequence[float]) -> InstanceAP:
    """The means over a ``table`` (C, T) of areas."""
    columns = ap_columns(thresholds)
    at_50, at_25 = tuple(thresholds).index(0.5), tuple(thresholds).index(0.25)
    return InstanceAP(
        thresholds=tuple(thresholds),
        table=table,
        # the order in which numpy sums follows the layout that this mixed indexing yields; so does the last bit
        ap=_nanmean(table[None][np.zeros((1, 1), int), :, columns[None, :]]),
        ap50=_nanmean(table[:, at_50]),
        ap25=_nanmean(table[:, at_25]),
    )


def _check_predictions(
    ground_truth: IntArray, indptr: IntArray, indices: IntArray, n_predictions: int, scores: Float64Array
) -> None:
    n_points = len(ground_truth)
    if len(indptr) != n_predictions + 1 or len(scores) != n_predictions:
        raise PredictionError(
            f"{n_predictions} labels, {len(indptr) - 1} masks, {len(scores)} scores; they must pair up"
        )
    # the original ranks inf above all numbers; here it is taken for an overflow, in which order was lost (README.md)
    if not np.isfinite(scores).all():
        bad = int(np.flatnonzero(~np.isfinite(scores))[0])
        raise PredictionError(f"instance {bad}: its confidence is {scores[bad]}; confidences are finite numbers")
    if len(indices):
        starts = np.zeros(len(indices), bool)
        starts[indptr[:-1][indptr[:-1] < len(indices)]] = True
        unsorted = np.flatnonzero((np.diff(indices) <= 0) & ~starts[1:])
        if len(unsorted):
            owner = int(np.searchsorted(indptr, unsorted[0], side="right") - 1)
            raise PredictionError(
                f"instance {owner}: its point indices are not strictly ascending; sort them, each once"
            )
        if indices.min() < 0 or indices.max() >= n_points:
            worst = int(np.flatnonzero((indices < 0) | (indices >= n_points))[0])
            owner = int(np.searchsorted(indptr, worst, side="right") - 1)
            raise PredictionError(
                f"instance {owner}: mask holds index {int(indices[worst])}, the scene has {n_points} points "
                f"(0..{n_points - 1})"
            )


def segments_of(ground_truth: IntArray) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Each point's row in the ascending list of distinct values, that list, and how many points have each."""
    if not len(ground_truth):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    if ground_truth.min() < 0 or ground_truth.max() > _MAX_VALUE:
        worst = int(ground_truth.min() if ground_truth.min() < 0 else ground_truth.max())
        raise DataError(f"ground truth: holds the value {worst}; values are label * 1000 + instance")
    n_points_of_value = np.bincount(ground_truth)
    values = np.flatnonzero(n_points_of_value)
    row_of_value = np.zeros(len(n_points_of_value), np.int64)
    row_of_value[values] = np.arange(len(values))
    return row_of_value[ground_truth], values, n_points_of_value[values]


def intersections(
    segment_of_point: Int64Array, n_segments: int, indptr: IntArray, indices: IntArray, kept: Int64Array
) -> Int64Array:
    """Points that prediction ``kept[r]`` shares with each segment, (R, n_segments), by one bincount."""
    size = np.diff(indptr)
    row_of_prediction = np.full(len(size), -1, np.int64)
    row_of_prediction[kept] = np.arange(len(kept))
    row = np.repeat(row_of_prediction, size)
    chosen = row >= 0
    key = row[chosen] * n_segments + segment_of_point[indices[chosen]]
    return np.bincount(key, minlength=len(kept) * n_segments).reshape(len(kept), n_segments).astype(np.int64)


def _nanmean(values: Float64Array) -> float:
    """``np.nanmean``, which takes its time, in every bit; NaN where there is no number."""
    is_nan = np.isnan(values)
    n = values.size - np.count_nonzero(is_nan)
    filled = values.copy(order="K")
    filled[is_nan] = 0.0
    return float(filled.sum() / n) if n else float("nan")
