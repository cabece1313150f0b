"""Instances one per row, as CSV and Parquet, and tables of what each kind of error costs."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from su3d_bench.core.errors import ModelMissing, counted
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


def _column(meaning: str) -> Any:
    return field(metadata={"meaning": meaning})


@dataclass(frozen=True)
class Sample:
    """An instance of a map or of the truth under one protocol; the fields are the columns, in their order."""

    run: str = _column("folder of the run")
    scene: str = _column("address of the scene, such as rooms/living0")
    method: str = _column("whose map")
    protocol: str = _column("under whose rules; of kind instance or semantic")
    kind: str = _column(
        "predicted: a mask of the map, under kind semantic what it calls by one name; true: an instance of the truth "
        "that takes part in the score"
    )
    instance: int | None = _column(
        "predicted: the number by which query and the page call it; true: its number among those of its class and "
        "scene; none under kind semantic for all points of a class that belong to no instance"
    )
    row: int | None = _column("predicted: its place in the prediction, from 0; true: none")
    class_name: str = _column(
        "the class that it is called or has; empty for none of the protocol's; object where the protocol has no classes"
    )
    name: str = _column("predicted: what the method or perception calls it; true: empty")
    score: float | None = _column("predicted: the confidence that counts under kind instance; true: none")
    n_points: int = _column(
        "points of the truth that it has; under kind semantic of those that are counted, predicted those that it names"
    )
    n_right: int | None = _column("of these points those that are called their class, under kind semantic; else none")
    is_counted: bool = _column(
        "whether it takes part: of a scored class and, under kind instance, of the protocol's minimum size"
    )
    best_iou: float = _column(
        "highest IoU with any of the other kind, whatever its class, 0 to 1; of the truth those that take part"
    )
    matched: int | None = _column("the instance of the other kind with that IoU; none where it is 0 or has no number")
    matched_class: str = _column("the class of that one; empty where there is none")
    is_hit_25: bool = _column(
        "predicted: a true positive above IoU 0.25, under kind semantic of the class of what it has that IoU with; "
        "true: met by one"
    )
    is_hit_50: bool = _column("the same above IoU 0.5")
    error: str = _column(
        "the kind of its error as attribute counts it, empty for none: of a mask merged, duplicate, mislabelled or "
        "background, of an instance of the truth split or missed; under kind semantic the cause of most of its wrong "
        "points: geometry, background, association or label"
    )
    centre_x_m: float | None = _column("centre of the box along the axes around its points, m; none without places")
    centre_y_m: float | None = _column("the same, y")
    centre_z_m: float | None = _column("the same, z; up in most datasets")
    size_x_m: float | None = _column("size of that box along x, m")
    size_y_m: float | None = _column("the same, y")
    size_z_m: float | None = _column("the same, z")


@dataclass(frozen=True)
class Column:
    """A column of the samples; ``may_lack``: where cells may be empty."""

    name: str
    kind: Kind
    may_lack: bool
    meaning: str


COLUMNS = tuple(
    Column(each.name, _KINDS[str(each.type)], "None" in str(each.type), each.metadata["meaning"])
    for each in fields(Sample)
)


def columns_table() -> Table:
    """What each column holds, a row a column."""
    rows = [(one.name, one.kind + (", may be empty" if one.may_lack else ""), one.meaning) for one in COLUMNS]
    return text_table("samples", [("column", "holds", "meaning"), *rows])


def csv_of(samples: Sequence[Sample]) -> str:
    """A line of names and a line a sample; numbers in full precision, 1 and 0 for yes and no, nothing for none.

    >>> csv_of([])[:17]
    'run,scene,method,'
    """
    names = [one.name for one in COLUMNS]
    return csv_lines([names, *([_cell(value) for value in asdict(sample).values()] for sample in samples)])


def _cell(value: object) -> object:
    return "" if value is None else int(value) if isinstance(value, bool) else value


def parquet_of(samples: Sequence[Sample]) -> bytes:
    """The samples as a Parquet file, a column's meaning in its metadata; ``ModelMissing`` without pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ModelMissing(
            "--format parquet needs the parquet extra: pip install 'su3d-bench[parquet]'; csv needs nothing"
        ) from error
    types = {
        "text": pyarrow.string(),
        "whole number": pyarrow.int64(),
        "number": pyarrow.float64(),
        "yes or no": pyarrow.bool_(),
    }
    form = pyarrow.schema(
        [
            pyarrow.field(one.name, types[one.kind], nullable=one.may_lack, metadata={"meaning": one.meaning})
            for one in COLUMNS
        ]
    )
    columns = {one.name: [getattr(sample, one.name) for sample in samples] for one in COLUMNS}
    stream = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns, schema=form), stream)
    return stream.getvalue()


MEANINGS: dict[str, dict[str, str]] = {
    "instance": {
        "merged": "one mask holds several objects",
        "split": "one object lies in several masks",
        "duplicate": "a mask repeats another one's object",
        "mislabelled": "the right mask, another class",
        "background": "a mask that belongs to no object",
        "missed": "an object that no mask is of",
    },
    "semantic": {
        "geometry": "no point of the map within 5 cm",
        "background": "the map is there, but no mask",
        "association": "a mask that belongs to another object",
        "label": "the object's own mask, another class",
    },
}
REST: dict[str, str] = {
    "instance": "masks that fit badly; mask and label wrong at once",
    "semantic": "classes that no correction of points reaches",
}
LEFT = {"overlap": "several together", "rest": "none of these"}  # what the two remainders are called
SUM = (
    "a gain is in percentage points, with this kind of error alone corrected; the value, all gains, 'several together' "
    "and 'none of these' add up to 100"
)
OVERLAP = "correcting all of them, beyond the sum of the gains"
STAGES: dict[str, str] = {
    "labels": "every mask named by the truth",
    "2D masks": "masks and names of each image from the truth",
}


def attribution_tables(attribution: Mapping[str, Any]) -> list[Table | Prose]:
    """One table a protocol; gains are in percentage points, each for one kind of error corrected alone."""
    return [
        Prose((f"{attribution['run']}: {attribution['method']}",)),
        *map(_protocol_table, attribution["protocols"]),
        Prose((SUM, *attribution["remarks"]), is_list=True),
    ]


def _protocol_table(protocol: Mapping[str, Any]) -> Table:
    names, n_scored = list(protocol["values"]), protocol["n_scored"]
    title = f"{protocol['protocol']} (version {protocol['version']}): {counted(len(protocol['scenes']), 'scene')}"
    header = ["", "errors" if n_scored is None else "points", *names, "what it is"]
    rows = [["as it is", "", *(percent(protocol["values"][name]) for name in names), ""]]
    for kind, cause in protocol["causes"].items():
        gains = [signed(cause["gains"][name]) for name in names]
        rows.append([kind, n_text(cause["n"], n_scored), *gains, MEANINGS[protocol["kind"]][kind]])
    rows.append([LEFT["overlap"], "", *(signed(protocol["overlap"][name]) for name in names), OVERLAP])
    rows.append([LEFT["rest"], "", *(signed(protocol["rest"][name]) for name in names), REST[protocol["kind"]]])
    for stage, values in protocol["stages"].items():
        rows.append([f"with true {stage}", "", *(percent(values[name]) for name in names), STAGES[stage]])
    return text_table(protocol["protocol"], [header, *rows], heading=title)


def n_text(n: int, n_scored: int | None) -> str:
    """A number of errors, or a share of the scored points.

    >>> n_text(3, None), n_text(25, 1000)
    ('3', '2.5 %')
    """
    return str(n) if n_scored is None else f"{100 * n / max(n_scored, 1):.1f} %"
