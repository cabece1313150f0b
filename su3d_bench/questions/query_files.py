"""A user's text queries with the objects that they refer to: a TOML file of ``[[query]]`` tables, or a CSV file.

Each has ``scene`` (``room0`` or ``replica/room0``), ``text``, and ``objects``: instance ids of the ground truth, a
list in TOML, separated by spaces in CSV. It may have ``kind`` (instance, affordance, ...) and ``source``. Texts are
data: anything except control characters is kept as it is. Also here: the groups in which sentences are scored
separately (unique and multiple, easy and hard, view-dependent and not).
"""

from __future__ import annotations

import ast
import csv
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.system.files import parse_toml
from su3d_bench.core.types import Float64Array, GroundTruth
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.tables.table import meant, separated_rows
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery

COLUMNS = ("scene", "text", "objects")
MORE_COLUMNS = ("kind", "source")  # optional, in any order after the others
MAX_OBJECTS_ID = 2**31 - 1
ADVICE = "pass a TOML or CSV query file, e.g. from su3d-bench query make --out queries.toml"
MAX_BYTES = 16 << 20  # some hundred thousand queries
MAX_CHARACTERS = 20_000  # per text
VARIANT = "query-objects"


def is_text(value: str) -> bool:
    """Whether ``value`` is short enough and free of control characters and lone surrogates.

    >>> is_text("\u202eright to left \U0001f600"), is_text("\x1b[2J")
    (True, False)
    """
    return len(value) <= MAX_CHARACTERS and not any(unicodedata.category(sign) in ("Cc", "Cs") for sign in value)


def only_words(text: str) -> str:
    if not text.strip() or not is_text(text):
        raise ValueError("expected text without control characters")
    return text.strip()


Words = Annotated[str, AfterValidator(only_words)]
ObjectId = Annotated[int, Field(ge=0, lt=MAX_OBJECTS_ID)]


def validated(kind: Any, content: Any, where: str) -> Any:
    """``content`` validated as a pydantic type; ``DataError`` with the place and value of the first error."""
    try:
        return _adapter(kind).validate_python(content)
    except ValidationError as error:
        fault = error.errors()[0]
        place = printable(".".join(map(str, fault["loc"])), 200)
        found = printable(repr(fault["input"]), 40)
        raise DataError(f"{where}: {place or 'it'}: {printable(fault['msg'], 200)}; found {found}") from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


class QueryRow(BaseModel):
    """One query of a file; ``objects`` is empty if unknown."""

    model_config = ConfigDict(extra="forbid")

    scene: Words
    text: Words
    objects: tuple[Annotated[int, Field(gt=0, le=MAX_OBJECTS_ID, strict=True)], ...]
    kind: Words | Literal[""] = ""
    source: Words | Literal[""] = ""


class _Queries(BaseModel):
    model_config = ConfigDict(extra="forbid")

    query: list[QueryRow]


def read_query_rows(path: Path) -> list[tuple[str, QueryRow]]:
    """All queries of a file, in order, with their location for messages."""
    where = printable(str(path), 200)
    text = read_text(path, where, ADVICE, MAX_BYTES)
    rows = list(_csv_rows(text, where) if path.suffix.lower() == ".csv" else _toml_rows(text, where))
    for at, row in rows:
        if len(set(row.objects)) != len(row.objects):
            raise DataError(f"{at}: duplicate object; list each object once")
    if not rows:
        raise DataError(f"{where}: contains no queries; expected {', '.join(COLUMNS)}")
    return rows


def read_query_file(path: Path) -> dict[str, tuple[TextQuery, ...]]:
    """The queries of each scene, in the order of the file; scene names without the dataset."""
    queries_of_scene: dict[str, list[TextQuery]] = {}
    for at, row in read_query_rows(path):
        if not row.objects:
            raise DataError(f"{at}: 'objects' must name at least one instance id above 0")
        queries = queries_of_scene.setdefault(row.scene.rpartition("/")[2], [])
        if any(query.text == row.text for query in queries):
            raise DataError(f"{at}: '{printable(row.text, 60)}' is a duplicate for {printable(row.scene, 60)}")
        queries.append(TextQuery(row.text, row.objects))
    return {scene: tuple(queries) for scene, queries in queries_of_scene.items()}


def query_truth(
    truth: GroundTruth,
    queries: tuple[TextQuery, ...],
    where: str,
    class_of: ClassOfName | None = None,
    alignment: Float64Array | None = None,
) -> QueryTruth:
    """The queries of a scene over its ground-truth instances; unknown objects are an error.

    Their groups are those of the file, by ``class_of`` if it names objects, otherwise by the classes of the truth.
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


def _toml_rows(text: str, where: str) -> Iterator[tuple[str, QueryRow]]:
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise DataError(f"{where}: not TOML ({printable(str(error), 120)})") from error
    for number, query in enumerate(validated(_Queries, content, where).query, 1):
        yield f"{where}: query {number}", query


def csv_rows(text: str, where: str, separators: str = ",") -> list[list[str]]:
    """The rows of a CSV text, split at the one of ``separators`` that is most frequent in its first line."""
    try:
        return separated_rows(text, max(separators, key=text.partition("\n")[0].count))
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)})") from error


def _csv_rows(text: str, where: str) -> Iterator[tuple[str, QueryRow]]:
    rows = csv_rows(text, where)
    header = tuple(word.strip() for word in rows[0]) if rows else ()
    more = header[len(COLUMNS) :]
    if header[: len(COLUMNS)] != COLUMNS or not set(more) <= set(MORE_COLUMNS) or len(set(more)) < len(more):
        raise DataError(f"{where}: the first line must be {','.join(COLUMNS)}, and kind or source may follow")
    for number, row in enumerate(rows[1:], 2):
        at = f"{where}: row {number}"
        if row and len(row) != len(header):
            raise DataError(f"{at}: has {len(row)} columns; expected {','.join(header)}")
        if row:
            cells: dict[str, Any] = dict(zip(header, map(meant, row), strict=True))
            yield at, validated(QueryRow, {**cells, "objects": [*map(_number, cells["objects"].split())]}, at)


def _number(word: str) -> int | str:
    return int(word) if word.isascii() and word.isdigit() and len(word) < 11 else word


UNIQUE, MULTIPLE = "unique", "multiple"
EASY, HARD = "easy", "hard"
BY_VIEW, BY_ANY_VIEW = "view-dependent", "view-independent"
LEFT_OUT = "left out"  # excluded from the evaluation of Nr3D with its candidates
PAIRS = ((UNIQUE, MULTIPLE), (EASY, HARD), (BY_VIEW, BY_ANY_VIEW))
# ``type2class`` of data/scannet/model_util_scannet.py: all other names of the table are one class, others.
CLASSES = frozenset((
    "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "picture", "counter", "desk", "curtain",
    "refrigerator", "shower curtain", "toilet", "sink", "bathtub",
))  # fmt: skip
OTHERS = "others"
# ``is_explicitly_view_dependent``
VIEW_WORDS = frozenset(
    ("front", "behind", "back", "right", "left", "facing", "leftmost", "rightmost", "looking", "across")
)
MAX_EASY_OBJECTS = 2  # objects of the target's class, including the target
MAX_TOKENS = 24  # per scored sentence: ``--max-seq-len``
ClassOfName = Callable[[str], str | None]  # the class of NYU40 that ScanNet's table gives a raw category


def scanrefer_groups(queries: Sequence[TextQuery], class_of: ClassOfName) -> tuple[TextQuery, ...]:
    """The queries of a scene of ScanRefer's file, each with ``unique`` or ``multiple``.

    An object is unique if it is the only one of its class among the scene's objects in the file, by the name in its
    first sentence. Queries without a name are unchanged.
    """
    known: dict[int, str] = {}
    for query in queries:
        if query.name:
            known.setdefault(query.object_ids[0], _class(query.name, class_of))
    classes = list(known.values())
    return tuple(
        with_group(query, UNIQUE if classes.count(_class(query.name, class_of)) == 1 else MULTIPLE)
        if query.name
        else query
        for query in queries
    )


def _class(name: str, class_of: ClassOfName) -> str:
    found = class_of(" ".join(name.split("_")))
    return found if found in CLASSES else OTHERS


def nr3d_groups(stimulus: str, tokens: str | None, mentions: str | None, at: str) -> tuple[str, ...]:
    """The groups of a row of Nr3D's file, or ``LEFT_OUT``; ``at`` is its location for messages.

    ``stimulus`` is ``scan-class-n-target-others``, ``n`` the number of objects of the class; ``tokens`` a Python list
    of words, ``mentions`` whether the sentence names the class: if it does not, it is excluded, and so is a sentence of
    more than 24 words or about the only object of its class.

    >>> nr3d_groups("scene0011_00-office_chair-3-1-2-4", "['the', 'left', 'chair']", "True", "row 2")
    ('hard', 'view-dependent')
    """
    parts = stimulus.split("-", 4)
    others = parts[4].split("-") if len(parts) == 5 else []
    numbers = [*parts[2:4], *(word for word in others if word)]
    is_sound = len(parts) >= 4 and all(word.isascii() and word.isdigit() and len(word) < 10 for word in numbers)
    if not is_sound or int(parts[2]) != len(numbers) - 1:
        fault = "must be scan-class-n-target-others, with n - 1 others"
        raise DataError(f"{at}: 'stimulus_id' {fault}; found {printable(stimulus, 60)}")
    n = int(parts[2])
    words = [] if tokens is None else _words(tokens, at)
    if (mentions or "True").strip() not in ("True", "true", "1") or len(words) > MAX_TOKENS or n < 2:
        return (LEFT_OUT,)
    return (EASY if n <= MAX_EASY_OBJECTS else HARD, BY_VIEW if VIEW_WORDS.intersection(words) else BY_ANY_VIEW)


def _words(text: str, at: str) -> list[str]:
    try:
        words = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        words = None
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise DataError(f"{at}: 'tokens' must be a list of words; found {printable(text, 40)}")
    return words


def grouped_by_truth(queries: Iterable[TextQuery], truth: GroundTruth) -> tuple[TextQuery, ...]:
    """The queries with a group of every pair that is still missing, by the classes of the ground-truth objects (ours).

    With several target objects the class of the first counts; a query is view-dependent if it has one of Nr3D's words.
    """
    ids, first = np.unique(truth.instance, return_index=True)
    class_of = {
        key: class_id for key, class_id in zip(ids.tolist(), truth.semantic[first].tolist(), strict=True) if key
    }
    classes = list(class_of.values())
    answer = []
    for query in queries:
        n = classes.count(class_of[query.object_ids[0]])
        words = re.findall(r"\w+", query.text.lower())
        ours = (
            UNIQUE if n == 1 else MULTIPLE,
            EASY if n <= MAX_EASY_OBJECTS else HARD,
            BY_VIEW if VIEW_WORDS.intersection(words) else BY_ANY_VIEW,
        )
        for pair, group in zip(PAIRS, ours, strict=True):
            query = query if _has(query.groups, pair) else with_group(query, group)
        answer.append(query)
    return tuple(answer)


def _has(groups: Collection[str], pair: tuple[str, str]) -> bool:
    return not {*pair, LEFT_OUT}.isdisjoint(groups)


def with_group(query: TextQuery, group: str) -> TextQuery:
    return replace(query, groups=(*query.groups, group))
