"""Numbers of a run in the short form in which its page holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.costs import MAP, TOTAL, MethodSummary, StageSummary, UpdateTimes
from su3d_bench.numerics.statistics import Growth

MOST_BINS = 160  # points of a line: more than a plot has room for
DIGITS = 4  # of a time


def confusion_cells(confusion: Int64Array) -> list[list[int]]:
    """Rows (true class, predicted class, points) of what is not 0; a predicted class -1 is none of the classes.

    >>> confusion_cells(np.array([[3, 0, 1], [0, 2, 0]]))
    [[0, 0, 3], [0, -1, 1], [1, 1, 2]]
    """
    n_classes = len(confusion)
    return [
        [int(true), int(called) if called < n_classes else -1, int(confusion[true, called])]
        for true, called in np.argwhere(confusion)
    ]


def series_of(times: UpdateTimes) -> dict[str, Any]:
    """The course of a scene's updates as means of ``per`` updates each, in ms, with the map's points where known."""
    per = max(1, -(-len(times) // MOST_BINS))
    series: dict[str, Any] = {"per": per, "n": len(times)}
    series |= {stage: _binned(times.ms(stage), per) for stage in (TOTAL, MAP)}
    if "n_points" in times.columns:
        series["points"] = [int(value) for value in _binned(times.columns["n_points"], per)]
    return series


def _binned(values: Float64Array, per: int) -> list[float]:
    starts = np.arange(0, len(values), per)
    sums = np.add.reduceat(values, starts) if len(values) else values
    sizes = np.diff(np.append(starts, len(values)))
    return [short(value) for value in sums / sizes]


def short(value: float) -> float:
    """``value`` with ``DIGITS`` digits, which is more than a plot or a table shows.

    >>> short(12.34567)
    12.35
    """
    return float(f"{value:.{DIGITS}g}")


def summary_data(summary: MethodSummary) -> dict[str, Any]:
    """A method's costs; times in ms, null where nothing was measured."""
    shown = {name: value for name, value in vars(summary).items() if name not in ("run", "frames_per_s")}
    numbers = {name: _number(value) if isinstance(value, float) else value for name, value in shown.items()}
    return numbers | {"stages": [_stage_data(stage) for stage in summary.stages]}


def _stage_data(stage: StageSummary) -> dict[str, Any]:
    numbers: Mapping[str, float] = {"first": stage.first, "p50": stage.p50, "p95": stage.p95, "max": stage.worst}
    return {
        "name": stage.name,
        **{name: _number(value) for name, value in numbers.items()},
        "share": _number(stage.share),
        "by_points": _growth_data(stage.against_points),
        "by_updates": _growth_data(stage.against_frames),
    }


def _growth_data(growth: Growth | None) -> dict[str, Any] | None:
    return None if growth is None else {**asdict(growth), "words": growth.words}


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else short(value)
