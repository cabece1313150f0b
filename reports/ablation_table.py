"""Table I: what one parameter of a method changes, from runs that hold the method and its variants."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from su3d_bench.errors import ConfigError
from su3d_bench.reports.measured import Measured
from su3d_bench.reports.paper_tables import (
    LAYOUTS,
    Layout,
    Shown,
    best_rows,
    cells_of,
    reported_rows,
    run_notes,
    units,
)
from su3d_bench.reports.published import published
from su3d_bench.reports.table_model import NOT_MEASURED, Cell, Table, TableRow

SIDES = (LAYOUTS["II"], LAYOUTS["III"])  # its columns are those of Tables II and III together
METRICS = tuple(name for side in SIDES for name in side.metrics)
M, K, RATIOS = "images m", "crop levels k", "crop ratios"
OWN_VALUES = {M: "5", K: "3", RATIOS: "0.8,1,1.2"}  # OpenSU3D, section IV-A: the method itself is in every group
_REPORTED = {"m": M, "k": K, "ratios": RATIOS}
_VARIANT = re.compile(r"(?P<base>[^@]+)@(?P<key>\w+)=(?P<value>[^=]+)")
Groups = Mapping[str, Mapping[str, str]]


def ablation_table(found: Sequence[Measured], shown: Shown, *, with_published: bool) -> Table:
    """A row for each value of a parameter, the best of each parameter marked.

    Variants are methods such as ``opensu3d@top_m=1``; lists of crop ratios that are not three long count as other
    numbers of crop levels. ``ConfigError`` where ``found`` has no variants, or those of several methods.
    """
    groups = _groups(found)
    sides = [_of_protocol(found, side) for side in SIDES]
    rows: list[TableRow] = []
    for group, values in groups.items():
        cells: dict[str, list[Cell]] = {value: [] for value in values}
        for side, members in zip(SIDES, sides, strict=True):
            _add_cells(cells, values, members, replace(shown, metrics=side.metrics, ceilings=False, scenes_count=False))
        rows += [TableRow(f"{group} = {value}", tuple(of_row), group=group) for value, of_row in cells.items()]
    notes: dict[str, None] = {}
    used = {method for values in groups.values() for method in values.values()}
    for side, members in zip(SIDES, sides, strict=True):
        own = [one for method, one in members.items() if method in used]
        notes[f"{', '.join(side.metrics)}: {units(own[0], replace(shown, ceilings=False))}"] = None
        notes |= dict.fromkeys(run_notes(own, [f"{one.method}, {one.scenes_text} scenes" for one in own]))
    figures = [figure for figure in published() if figure.table == "I"] if with_published else []
    reported, sources = reported_rows(figures, METRICS, len(METRICS))
    named = [_named(row) for row in reported]
    return Table("I", "Ablation of single parameters.", "parameter", METRICS, (*rows, *named), (*notes, *sources))


def _groups(found: Sequence[Measured]) -> Groups:
    """Parameter -> value -> method, values in ascending order."""
    groups: dict[str, dict[str, str]] = {}
    bases: dict[str, None] = {}
    for name in dict.fromkeys(one.method for one in found):
        match = _VARIANT.fullmatch(name)
        if match is not None:
            bases[match["base"]] = None
            group, value = _place_of(match["key"], match["value"])
            groups.setdefault(group, {})[value] = name
    if len(bases) != 1:
        what = f"these runs have some of {', '.join(bases)}; name those of one with --methods"
        raise ConfigError(
            "Table I: needs variants of one method with one parameter changed, such as opensu3d@top_m=1; "
            + (what if bases else "these runs have none")
        )
    (base,) = bases
    if any(one.method == base for one in found):
        for group, values in groups.items():
            values.setdefault(OWN_VALUES.get(group, "its own"), base)
    return {group: dict(sorted(values.items(), key=lambda one: _order(one[0]))) for group, values in groups.items()}


def _place_of(key: str, text: str) -> tuple[str, str]:
    value = text.strip("[]").replace(" ", "").replace(".0,", ",").removesuffix(".0")
    if key == "crop_ratios":
        n_levels = value.count(",") + 1
        return (RATIOS, value) if n_levels == 3 else (K, str(n_levels))
    return {"top_m": M}.get(key, key), value


def _order(value: str) -> tuple[int, float, str]:
    try:
        return (0, float(value), "")
    except ValueError:
        return (1, 0.0, value)


def _of_protocol(found: Sequence[Measured], side: Layout) -> dict[str, Measured]:
    """Method -> its numbers under the protocol of that side's set-up, or the first that has its metrics."""
    fitting = [one for one in found if all(name in one.metrics for name in side.metrics)]
    if not fitting:
        raise ConfigError(f"Table I: needs {', '.join(side.metrics)}; score the run under {side.protocol} too")
    names = [one.protocol for one in fitting]
    chosen = side.protocol if side.protocol in names else names[0]
    members: dict[str, Measured] = {}
    for one in fitting:
        if one.protocol == chosen and members.setdefault(one.method, one) is not one:
            raise ConfigError(f"Table I: {one.method} is in {members[one.method].run} and {one.run}; name one of them")
    return members


def _add_cells(
    cells: Mapping[str, list[Cell]], values: Mapping[str, str], members: Mapping[str, Measured], shown: Shown
) -> None:
    present = [value for value, method in values.items() if method in members]
    rows = [members[values[value]] for value in present]
    best, _ = best_rows(rows, shown)
    for value, of_row in cells.items():
        if value in present:
            k = present.index(value)
            of_row += cells_of(rows[k], shown, {name for name in shown.metrics if k in best.get(name, ())})
        else:
            of_row += [Cell(NOT_MEASURED)] * len(shown.metrics)


def _named(row: TableRow) -> TableRow:
    key, _, value = row.label.partition("=")
    return replace(row, label=f"{_REPORTED[key]} = {value}", group=_REPORTED[key])
