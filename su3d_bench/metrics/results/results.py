"""From the additive counts of scenes to what is reported: pooled and scene-mean values, classes, intervals."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.matching.labelling import scored_classes
from su3d_bench.metrics.open_vocabulary import object_means
from su3d_bench.metrics.protocols import AP_NAMES, SHARE_KINDS, VALUES_OF_METRIC, ProtocolRules
from su3d_bench.metrics.questions import shares
from su3d_bench.metrics.results import resampling
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.numerics.statistics import percentile_interval, resample_weights

Counts = instance_ap.InstanceCounts | semantic.SemanticCounts | object_means.ObjectCounts | shares.ShareCounts
CURVE_KINDS = ("instance", "queries")  # their counts are those of a precision-recall curve
GROUP_COLUMNS = {"mAcc": "recall", "mIoU": "IoU"}  # what a group of classes is called by, and what it averages


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
        return {name: plain_json(getattr(self, name)) for name in names.split()}


def plain_json(value: Any) -> Any:
    """``value`` with NaN as None and tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain_json(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def form_result(
    rules: ProtocolRules,
    scenes: Sequence[str],
    counts: Sequence[Counts],
    *,
    coverage: Mapping[str, float],
    n_predictions: Mapping[str, int],
    warnings: Sequence[str],
    with_intervals: bool = True,
) -> ProtocolResult:
    """The result of ``scenes`` from their counts, in that order; ``intervals`` are None where they are not wanted."""
    curve = _curve(rules, counts) if rules.kind in CURVE_KINDS else None
    pooled = metric_values(rules, counts, pooled=True) if curve is None else _ap_values(curve)
    per_scene = dict(zip(scenes, _scene_values(rules, counts), strict=True))
    scene_mean = _scene_mean(per_scene.values())
    per_class = _class_values(rules, counts, curve)
    rows = list(per_scene.values())
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(rules.headline)
    if with_intervals and len(scenes) > 1:
        resampled = resampled_metrics(rules, counts, rows, resample_weights(len(scenes)))
        intervals = {key: percentile_interval(resampled[key]) for key in rules.headline}
    return ProtocolResult(
        protocol=rules.name,
        version=rules.version,
        headline=rules.headline,
        scenes=tuple(scenes),
        metrics=pooled if rules.aggregate == "pooled" else scene_mean,
        pooled=pooled,
        scene_mean=scene_mean,
        intervals=intervals,
        per_scene=per_scene,
        per_class=per_class,
        groups=_group_values(rules, curve, per_class),
        coverage=coverage,
        n_predictions=n_predictions,
        warnings=(*warnings, *_warnings(rules, counts)),
    )


def reported_values(rules: ProtocolRules, counts: Sequence[Counts]) -> Mapping[str, float]:
    """``ProtocolResult.metrics`` alone."""
    if rules.aggregate == "pooled":
        return metric_values(rules, counts, pooled=True)
    return _scene_mean(_scene_values(rules, counts))


def _scene_mean(rows: Collection[Mapping[str, float]]) -> dict[str, float]:
    return {key: semantic.nan_mean(np.array([row[key] for row in rows])) for key in next(iter(rows))}


def _scene_values(rules: ProtocolRules, counts: Sequence[Counts]) -> list[dict[str, float]]:
    """The metrics of each scene alone."""
    if rules.kind in CURVE_KINDS:
        each = instance_ap.combine_each(cast("Sequence[instance_ap.InstanceCounts]", counts), rules.thresholds)
        return [_ap_values(ap) for ap in each]
    return [metric_values(rules, [count], pooled=False) for count in counts]


def _curve(rules: ProtocolRules, counts: Sequence[Counts]) -> instance_ap.InstanceAP:
    return instance_ap.combine(cast("Sequence[instance_ap.InstanceCounts]", counts), rules.thresholds)


def _ap_values(ap: instance_ap.InstanceAP) -> dict[str, float]:
    return {"AP": ap.ap, "AP50": ap.ap50, "AP25": ap.ap25}


def metric_values(rules: ProtocolRules, counts: Sequence[Counts], *, pooled: bool) -> dict[str, float]:
    """The protocol's metrics of the scenes together.

    ConceptGraphs' rows differ: the pooled one averages over the classes that have scored points, that of a scene over
    the classes that its ground truth contains.
    """
    if rules.kind in CURVE_KINDS:
        return _ap_values(_curve(rules, counts))
    if rules.kind == "categories":
        means = object_means.combine(cast("Sequence[object_means.ObjectCounts]", counts))
        return dict(zip(VALUES_OF_METRIC[rules.metric], means.tolist(), strict=True))
    if rules.kind in SHARE_KINDS:
        return _share_values(rules, shares.combine(cast("Sequence[shares.ShareCounts]", counts)))
    metrics = _semantic_metrics(rules, counts, pooled=pooled)
    return {
        "mAcc": metrics.mean_accuracy,
        "mIoU": metrics.mean_iou,
        "F-mIoU": metrics.frequency_weighted_iou,
        **({"pAcc": metrics.point_accuracy} if rules.metric == "hovsg" else {}),
        "mPrecision": metrics.mean_precision,
        "mF1": metrics.mean_f1,
        "mF1-conceptgraphs": metrics.mean_f1_conceptgraphs,
        "n_classes": len(metrics.class_index),
        **{f"n_IoU>{level:.2f}": n for level, n in zip(semantic.IOU_LEVELS, metrics.n_classes_above, strict=True)},
    }


def _share_values(rules: ProtocolRules, counts: shares.ShareCounts) -> dict[str, float]:
    """The share of right judgements under each value's name, and how many there were under ``n_<name>``."""
    names = VALUES_OF_METRIC[rules.metric]
    n_judged = {f"n_{name}": n for name, n in zip(names, counts.n_judged.tolist(), strict=True)}
    return dict(zip(names, shares.shares(counts).tolist(), strict=True)) | n_judged


def _semantic_metrics(rules: ProtocolRules, counts: Sequence[Counts], *, pooled: bool) -> semantic.SemanticMetrics:
    whole = semantic.concatenate(cast("Sequence[semantic.SemanticCounts]", counts))
    if rules.metric == "hovsg":
        return semantic.hovsg_metrics(whole.confusion, scored_classes(rules))
    if rules.metric == "scannet":
        scored = np.flatnonzero(scored_classes(rules))
        return semantic.scannet_metrics(_keep_columns(whole.confusion, scored)[scored])
    has_points = whole.confusion.sum(axis=1) > 0
    keep = np.flatnonzero(has_points if pooled else whole.is_present)
    confusion = whole.confusion.copy()
    if pooled:
        # Of a class that a ground-truth cloud has and no scored point, the original slices away what was called so
        confusion[:, np.flatnonzero(whole.is_present & ~has_points)] = 0
    folded = np.zeros_like(confusion)
    folded[:, [*keep, -1]] = _keep_columns(confusion, keep)
    return semantic.conceptgraphs_metrics(folded, keep)


def _keep_columns(confusion: Int64Array, keep: Int64Array) -> Int64Array:
    """The columns ``keep`` and a last one with all others: a point called anything else is called wrongly."""
    n_elsewhere = confusion.sum(axis=1) - confusion[:, keep].sum(axis=1)
    return np.concatenate([confusion[:, keep], n_elsewhere[:, None]], axis=1)


def _class_values(
    rules: ProtocolRules, counts: Sequence[Counts], curve: instance_ap.InstanceAP | None
) -> dict[str, dict[str, float]]:
    if rules.kind == "categories" or rules.kind in SHARE_KINDS:
        return {}
    if curve is not None:
        of_class = [dict(zip(AP_NAMES, curve.of_class(index), strict=True)) for index in range(len(rules.curve_names))]
        return dict(zip(rules.curve_names, of_class, strict=True))
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


def _group_values(
    rules: ProtocolRules, curve: instance_ap.InstanceAP | None, per_class: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """The mean of each group over those of its classes that have a value, all scenes pooled."""
    names = list(dict.fromkeys(entry.group for entry in rules.scored if entry.group))
    if rules.class_agnostic is not None or not names:
        return {}
    if rules.kind == "instance" and curve is not None:
        members = {name: [i for i, entry in enumerate(rules.scored) if entry.group == name] for name in names}
        return {name: dict(zip(AP_NAMES, curve.of_group(members[name]), strict=True)) for name in names}
    rows = {name: [per_class.get(entry.name, {}) for entry in rules.scored if entry.group == name] for name in names}
    return {
        name: {
            shown: semantic.nan_mean(np.array([row.get(column, np.nan) for row in rows[name]]))
            for shown, column in GROUP_COLUMNS.items()
        }
        for name in names
    }


def resampled_metrics(
    rules: ProtocolRules, counts: Sequence[Counts], rows: Sequence[Mapping[str, float]], weights: Int64Array
) -> dict[str, Float64Array]:
    """Each headline metric (R,) of the scenes drawn ``weights`` (R, S) times, pooled or as the mean over scenes.

    ``rows`` hold the metrics of each scene alone, from which the mean over scenes is formed. With weights of ones this
    is the value over all scenes, with a single one that of a scene alone.
    """
    if rules.aggregate == "scene-mean":
        return {name: _weighted_mean(np.array([row[name] for row in rows]), weights) for name in rules.headline}
    if rules.kind in CURVE_KINDS:
        instances = cast("Sequence[instance_ap.InstanceCounts]", counts)
        pooled = resampling.resampled_ap(instances, weights, rules.thresholds)
    elif rules.kind == "categories":
        values = object_means.resampled(cast("Sequence[object_means.ObjectCounts]", counts), weights)
        pooled = dict(zip(VALUES_OF_METRIC[rules.metric], values.T, strict=True))
    elif rules.kind in SHARE_KINDS:
        values = shares.resampled(cast("Sequence[shares.ShareCounts]", counts), weights)
        pooled = dict(zip(VALUES_OF_METRIC[rules.metric], values.T, strict=True))
    else:
        confusions = cast("Sequence[semantic.SemanticCounts]", counts)
        is_scored = scored_classes(rules) if rules.metric == "hovsg" else None
        pooled = resampling.resampled_semantic(confusions, weights, rules.metric, is_scored)
    return {name: pooled[name] for name in rules.headline}


def _weighted_mean(values: Float64Array, weights: Int64Array) -> Float64Array:
    is_number = ~np.isnan(values)
    drawn = weights[:, is_number].astype(np.float64)
    n = drawn.sum(axis=1)
    return np.where(n > 0, (drawn * values[is_number]).sum(axis=1) / np.maximum(n, 1), np.nan)


def _warnings(rules: ProtocolRules, counts: Sequence[Counts]) -> list[str]:
    if rules.kind not in CURVE_KINDS:
        return []
    whole = instance_ap.concatenate(cast("Sequence[instance_ap.InstanceCounts]", counts))
    small = np.flatnonzero((whole.n_truth == 0) & (whole.n_small_truth > 0))
    if not len(small):
        return []
    names = ", ".join(f"'{rules.curve_names[index]}'" for index in small)
    return [f"not scored, because no scene has an instance of {rules.min_region_size} points: {names}"]
