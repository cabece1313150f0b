"""What was predicted and what is there, a row an instance: what each column means, and the rows as CSV and Parquet."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from su3d_bench.core.errors import ModelMissing
from su3d_bench.formats.tables.table import Table, csv_lines, text_table

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
