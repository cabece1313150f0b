"""A user's text queries with the objects that they speak of: a TOML file of ``[[query]]`` tables, or a CSV file.

Each has ``scene`` (``room0`` or ``replica/room0``), ``text``, and ``objects``: instance ids of the ground truth, a
list in TOML, separated by blanks in CSV. It may have ``kind`` (instance, affordance, ...) and ``source``. Texts are
data: anything but control characters stands in them as it is.
"""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.toml import parse_toml
from su3d_bench.core.types import Float64Array, GroundTruth
from su3d_bench.formats.tables.csv_text import meant, separated_rows
from su3d_bench.formats.text_files import read_text
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery
from su3d_bench.questions.files.groups import ClassOfName, grouped_by_truth, scanrefer_groups

COLUMNS = ("scene", "text", "objects")
MORE_COLUMNS = ("kind", "source")  # may be there, in any order behind the others
MOST_OBJECTS_ID = 2**31 - 1
ADVICE = "name a file of queries, TOML or CSV, such as su3d-bench query make --out queries.toml writes"
MOST_BYTES = 16 << 20  # some hundred thousand queries
MOST_CHARACTERS = 20_000  # of one text
VARIANT = "query-objects"


@dataclass(frozen=True)
class QueryRow:
    """One query as the file has it; ``at`` says where it stands, for messages."""

    at: str
    scene: str
    text: str
    objects: tuple[int, ...]
    kind: str = ""
    source: str = ""


def read_query_rows(path: Path) -> list[QueryRow]:
    """Every query of a file in its order; ``objects`` is empty where nobody knows them."""
    where = printable(str(path), 200)
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; split it")
    text = read_text(path, where, ADVICE)
    rows = list(_csv_rows(text, where) if path.suffix.lower() == ".csv" else _toml_rows(text, where))
    for row in rows:
        if len(set(row.objects)) != len(row.objects):
            raise DataError(f"{row.at}: an object stands there twice; name each once")
    if not rows:
        raise DataError(f"{where}: holds no query; expected {', '.join(COLUMNS)}")
    return rows


def read_query_file(path: Path) -> dict[str, tuple[TextQuery, ...]]:
    """The queries of each scene, in the order of the file; scenes are called without the dataset."""
    queries_of_scene: dict[str, list[TextQuery]] = {}
    for row in read_query_rows(path):
        if not row.objects:
            raise DataError(f"{row.at}: 'objects' must name at least one instance id above 0")
        queries = queries_of_scene.setdefault(row.scene.rpartition("/")[2], [])
        if any(query.text == row.text for query in queries):
            raise DataError(
                f"{row.at}: the query '{printable(row.text, 60)}' stands there twice for {printable(row.scene, 60)}"
            )
        queries.append(TextQuery(row.text, row.objects))
    return {scene: tuple(queries) for scene, queries in queries_of_scene.items()}


def query_truth(
    truth: GroundTruth,
    queries: tuple[TextQuery, ...],
    where: str,
    class_of: ClassOfName | None = None,
    alignment: Float64Array | None = None,
) -> QueryTruth:
    """The queries of a scene over the instances of its ground truth; an object that is not there is an error.

    Their groups are those of the file, by ``class_of`` where it names objects, and else by the classes of the truth.
    """
    known = set(np.unique(truth.instance[truth.instance > 0]).tolist())
    for query in queries:
        for object_id in query.object_ids:
            if object_id not in known:
                raise DataError(
                    f"{where}: query '{printable(query.text, 60)}' names object {object_id}; the ground truth has "
                    f"{len(known)} objects, {min(known, default=0)} to {max(known, default=0)}"
                )
    owner = truth.instance.astype(np.int64)
    owner[owner <= 0] = -1
    named = queries if class_of is None else scanrefer_groups(queries, class_of)
    source = f"queries of a file, objects from {truth.source}"
    return QueryTruth(truth.points, owner, grouped_by_truth(named, truth), VARIANT, source, alignment=alignment)


def _toml_rows(text: str, where: str) -> Iterator[QueryRow]:
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise DataError(f"{where}: not TOML ({printable(str(error), 120)})") from error
    tables = content.get("query")
    if set(content) != {"query"} or not isinstance(tables, list):
        raise DataError(f"{where}: expected tables [[query]] and nothing else")
    for number, table in enumerate(tables, 1):
        at = f"{where}: query {number}"
        if not isinstance(table, Mapping) or not set(COLUMNS) <= set(table) <= {*COLUMNS, *MORE_COLUMNS}:
            raise DataError(f"{at}: expected the keys {', '.join(COLUMNS)}, and kind or source where they are known")
        objects = table["objects"]
        if not isinstance(objects, list) or not all(type(object_id) is int for object_id in objects):
            raise DataError(f"{at}: 'objects' must be a list of instance ids")
        yield _row(at, table, objects)


def _csv_rows(text: str, where: str) -> Iterator[QueryRow]:
    try:
        rows = separated_rows(text)
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)})") from error
    header = tuple(word.strip() for word in rows[0]) if rows else ()
    more = header[len(COLUMNS) :]
    if header[: len(COLUMNS)] != COLUMNS or not set(more) <= set(MORE_COLUMNS) or len(set(more)) < len(more):
        raise DataError(f"{where}: the first line must be {','.join(COLUMNS)}, and kind or source may follow")
    for number, row in enumerate(rows[1:], 2):
        at = f"{where}: row {number}"
        if not row:
            continue
        if len(row) != len(header):
            raise DataError(f"{at}: has {len(row)} columns; expected {','.join(header)}")
        words = row[2].split()
        if not all(word.isascii() and word.isdigit() and len(word) < 11 for word in words):
            raise DataError(f"{at}: 'objects' must be instance ids with blanks between them")
        yield _row(at, dict(zip(header, map(meant, row), strict=True)), [int(word) for word in words])


def _row(at: str, values: Mapping[str, Any], objects: Sequence[int]) -> QueryRow:
    if not all(0 < object_id <= MOST_OBJECTS_ID for object_id in objects):
        raise DataError(f"{at}: 'objects' must name instance ids above 0")
    scene, text = (_text(values[name], at) for name in ("scene", "text"))
    kind, source = (_text(values[name], at) if values.get(name) else "" for name in MORE_COLUMNS)
    return QueryRow(at, scene, text, tuple(objects), kind, source)


def _text(value: Any, at: str) -> str:
    if not isinstance(value, str) or not value.strip() or not is_text(value):
        raise DataError(f"{at}: 'scene' and 'text' must be words; found {printable(repr(value), 40)}")
    return value.strip()


def is_text(value: str) -> bool:
    """Whether ``value`` is short enough and free of control characters and lone surrogates.

    >>> is_text("\u202eright to left \U0001f600"), is_text("\x1b[2J")
    (True, False)
    """
    return len(value) <= MOST_CHARACTERS and not any(unicodedata.category(sign) in ("Cc", "Cs") for sign in value)
