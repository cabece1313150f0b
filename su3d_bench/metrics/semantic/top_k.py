"""Protocols of kind ``top-k``: the most likely classes of a point, a hit if any is among the point's labels.

Source: semantic/eval/eval_semantic.py and semantic/utils/confmat.py of scannetpp/scannetpp at commit f3b4712.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.matching import labelling
from su3d_bench.metrics.metric import Counts, Metric, Pooled, SceneScore, axes, present
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.metrics.semantic.confusion import SemanticCounts, SemanticMetrics
from su3d_bench.metrics.semantic.score import owners_at
from su3d_bench.numerics.statistics import ratio

ONE_CLASS = "the prediction has one class per point: top {k} is top 1"


@dataclass(frozen=True)
class TopKCounts(Counts):
    """The counts of one scene or several: ``best`` and ``any`` (C, C + 1) int64 of the first class and of the k.

    Rows are labels, columns predicted classes, the last one for points without a predicted class. ``is_present`` (C,)
    classes are among the labels of the scenes.
    """

    stored_as = "top-k"

    best: Int64Array = field(metadata=axes("classes", "columns"))
    any: Int64Array = field(metadata=axes("classes", "columns"))
    is_present: BoolArray = field(metadata=axes("classes"))

    def contradiction(self) -> str | None:
        """Points of a class that the scenes do not contain, unequal numbers of points, or fewer hits for k classes."""
        absent = np.flatnonzero((self.best.any(axis=1) | self.any.any(axis=1)) & ~self.is_present)
        if len(absent):
            return f"'best' or 'any' has points of class {absent[0]}, which the scene does not have"
        if self.best.sum() != self.any.sum():
            return f"'best' has {self.best.sum()} points, 'any' {self.any.sum()}"
        fewer = np.trace(self.any) < np.trace(self.best)
        return "'any' has fewer hits than 'best'" if fewer else None

    @property
    def each(self) -> tuple[SemanticCounts, SemanticCounts]:
        """The two matrices as counts of one class per point."""
        return SemanticCounts(self.best, self.is_present), SemanticCounts(self.any, self.is_present)


def top_k_confusion(labels: Int64Array, ranked: Int64Array, n_classes: int) -> Int64Array:
    """Counts (C, C + 1) of pairs (label, predicted class), one per point of ``labels`` (N, L) and ``ranked`` (N, k).

    Both are class indices, padded with -1. Points without a label are skipped. The best ranked class that is among the
    labels is a hit; otherwise the first label is paired with the first class, in the last column if that is -1.

    >>> labels = np.array([[0, 1], [0, -1], [-1, -1], [1, 0]])
    >>> ranked = np.array([[2, 1], [2, 1], [0, 1], [-1, -1]])
    >>> top_k_confusion(labels, ranked[:, :1], 3).tolist()
    [[0, 0, 2, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
    >>> top_k_confusion(labels, ranked, 3).tolist()
    [[0, 0, 1, 0], [0, 1, 0, 1], [0, 0, 0, 0]]
    """
    first_label = labels[np.arange(len(labels)), (labels >= 0).argmax(axis=1)]
    truth, called = first_label.copy(), ranked[:, 0].copy()
    is_open = np.ones(len(labels), np.bool_)
    for column in ranked.T:
        is_hit = is_open & (column >= 0) & (labels == column[:, None]).any(axis=1)
        truth[is_hit] = called[is_hit] = column[is_hit]
        is_open &= ~is_hit
    return semantic.confusion_matrix(truth, called, n_classes)


@dataclass(frozen=True)
class RankedPoints:
    """The predicted classes (N, k) of each wanted ground-truth point, the most likely first, padded with -1, and the
    distance (N,) to the point that they come from."""

    classes: Int64Array
    distance_m: Float64Array
    warnings: tuple[str, ...]


def ranked_at(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None, wanted: BoolArray
) -> RankedPoints:
    """The predicted classes of the ``wanted`` (N,) ground-truth points: those of the nearest object or feature row."""
    assert rules.top_k is not None
    is_present = present(_labels(rules, truth).ravel(), len(rules.classes))
    ranked = labelling.ranked_classes(rules, prediction, encoder, is_present, rules.top_k)
    ranked[~np.append(labelling.scored_classes(rules), False)[ranked]] = -1
    row, distance_m = owners_at(rules, prediction, np.ones(len(ranked), np.bool_), truth.points, wanted)
    classes = np.append(ranked, np.full((1, rules.top_k), -1), axis=0)[row]
    warning = labelling.encoder_warning(rules, prediction, encoder)
    return RankedPoints(classes, distance_m, () if warning is None else (warning,))


class TopKMetric(Metric[TopKCounts]):
    """The most likely classes of a point, compared with all its labels."""

    truth = GroundTruth
    counts = TopKCounts

    @property
    def _k(self) -> int:
        assert self.rules.top_k is not None
        return self.rules.top_k

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.classes), "columns": len(self.rules.classes) + 1}

    def per_scene(self, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        if truth.evaluation_points is not None:
            raise DataError(f"{rules.name}: ground truth '{truth.variant}' has no labels on its evaluation points")
        labels = _labels(self.rules, truth)
        is_present = present(labels.ravel(), len(rules.classes))
        wanted: BoolArray = np.any(labels >= 0, axis=1)
        n = len(rules.classes)
        found = ranked_at(rules, truth, prediction, encoder, wanted)
        called = found.classes[wanted]
        counts = TopKCounts(
            top_k_confusion(labels[wanted], called[:, :1], n), top_k_confusion(labels[wanted], called, n), is_present
        )
        warnings = list(found.warnings)
        if self._k > 1 and (called[:, 0] >= 0).any() and (called[:, 1:] < 0).all():
            warnings.append(ONE_CLASS.format(k=self._k))
        return self.score(counts, prediction, found.distance_m[wanted], warnings)

    def pooled(self, counts: Sequence[TopKCounts]) -> Pooled:
        best, any_of_k = self._metrics(counts)
        classes = {
            self.rules.classes[index].name: {
                "recall": float(best.recall[index]),
                "precision": float(best.precision[index]),
                "IoU": float(best.iou[index]),
                "F1": float(best.f1[index]),
                f"top-{self._k} recall": float(any_of_k.recall[index]),
                f"top-{self._k} IoU": float(any_of_k.iou[index]),
            }
            for index in np.flatnonzero(labelling.scored_classes(self.rules))
        }
        values = (best.mean_iou, best.mean_accuracy, any_of_k.mean_iou, any_of_k.mean_accuracy)
        return Pooled(dict(zip(self.rules.value_names, values, strict=True)), classes)

    def resampled(self, counts: Sequence[TopKCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        halves = [
            semantic.resampled_semantic([of_scene.each[which] for of_scene in counts], weights, "scannet")
            for which in (0, 1)
        ]
        columns = [half[name] for half in halves for name in ("mIoU", "mAcc")]
        return dict(zip(self.rules.value_names, columns, strict=True))

    def resampled_classes(
        self, counts: Sequence[TopKCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        answer: dict[str, dict[str, Float64Array]] = {}
        for which, prefix in ((0, ""), (1, f"top-{self._k} ")):
            hit, n_true, n_predicted = semantic.resampled_points([c.each[which] for c in counts], weights)
            recall, iou = ratio(hit, n_true), np.where(n_true > 0, ratio(hit, n_true + n_predicted - hit), np.nan)
            for index in np.flatnonzero(labelling.scored_classes(self.rules)):
                if any(c.is_present[index] for c in counts):
                    row = answer.setdefault(self.rules.classes[index].name, {})
                    row |= {f"{prefix}recall": recall[:, index], f"{prefix}IoU": iou[:, index]}
        return answer

    def _metrics(self, counts: Sequence[TopKCounts]) -> tuple[SemanticMetrics, SemanticMetrics]:
        """Values for the first class and for the k, over all classes; unscored ones have no points and no value."""
        whole = TopKCounts.joined(counts)
        return semantic.scannet_metrics(whole.best), semantic.scannet_metrics(whole.any)


def _labels(rules: ProtocolRules, truth: GroundTruth) -> Int64Array:
    """The class indices (N, L) of the labels of each point, padded with -1; none for excluded points."""
    ids = truth.semantic[:, None] if truth.every_semantic is None else truth.every_semantic
    labels = labelling.class_index_of_ids(rules, ids.ravel()).reshape(ids.shape)
    labels[~np.append(labelling.scored_classes(rules), False)[labels]] = -1
    labels[truth.semantic < 0] = -1
    return labels
