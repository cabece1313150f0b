"""From the additive counts of scenes to what is reported: pooled and scene-mean values, classes, intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from su3d_bench.metrics import instance_ap, resampling, semantic
from su3d_bench.protocols import ProtocolRules
from su3d_bench.statistics import percentile_interval, resample_weights
from su3d_bench.types import Float64Array, Int64Array

Counts = instance_ap.InstanceCounts | semantic.SemanticCounts


@dataclass(frozen=True)
class ProtocolResult:
    """The numbers of one method under one protocol, as fractions, NaN where undefined.

    ``metrics`` is ``pooled`` or ``scene_mean``, whichever the protocol reports; ``intervals`` belong to it, for the
    headline metrics, and are ``None`` for a single scene. ``coverage``: by radius in metres, the share of scored points
    without a predicted point that near. ``groups`` holds head, common and tail where the protocol has them.
    """

    protocol: str
    version: int
    headline: tuple[str, ...]
    scenes: tuple[str, ...]
    metrics: Mapping[str, float]
    pooled: Mapping[str, float]
    scene_mean: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float] | None]
    per_scene: Mapping[str, Mapping[str, float]]
    per_class: Mapping[str, Mapping[str, float]]
    groups: Mapping[str, Mapping[str, float]]
    coverage: Mapping[str, float]
    n_predictions: Mapping[str, int]
    warnings: tuple[str, ...]

    @property
    def n_scenes(self) -> int:
        return len(self.scenes)

    def to_json(self) -> dict[str, Any]:
        """Plain values for a JSON file, NaN as null."""
        names = (
            "protocol version headline n_scenes scenes metrics intervals pooled scene_mean per_scene per_class groups "
            "coverage n_predictions warnings"
        )
        return {name: _plain(getattr(self, name)) for name in names.split()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def form_result(
    rules: ProtocolRules,
    scenes: Sequence[str],
    counts: Sequence[Counts],
    *,
    coverage: Mapping[str, float],
    n_predictions: Mapping[str, int],
    warnings: Sequence[str],
) -> ProtocolResult:
    """The result of ``scenes`` from their counts, in that order."""
    pooled = metric_values(rules, counts, pooled=True)
    per_scene = {
        scene: metric_values(rules, [count], pooled=False) for scene, count in zip(scenes, counts, strict=True)
    }
    scene_mean = {key: semantic.nan_mean(np.array([row[key] for row in per_scene.values()])) for key in pooled}
    weights = resample_weights(len(scenes))
    if rules.aggregate == "pooled":
        metrics, resampled = pooled, _resampled(rules, counts, weights)
    else:
        table = {key: np.array([row[key] for row in per_scene.values()]) for key in rules.headline}
        metrics, resampled = scene_mean, {key: _weighted_mean(row, weights) for key, row in table.items()}
    return ProtocolResult(
        protocol=rules.name,
        version=rules.version,
        headline=rules.headline,
        scenes=tuple(scenes),
        metrics=metrics,
        pooled=pooled,
        scene_mean=scene_mean,
        intervals={key: percentile_interval(resampled[key]) if len(scenes) > 1 else None for key in rules.headline},
        per_scene=per_scene,
        per_class=_class_values(rules, counts),
        groups=_group_values(rules, counts),
        coverage=coverage,
        n_predictions=n_predictions,
        warnings=(*warnings, *_warnings(rules, counts)),
    )


def metric_values(rules: ProtocolRules, counts: Sequence[Counts], *, pooled: bool) -> dict[str, float]:
    """The protocol's metrics of the scenes together.

    ConceptGraphs' rows differ: the pooled one averages over the classes that have scored points, that of a scene over
    the classes that its ground truth contains.
    """
    if rules.kind == "instance":
        ap = instance_ap.combine(cast("Sequence[instance_ap.InstanceCounts]", counts), rules.thresholds)
        return {"AP": ap.ap, "AP50": ap.ap50, "AP25": ap.ap25}
    metrics = _semantic_metrics(rules, counts, pooled=pooled)
    return {
        "mAcc": metrics.mean_accuracy,
        "mIoU": metrics.mean_iou,
        "F-mIoU": metrics.frequency_weighted_iou,
        "mPrecision": metrics.mean_precision,
        "mF1": metrics.mean_f1,
        "mF1-conceptgraphs": metrics.mean_f1_conceptgraphs,
        "n_classes": len(metrics.class_index),
        **{f"n_IoU>{level:.2f}": n for level, n in zip(semantic.IOU_LEVELS, metrics.n_classes_above, strict=True)},
    }


def _semantic_metrics(rules: ProtocolRules, counts: Sequence[Counts], *, pooled: bool) -> semantic.SemanticMetrics:
    whole = semantic.concatenate(cast("Sequence[semantic.SemanticCounts]", counts))
    if rules.metric == "scannet":
        scored = [index for index, entry in enumerate(rules.classes) if not rules.is_ignored(entry.name)]
        return semantic.scannet_metrics(_keep_columns(whole.confusion, np.array(scored))[scored])
    has_points = whole.confusion.sum(axis=1) > 0
    keep = np.flatnonzero(has_points if pooled else whole.is_present)
    folded = np.zeros_like(whole.confusion)
    folded[:, [*keep, -1]] = _keep_columns(whole.confusion, keep)
    return semantic.conceptgraphs_metrics(folded, keep)


def _keep_columns(confusion: Int64Array, keep: Int64Array) -> Int64Array:
    """The columns ``keep`` and a last one with all others: a point called anything else is called wrongly.

    The original slices other columns away; there, its classifier cannot choose them.
    """
    n_elsewhere = confusion.sum(axis=1) - confusion[:, keep].sum(axis=1)
    return np.concatenate([confusion[:, keep], n_elsewhere[:, None]], axis=1)


def _class_values(rules: ProtocolRules, counts: Sequence[Counts]) -> dict[str, dict[str, float]]:
    if rules.kind == "instance":
        ap = instance_ap.combine(cast("Sequence[instance_ap.InstanceCounts]", counts), rules.thresholds)
        return {
            entry.name: dict(zip(("AP", "AP50", "AP25"), ap.of_class(index), strict=True))
            for index, entry in enumerate(rules.scored)
        }
    metrics = _semantic_metrics(rules, counts, pooled=True)
    names = rules.scored if rules.metric == "scannet" else rules.classes
    return {
        names[index].name: {
            "recall": float(metrics.recall[row]),
            "precision": float(metrics.precision[row]),
            "IoU": float(metrics.iou[row]),
            "F1": float(metrics.f1[row]),
            "F1-conceptgraphs": float(metrics.f1_conceptgraphs[row]),
        }
        for row, index in enumerate(metrics.class_index)
    }


def _group_values(rules: ProtocolRules, counts: Sequence[Counts]) -> dict[str, dict[str, float]]:
    names = list(dict.fromkeys(entry.group for entry in rules.scored if entry.group))
    if rules.kind != "instance" or not names:
        return {}
    ap = instance_ap.combine(cast("Sequence[instance_ap.InstanceCounts]", counts), rules.thresholds)
    members = {name: [i for i, entry in enumerate(rules.scored) if entry.group == name] for name in names}
    return {name: dict(zip(("AP", "AP50", "AP25"), ap.of_group(members[name]), strict=True)) for name in names}


def _resampled(rules: ProtocolRules, counts: Sequence[Counts], weights: Int64Array) -> dict[str, Float64Array]:
    if rules.kind == "instance":
        instances = cast("Sequence[instance_ap.InstanceCounts]", counts)
        return resampling.resampled_ap(instances, weights, rules.thresholds)
    return resampling.resampled_semantic(cast("Sequence[semantic.SemanticCounts]", counts), weights, rules.metric)


def _weighted_mean(values: Float64Array, weights: Int64Array) -> Float64Array:
    is_number = ~np.isnan(values)
    drawn = weights[:, is_number].astype(np.float64)
    n = drawn.sum(axis=1)
    return np.where(n > 0, (drawn * values[is_number]).sum(axis=1) / np.maximum(n, 1), np.nan)


def _warnings(rules: ProtocolRules, counts: Sequence[Counts]) -> list[str]:
    if rules.kind != "instance":
        return []
    whole = instance_ap.concatenate(cast("Sequence[instance_ap.InstanceCounts]", counts))
    small = np.flatnonzero((whole.n_truth == 0) & (whole.n_small_truth > 0))
    if not len(small):
        return []
    names = ", ".join(f"'{rules.scored[index].name}'" for index in small)
    return [f"not scored, because no scene has an instance of {rules.min_region_size} points: {names}"]
