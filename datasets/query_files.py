"""A user's text queries with the objects that they speak of: a TOML file of ``[[query]]`` tables, or a CSV file.

Each has ``scene`` (``room0`` or ``replica/room0``), ``text``, and ``objects``: instance ids of the ground truth, a
list in TOML, separated by blanks in CSV.
"""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.datasets.recorded_frames import read_text
from su3d_bench.errors import DataError
from su3d_bench.metrics.query_ap import QueryTruth, TextQuery
from su3d_bench.plain_text import printable
from su3d_bench.types import GroundTruth

COLUMNS = ("scene", "text", "objects")
MOST_OBJECTS_ID = 2**31 - 1
MOST_BYTES = 16 << 20  # some hundred thousand queries
VARIANT = "query-objects"


def read_query_file(path: Path) -> dict[str, tuple[TextQuery, ...]]:
    """The queries of each scene, in the order of the file; scenes are called without the dataset."""
    where = printable(str(path), 200)
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; split it")
    text = read_text(path, where)
    rows = _csv_rows(text, where) if path.suffix.lower() == ".csv" else _toml_rows(text, where)
    found: dict[str, list[TextQuery]] = {}
    for at, scene, query, objects in rows:
        if len(set(objects)) != len(objects):
            raise DataError(f"{at}: an object stands there twice; name each once")
        queries = found.setdefault(scene.rpartition("/")[2], [])
        if any(one.text == query for one in queries):
            raise DataError(f"{at}: the query '{printable(query, 60)}' stands there twice for {printable(scene, 60)}")
        queries.append(TextQuery(query, objects))
    if not found:
        raise DataError(f"{where}: holds no query; expected {', '.join(COLUMNS)}")
    return {scene: tuple(queries) for scene, queries in found.items()}


def query_truth(truth: GroundTruth, queries: tuple[TextQuery, ...], where: str) -> QueryTruth:
    """The queries of a scene over the instances of its ground truth; an object that is not there is an error."""
    known = set(np.unique(truth.instance[truth.instance > 0]).tolist())
    for query in queries:
        for one in query.object_ids:
            if one not in known:
                raise DataError(
                    f"{where}: query '{printable(query.text, 60)}' names object {one}; the ground truth has "
                    f"{len(known)} objects, {min(known, default=0)} to {max(known, default=0)}"
                )
    owner = truth.instance.astype(np.int64)
    owner[owner <= 0] = -1
    return QueryTruth(truth.points, owner, queries, VARIANT, f"queries of a file, objects from {truth.source}")


Row = tuple[str, str, str, tuple[int, ...]]


def _toml_rows(text: str, where: str) -> Iterator[Row]:
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise DataError(f"{where}: not TOML ({printable(str(error), 120)})") from error
    tables = content.get("query")
    if set(content) != {"query"} or not isinstance(tables, list):
        raise DataError(f"{where}: expected tables [[query]] and nothing else")
    for number, table in enumerate(tables, 1):
        at = f"{where}: query {number}"
        if not isinstance(table, Mapping) or set(table) != set(COLUMNS):
            raise DataError(f"{at}: expected the keys {', '.join(COLUMNS)}")
        objects = table["objects"]
        if not isinstance(objects, list) or not all(type(one) is int for one in objects):
            raise DataError(f"{at}: 'objects' must be a list of instance ids")
        yield at, _text(table["scene"], at), _text(table["text"], at), _ids(objects, at)


def _csv_rows(text: str, where: str) -> Iterator[Row]:
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)})") from error
    if not rows or tuple(word.strip() for word in rows[0]) != COLUMNS:
        raise DataError(f"{where}: the first line must be {','.join(COLUMNS)}")
    for number, row in enumerate(rows[1:], 2):
        at = f"{where}: row {number}"
        if not row:
            continue
        if len(row) != len(COLUMNS):
            raise DataError(f"{at}: has {len(row)} columns; expected {','.join(COLUMNS)}")
        words = row[2].split()
        if not all(word.isascii() and word.isdigit() and len(word) < 11 for word in words):
            raise DataError(f"{at}: 'objects' must be instance ids with blanks between them")
        yield at, _text(row[0], at), _text(row[1], at), _ids([int(word) for word in words], at)


def _text(value: Any, at: str) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise DataError(f"{at}: 'scene' and 'text' must be words; found {printable(repr(value), 40)}")
    return value.strip()


def _ids(values: list[int], at: str) -> tuple[int, ...]:
    if not values or not all(0 < one <= MOST_OBJECTS_ID for one in values):
        raise DataError(f"{at}: 'objects' must name at least one instance id above 0")
    return tuple(values)
