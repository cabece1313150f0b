"""Data model of annotation sheets: anonymous items, the separate key and the instructions.

``sheet.json`` goes to annotators, ``key.json`` does not. Ids start with a letter so that spreadsheets do not read them
as numbers.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.files.atomic import write_json
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 1
SHEET_FILE, KEY_FILE = "sheet.json", "key.json"
PICTURES = "pictures"  # folder of the pictures, next to sheet.json
MAX_BYTES = 64 << 20  # of sheet.json or key.json: a hundred thousand items
SheetKind = Literal["retrieval", "annotation", "reasoning"]
# Columns of an answers file; others may follow and are only for readers.
ANSWER_COLUMNS = ("sheet_id", "item_id", "annotator", "question", "answer", "check")
COMMENT = "comment"  # an optional column
RIGHT, WRONG, CANNOT_TELL = "right", "wrong", "cannot tell"
# The names in metrics/questions for the merging of a mask.
MERGES = ("well-merged", "under-merged", "over-merged", CANNOT_TELL)
_DIGITS = 12


class _Strict:
    """Strict model: no extra fields, no type conversion."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)


@dataclass(frozen=True)
class Ask(_Strict):
    """A question about an item: ``name`` identifies it in answer files, ``text`` is shown, ``choices`` are the answers.

    ``meanings``: explanations of the choices, in order.
    """

    name: str
    text: str
    choices: tuple[str, ...]
    meanings: tuple[str, ...] = ()


@dataclass(frozen=True)
class SheetKindRules(_Strict):
    """Questions, page texts and picture titles of a kind of sheet; ``guide`` explains the pictures."""

    title: str
    outlined: str
    room: str
    guide: tuple[str, ...]
    asks: tuple[Ask, ...]


SHEET_KINDS: Mapping[SheetKind, SheetKindRules] = TypeAdapter(dict[SheetKind, SheetKindRules]).validate_json(
    json.dumps(tomllib.loads(file_text(Path(__file__).with_name("asks.toml"))))
)
ASKS: Mapping[SheetKind, tuple[Ask, ...]] = {name: kind.asks for name, kind in SHEET_KINDS.items()}


@dataclass(frozen=True)
class SheetItem(_Strict):
    """One item to judge: ``text`` is the query, the labels, or question and answer; ``asks`` names its questions.

    ``pictures`` are file names below ``PICTURES``, ``picture_digests`` their SHA-256; ``check`` is a digest of all.
    """

    id: str
    text: str
    asks: tuple[str, ...]
    pictures: tuple[str, ...]
    picture_digests: tuple[str, ...]
    check: str


@dataclass(frozen=True)
class AnnotatorShare(_Strict):
    """Ids of the items assigned to one annotator, in presentation order."""

    name: str
    item_ids: tuple[str, ...]


@dataclass(frozen=True)
class Sheet(_Strict):
    """Everything shown to the annotators of a set; ``id`` is the kind followed by a digest."""

    id: str
    kind: SheetKind
    seed: int
    asks: tuple[Ask, ...]
    items: tuple[SheetItem, ...]
    annotators: tuple[AnnotatorShare, ...]

    def ask(self, name: str) -> Ask:
        return next(ask for ask in self.asks if ask.name == name)

    def items_of(self, share: AnnotatorShare) -> list[SheetItem]:
        """The items of one annotator in presentation order."""
        by_id = {item.id: item for item in self.items}
        return [by_id[item_id] for item_id in share.item_ids]


@dataclass(frozen=True)
class KeyItem(_Strict):
    """The source of an item: instance ``instance_id`` of a map of ``scene`` (``<dataset>/<scene>``).

    ``methods``: all methods with this answer, including variants such as ``opensu3d@scheme4``; ``instance_ids`` its id
    in the map of each of them (-1 if an answer names several or none). ``question_id`` and ``question_kind`` are those
    of the question ('' in annotation sheets). ``represents``: the hidden meaning of an ask, such as
    ``{"label 1": ("n", "n'")}``. ``automatic``: ask -> the correct choice according to the ground truth, if known.
    """

    id: str
    scene: str
    methods: tuple[str, ...]
    instance_ids: tuple[int, ...]
    question_id: str
    question_kind: str
    represents: Mapping[str, tuple[str, ...]]
    automatic: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class JudgedRun:
    """Configuration of the judged run.

    ``answered_by``: the source of the answers of reasoning sheets, or of labels n'; ``profile``, ``encoder``, ``limit``
    and ``changed`` (method -> settings that are not defaults) are those of the run; ``remarks``: notes to be shown with
    its numbers.
    """

    answered_by: str = ""
    profile: str = ""
    encoder: str = ""
    limit: int = 0
    changed: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def provenance_remarks(self) -> dict[str, Any]:
        """These fields, for other records of the same run."""
        return {one.name: getattr(self, one.name) for one in fields(JudgedRun)}


@dataclass(frozen=True)
class Key(JudgedRun, _Strict):
    """The key, kept by the maintainer: ``sheet_id`` identifies its sheet, ``run`` is the run folder, ``run_digest`` its
    code."""

    sheet_id: str
    kind: SheetKind
    run: str
    run_digest: str
    methods: tuple[str, ...]
    automatic_rule: str
    items: tuple[KeyItem, ...]


def new_item(
    set_id: str, item_id: str, text: str, asks: Sequence[str], pictures: Sequence[str], digests: Sequence[str]
) -> SheetItem:
    """An item with its check, a short digest of everything shown to the annotator.

    >>> new_item("a-1", "item-1", "chair", [], [], []).check == new_item("a-1", "item-1", "table", [], [], []).check
    False
    """
    check = "c" + digest_json([set_id, item_id, text, list(asks), list(digests)])[:_DIGITS]
    return SheetItem(item_id, text, tuple(asks), tuple(pictures), tuple(digests), check)


def sheet_id_of(kind: SheetKind, seed: int, contents: Any) -> str:
    """The id of a set: the kind and a digest of its content."""
    return f"{kind}-" + digest_json([SCHEMA, kind, seed, contents])[:_DIGITS]


def read_sheet(path: Path) -> Sheet:
    """The set in a ``sheet.json``; ``DataError`` if the file is not one of ``sheets make``."""
    return read_record(path, Sheet)


def read_key(path: Path) -> Key:
    """The key in a ``key.json``; ``DataError`` if the file is not one of ``sheets make``."""
    return read_record(path, Key)


Record = TypeVar("Record", bound="DataclassInstance")


def write_record(path: Path, record: DataclassInstance) -> Path:
    """Write a record as JSON with a checksum of its content; returns the path."""
    content = asdict(record)
    write_json(path, content | {"schema_version": SCHEMA, "digest": digest_json(content)})
    return path


def read_record(path: Path, kind: type[Record], maker: str = "sheets make") -> Record:
    """The record of a JSON file of the command ``maker``; ``DataError`` for any other or changed file."""
    where = printable(str(path), 200)
    content = parsed_json(read_bytes(path, where, f"pass a file written by su3d-bench {maker}", MAX_BYTES), where)
    if not isinstance(content, dict) or "digest" not in content:
        raise DataError(f"{where}: not a file written by su3d-bench {maker}")
    digest, schema = content.pop("digest"), content.pop("schema_version", None)
    if schema != SCHEMA:
        raise DataError(f"{where}: schema is {printable(str(schema), 20)}, expected {SCHEMA}; create the file again")
    if digest != digest_json(content):
        raise DataError(f"{where}: changed since su3d-bench {maker} wrote it; restore it or create it again")
    try:
        return TypeAdapter(kind).validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        place = printable(".".join(map(str, error.errors()[0]["loc"])), 120)
        raise DataError(f"{where}: invalid file for su3d-bench {maker} ({place})") from error


_FOR_ALL_KINDS = (
    f"'{CANNOT_TELL}' is for what the picture does not show; it is counted separately, not as an error.",
    "Two seconds are usually enough; your first impression counts.",
    "Judge on your own, and do not discuss items before all are done: agreement between annotators is also a result.",
)


def guide_of(sheet: Sheet) -> tuple[str, ...]:
    """The instructions at the start of a sheet."""
    return (*SHEET_KINDS[sheet.kind].guide, *_FOR_ALL_KINDS)
