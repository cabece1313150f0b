"""The largest error of each kind at which a method keeps a share of its clean score, by bisection over the severity.

Every step extends one run by one cell per method and corruption, so that the search is resumed and distributed as any
run. The interval is that of the jackknife over scenes: the crossing is found again without each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.analysis.sides import Numbers, Side, SideNumbers, headline_numbers
from su3d_bench.analysis.sweeps import cells_of
from su3d_bench.core.types import Float64Array, Interval
from su3d_bench.corruptions.apply import Cell, Condition
from su3d_bench.corruptions.model import MAX_SEVERITY, Corruption
from su3d_bench.numerics.statistics import jackknife_interval
from su3d_bench.runs.finished import FinishedRun

SHARE_KEPT = 0.95
N_STEPS = 6  # of the bisection: the severity is then known to 5 / 2^6


@dataclass(frozen=True)
class Tolerance:
    """The ``severity`` (0..5), and its ``value`` in the corruption's unit, at which ``method`` falls to the share kept.

    Of whole values (frames, pixels) it is the last one that keeps the share. ``interval`` of the value, None if scenes
    do not differ. ``is_beyond``: the share is kept at the highest severity that was measured, so that the value is a
    lower bound.
    """

    method: str
    corruption: Corruption
    severity: float
    value: float
    interval: Interval | None
    is_beyond: bool


Evaluate = Callable[[Sequence[Cell]], Mapping[Cell, Numbers]]


def find_tolerances(
    evaluate: Evaluate, methods: Sequence[str], corruptions: Sequence[Corruption], share: float = SHARE_KEPT
) -> list[Tolerance]:
    """The tolerance of each method to each corruption; ``evaluate`` returns numbers of cells over the same scenes."""
    pairs = [(method, corruption) for method in methods for corruption in corruptions]
    clean = evaluate([Cell(method, ()) for method in methods])
    curves: dict[tuple[str, str], dict[float, Numbers]] = {
        (method, corruption.address): {0.0: clean[Cell(method, ())]} for method, corruption in pairs
    }
    between = {(method, corruption.address): (0.0, float(MAX_SEVERITY)) for method, corruption in pairs}
    nexts = {key: float(MAX_SEVERITY) for key in between}
    for _ in range(N_STEPS + 1):
        if not nexts:  # all are kept at the highest severity
            break
        cells = {
            (method, corruption.address): Cell(method, (Condition(corruption, nexts[method, corruption.address]),))
            for method, corruption in pairs
            if (method, corruption.address) in nexts
        }
        found = evaluate(list(cells.values()))
        for key, cell in cells.items():
            severity, curve = nexts.pop(key), curves[key]
            curve[severity] = found[cell]
            is_kept = found[cell].value >= share * curve[0.0].value
            if is_kept and severity == MAX_SEVERITY:
                continue
            between[key] = (severity, between[key][1]) if is_kept else (between[key][0], severity)
            nexts[key] = sum(between[key]) / 2
    return [_tolerance(method, corruption, curves[method, corruption.address], share) for method, corruption in pairs]


def _tolerance(method: str, corruption: Corruption, curve: Mapping[float, Numbers], share: float) -> Tolerance:
    values = np.array([curve[severity].without_each for severity in sorted(curve)])  # (K, 1 + G)
    severities = np.array([corruption.applied(severity) for severity in sorted(curve)])
    crossings = np.array([crossing(severities, column, share) for column in values.T])
    highest = float(severities[-1])
    interval = jackknife_interval(crossings, bounds=(0.0, highest))
    severity = float(crossings[0])
    ends = sorted(map(corruption.value_within, interval or ()))
    return Tolerance(
        method, corruption, severity, corruption.value_within(severity),
        (ends[0], ends[1]) if ends else None, severity >= highest,
    )  # fmt: skip


def crossing(severities: Float64Array, values: Float64Array, share: float) -> float:
    """The first severity at which ``values``, linear between ``severities`` from 0, fall below ``share`` of the first.

    >>> crossing(np.array([0.0, 2.0, 5.0]), np.array([0.8, 0.8, 0.5]), 0.75)
    4.0
    """
    limit = share * values[0]
    below = np.flatnonzero(values < limit)
    if not len(below):
        return float(severities[-1])
    k = int(below[0])
    part = (values[k - 1] - limit) / (values[k - 1] - values[k])
    return float(severities[k - 1] + part * (severities[k] - severities[k - 1]))


def numbers_of(run: FinishedRun, protocol: str, metric: str, cells: Sequence[Cell]) -> dict[Cell, Numbers]:
    """The numbers of cells of a finished run over the scenes that all have."""
    sides = [Side(run, cell.name) for cell in cells]
    found = SideNumbers().over_common(protocol, sides)
    return {cell: headline_numbers([one], metric) for cell, one in zip(cells, found, strict=True)}


def swept_tolerances(run: FinishedRun, protocol: str, metric: str, share: float = SHARE_KEPT) -> list[Tolerance]:
    """The tolerances between the severities that a sweep has, without a search; not of pairs of corruptions."""
    found = []
    for method, cells in cells_of(run.methods).items():
        if run.results[method, protocol].result is None:
            continue
        numbers = numbers_of(run, protocol, metric, [Cell(method, ()), *cells])
        curves: dict[str, tuple[Corruption, dict[float, Numbers]]] = {}
        for (condition,) in (cell.conditions for cell in cells if len(cell.conditions) == 1):
            row = condition.corruption
            _, curve = curves.setdefault(row.address, (row, {0.0: numbers[Cell(method, ())]}))
            curve[condition.severity] = numbers[Cell(method, (condition,))]
        found += [_tolerance(method, row, curve, share) for row, curve in curves.values()]
    return found
