"""The ScanNet instance average precision, equal to the official evaluator in every bit.

Source: BenchmarkScripts/3d_evaluation/evaluate_semantic_instance.py of ScanNet at commit 3830fce, with the one-line
mend of its pull request 26 (a class whose predictions are all ignored scores 0 instead of raising IndexError).
A scene gives a table of counted predictions (``scene_counts``), tables of scenes are concatenated, and only ``combine``
forms ratios.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.instance.precision_recall import average_precisions
from su3d_bench.metrics.metric import Arrays, Counts

# arange(0.5, 0.95, 0.05) excludes its end: nine thresholds up to 0.90, as these doubles; then 0.25
THRESHOLDS: tuple[float, ...] = (*(float(t) for t in np.arange(0.5, 0.95, 0.05)), 0.25)
MIN_REGION_SIZE = 100  # points; the official script's --min_region_size, opt.min_region_sizes
INSTANCES_PER_CLASS = 1000  # ground truth is label * 1000 + instance

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


def values_of_numbers(numbers: IntArray) -> Int64Array:
    """One value a point, 1000 + the number of its object, and 0 for none, of numbers of objects without classes.

    As in the OpenSUN3D challenge's script n and 1000 + n are one object, 1000 is one too, and from 2000 on none is
    (load_ids and get_instances in eval_utils/util_3d.py of OpenSun3D/cvpr24-challenge at 59db30f).

    >>> values_of_numbers(np.array([0, 1, 7, 1007, 1000, 2000])).tolist()
    [0, 1001, 1007, 1007, 1000, 0]
    """
    numbers = np.asarray(numbers, np.int64)
    values = np.where((numbers > 0) & (numbers < INSTANCES_PER_CLASS), numbers + INSTANCES_PER_CLASS, numbers)
    return np.where(values // INSTANCES_PER_CLASS == 1, values, 0)


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


def stacked(parts: Sequence[InstanceCounts]) -> InstanceCounts:
    """The counts of classes one after another."""
    names = InstanceCounts.arrays
    return InstanceCounts(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


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

    >>> from su3d_bench.metrics.instance.scene_counts import per_scene
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


def _nanmean(values: Float64Array) -> float:
    """``np.nanmean``, which takes its time, in every bit; NaN where there is no number."""
    is_nan = np.isnan(values)
    n = values.size - np.count_nonzero(is_nan)
    filled = values.copy(order="K")
    filled[is_nan] = 0.0
    return float(filled.sum() / n) if n else float("nan")
