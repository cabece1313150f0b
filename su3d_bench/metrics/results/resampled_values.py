"""The metrics of each class when scenes are drawn with weights, from their additive counts.

With weights of ones this is the value over all scenes, with a single one that of a scene alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.matching.labelling import scored_classes
from su3d_bench.metrics.protocols import SHARE_KINDS, ProtocolRules
from su3d_bench.metrics.results import resampling
from su3d_bench.metrics.results.results import CURVE_KINDS, Counts
from su3d_bench.metrics.semantic.confusion import SemanticCounts


def class_columns(rules: ProtocolRules) -> tuple[str, ...]:
    """What is known of a single class: its AP values, or its recall and IoU; nothing where there are no classes."""
    if rules.kind in CURVE_KINDS:
        return tuple(name for name in ("AP", "AP50", "AP25") if name in rules.headline)
    return () if rules.kind == "categories" or rules.kind in SHARE_KINDS else ("recall", "IoU")


def resampled_classes(
    rules: ProtocolRules, counts: Sequence[Counts], weights: Int64Array
) -> dict[str, dict[str, Float64Array]]:
    """Class -> column -> value (R,) of the scenes drawn ``weights`` (R, S) times; NaN where it has no truth there."""
    if rules.kind == "categories" or rules.kind in SHARE_KINDS:
        return {}
    if rules.kind in CURVE_KINDS:
        columns = class_columns(rules)
        curves = cast("Sequence[InstanceCounts]", counts)
        answer = {}
        for index, name in enumerate(rules.curve_names):
            if any(one.n_truth[index] for one in curves):
                values = resampling.resampled_ap([_only(one, index) for one in curves], weights, rules.thresholds)
                answer[name] = {column: values[column] for column in columns}
        return answer
    return _semantic_classes(rules, cast("Sequence[SemanticCounts]", counts), weights)


def _only(counts: InstanceCounts, index: int) -> InstanceCounts:
    """The counts of one class alone."""
    rows = np.flatnonzero(counts.class_index == index)
    return InstanceCounts(
        class_index=np.zeros(len(rows), np.int32),
        threshold_index=counts.threshold_index[rows],
        score=counts.score[rows],
        is_true=counts.is_true[rows],
        n_missed=counts.n_missed[[index]],
        n_truth=counts.n_truth[[index]],
        n_small_truth=counts.n_small_truth[[index]],
        n_predictions=counts.n_predictions[[index]],
    )


def _semantic_classes(
    rules: ProtocolRules, counts: Sequence[SemanticCounts], weights: Int64Array
) -> dict[str, dict[str, Float64Array]]:
    n_classes = len(counts[0].is_present)
    drawn = weights.astype(np.float64)
    hit = drawn @ np.stack([np.diag(one.confusion[:, :n_classes]) for one in counts]).astype(np.float64)
    n_true = drawn @ np.stack([one.confusion.sum(axis=1) for one in counts]).astype(np.float64)
    n_predicted = drawn @ np.stack([one.confusion[:, :n_classes].sum(axis=0) for one in counts]).astype(np.float64)
    recall = np.where(n_true > 0, hit / np.maximum(n_true, 1), np.nan)
    iou = np.where(n_true > 0, hit / np.maximum(n_true + n_predicted - hit, 1), np.nan)
    names = rules.scored if rules.metric == "scannet" else rules.classes
    kept = np.arange(n_classes) if rules.metric != "scannet" else np.flatnonzero(scored_classes(rules))
    is_scored = scored_classes(rules)
    return {
        entry.name: {"recall": recall[:, index], "IoU": iou[:, index]}
        for entry, index in zip(names, kept, strict=True)
        if is_scored[index] and any(one.confusion[index].any() for one in counts)
    }
