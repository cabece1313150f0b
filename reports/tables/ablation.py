"""Table I of OpenSU3D's paper: a sweep over single parameters, each value compared with the default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from su3d_bench.core.errors import ConfigError, counted
from su3d_bench.core.registry import base_name
from su3d_bench.formats.tables.table import Cell, Table, TableRow, signed
from su3d_bench.numerics.statistics import holm, sign_flip_test
from su3d_bench.reports.tables import paper
from su3d_bench.reports.tables.model import Measured

# Table I: all of it in OpenMask3D's set-up, as the paper's text has it.
SIDES = (paper.Layout(paper.LAYOUTS["II"].metrics, "replica-openmask3d-semantic"), paper.LAYOUTS["III"])
METRICS = tuple(name for side in SIDES for name in side.metrics)


@dataclass(frozen=True)
class SweepRow:
    """A requested value of a parameter, and the method of the run with that value.

    ``is_default``: whether it is the method's default.
    """

    parameter: str
    value: str
    method: str
    is_default: bool = False


def ablation_table(
    measured: Sequence[Measured], sweep: Sequence[SweepRow], shown: paper.Shown, *, with_published: bool
) -> Table:
    """Return a row for each of ``sweep``; each number is followed by its difference from the default row.

    Raises ``ConfigError`` if ``measured`` lacks one of its methods, or a protocol of either kind.
    """
    parameters = dict.fromkeys(row.parameter for row in sweep)
    sweep = [row for parameter in parameters for row in sweep if row.parameter == parameter]
    sides = [_of_protocol(measured, side) for side in SIDES]
    for side, members in zip(SIDES, sides, strict=True):
        if missing := [entry.method for entry in sweep if entry.method not in members]:
            raise ConfigError(
                f"Table I: no scores of {missing[0]} for {', '.join(side.metrics)}; run the sweep again to resume it"
            )
    looks = [replace(shown, metrics=side.metrics, ceilings=False, scenes_count=False) for side in SIDES]
    halves = [_half(sweep, members, look) for members, look in zip(sides, looks, strict=True)]
    rows = [
        TableRow(f"{member.parameter} = {member.value}", (*left, *right), group=member.parameter)
        for member, left, right in zip(sweep, *(half.cells for half in halves), strict=True)
    ]
    used = [[side[name] for name in dict.fromkeys(row.method for row in sweep)] for side in sides]
    notes: dict[str, None] = {}
    for own, look in zip(used, looks, strict=True):
        notes[f"{', '.join(look.metrics)}: {paper.units(own[0], look)}"] = None
        labels = [row.method if row.is_whole else f"{row.method} ({row.scenes_text} scenes)" for row in own]
        notes |= dict.fromkeys(paper.run_notes(own, labels))
    notes |= dict.fromkeys(note for half in halves for note in half.notes)
    is_papers = with_published and base_name(sweep[0].method) == "opensu3d"
    figures = paper.figures_of(is_wanted=is_papers, table="I")
    reported, sources = paper.reported_rows(figures, METRICS, len(METRICS))
    protocols = dict.fromkeys(rows_of[0].protocol for rows_of in used)
    is_its_protocol = tuple(protocols) == tuple(side.protocol for side in SIDES)
    setup = paper.other_setup([row for rows_of in used for row in rows_of], is_its_protocol=is_its_protocol)
    caption = f"Ablation of single parameters on {used[0][0].datasets}, {' and '.join(protocols)}{setup}."
    return Table("I", caption, "parameter", METRICS, (*rows, *map(_named, reported)), (*notes, *sources))


def _of_protocol(measured: Sequence[Measured], side: paper.Layout) -> dict[str, Measured]:
    """Method -> its numbers under the protocol of that side, otherwise under the first protocol with the metrics."""
    fitting = [row for row in measured if all(name in row.metrics for name in side.metrics)]
    if not fitting:
        raise ConfigError(f"Table I: needs {', '.join(side.metrics)}; also score the sweep under {side.protocol}")
    names = [row.protocol for row in fitting]
    chosen = side.protocol if side.protocol in names else names[0]
    members: dict[str, Measured] = {}
    for row in fitting:
        if row.protocol == chosen and members.setdefault(row.method, row) is not row:
            raise ConfigError(f"Table I: {row.method} is in {members[row.method].run} and {row.run}; give only one")
    return members


@dataclass(frozen=True)
class _Half:
    """The cells of one side of Table I, one row per value of the sweep, and the notes on them."""

    cells: list[list[Cell]]
    notes: tuple[str, ...]


def _half(sweep: Sequence[SweepRow], members: Mapping[str, Measured], shown: paper.Shown) -> _Half:
    own_name = next((row.method for row in sweep if row.is_default), None)
    if own_name is None:
        note = "No row has the method's default values, so that no row is compared or marked."
        return _Half([paper.cells_of(members[row.method], shown, set()) for row in sweep], (note,))
    own = members[own_name]
    others = [members[name] for name in dict.fromkeys(row.method for row in sweep) if name != own_name]
    if any((row.scenes, row.limit) != (own.scenes, own.limit) for row in others):
        note = "The rows have different scenes or frames, so that no row is compared or marked."
        return _Half([paper.cells_of(members[row.method], shown, set()) for row in sweep], (note,))
    compared = {name: _compared(own, others, name) for name in shown.metrics}
    cells = []
    for entry in sweep:
        row = members[entry.method]
        group = [members[member.method] for member in sweep if member.parameter == entry.parameter]
        best = {name for name in shown.metrics if _is_best(row, own, group, name, compared[name])}
        own_cells = zip(paper.cells_of(row, shown, best), shown.metrics, strict=True)
        cells.append([_beside(cell, compared, name, row) for cell, name in own_cells])
    smallest = min((one.smallest_p for of_metric in compared.values() for one in of_metric.values()), default=1.0)
    difference = (
        f"In parentheses: mean difference to {own_name} over scenes, in percentage points, and p (two-sided sign-flip "
        f"test, Holm's correction over the {counted(len(others), 'other row')} of the sweep, per metric)"
    )
    if smallest >= paper.LEVEL:
        return _Half(cells, (f"{difference}.", paper.nothing_can_be_marked("scenes", smallest)))
    bold = f"Bold: the highest value of its parameter if p < {paper.LEVEL}"
    bold += f"; for {own_name} if all others of the parameter differ"
    return _Half(cells, (f"{difference}. {bold}.",))


@dataclass(frozen=True)
class _Difference:
    """Difference from the default row: mean over scenes; ``p`` and the smallest possible p after Holm's correction."""

    mean: float
    p: float
    smallest_p: float


def _compared(own: Measured, others: Sequence[Measured], metric: str) -> dict[str, _Difference]:
    """Method -> its difference from ``own``, for the methods that share a scene with it."""
    changes = {row.method: paper.of_scenes(row, metric) - paper.of_scenes(own, metric) for row in others}
    tests = {method: test for method, change in changes.items() if (test := sign_flip_test(change)) is not None}
    adjusted = [p for p in holm([test.p for test in tests.values()]) if p is not None]
    return {
        method: _Difference(float(np.nanmean(changes[method])), p, min(1.0, len(tests) * test.smallest_p))
        for (method, test), p in zip(tests.items(), adjusted, strict=True)
    }


def _is_best(
    row: Measured, own: Measured, group: Sequence[Measured], metric: str, compared: Mapping[str, _Difference]
) -> bool:
    """Whether a row is significantly the highest of its parameter, also in the mean over scenes."""
    values = [member.metrics.get(metric) for member in group]
    known = [value for value in values if value is not None]
    if len(known) < 2 or row.metrics.get(metric) != max(known):
        return False
    rivals = [row] if row is not own else [member for member in group if member is not own]
    ahead = 1 if row is not own else -1
    return all(
        (found := compared.get(member.method)) is not None and found.p < paper.LEVEL and ahead * found.mean > 0
        for member in rivals
    )


def _beside(cell: Cell, compared: Mapping[str, Mapping[str, _Difference]], metric: str, row: Measured) -> Cell:
    """Return ``cell`` with its difference from the default row."""
    difference = compared[metric].get(row.method)
    if difference is None:
        return cell
    text = f"({signed(difference.mean)}, p {difference.p:.2g})"
    return replace(cell, beside=f"{cell.beside} {text}".lstrip())


def _named(row: TableRow) -> TableRow:
    parameter, _, value = row.label.partition("=")
    return replace(row, label=f"{parameter} = {value}", group=parameter)
