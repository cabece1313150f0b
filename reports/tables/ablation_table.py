"""Table I: what single parameters of a method change, from a sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from su3d_bench.core.errors import ConfigError
from su3d_bench.reports.tables.measured import Measured
from su3d_bench.reports.tables.model import Cell, Table, TableRow
from su3d_bench.reports.tables.paper import LAYOUTS, Layout, Shown, best_rows, cells_of, reported_rows, run_notes, units
from su3d_bench.reports.tables.published import published

SIDES = (LAYOUTS["II"], LAYOUTS["III"])  # its columns are those of Tables II and III together
METRICS = tuple(name for side in SIDES for name in side.metrics)


@dataclass(frozen=True)
class SweepRow:
    """A value of a parameter, and the method of the run that has it."""

    parameter: str
    value: str
    method: str


def ablation_table(
    found: Sequence[Measured], sweep: Sequence[SweepRow], shown: Shown, *, with_published: bool
) -> Table:
    """A row for each of ``sweep``, the best of each parameter marked.

    Raises ``ConfigError`` where ``found`` lacks one of its methods, or a protocol of either kind.
    """
    sides = [_of_protocol(found, side) for side in SIDES]
    looks = [replace(shown, metrics=side.metrics, ceilings=False, scenes_count=False) for side in SIDES]
    rows: list[TableRow] = []
    notes: dict[str, None] = {}
    marks: dict[str, None] = {}
    for parameter in dict.fromkeys(one.parameter for one in sweep):
        members = [one for one in sweep if one.parameter == parameter]
        halves = [_cells(members, side, look, marks) for side, look in zip(sides, looks, strict=True)]
        rows += [
            TableRow(f"{parameter} = {one.value}", (*left, *right), group=parameter)
            for one, left, right in zip(members, *halves, strict=True)
        ]
    used = {one.method for one in sweep}
    for side, look in zip(sides, looks, strict=True):
        own = [one for method, one in side.items() if method in used]
        notes[f"{', '.join(look.metrics)}: {units(own[0], look)}"] = None
        labels = [one.method if one.is_whole else f"{one.method} ({one.scenes_text} scenes)" for one in own]
        notes |= dict.fromkeys(run_notes(own, labels))
    is_papers = with_published and sweep[0].method.partition("@")[0] == "opensu3d"
    figures = [figure for figure in published() if figure.table == "I"] if is_papers else []
    reported, sources = reported_rows(figures, METRICS, len(METRICS))
    body = (*rows, *map(_named, reported))
    return Table("I", "Ablation of single parameters.", "parameter", METRICS, body, (*notes, *marks, *sources))


def _of_protocol(found: Sequence[Measured], side: Layout) -> dict[str, Measured]:
    """Method -> its numbers under the protocol of that side's set-up, or the first that has its metrics."""
    fitting = [one for one in found if all(name in one.metrics for name in side.metrics)]
    if not fitting:
        raise ConfigError(f"Table I: needs {', '.join(side.metrics)}; score the sweep under {side.protocol} too")
    names = [one.protocol for one in fitting]
    chosen = side.protocol if side.protocol in names else names[0]
    members: dict[str, Measured] = {}
    for one in fitting:
        if one.protocol == chosen and members.setdefault(one.method, one) is not one:
            raise ConfigError(f"Table I: {one.method} is in {members[one.method].run} and {one.run}; name one of them")
    return members


def _cells(
    sweep: Sequence[SweepRow], side: Mapping[str, Measured], shown: Shown, marks: dict[str, None]
) -> list[list[Cell]]:
    """The cells of one parameter's rows; what must be said of the best of them is entered in ``marks``."""
    for one in sweep:
        if one.method not in side:
            raise ConfigError(
                f"Table I: no scores of {one.method} for {', '.join(shown.metrics)}; run the sweep again, it goes on "
                "where it stopped"
            )
    rows = [side[one.method] for one in sweep]
    best, why = best_rows(rows, shown)
    marks |= {why: None} if why else {}
    return [
        cells_of(row, shown, {name for name in shown.metrics if k in best.get(name, ())}) for k, row in enumerate(rows)
    ]


def _named(row: TableRow) -> TableRow:
    parameter, _, value = row.label.partition("=")
    return replace(row, label=f"{parameter} = {value}", group=parameter)
