"""Cost and quality: the scores of methods beside their time per frame, memory and map size, one table per machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Table, TableRow, csv_lines
from su3d_bench.metrics.costs import pareto_front
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import Shown, cells_of, labels_of, units

MIB = 2**20
# Title and unit of each cost.
COSTS: Mapping[str, tuple[str, float]] = {
    "frame_s": ("s per frame", 1),
    "map_s": ("s without perception", 1),
    "peak_rss_bytes": ("peak MiB", MIB),
    "device_bytes": ("GPU MiB", MIB),
    "saved_bytes": ("saved map, MiB", MIB),
    "n_points": ("points", 1),
    "n_instances": ("instances", 1),
}
NOTES = (
    "Hz: frames that arrive per second in real time; -: every frame waits for the method. Times: medians of an update "
    "without reading the frame; all other costs: the largest of the scenes. Bold: no other row has a higher first score "
    "at this cost or less. Rows of other machines, rules or scenes are in tables of their own."
)
NOT_TIMED = "s per frame is missing where perception may be read from files; run with --set perception.cache=false"


@dataclass(frozen=True)
class CostRow:
    """A method of a run under one protocol: its ``score``, and its ``costs`` by the names of ``COSTS``, None if unknown.

    ``machine``: where the costs were measured; ``data``: rules and data of the score. Only rows that agree in both are
    compared. ``rate_hz``: frames that arrive per second, None if every frame waits for the method.
    """

    score: Measured
    machine: str
    data: str
    rate_hz: float | None
    costs: Mapping[str, float | None]

    @property
    def quality(self) -> float | None:
        """The first headline metric."""
        return self.score.metrics.get(self.score.headline[0])


def comparable_rows(rows: Sequence[CostRow]) -> list[list[CostRow]]:
    """Return the rows of each table or figure; methods in order, each by rising rate."""
    groups: dict[tuple[str, str], list[CostRow]] = {}
    for row in rows:
        groups.setdefault((row.data, row.machine), []).append(row)
    methods = list(dict.fromkeys(row.score.method for row in rows))
    order = {method: k for k, method in enumerate(methods)}
    return [
        sorted(group, key=lambda row: (order[row.score.method], row.rate_hz or float("inf")))
        for group in groups.values()
    ]


def names_of(rows: Sequence[CostRow]) -> list[str]:
    """Return the names of the methods, with the run's name if a method occurs twice at the same rate."""
    pairs = {(row.score.method, row.rate_hz) for row in rows}
    return [row.score.method for row in rows] if len(pairs) == len(rows) else labels_of([row.score for row in rows])


def front_of(rows: Sequence[CostRow], cost: str) -> list[CostRow]:
    """Return the rows, by rising ``cost``, that no other row surpasses; those that use ground truth do not count."""
    rivals = [row for row in rows if None not in (row.costs[cost], row.quality) and not row.score.is_ceiling]
    front = pareto_front([row.costs[cost] or 0.0 for row in rivals], [row.quality or 0.0 for row in rivals])
    return [rivals[k] for k in front]


def cost_tables(rows: Sequence[CostRow]) -> list[Table]:
    """Return one table per machine, protocol and set of scenes."""
    return [_table(number, group) for number, group in enumerate(comparable_rows(rows), 1)]


def _table(number: int, rows: Sequence[CostRow]) -> Table:
    first = rows[0].score
    shown = Shown(metrics=first.headline, intervals=True)
    costs = [cost for cost in COSTS if any(row.costs[cost] is not None for row in rows)]
    best = {cost: {id(row) for row in front_of(rows, cost)} for cost in costs}
    body = []
    for row, name in zip(rows, names_of(rows), strict=True):
        rate = Cell(NOT_MEASURED if row.rate_hz is None else f"{row.rate_hz:g}")
        cells = [Cell(_number(row.costs[cost], cost), is_best=id(row) in best[cost]) for cost in costs]
        body.append(TableRow(name, (rate, *cells_of(row.score, shown, set()), *cells), group=row.score.method))
    caption = f": {first.protocol} on {rows[0].machine}."
    columns = ("Hz", *first.headline, *(COSTS[cost][0] for cost in costs))
    notes = [units(first, shown), NOTES, *([NOT_TIMED] if any(row.costs["frame_s"] is None for row in rows) else [])]
    return Table(f"costs-{number}", caption, "method", columns, tuple(body), tuple(notes), "Cost and quality")


def _number(value: float | None, cost: str) -> str:
    if value is None:
        return NOT_MEASURED
    amount = value / COSTS[cost][1]
    return f"{amount:,.0f}" if amount >= 100 else f"{amount:.3g}"


def cost_values(rows: Sequence[CostRow]) -> list[dict[str, Any]]:
    """Return one entry per row and headline metric, in full precision: fractions, seconds, bytes."""
    return [
        {
            **{name: getattr(row.score, name) for name in ("run", "method", "protocol", "version")},
            **{"machine": row.machine, "rate_hz": row.rate_hz, "metric": metric},
            **{"value": row.score.metrics.get(metric), "interval": row.score.intervals.get(metric), **row.costs},
        }
        for row in rows
        for metric in row.score.headline
    ]


def costs_csv(rows: Sequence[CostRow]) -> str:
    """Return ``cost_values`` as CSV, the interval in two columns."""
    entries = [
        {k: v for k, v in one.items() if k != "interval"} | dict(zip(("low", "high"), one["interval"] or ("", "")))
        for one in cost_values(rows)
    ]
    blank = [["" if value is None else value for value in one.values()] for one in entries]
    return csv_lines([[*entries[0]], *blank]) if entries else ""
