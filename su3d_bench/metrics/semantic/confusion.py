"""Semantic segmentation metrics from integer confusion matrices, as ConceptGraphs, ScanNet and HOV-SG compute them.

Rows are the true class, columns the predicted one; a last extra column is for points predicted as none of the
classes. Matrices of scenes are additive; only the functions that return ``SemanticMetrics`` compute ratios.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.metric import Counts, axes
from su3d_bench.numerics.statistics import nan_mean, ratio, row_means

IOU_LEVELS = (0.15, 0.25, 0.50, 0.75)  # conceptgraph/utils/eval.py counts the classes above these


@dataclass(frozen=True)
class SemanticCounts(Counts):
    """The counts of one scene or several: ``confusion`` (C, C + 1) int64 and the classes of the scenes (C,)."""

    stored_as = "semantic"

    confusion: Int64Array = field(metadata=axes("classes", "columns"))
    is_present: BoolArray = field(metadata=axes("classes"))

    def contradiction(self) -> str | None:
        """Points of a class that the scenes do not contain."""
        absent = np.flatnonzero(self.confusion.any(axis=1) & ~self.is_present)
        return f"'confusion' has points of class {absent[0]}, which the scene does not have" if len(absent) else None


@dataclass(frozen=True)
class SemanticMetrics:
    """Values for each scored class, in the order of ``class_index``, and their means."""

    class_index: Int64Array
    recall: Float64Array
    precision: Float64Array
    iou: Float64Array
    f1: Float64Array
    f1_conceptgraphs: Float64Array
    mean_accuracy: float
    mean_precision: float
    mean_iou: float
    frequency_weighted_iou: float
    mean_f1: float
    mean_f1_conceptgraphs: float
    point_accuracy: float
    n_classes_above: tuple[int, ...]


def per_scene(truth: IntArray, predicted: IntArray, is_present: BoolArray) -> SemanticCounts:
    """The additive counts of one scene from class indices per point, -1 for a true class that is not scored.

    ``is_present`` (C,) marks the scored classes of the scene, with or without points. Points whose true class is not
    among them are excluded, whatever is predicted there.

    >>> counts = per_scene(np.array([0, 0, 1, -1]), np.array([0, 1, -1, 0]), np.array([True, True]))
    >>> counts.confusion.tolist()
    [[1, 1, 0], [0, 0, 1]]
    """
    counts = is_present[truth]  # its value for a negative truth does not matter, the matrix skips it
    return SemanticCounts(confusion_matrix(truth[counts], predicted[counts], len(is_present)), is_present.copy())


def confusion_matrix(truth: IntArray, predicted: IntArray, n_classes: int) -> Int64Array:
    """Counts (C, C + 1) of pairs (true, predicted): a negative truth is skipped, a negative prediction comes last.

    >>> confusion_matrix(np.array([0, 1, 1, -1]), np.array([0, 0, -1, 1]), 2).tolist()
    [[1, 0, 0], [1, 0, 1]]
    """
    scored = truth >= 0
    row = truth[scored].astype(np.int64)
    column = predicted[scored].astype(np.int64)
    column[column < 0] = n_classes
    width = n_classes + 1
    return np.bincount(row * width + column, minlength=n_classes * width).reshape(n_classes, width).astype(np.int64)


def conceptgraphs_metrics(
    confusion: Int64Array | Float64Array, keep: IntArray, dtype: type[np.float32] | type[np.float64] = np.float64
) -> SemanticMetrics:
    """mAcc, F-mIoU and related metrics over the classes ``keep``, as in conceptgraph/utils/eval.py (commit 5c4da70).

    ``confusion`` (C, C) or (C, C + 1). Rows and columns are sliced together, as in the original; predictions outside
    the kept columns count as missed only in the extra column. Denominators are at least 1, so a class without points
    scores 0 and is included in the mean; F-mIoU without any point is NaN, 0/0 in the original. ``dtype`` float32
    computes as the original does, to the last bit. Without classes all values are NaN.

    ``f1_conceptgraphs`` is the original's F1, 2PR / max(1, P + R), which is not a harmonic mean below P + R = 1.

    >>> metrics = conceptgraphs_metrics(np.array([[8, 2, 0], [1, 9, 0], [0, 0, 0]]), np.array([0, 1]))
    >>> round(metrics.mean_accuracy, 4), round(metrics.frequency_weighted_iou, 4)
    (0.85, 0.7386)
    """
    kept: Int64Array = np.asarray(keep, np.int64)
    square: NDArray[Any] = np.ascontiguousarray(confusion[np.ix_(kept, kept)]).astype(dtype)
    has_none = confusion.shape[1] > confusion.shape[0]
    n_none: NDArray[Any] = confusion[kept, -1].astype(dtype) if has_none else np.zeros(len(kept), dtype)
    hit = np.diag(square)
    # float32 sums above 2^24 depend on the order: each row and each column separately, as in the original
    n_true: NDArray[Any] = np.array([row.sum() for row in square], dtype)
    n_true += n_none
    n_predicted = np.array([column.sum() for column in square.T], dtype)
    union = np.maximum(dtype(1), n_true + n_predicted - hit)
    recall = (hit / np.maximum(dtype(1), n_true)).astype(np.float64)
    precision = (hit / np.maximum(dtype(1), n_predicted)).astype(np.float64)
    iou = (hit / union).astype(np.float64)
    both = precision + recall
    f1 = np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)
    metrics = _with_means(kept, recall, precision, iou, f1, n_true.astype(np.float64))
    # the original's IoUs are float32, and one of 3/20 is above 0.15 there
    iou_of_original = hit.astype(np.float32) / union.astype(np.float32)
    metrics = replace(metrics, n_classes_above=_n_above(iou_of_original.astype(np.float64)))
    n_points = square.sum() + n_none.sum()
    if dtype is np.float32 and n_points > 0:
        # in this order, with which a perfect prediction may score 0.9999999999999999
        return replace(metrics, frequency_weighted_iou=float((iou * n_true / n_points).sum()))
    return metrics


def _n_above(iou: Float64Array) -> tuple[int, ...]:
    return tuple(int((iou > level).sum()) for level in IOU_LEVELS)


def scannet_metrics(confusion: IntArray, *, counts_unseen: bool = False) -> SemanticMetrics:
    """IoU of each class as in evaluate_semantic_label.py of ScanNet (commit 3830fce), and means that it lacks.

    ``confusion`` (C, C + 1), the last column for predictions outside the classes. A class that is never true has IoU 0
    if it was predicted and otherwise NaN, which is excluded from the mean IoU. Recall is NaN for a class that is never
    true; mean accuracy and frequency-weighted IoU are over the others. These means are ours, not the original's.
    ``counts_unseen``: recall is also 0 for a class that is never true but was predicted, so that mean accuracy includes
    it, as in iou_acc_from_confmat of ovo/utils/eval_utils.py of OVO (commit cf3b68e).

    >>> metrics = scannet_metrics(np.array([[3, 1, 0], [0, 0, 0]]))
    >>> metrics.iou.tolist(), metrics.mean_iou, metrics.mean_accuracy
    ([0.75, 0.0], 0.375, 0.75)
    """
    hit, n_true, n_predicted = _points(confusion)
    iou = ratio(hit, n_true + n_predicted - hit)
    recall = ratio(hit, n_true)
    if counts_unseen:
        recall[(n_true == 0) & (n_predicted > 0)] = 0.0
    f1 = ratio(2 * hit, n_true + n_predicted)
    return _with_means(np.arange(len(hit)), recall, ratio(hit, n_predicted), iou, f1, n_true)


def _points(confusion: IntArray) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Points (C,) of each class: correct, true, and predicted."""
    square = confusion[:, : len(confusion)]
    return (
        np.diag(square).astype(np.float64),
        confusion.sum(axis=1).astype(np.float64),
        square.sum(axis=0).astype(np.float64),
    )


def hovsg_metrics(confusion: IntArray, is_scored: BoolArray) -> SemanticMetrics:
    """The scores of application/eval/evaluate_sem_seg.py of HOV-SG (commit 71a8069), over scored classes that are true.

    ``confusion`` (C, C + 1) has all points, including those of ignored classes: predictions there are false positives.
    A class that is true but never predicted counts 0. Scores are of one scene; the original averages them over scenes.

    >>> confusion = np.array([[2, 0, 0], [1, 3, 0]])  # class 0 is ignored, and one point of class 1 is called so
    >>> metrics = hovsg_metrics(confusion, np.array([False, True]))
    >>> metrics.mean_accuracy, metrics.mean_iou
    (0.75, 0.75)
    """
    keep = np.flatnonzero(is_scored & (confusion.sum(axis=1) > 0))
    hit, n_true, n_predicted = (points[keep] for points in _points(confusion))
    precision = hit / np.maximum(1.0, n_predicted)
    iou = ratio(hit, n_true + n_predicted - hit)
    f1 = ratio(2 * hit, n_true + n_predicted)
    return _with_means(keep, ratio(hit, n_true), precision, iou, f1, n_true)


def _with_means(
    class_index: Int64Array,
    recall: Float64Array,
    precision: Float64Array,
    iou: Float64Array,
    f1: Float64Array,
    n_true: Float64Array,
) -> SemanticMetrics:
    f1_conceptgraphs = 2 * precision * recall / np.maximum(1.0, precision + recall)
    n_points = float(n_true.sum())
    weighted = (n_true * np.nan_to_num(iou)).sum() / n_points if n_points > 0 else np.nan
    return SemanticMetrics(
        class_index=class_index,
        recall=recall,
        precision=precision,
        iou=iou,
        f1=f1,
        f1_conceptgraphs=f1_conceptgraphs,
        mean_accuracy=nan_mean(recall),
        mean_precision=nan_mean(precision),
        mean_iou=nan_mean(iou),
        frequency_weighted_iou=float(weighted),
        mean_f1=nan_mean(f1),
        mean_f1_conceptgraphs=nan_mean(f1_conceptgraphs),
        point_accuracy=float((n_true * np.nan_to_num(recall)).sum() / n_points) if n_points > 0 else float("nan"),
        n_classes_above=_n_above(iou),
    )


def resampled_semantic(
    counts: Sequence[SemanticCounts], weights: Int64Array, metric: str, is_scored: BoolArray | None = None
) -> dict[str, Float64Array]:
    """mAcc, mIoU and F-mIoU (R,) of the pooled confusion of the scenes drawn ``weights`` (R, S) times.

    Classes that are true in any drawn scene count; with ``scannet`` those that are only predicted are included in the
    mean IoU as 0, with ``ovo`` in mAcc too. If the confusion matrices contain ignored classes, ``is_scored`` (C,) marks
    the others.

    >>> a = SemanticCounts(np.array([[4, 0, 0], [0, 0, 0]]), np.array([True, True]))
    >>> b = SemanticCounts(np.array([[0, 0, 0], [1, 1, 0]]), np.array([False, True]))
    >>> resampled_semantic([a, b], np.array([[2, 0], [1, 1], [0, 2]]), "conceptgraphs")["mAcc"].tolist()
    [1.0, 0.75, 0.5]
    """
    hit, n_true, n_predicted = resampled_points(counts, weights)
    if is_scored is not None:
        hit, n_true, n_predicted = hit[:, is_scored], n_true[:, is_scored], n_predicted[:, is_scored]
    counted = n_true > 0
    if metric == "conceptgraphs":
        n_true = n_true - resampled_points_sliced_away(counts, weights, n_true)
    union = n_true + n_predicted - hit
    recall = np.where(union > 0 if metric == "ovo" else counted, hit / np.maximum(n_true, 1), np.nan)
    has_iou = union > 0 if metric in {"scannet", "ovo"} else counted
    iou = np.where(has_iou, hit / np.maximum(union, 1), np.nan)
    n_points = n_true.sum(axis=1)
    weighted = (n_true * np.nan_to_num(iou)).sum(axis=1) / np.maximum(n_points, 1)
    return {
        "mAcc": row_means(recall),
        "mIoU": row_means(iou),
        "F-mIoU": np.where(counted.any(axis=1), weighted, np.nan),
    }


def resampled_points(
    counts: Sequence[SemanticCounts], weights: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Points (R, C) of each class in the drawn scenes: correct, true, and predicted."""
    drawn = weights.astype(np.float64)
    hit, n_true, n_predicted = zip(*(_points(of_scene.confusion) for of_scene in counts), strict=True)
    return drawn @ np.stack(hit), drawn @ np.stack(n_true), drawn @ np.stack(n_predicted)


def resampled_points_sliced_away(
    counts: Sequence[SemanticCounts], weights: Int64Array, n_true: Float64Array
) -> Float64Array:
    """Points (R, C) of each true class, in the drawn scenes, that ConceptGraphs excludes from the pooled rows.

    Their predicted class is present in a drawn scene, but has no true point, ``n_true`` (R, C), in any.
    """
    is_sliced = (weights @ np.stack([c.is_present for c in counts]).astype(np.int64) > 0) & (n_true == 0)
    sliced_away = np.zeros_like(n_true)
    for row in np.flatnonzero(is_sliced.any(axis=1)):  # none for most runs
        columns = np.flatnonzero(is_sliced[row])
        of_scenes = np.stack([c.confusion[:, columns].sum(axis=1) for c in counts])
        sliced_away[row] = weights[row] @ of_scenes
    return sliced_away
