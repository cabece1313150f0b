"""Instances against true boxes: what a scene counts, and precision, recall and AP of counts, as 3D detection has them.

Source: utils/eval_det.py of VoteNet, which takes the area under the envelope of precision over recall from PASCAL VOC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.metric import Arrays, Counts

THRESHOLDS = (0.25, 0.5)
PLACES = tuple(f"{100 * threshold:.0f}" for threshold in THRESHOLDS)  # as names of values end
_MAX_CELLS = 4_000_000  # of a (resamples, rows) block: 32 MB of float64


@dataclass(frozen=True)
class BoxCounts(Counts):
    """What one scene, or several, adds: one row for each instance of a scored class.

    ``class_index`` (E,) int32 and ``score`` (E,) float64 are its class and confidence, ``is_true`` (E, T) whether it is
    the one that finds a true box at each of the thresholds. Of the true boxes of each class, (C,) int64: ``n_truth``
    how many there are, ``n_centred`` how many hold the centroid of an instance of their class, ``n_located`` how many
    are found at the first threshold by an instance of any class, ``n_named`` how many of these by one of their own.
    """

    stored_as = "boxes"
    arrays: ClassVar[Arrays] = {
        "class_index": ("i", ("rows",)),
        "score": ("f", ("rows",)),
        "is_true": ("b", ("rows", "thresholds")),
        "n_truth": ("i", ("classes",)),
        "n_centred": ("i", ("classes",)),
        "n_located": ("i", ("classes",)),
        "n_named": ("i", ("classes",)),
    }

    class_index: Int32Array
    score: Float64Array
    is_true: BoolArray
    n_truth: Int64Array
    n_centred: Int64Array
    n_located: Int64Array
    n_named: Int64Array

    def contradiction(self) -> str | None:
        """Rows beyond the classes, scores without an order, more boxes found or named than there are or can be."""
        n_classes = len(self.n_truth)
        if self.class_index.max(initial=-1) >= n_classes:
            return f"'class_index' counts beyond the {n_classes} classes"
        if not np.isfinite(self.score).all():
            return "'score' has values that are NaN or infinite"
        if self.is_true.shape[1] != len(THRESHOLDS):
            return f"'is_true' has {self.is_true.shape[1]} thresholds of {len(THRESHOLDS)}"
        n_rows = np.bincount(self.class_index, minlength=n_classes)
        loose, strict = (self._n_hits(t) for t in range(len(THRESHOLDS)))
        reachable = np.where(n_rows > 0, self.n_truth, 0)
        for name, few, many in (
            ("is_true", loose, self.n_truth),
            ("is_true", strict, loose),
            ("n_centred", self.n_centred, reachable),
            ("n_located", self.n_located, self.n_truth),
            ("n_named", self.n_named, self.n_located),
            ("n_named", self.n_named, n_rows),
        ):
            wrong = np.flatnonzero(few > many)
            if len(wrong):
                row = wrong[0]
                return f"'{name}' of class {row} counts {few[row]} boxes where at most {many[row]} can be"
        return None

    def _n_hits(self, threshold: int) -> Int64Array:
        return np.bincount(self.class_index[self.is_true[:, threshold]], minlength=len(self.n_truth))


def count_boxes(
    iou: Float64Array,
    holds_centroid: BoolArray,
    true_class: Int64Array,
    called: Int64Array,
    scores: Float64Array,
    n_classes: int,
) -> BoxCounts:
    """The counts of a scene of K instances and G true boxes from their ``iou`` (K, G).

    ``holds_centroid`` (K, G): of which instance each box holds the centroid; ``true_class`` (G,) and ``called`` (K,)
    are indices of classes, -1 for an instance of none of them; such a one can locate a box, and no more.

    >>> iou = np.array([[0.6, 0.0], [0.4, 0.0], [0.0, 0.3]])
    >>> counts = count_boxes(iou, iou > 0.2, np.array([0, 1]), np.array([0, 0, 0]), np.array([0.5, 0.9, 0.7]), 2)
    >>> counts.score.tolist(), counts.is_true.tolist()
    ([0.9, 0.7, 0.5], [[True, False], [False, False], [False, True]])
    >>> counts.n_centred.tolist(), counts.n_located.tolist(), counts.n_named.tolist()
    ([1, 0], [1, 1], [1, 0])
    """
    order = np.lexsort((-scores, called))
    order = order[called[order] >= 0]
    is_true = np.zeros((len(order), len(THRESHOLDS)), bool)
    for c in np.intersect1d(called, true_class):
        rows, columns = np.flatnonzero(called[order] == c), np.flatnonzero(true_class == c)
        of_class = iou[np.ix_(order[rows], columns)]
        best, best_iou = of_class.argmax(axis=1), of_class.max(axis=1)
        for t, threshold in enumerate(THRESHOLDS):
            over = np.flatnonzero(best_iou > threshold)
            is_true[rows[over[np.unique(best[over], return_index=True)[1]]], t] = True
    is_same = called[:, None] == true_class
    located, named = _located(iou, scores, is_same)
    centred = (holds_centroid & is_same).any(axis=0)
    n_truth, *found = (
        np.bincount(true_class[which], minlength=n_classes).astype(np.int64)
        for which in (np.ones(len(true_class), bool), centred, located, named)
    )
    return BoxCounts(called[order].astype(np.int32), np.asarray(scores, np.float64)[order], is_true, n_truth, *found)


def _located(iou: Float64Array, scores: Float64Array, is_same: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Which boxes (G,) instances of any class find, and of which the best of these has the right class.

    The best by confidence, of equals by IoU, of equals one of the right class, so that their order is nothing.
    """
    located, named = np.zeros(iou.shape[1], bool), np.zeros(iou.shape[1], bool)
    if not iou.size:
        return located, named
    best, best_iou = iou.argmax(axis=1), iou.max(axis=1)
    found = np.flatnonzero(best_iou > THRESHOLDS[0])
    is_right = is_same[found, best[found]]
    order = found[np.lexsort((is_right, best_iou[found], scores[found]))]
    located[best[order]] = True
    for row in order:  # the last of each box stays
        named[best[row]] = is_same[row, best[row]]
    return located, named


def class_values(counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, Float64Array]:
    """AP and recall at each threshold (R, C) of the scenes drawn ``weights`` (R, S) times; NaN without a true box.

    Instances of one confidence enter the curve together; of other confidences the area is VoteNet's.

    >>> found = BoxCounts(np.zeros(1, np.int32), np.ones(1), np.array([[True, False]]), *np.array([[2], [1], [1], [1]]))
    >>> {name: value.tolist() for name, value in class_values([found], np.array([[1]])).items()}
    {'AP25': [[0.5]], 'recall25': [[0.5]], 'AP50': [[0.0]], 'recall50': [[0.0]]}
    """
    n_truth = weights @ np.stack([of_scene.n_truth for of_scene in counts])
    scene = np.concatenate([np.full(len(of_scene.score), s) for s, of_scene in enumerate(counts)])
    score = np.concatenate([of_scene.score for of_scene in counts])
    class_index = np.concatenate([of_scene.class_index for of_scene in counts])
    is_true = np.concatenate([of_scene.is_true for of_scene in counts])
    order = np.lexsort((-score, class_index))
    bounds = np.searchsorted(class_index[order], np.arange(n_truth.shape[1] + 1))
    values = {f"{name}{place}": np.full(n_truth.shape, np.nan) for place in PLACES for name in ("AP", "recall")}
    for c in np.flatnonzero(n_truth.any(axis=0)):
        own = order[bounds[c] : bounds[c + 1]]
        for t, place in enumerate(PLACES):
            area, recall = _curves(score[own], is_true[own, t], scene[own], n_truth[:, c], weights)
            values[f"AP{place}"][:, c], values[f"recall{place}"][:, c] = area, recall
    return values


def _curves(
    score: Float64Array, is_true: BoolArray, scene: Int64Array, n_truth: Int64Array, weights: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """Area (R,) and recall (R,) of one class, whose rows come by falling score; NaN where a draw has no true box."""
    area, recall = np.zeros(len(weights)), np.zeros(len(weights))
    if len(score):
        is_last = np.append(np.diff(score) != 0, True)
        n_at_once = max(1, _MAX_CELLS // len(score))
        for start in range(0, len(weights), n_at_once):
            block = slice(start, start + n_at_once)
            drawn = weights[block][:, scene]
            n_true = np.cumsum(drawn * is_true, axis=1)[:, is_last]
            precision = n_true / np.maximum(np.cumsum(drawn, axis=1)[:, is_last], 1)
            found = n_true / np.maximum(n_truth[block, None], 1)
            envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
            area[block] = (np.diff(found, axis=1, prepend=0.0) * envelope).sum(axis=1)
            recall[block] = found[:, -1]
    return np.where(n_truth > 0, area, np.nan), np.where(n_truth > 0, recall, np.nan)


def share_values(counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, tuple[Int64Array, Int64Array]]:
    """The numerator and denominator (R, C) of the shares ``centroid``, ``class`` and precision at each threshold."""
    drawn = {
        name: weights @ np.stack([getattr(of_scene, name) for of_scene in counts])
        for name in ("n_truth", "n_centred", "n_located", "n_named")
    }
    n_classes = drawn["n_truth"].shape[1]

    def rows(which: Sequence[BoolArray]) -> Int64Array:
        each = [
            np.bincount(of_scene.class_index[chosen], minlength=n_classes)
            for of_scene, chosen in zip(counts, which, strict=True)
        ]
        drawn_rows: Int64Array = weights @ np.stack(each).astype(np.int64)
        return drawn_rows

    n_rows = rows([np.ones(len(of_scene.score), bool) for of_scene in counts])
    shares = {"centroid": (drawn["n_centred"], drawn["n_truth"]), "class": (drawn["n_named"], drawn["n_located"])}
    for t, place in enumerate(PLACES):
        shares[f"precision{place}"] = rows([of_scene.is_true[:, t] for of_scene in counts]), n_rows
    return shares
