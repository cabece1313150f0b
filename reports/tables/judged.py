"""Tables IV and V of OpenSU3D's paper and its reasoning scores, as people or the ground truth judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from su3d_bench.core.errors import ConfigError
from su3d_bench.reports.tables.measured import Measured
from su3d_bench.reports.tables.model import Cell, Table, TableRow
from su3d_bench.reports.tables.paper import Shown, protocol_table, reported_rows
from su3d_bench.reports.tables.published import Figure, PaperTable, published

OWN_NAMES = {"merge-accuracy": "well-merged"}  # the paper's name: ours


@dataclass(frozen=True)
class JudgedLayout:
    """``parts``: what each method has a row of -> metric by the column that it stands in; '' where it has one row."""

    kind: str
    subject: str
    columns: tuple[str, ...]
    parts: Mapping[str, Mapping[str, str]]


KINDS = ("instance", "affordance", "property", "relative")
JUDGED: Mapping[PaperTable, JudgedLayout] = {
    "IV": JudgedLayout("retrieval", "Retrieval by text", KINDS, {"": {}}),
    "V": JudgedLayout(
        "annotation",
        "Labels and merging",
        ("label-accuracy", "merge-accuracy"),
        {
            "direct label (n)": OWN_NAMES | {"label-accuracy": "label n"},
            "refined label (n')": OWN_NAMES | {"label-accuracy": "label n'"},
        },
    ),
    "reasoning": JudgedLayout(
        "reasoning", "Spatial reasoning", ("reasoning-accuracy", "objects"), {"": {"reasoning-accuracy": "answer"}}
    ),
}


def judged_table(number: PaperTable, found: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """Such a table for each dataset: what people judged, what the ground truth judged, what the paper reports."""
    layout = JUDGED[number]
    rows = [one for one in found if one.kind == layout.kind]
    if not any(one.per_scene for one in rows):
        have = ", ".join(dict.fromkeys(one.protocol for one in found))
        raise ConfigError(
            f"Table {number}: needs {_protocols(layout.kind)}, or scores of sheets of kind {layout.kind}; there are "
            f"{have}"
        )
    tables = []
    for dataset in dict.fromkeys(one.datasets for one in rows if one.per_scene):
        figures = [one for one in published() if one.table == number] if with_published else []
        of_dataset = [one for one in rows if one.datasets == dataset or not one.per_scene]
        tables.append(_dataset_table(number, layout, dataset, of_dataset, figures, shown))
    return tables


def _dataset_table(
    number: PaperTable,
    layout: JudgedLayout,
    dataset: str,
    measured: Sequence[Measured],
    figures: Sequence[Figure],
    shown: Shown,
) -> Table:
    shown = replace(shown, metrics=shown.metrics or layout.columns, scenes_count=True)
    body: list[TableRow] = []
    notes: list[str] = []
    columns: tuple[str, ...] = ()
    for protocol in sorted({one.protocol for one in measured}, key=lambda name: not name.endswith("-people")):
        rows = [one for one in measured if one.protocol == protocol]
        if not any(one.per_scene for one in rows):
            continue
        table = protocol_table([_part(one, name, layout) for one in rows for name in layout.parts], shown, [])
        judge = "people" if rows[0].is_by_people else "ground truth"
        body += [_named(row, judge, layout) for row in table.rows]
        notes += [f"{judge}: {note}" for note in table.notes]
        columns = table.columns
    same = [one for one in figures if one.dataset == dataset]
    reported, sources = reported_rows(same or figures, shown.metrics, len(columns))
    setup = "" if same or not figures else ", not the paper's data"
    return Table(
        name=f"{number}-{dataset}",
        caption=f"{layout.subject} on {dataset}{setup}.",
        head="method, judge",
        columns=columns,
        rows=(*body, *reported),
        notes=(*notes, *sources),
    )


def _protocols(kind: str) -> str:
    datasets = ("rooms",) if kind == "reasoning" else ("rooms", "replica", "scannet")
    names = [f"{one}-{kind}" for one in datasets]
    return f"protocol {' or '.join(names)}"


def _part(row: Measured, part: str, layout: JudgedLayout) -> Measured:
    """``row`` with the metrics of one part under the names of their columns."""
    names = layout.parts[part]
    known = {column: name for column, name in names.items() if name in row.metrics}
    return replace(
        row,
        method=f"{row.method}: {part}" if part else row.method,
        metrics=dict(row.metrics) | {column: row.metrics[name] for column, name in known.items()},
        intervals=dict(row.intervals) | {column: row.intervals.get(name) for column, name in known.items()},
        ceilings=dict(row.ceilings) | {column: row.ceilings.get(name) for column, name in known.items()},
        per_scene={
            scene: dict(values) | {column: values.get(name) for column, name in known.items()}
            for scene, values in row.per_scene.items()
        },
    )


def _named(row: TableRow, judge: str, layout: JudgedLayout) -> TableRow:
    """``row`` with its judge, and each cell with the number's own name, by which a paper is checked."""
    return replace(row, label=f"{row.label}, {judge}", group=judge, cells=tuple(_own(c, layout) for c in row.cells))


def _own(cell: Cell, layout: JudgedLayout) -> Cell:
    if cell.origin is None:
        return cell
    method, _, part = cell.origin.method.rpartition(": ")
    if "" in layout.parts:
        method, part = cell.origin.method, ""
    elif part not in layout.parts:
        return cell
    metric = layout.parts[part].get(cell.origin.metric, cell.origin.metric)
    return replace(cell, origin=replace(cell.origin, method=method, metric=metric))
