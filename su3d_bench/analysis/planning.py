"""What a benchmark must hold to show a difference between two methods, from runs of both under one seed or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.sides import (
    OverScenes,
    Side,
    SideNumbers,
    protocols_in_both,
    refuse_other_requests,
)
from su3d_bench.core.errors import ConfigError, counted, printable
from su3d_bench.core.types import BoolArray, Float64Array, Interval
from su3d_bench.metrics.scoring import plain_json
from su3d_bench.numerics.statistics import (
    NO_SPREAD,
    POWER,
    Variance,
    crossed_interval,
    has_part,
    pseudo_values,
    scenes_needed,
    variance_of,
    variance_range,
)
from su3d_bench.runs.finished import FinishedRun, read_run

SCHEMA = 1
SEEDS = (1, 2, 3, 5, 10)  # of which the scenes are told, where runs of several seeds say what these move


@dataclass(frozen=True)
class Need:
    """The scenes, each under ``n_seeds`` seeds, that find a difference of ``points`` per cent; None: no number does.

    ``low`` and ``high``: what it would be at the ends of the 95 % interval of the variance.
    """

    points: float
    n_seeds: int
    n_scenes: int | None
    low: int | None
    high: int | None


@dataclass(frozen=True)
class MetricPlan:
    """One metric: the ``difference`` of the second method less the first, as a fraction, with its ``interval`` over the
    scenes and seeds that were run, how it varies, and what is needed; no variance where nothing varies, or too few
    scenes count."""

    difference: float
    interval: Interval | None
    variance: Variance | None
    needs: tuple[Need, ...]


@dataclass(frozen=True)
class Plan:
    """``protocols``: protocol -> metric -> plan; ``seeds`` are those of the runs."""

    left: str
    right: str
    runs: tuple[str, ...]
    seeds: tuple[int, ...]
    scenes: tuple[str, ...]
    power: float
    protocols: Mapping[str, Mapping[str, MetricPlan]]
    remarks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain values in full precision, null where undefined."""
        return {"schema": SCHEMA, **plain_json(asdict(self))}


def plan(
    runs: Sequence[Path],
    methods: Sequence[str] = (),
    *,
    points: Sequence[float],
    protocols: Sequence[str] = (),
    power: float = POWER,
) -> Plan:
    """What shows differences of ``points`` per cent between two methods, from ``runs`` that differ in their seed alone.

    Without ``methods`` the runs' only two. Raises ``ConfigError`` where the runs do not belong together, hold one seed
    twice, or too little to tell how differences vary.
    """
    _check_request(points, power)
    read = [read_run(path) for path in dict.fromkeys(runs)]
    pair = _two_methods(read[0], methods)
    sides = [(Side(run, pair[0]), Side(run, pair[1])) for run in read]
    refuse_other_requests(read, set(pair))
    numbers = SideNumbers()
    plans: dict[str, dict[str, MetricPlan]] = {}
    scenes: dict[str, None] = {}
    for name in protocols_in_both(*sides[0], protocols):
        over_scenes = _over_common_scenes(name, sides, numbers)
        scenes |= dict.fromkeys(over_scenes[0][0].result.scenes)
        plans[name] = {
            metric: _plan_metric(
                np.array([right.without_each[metric] - left.without_each[metric] for left, right in over_scenes]),
                np.array([right.of_scenes(metric) - left.of_scenes(metric) for left, right in over_scenes]),
                points,
                power,
            )
            for metric in sides[0][0].run.rules(name).headline
        }
    seeds = tuple(run.record.seed or 0 for run in read)
    remarks = tuple(dict.fromkeys(line for run in read for line in run.elsewhere_lines()))
    return Plan(*pair, tuple(run.name for run in read), seeds, tuple(scenes), power, plans, remarks)


def _over_common_scenes(
    protocol: str, sides: Sequence[tuple[Side, Side]], numbers: SideNumbers
) -> list[tuple[OverScenes, OverScenes]]:
    """What the two methods of each run come to over the scenes that all have."""
    found = numbers.over_common(protocol, [side for of_run in sides for side in of_run])
    n_scenes = len(found[0].result.scenes) if found else 0
    if n_scenes < 2:
        raise ConfigError(
            f"{sides[0][0].run.name}: {counted(n_scenes, 'scene')} {'is' if n_scenes == 1 else 'are'} scored under "
            f"{protocol} for both methods in every run; at least two tell how a difference varies"
        )
    return list(zip(found[::2], found[1::2], strict=True))


def _check_request(points: Sequence[float], power: float) -> None:
    for value in points:
        if not 0 < value <= 100:
            raise ConfigError(f"--points {value:g}: expected per cent above 0 and at most 100")
    if not 0.05 < power < 1:
        raise ConfigError(f"--power {power:g}: expected a probability above 0.05 and below 1, such as 0.8")


def _two_methods(run: FinishedRun, methods: Sequence[str]) -> tuple[str, str]:
    chosen = list(methods) or list(run.methods)
    if len(chosen) != 2 or chosen[0] == chosen[1]:
        known = ", ".join(printable(name, 80) for name in run.methods)
        raise ConfigError(f"{run.name}: a difference is of two methods; name them with --methods A B (it has {known})")
    return chosen[0], chosen[1]


def _plan_metric(
    without_each: Float64Array, of_scenes: Float64Array, points: Sequence[float], power: float
) -> MetricPlan:
    """``without_each`` (R, 1 + G) of each run's difference, ``of_scenes`` (R, S) that of each scene alone."""
    rows = list(zip(without_each, ~np.isnan(of_scenes), strict=True))
    is_part: BoolArray = np.asarray(np.any([has_part(*row) for row in rows], axis=0))
    pseudo = np.array([pseudo_values(values, is_part) for values, _ in rows])
    difference = float(without_each[:, 0].mean())
    if pseudo.shape[1] < 2 or not np.isfinite(pseudo).all():
        return MetricPlan(difference, None, None, ())
    variance = variance_of(pseudo)
    if variance.error(*pseudo.shape[::-1])[0] <= NO_SPREAD:
        return MetricPlan(difference, None, None, ())
    seeds = (1,) if variance.of_seeds is None else SEEDS
    least, most = variance_range(variance)
    needs = tuple(
        Need(value, n_seeds, *(scenes_needed(one, value / 100.0, n_seeds, power) for one in (variance, least, most)))
        for n_seeds in seeds
        for value in points
    )
    return MetricPlan(difference, crossed_interval(difference, variance), variance, needs)
