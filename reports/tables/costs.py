"""Cost and quality: the scores of methods beside their time per frame, memory and map size, one table per machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Table, TableRow
from su3d_bench.metrics.costs import pareto_front
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import Shown, cells_of, labels_of, units

RATE, TIME = "rate_hz", "frame_s"
COSTS = {RATE: "rate (Hz)", TIME: "s per frame", "map_s": "s without perception", "peak_mib": "peak MiB"}
COSTS |= {"gpu_mib": "GPU MiB", "saved_mib": "saved map, MiB", "n_points": "points", "n_instances": "instances"}
NOTES = (
    "Rate: frames that arrive per second in real time; -: each frame waits for the method. Times: medians of an update "
    "without reading the frame; all other costs: the largest of the scenes. Bold: no other row has a higher first "
    "metric at this cost or less. Rows of other machines, rules or scenes are in tables of their own.",
    "s per frame is missing where perception may be read from files; run with --set perception.cache=false",
)


@dataclass(frozen=True)
class CostRow:
    """A method of a run under one protocol: its ``score``, and its ``costs`` by the keys of ``COSTS``, None if unknown.

    ``machine``: where the costs were measured; ``data``: rules and data of the score. Only rows that agree in both are
    compared.
    """

    score: Measured
    machine: str
    data: str
    costs: Mapping[str, float | None]


def comparable_rows(rows: Sequence[CostRow]) -> list[list[CostRow]]:
    """Return the rows of each table or figure; methods in order, each by rising rate."""
    methods = [row.score.method for row in rows]
    groups: dict[tuple[str, str], list[CostRow]] = {}
    for row in sorted(rows, key=lambda row: (methods.index(row.score.method), row.costs[RATE] or float("inf"))):
        groups.setdefault((row.data, row.machine), []).append(row)
    return list(groups.values())


def points_of(rows: Sequence[CostRow], cost: str) -> list[tuple[float, float, CostRow]]:
    """Return the cost, the first headline metric in per cent, and the row, where both are known."""
    points = [(row.costs[cost], row.score.metrics.get(row.score.headline[0]), row) for row in rows]
    return [(x, 100 * y, row) for x, y, row in points if x is not None and y is not None]


def front_of(rows: Sequence[CostRow], cost: str) -> list[tuple[float, float, CostRow]]:
    """Return the Pareto front of the points, by rising cost."""
    points = points_of(rows, cost)
    return [points[k] for k in pareto_front([x for x, _, _ in points], [y for _, y, _ in points])]


def cost_tables(rows: Sequence[CostRow]) -> list[Table]:
    """Return one table per machine, protocol and set of scenes."""
    return [_table(number, group) for number, group in enumerate(comparable_rows(rows), 1)]


def _table(number: int, rows: Sequence[CostRow]) -> Table:
    scores = [row.score for row in rows]
    shown = Shown(metrics=scores[0].headline, intervals=True)
    costs = [cost for cost in COSTS if cost == RATE or any(row.costs[cost] is not None for row in rows)]
    best = {(cost, id(row)) for cost in costs if cost != RATE for _, _, row in front_of(rows, cost)}
    body = []
    for row, label in zip(rows, labels_of(scores), strict=True):
        rate, *cells = [Cell(cost_text(row.costs[cost]), is_best=(cost, id(row)) in best) for cost in costs]
        body.append(TableRow(label, (rate, *cells_of(row.score, shown, set()), *cells), group=row.score.method))
    columns = (COSTS[RATE], *shown.metrics, *(COSTS[cost] for cost in costs[1:]))
    is_untimed = any(row.costs["peak_mib"] and row.costs[TIME] is None for row in rows)
    notes = (units(scores[0], shown), *NOTES[: 1 + is_untimed])
    caption = f": {scores[0].protocol} on {rows[0].machine}."
    return Table(f"costs-{number}", caption, "method", columns, tuple(body), notes, "Cost and quality")


def cost_text(value: float | None) -> str:
    """Return three significant digits, or all before the point; ``-`` for None."""
    return NOT_MEASURED if value is None else f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def cost_values(rows: Sequence[CostRow]) -> list[dict[str, Any]]:
    """Return one entry per row and headline metric, in full precision; metrics are fractions."""
    values = []
    for row, metric in [(each, metric) for each in rows for metric in each.score.headline]:
        about = {name: getattr(row.score, name) for name in ("run", "method", "protocol", "version")}
        low, high = row.score.intervals.get(metric) or (None, None)
        value = {"metric": metric, "value": row.score.metrics.get(metric), "low": low, "high": high}
        values.append({**about, "machine": row.machine, "data": row.data, **value, **row.costs})
    return values
