"""From the additive counts of scenes to what is reported: pooled and scene-mean values, classes, intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.metrics.metric import Counts, Metric, scene_mean
from su3d_bench.numerics.statistics import percentile_interval, resample_weights


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
    """``value`` with None for what is no finite number, and tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def form_result(
    metric: Metric[Any],
    scenes: Sequence[str],
    counts: Sequence[Counts],
    *,
    coverage: Mapping[str, float],
    n_predictions: Mapping[str, int],
    warnings: Sequence[str],
    with_intervals: bool = True,
) -> ProtocolResult:
    """The result of ``scenes`` from their counts, in that order; ``intervals`` are None where they are not wanted."""
    rules = metric.rules
    pooled = metric.pooled(counts)
    rows = metric.combine_each(counts)
    mean = scene_mean(rows)
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(rules.headline)
    if with_intervals and len(scenes) > 1:
        resampled = metric.resampled_headline(counts, rows, resample_weights(len(scenes)))
        intervals = {key: percentile_interval(resampled[key]) for key in rules.headline}
    return ProtocolResult(
        protocol=rules.name,
        version=rules.version,
        headline=rules.headline,
        scenes=tuple(scenes),
        metrics=pooled.values if rules.aggregate == "pooled" else mean,
        pooled=pooled.values,
        scene_mean=mean,
        intervals=intervals,
        per_scene=dict(zip(scenes, rows, strict=True)),
        per_class=pooled.classes,
        groups=pooled.groups,
        coverage=coverage,
        n_predictions=n_predictions,
        warnings=(*warnings, *pooled.warnings),
    )
