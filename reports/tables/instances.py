"""Instances, one per row, as CSV, and tables of the cost of each kind of error."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.errors import counted
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.tables.table import Prose, Table, csv_lines, percent, signed, text_table

Kind = Literal["text", "whole number", "number", "yes or no"]
_KINDS: Mapping[str, Kind] = {
    "str": "text",
    "int": "whole number",
    "int | None": "whole number",
    "float": "number",
    "float | None": "number",
    "bool": "yes or no",
}


@dataclass(frozen=True)
class InstanceRow:
    """A predicted or ground-truth instance under one protocol: the columns of ``instances.toml``, in order."""

    run: str
    scene: str
    method: str
    protocol: str
    kind: str
    instance: int | None
    row: int | None
    class_name: str
    name: str
    score: float | None
    n_points: int
    n_right: int | None
    is_counted: bool
    best_iou: float
    matched: int | None
    matched_class: str
    is_hit_25: bool
    is_hit_50: bool
    error: str
    centre_x_m: float | None
    centre_y_m: float | None
    centre_z_m: float | None
    size_x_m: float | None
    size_y_m: float | None
    size_z_m: float | None


@dataclass(frozen=True)
class Column:
    """A column of the table; ``may_lack``: whether cells may be empty."""

    name: str
    kind: Kind
    may_lack: bool
    meaning: str


TEXTS: Mapping[str, Any] = tomllib.loads(file_text(Path(__file__).resolve().parent / "instances.toml"))
COLUMNS = tuple(
    Column(each.name, _KINDS[str(each.type)], "None" in str(each.type), TEXTS["columns"][each.name])
    for each in fields(InstanceRow)
)


def columns_table() -> Table:
    """Return the table that describes the columns, one per row."""
    rows = [(one.name, one.kind + (", may be empty" if one.may_lack else ""), one.meaning) for one in COLUMNS]
    return text_table("instances", [("column", "type", "description"), *rows])


def csv_of(rows: Sequence[InstanceRow]) -> str:
    """Return a header and one line per sample: full precision, 1 and 0 for yes and no, empty for None.

    >>> csv_of([])[:17]
    'run,scene,method,'
    """
    names = [one.name for one in COLUMNS]
    return csv_lines([names, *([_cell(value) for value in asdict(row).values()] for row in rows)])


def _cell(value: object) -> object:
    return "" if value is None else int(value) if isinstance(value, bool) else value


LEFT = {"overlap": "interaction", "rest": "remaining"}  # row labels of the two remainders
SUM = (
    "gains are in percentage points, with only this kind of error corrected; the score, all gains, 'interaction' "
    "and 'remaining' add up to 100"
)
OVERLAP = "all corrected together, minus the sum of the gains"


def attribution_tables(attribution: Mapping[str, Any]) -> list[Table | Prose]:
    """Return one table per protocol; gains are in percentage points, with only one kind of error corrected."""
    return [
        Prose((f"{attribution['run']}: {attribution['method']}",)),
        *map(_protocol_table, attribution["protocols"]),
        Prose((SUM, *attribution["remarks"]), is_list=True),
    ]


def _protocol_table(protocol: Mapping[str, Any]) -> Table:
    names, n_scored = list(protocol["values"]), protocol["n_scored"]
    meanings = TEXTS["errors"][protocol["kind"]]
    title = f"{protocol['protocol']} (version {protocol['version']}): {counted(len(protocol['scenes']), 'scene')}"
    header = ["", "errors" if n_scored is None else "points", *names, "description"]
    rows = [["score", "", *(percent(protocol["values"][name]) for name in names), ""]]
    for kind, cause in protocol["causes"].items():
        gains = [signed(cause["gains"][name]) for name in names]
        rows.append([kind, n_text(cause["n"], n_scored), *gains, meanings[kind]])
    rows.append([LEFT["overlap"], "", *(signed(protocol["overlap"][name]) for name in names), OVERLAP])
    rows.append([LEFT["rest"], "", *(signed(protocol["rest"][name]) for name in names), meanings["rest"]])
    for stage, values in protocol["stages"].items():
        rows.append([f"with GT {stage}", "", *(percent(values[name]) for name in names), TEXTS["stages"][stage]])
    return text_table(protocol["protocol"], [header, *rows], heading=title)


def n_text(n: int, n_scored: int | None) -> str:
    """Return a number of errors, or a percentage of the scored points.

    >>> n_text(3, None), n_text(25, 1000)
    ('3', '2.5 %')
    """
    return str(n) if n_scored is None else f"{100 * n / max(n_scored, 1):.1f} %"
