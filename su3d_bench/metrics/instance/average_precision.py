"""The ScanNet instance average precision, equal to the official evaluator in every bit.

Source: BenchmarkScripts/3d_evaluation/evaluate_semantic_instance.py of ScanNet at commit 3830fce, with the one-line
fix of its pull request 26 (a class whose predictions are all ignored scores 0 instead of raising IndexError).
A scene gives a table of counted predictions (``scene_counts``), tables of scenes are concatenated, and only ``combine``
forms ratios.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array, IntArray
from su3d_bench.metrics.metric import ROWS, Counts, axes
from su3d_bench.numerics.statistics import row_means

_SPLITTER = 134217729.0  # 2**27 + 1: Veltkamp's constant, cuts a double into two halves of 26 bits
ROWS_AT_ONCE = 1 << 20  # rows of curves computed together, which bounds their memory


def average_precision(scores: Float64Array, is_true: BoolArray, n_missed: int) -> float:
    """Area under the raw precision-recall polyline: one vertex per distinct score, and (recall 0, precision 1).

    Rows are the counted predictions of one class; 0 without rows (pull request 26).

    >>> average_precision(np.array([1.0, 1.0, 1.0]), np.array([True, True, False]), 2)  # recall (1 + precision) / 2
    0.41666666666666663
    """
    cell = np.zeros(len(scores), np.int64)
    return float(average_precisions(cell, scores, is_true, np.array([n_missed]), np.array([True]))[0])


def average_precisions(
    cell: Int64Array, score: Float64Array, is_true: BoolArray, n_missed: Int64Array, is_wanted: BoolArray
) -> Float64Array:
    """``average_precision`` of the rows of each cell, NaN for unwanted cells.

    ``cell`` (E,), ``score`` (E,) and ``is_true`` (E,) have one row per counted prediction, ``n_missed`` and
    ``is_wanted`` one value per cell.
    """
    rows = np.flatnonzero(is_wanted[cell])
    order = rows[np.argsort(score[rows])]  # the order of equal scores does not change a curve
    order = order[np.argsort(cell[order].astype(np.min_scalar_type(len(n_missed))), kind="stable")]
    bounds = np.searchsorted(cell[order], np.arange(len(n_missed) + 1))
    score, is_true = score[order], is_true[order]
    values = np.where(is_wanted, 0.0, np.nan)
    with_rows = np.flatnonzero(np.diff(bounds))
    starts, ends = bounds[with_rows], bounds[with_rows + 1]
    first = 0
    while first < len(with_rows):
        last = max(first + 1, int(np.searchsorted(ends, starts[first] + ROWS_AT_ONCE, side="right")))
        own = slice(starts[first], ends[last - 1])
        cells = with_rows[first:last]
        values[cells] = _areas(score[own], is_true[own], starts[first:last] - own.start, n_missed[cells])
        first = last
    return values


def _areas(score: Float64Array, is_true: BoolArray, starts: Int64Array, n_missed: Int64Array) -> Float64Array:
    """The area (C,) of each cell; its rows, at least one, begin at ``starts`` (C,) and have ascending scores."""
    n_rows = np.diff(starts, append=len(score))
    is_vertex = np.append(True, score[1:] != score[:-1])
    is_vertex[starts] = True
    row, cell = np.flatnonzero(is_vertex), np.repeat(np.arange(len(starts)), n_rows)[is_vertex]
    n_true_before = np.append(0, np.cumsum(is_true))
    n_true = n_true_before[starts + n_rows] - n_true_before[starts]
    hits = n_true_before[starts + n_rows][cell] - n_true_before[row]
    # after the vertices of each cell come the vertex (recall 0, precision 1) and a second recall of 0
    n_vertices = np.bincount(cell)
    ends = np.cumsum(n_vertices + 2)
    at = np.arange(len(row)) + 2 * cell
    precision, recall = np.ones(ends[-1]), np.zeros(ends[-1])
    precision[at] = hits / ((starts + n_rows)[cell] - row)
    # every instance is either a true positive at some score or missed, so the denominator is one constant
    with np.errstate(invalid="ignore"):
        recall[at] = hits / (n_true + n_missed)[cell]
    # convolution with (-1/2, 0, 1/2): halving is exact, so this equals numpy.convolve in every bit
    width = np.zeros(ends[-1])
    width[1:-1] = 0.5 * (recall[:-2] - recall[2:])
    begins = ends - n_vertices - 2
    width[begins] = 0.5 * (recall[begins] - recall[begins + 1])
    return dots(precision, width, begins, n_vertices + 1)


# ``np.dot`` uses the BLAS, whose order of additions differs between processors: the last bit of the same curve is
# different with AVX2 and AVX-512. The reference results of the original evaluators come from OpenBLAS's
# AVX-512 kernel (kernel/x86_64/ddot_microk_skylakex-2.c, and the tail loop of ddot.c): we add in that order,
# in plain double arithmetic, for many curves at once.
def dots(left: Float64Array, right: Float64Array, starts: Int64Array, lengths: Int64Array) -> Float64Array:
    """The sum of products of each stretch, in the order of OpenBLAS's AVX-512 kernel with fused multiply-adds.

    Values must be far from overflow and underflow, which holds for precisions and recall steps.

    >>> dots(np.array([1.0, 0.5, 0.25]), np.array([0.5, 0.25, 0.25]), np.array([0, 1]), np.array([3, 2])).tolist()
    [0.6875, 0.1875]
    """
    products = _exact_products(left, right)
    n_blocked = lengths - lengths % 16
    n_wide = n_blocked - n_blocked % 32
    wide = _chains(*products, starts, n_wide // 32, np.zeros((len(starts), 32)))
    # the halves of each 512-bit register are added into one of 256 bits, to which the last block of 16 is added
    halves = wide.reshape(-1, 4, 2, 4)
    lanes = (halves[:, :, 0] + halves[:, :, 1]).reshape(-1, 16)
    fours = _chains(*products, starts + n_wide, (n_blocked - n_wide) // 16, lanes).reshape(-1, 4, 4)
    four = ((fours[:, 0] + fours[:, 1]) + fours[:, 2]) + fours[:, 3]
    total = (four[:, 0] + four[:, 2]) + (four[:, 1] + four[:, 3])
    return _chains(*products, starts + n_blocked, lengths - n_blocked, total[:, None])[:, 0]


def _chains(
    product: Float64Array, error: Float64Array, starts: Int64Array, n_steps: Int64Array, totals: Float64Array
) -> Float64Array:
    """``totals`` (C, lanes) plus the next exact products of every lane, one per step, rounded once per step."""
    order = np.argsort(-n_steps, kind="stable")
    totals, lanes = totals[order], np.arange(totals.shape[1])
    n_left = np.searchsorted(-n_steps[order], -np.arange(n_steps.max(initial=0)), side="left")
    for step, n in enumerate(n_left.tolist()):
        at = starts[order[:n], None] + (step * len(lanes) + lanes)
        totals[:n] = _rounded_once(product[at], error[at], totals[:n])
    back = np.empty_like(totals)
    back[order] = totals
    return back


def _rounded_once(product: Float64Array, error: Float64Array, total: Float64Array) -> Float64Array:
    """``product + error + total`` as in a fused multiply-add; ``error`` is the rounding error of ``product``.

    The sum of the remainders of two exact additions is rounded to odd, so that the last addition rounds correctly
    (Boldo and Melquiond, Emulation of FMA and correctly rounded sums, IEEE Transactions on Computers 57, 2008).
    """
    high, low = _exact_sums(total, error)
    high, middle = _exact_sums(product, high)
    rest, lost = _exact_sums(low, middle)
    bits = rest.view(np.int64)
    is_even = (lost != 0) & (bits & 1 == 0)
    bits += np.where(is_even, np.where((lost > 0) == (rest > 0), 1, -1), 0)
    return high + rest


def _exact_sums(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Knuth's sum: rounded sums and their rounding errors; the two add up to the exact sums."""
    total = left + right
    part = total - left
    return total, (left - (total - part)) + (right - part)


def _exact_products(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Dekker's product: rounded products and their rounding errors; the two add up to the exact products."""
    product = left * right
    left_high, left_low = _halves(left)
    right_high, right_low = _halves(right)
    error = left_low * right_low - (
        ((product - left_high * right_high) - left_low * right_high) - left_high * right_low
    )
    return product, error


def _halves(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    scaled = _SPLITTER * values
    high = scaled - (scaled - values)
    return high, values - high


# arange(0.5, 0.95, 0.05) excludes its end: nine thresholds up to 0.90, as these doubles; then 0.25
THRESHOLDS: tuple[float, ...] = (*(float(t) for t in np.arange(0.5, 0.95, 0.05)), 0.25)
MIN_REGION_SIZE = 100  # points; the official script's --min_region_size, opt.min_region_sizes
INSTANCES_PER_CLASS = 1000  # ground truth is label * 1000 + instance


@dataclass(frozen=True)
class InstanceCounts(Counts):
    """The AP counts of one scene or several: one row per counted prediction, class and threshold.

    ``class_index`` (E,) int32 and ``threshold_index`` (E,) int32 state where row e counts, ``score`` (E,) float64 its
    confidence, ``is_true`` (E,) whether it is a true positive; ``n_missed`` (C, T) int64 counts the ground-truth
    instances without a match, ``n_truth`` (C,) those that are scored, ``n_small_truth`` (C,) those below the minimum
    size, ``n_predictions`` (C,) the predictions of at least that size, including ignored ones.
    """

    stored_as = "instance"

    class_index: Int32Array = field(metadata=axes(ROWS))
    threshold_index: Int32Array = field(metadata=axes(ROWS))
    score: Float64Array = field(metadata=axes(ROWS))
    is_true: BoolArray = field(metadata=axes(ROWS))
    n_missed: Int64Array = field(metadata=axes("classes", "thresholds"))
    n_truth: Int64Array = field(metadata=axes("classes"))
    n_small_truth: Int64Array = field(metadata=axes("classes"))
    n_predictions: Int64Array = field(metadata=axes("classes"))

    @property
    def has_match(self) -> bool:
        return bool(self.is_true.any())

    def contradiction(self) -> str | None:
        """Rows beyond the classes or thresholds, non-finite scores, or instances neither matched nor missed."""
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
        return f"'n_truth' of class {row} is {self.n_truth[row]}, matched and missed are {known[row, column]}"


@dataclass(frozen=True)
class InstanceAP:
    """Average precision: ``table`` (C, T) for each class and threshold, NaN for classes without ground truth.

    ``ap`` averages over all thresholds except 0.25.
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


def ap_columns(thresholds: Sequence[float]) -> Int64Array:
    """The indices of the thresholds over which AP is averaged: all except 0.25.

    >>> ap_columns((0.5, 0.75, 0.25)).tolist()
    [0, 1]
    """
    return np.flatnonzero(~np.isclose(thresholds, 0.25)).astype(np.int64)


def encode_ground_truth(semantic: IntArray, instance: IntArray) -> Int64Array:
    """One value per point, label * 1000 + instance, or 0 (unannotated) without an instance.

    Instances without a label keep values below 1000, which are void, but not the same as 0 in every original.

    >>> encode_ground_truth(np.array([5, 5, 0, 7]), np.array([1, 2, 3, 0])).tolist()
    [5001, 5002, 3, 0]
    """
    if len(instance) and (instance.min() < 0 or semantic.min() < 0):
        worst = min(int(instance.min()), int(semantic.min()))
        raise DataError(f"ground truth: contains the id {worst}; ids are positive, or 0 for none")
    if len(instance) and instance.max() >= INSTANCES_PER_CLASS:
        raise DataError(
            f"ground truth: instance id {int(instance.max())} would spill into the next class; "
            f"number the instances of a scene from 1 to {INSTANCES_PER_CLASS - 1}"
        )
    value = np.asarray(semantic, np.int64) * INSTANCES_PER_CLASS + instance
    value[np.asarray(instance) == 0] = 0
    return value


def values_of_numbers(numbers: IntArray) -> Int64Array:
    """One value per point, 1000 + its object number, or 0 for none, from object numbers without classes.

    As in the OpenSUN3D challenge's script, n and 1000 + n are the same object, 1000 is an object too, and values from
    2000 are none (load_ids and get_instances in eval_utils/util_3d.py of OpenSun3D/cvpr24-challenge at 59db30f).

    >>> values_of_numbers(np.array([0, 1, 7, 1007, 1000, 2000])).tolist()
    [0, 1001, 1007, 1007, 1000, 0]
    """
    numbers = np.asarray(numbers, np.int64)
    values = np.where((numbers > 0) & (numbers < INSTANCES_PER_CLASS), numbers + INSTANCES_PER_CLASS, numbers)
    return np.where(values // INSTANCES_PER_CLASS == 1, values, 0)


def last_line_of_each_mask_file(files: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs (line of first occurrence, line of last occurrence), one per distinct mask file, in order of the first.

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
    """The counts of classes, concatenated."""
    names = InstanceCounts.arrays()
    return InstanceCounts(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def only(counts: InstanceCounts, indices: Sequence[int]) -> InstanceCounts:
    """The counts of some classes, in increasing order."""
    rows = np.flatnonzero(np.isin(counts.class_index, indices))
    own = {
        name: getattr(counts, name)[rows if names == (ROWS,) else list(indices)]
        for name, (_, names) in InstanceCounts.arrays().items()
    }
    position = np.searchsorted(indices, counts.class_index[rows]).astype(np.int32)
    return InstanceCounts(**own | {"class_index": position})


def combine(counts: Sequence[InstanceCounts], thresholds: Sequence[float] = THRESHOLDS) -> InstanceAP:
    """AP over all scenes: their predictions share one curve per class, and classes are averaged.

    Classes without a ground-truth instance are NaN and excluded from the mean; without any class the means are NaN.

    >>> from su3d_bench.metrics.instance.scene_counts import per_scene
    >>> hit = per_scene(np.full(120, 7004), np.array([0, 120]), np.arange(120), np.array([7]), np.ones(1), [7])
    >>> miss = per_scene(np.full(120, 7009), np.array([0]), np.arange(0), np.zeros(0, int), np.ones(0), [7])
    >>> combine([hit, miss]).ap
    0.5
    """
    return combine_each([InstanceCounts.joined(counts)], thresholds)[0]


def combine_each(counts: Sequence[InstanceCounts], thresholds: Sequence[float] = THRESHOLDS) -> list[InstanceAP]:
    """AP of each scene, or of each group of scenes whose counts are joined."""
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
        # the order in which numpy sums, and so the last bit, depends on the layout that this mixed indexing gives
        ap=_nanmean(table[None][np.zeros((1, 1), int), :, columns[None, :]]),
        ap50=_nanmean(table[:, at_50]),
        ap25=_nanmean(table[:, at_25]),
    )


def _nanmean(values: Float64Array) -> float:
    """A faster ``np.nanmean``, equal in every bit; NaN without any number."""
    is_nan = np.isnan(values)
    n = values.size - np.count_nonzero(is_nan)
    filled = values.copy(order="K")
    filled[is_nan] = 0.0
    return float(filled.sum() / n) if n else float("nan")


MANY_ROWS = 20_000  # from here on compiled loops are faster, including the time to load them
AT_ONCE = 64  # resamples processed together: their counts stay in the L1 cache
_MAX_CELLS = 4_000_000  # of a (resamples, rows) block: 32 MB of float64


def resampled_ap(
    counts: Sequence[InstanceCounts], weights: Int64Array, thresholds: Sequence[float] = THRESHOLDS
) -> dict[str, Float64Array]:
    """AP, AP50 and AP25 (R,) of the scenes drawn ``weights`` (R, S) times, equal to ``combine`` up to rounding.

    >>> from su3d_bench.metrics.instance.scene_counts import per_scene
    >>> hit = per_scene(np.full(120, 7004), np.array([0, 120]), np.arange(120), np.array([7]), np.ones(1), [7])
    >>> miss = per_scene(np.full(120, 7009), np.array([0]), np.arange(0), np.zeros(0, int), np.ones(0), [7])
    >>> resampled_ap([hit, miss], np.array([[2, 0], [1, 1], [0, 2]]))["AP"].tolist()
    [1.0, 0.5, 0.0]
    """
    n_classes, n_thresholds = counts[0].n_missed.shape
    scene = np.concatenate([np.full(len(c.score), s, np.int64) for s, c in enumerate(counts)])
    score = np.concatenate([c.score for c in counts])
    is_true = np.concatenate([c.is_true for c in counts])
    cell = np.concatenate([c.class_index.astype(np.int64) * n_thresholds + c.threshold_index for c in counts])
    order = np.lexsort((-score, cell))
    rows = _Rows(scene[order], score[order], is_true[order])
    bounds = np.searchsorted(cell[order], np.arange(n_classes * n_thresholds + 1))
    n_truth = weights @ np.stack([c.n_truth for c in counts])
    resampled_areas = _compiled_areas if len(score) >= MANY_ROWS else _drawn_areas
    table = resampled_areas(rows, bounds, n_truth, weights).reshape(len(weights), n_classes, n_thresholds)
    table[n_truth == 0] = np.nan
    return {
        "AP": row_means(table[:, :, ap_columns(thresholds)].reshape(len(weights), -1)),
        "AP50": row_means(table[:, :, tuple(thresholds).index(0.5)]),
        "AP25": row_means(table[:, :, tuple(thresholds).index(0.25)]),
    }


@dataclass(frozen=True)
class _Rows:
    """The counted predictions ordered by class and threshold, with descending scores in each."""

    scene: Int64Array
    score: Float64Array
    is_true: BoolArray


def _drawn_areas(rows: _Rows, bounds: Int64Array, n_truth: Int64Array, weights: Int64Array) -> Float64Array:
    """Area (R, cells) under each resample's polylines; ``bounds`` of the cells' rows, ``n_truth`` (R, C)."""
    areas = np.zeros((len(weights), len(bounds) - 1))
    n_thresholds = areas.shape[1] // n_truth.shape[1]
    for c in np.flatnonzero(n_truth.any(axis=0)):
        for cell in range(c * n_thresholds, (c + 1) * n_thresholds):
            own = slice(bounds[cell], bounds[cell + 1])
            areas[:, cell] = _weighted_areas(
                rows.score[own], rows.is_true[own], rows.scene[own], n_truth[:, c], weights
            )
    return areas


def _compiled_areas(rows: _Rows, bounds: Int64Array, n_truth: Int64Array, weights: Int64Array) -> Float64Array:
    """``_drawn_areas`` for many rows, up to rounding, with compiled loops on all cores."""
    from su3d_bench.metrics.instance.kernels import resampled_areas

    areas = np.zeros((len(bounds) - 1, len(weights)))
    class_of_cell = np.repeat(np.arange(n_truth.shape[1]), len(areas) // n_truth.shape[1])
    is_last = np.diff(rows.score, append=np.nan) != 0
    is_last[bounds[1:][bounds[1:] > 0] - 1] = True
    scene = rows.scene.astype(np.int32)

    def fill(start: int) -> None:
        own = slice(start, start + AT_ONCE)
        drawn = np.ascontiguousarray(weights[own].T, np.int32)
        instances = np.ascontiguousarray(n_truth[own].T, np.int32)
        areas_of_block = np.empty((len(areas), drawn.shape[1]))
        resampled_areas(scene, rows.is_true, is_last, bounds, class_of_cell, instances, drawn, areas_of_block)
        areas[:, own] = areas_of_block

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(fill, range(0, len(weights), AT_ONCE)))  # raises an exception of a thread
    return np.ascontiguousarray(areas.T)  # the order of later sums, and so the last bit, depends on the layout


def _weighted_areas(
    score: Float64Array, is_true: BoolArray, scene: Int64Array, n_truth: Int64Array, weights: Int64Array
) -> Float64Array:
    """Area under each resample's precision-recall polyline; rows have descending scores.

    A vertex without weight repeats its neighbour and adds no area, so all resamples share the same vertices.
    """
    if not len(score):
        return np.zeros(len(weights))
    last_of_score = np.flatnonzero(np.append(np.diff(score) != 0, True))
    areas = np.empty(len(weights))
    step = max(1, _MAX_CELLS // len(score))
    for start in range(0, len(weights), step):
        drawn = weights[start : start + step][:, scene]
        n_counted = np.cumsum(drawn, axis=1)[:, last_of_score].astype(np.float64)
        n_hit = np.cumsum(drawn * is_true, axis=1)[:, last_of_score].astype(np.float64)
        precision = np.divide(n_hit, n_counted, out=np.ones_like(n_hit), where=n_counted > 0)
        recall = n_hit / np.maximum(n_truth[start : start + step, None], 1)
        precision = np.concatenate([np.ones((len(drawn), 1)), precision], axis=1)
        recall = np.concatenate([np.zeros((len(drawn), 1)), recall], axis=1)
        areas[start : start + step] = (np.diff(recall, axis=1) * (precision[:, 1:] + precision[:, :-1]) / 2).sum(axis=1)
    return areas
