"""What the sides of a comparison come to over scenes, and over seeds where a side is several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.analysis.sides import Side
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import ProtocolResult, combine, metric_of
from su3d_bench.numerics.statistics import leave_one_out


class SideNumbers:
    """What sides give, made once for all pairs that they are in."""

    def __init__(self) -> None:
        self._scores: dict[tuple[Path, str], dict[str, dict[str, SceneScore]]] = {}
        self._over_scenes: dict[tuple[Path, str, str, tuple[str, ...]], OverScenes] = {}

    def scores(self, side: Side) -> dict[str, dict[str, SceneScore]]:
        """Protocol -> scene -> counts."""
        key = side.run.folder.path, side.method
        if key not in self._scores:
            self._scores[key] = side.run.scores(side.method)
        return self._scores[key]

    def over_scenes(self, rules: ProtocolRules, side: Side, scores: Mapping[str, SceneScore]) -> OverScenes:
        """The numbers over the scenes of ``scores``, and without each of them."""
        key = side.run.folder.path, side.method, rules.name, tuple(scores)
        if key not in self._over_scenes:
            result = combine(rules, scores, with_intervals=False)
            counts = [scores[scene].counts for scene in result.scenes]
            rows = [result.per_scene[scene] for scene in result.scenes]
            without_each = metric_of(rules).resampled_headline(counts, rows, leave_one_out(len(rows)))
            self._over_scenes[key] = OverScenes(result, counts, without_each)
        return self._over_scenes[key]


@dataclass(frozen=True)
class OverScenes:
    """``without_each``: each headline metric (1 + G,) over all scenes, then without each in turn."""

    result: ProtocolResult
    counts: Sequence[Counts]
    without_each: Mapping[str, Float64Array]

    def of_scenes(self, metric: str) -> Float64Array:
        """The metric (S,) of each scene alone, NaN where undefined."""
        return np.array([self.result.per_scene[scene][metric] for scene in self.result.scenes], np.float64)


@dataclass(frozen=True)
class Numbers:
    """A value of a side: over all scenes, of each scene alone (S,), and over all but each in turn (1 + G,).

    Of several runs it is their mean, and ``deviation_of_seeds`` how far a single run's value over all scenes lies from
    it, as a standard deviation; None of one run.
    """

    value: float
    of_scenes: Float64Array
    without_each: Float64Array
    deviation_of_seeds: float | None


def over_seeds(
    values: Sequence[float], of_scenes: Sequence[Float64Array], without_each: Sequence[Float64Array]
) -> Numbers:
    """The mean over runs, of which each sequence has an entry; undefined where it is undefined in one.

    >>> alone, left_out = np.array([0.4, 0.6]), np.array([0.5, 0.6, 0.4])
    >>> found = over_seeds([0.5, 0.7], [alone, alone + 0.2], [left_out, left_out + 0.2])
    >>> round(found.value, 3), found.of_scenes.round(3).tolist(), round(found.deviation_of_seeds, 3)
    (0.6, [0.5, 0.7], 0.141)
    """
    if len(values) == 1:
        return Numbers(values[0], of_scenes[0], without_each[0], None)
    deviation = float(np.std(values, ddof=1))
    return Numbers(float(np.mean(values)), np.mean(of_scenes, axis=0), np.mean(without_each, axis=0), deviation)


def headline_numbers(side: Sequence[OverScenes], metric: str) -> Numbers:
    """A headline metric of the runs of a side."""
    return over_seeds(
        [of_run.result.metrics[metric] for of_run in side],
        [of_run.of_scenes(metric) for of_run in side],
        [of_run.without_each[metric] for of_run in side],
    )


def class_numbers(rules: ProtocolRules, side: Sequence[OverScenes]) -> dict[tuple[str, str], Numbers]:
    """(class, column) -> the value of the runs of a side, of what all of them have."""
    metric = metric_of(rules)
    n_scenes = len(side[0].result.scenes)
    alone = np.eye(n_scenes, dtype=np.int64)
    without_each = [metric.resampled_classes(of_run.counts, leave_one_out(n_scenes)) for of_run in side]
    single = [metric.resampled_classes(of_run.counts, alone) for of_run in side]
    return {
        (name, column): over_seeds(
            [of_run.result.per_class[name][column] for of_run in side],
            [of_run[name][column] for of_run in single],
            [of_run[name][column] for of_run in without_each],
        )
        for name, columns in without_each[0].items()
        for column in columns
        if all(name in of_run for of_run in without_each)
    }
