"""What a set of annotation sheets is: items without a word on who made them, the key kept apart, and answers.

``sheet.json`` goes to annotators, ``key.json`` does not. Ids begin with a letter, so that no spreadsheet takes one
for a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import DataError, printable, reading
from su3d_bench.core.files.atomic import write_json
from su3d_bench.core.system.files import file_bytes

SCHEMA = 1
SHEET_FILE, KEY_FILE = "sheet.json", "key.json"
PICTURES = "pictures"  # folder of the pictures, beside sheet.json
MOST_BYTES = 64 << 20  # of sheet.json or key.json: a hundred thousand items
SheetKind = Literal["retrieval", "annotation", "reasoning", "questions"]
# Columns of a file of answers; others may follow and are for the reader alone.
ANSWER_COLUMNS = ("sheet_id", "item_id", "annotator", "question", "answer", "check")
RIGHT, WRONG, CANNOT_TELL = "right", "wrong", "cannot tell"
JUDGEMENTS = (RIGHT, WRONG, CANNOT_TELL)
ARGUABLE = "arguable"
VERDICTS = (RIGHT, ARGUABLE, WRONG)  # of a question: what nobody can tell from pictures is at best arguable
# The names that metrics/score_questions.py has for the merging of a mask.
MERGES = ("well-merged", "under-merged", "over-merged", CANNOT_TELL)
_DIGITS = 12


class _Strict:
    """What is read as it was written: no other fields, and no value that would have to be converted."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)


@dataclass(frozen=True)
class Ask(_Strict):
    """A question that is put of an item: ``name`` stands in the answers, ``text`` is read, one of ``choices`` is right.

    ``meanings``: what each choice means, in their order.
    """

    name: str
    text: str
    choices: tuple[str, ...]
    meanings: tuple[str, ...] = ()


LABEL_MEANINGS = ("a fitting name, general or special", "a name of something else", "the picture does not show it")
ASKS: Mapping[SheetKind, tuple[Ask, ...]] = {
    "retrieval": (
        Ask(
            "retrieval",
            "Does the outlined object answer this?",
            JUDGEMENTS,
            ("the outlined object answers the text", "it does not", "the picture does not show it"),
        ),
    ),
    "annotation": (
        Ask("label 1", "Is label 1 right?", JUDGEMENTS, LABEL_MEANINGS),
        Ask("label 2", "Is label 2 right?", JUDGEMENTS, LABEL_MEANINGS),
        Ask(
            "merging",
            "How is the mask merged?",
            MERGES,
            (
                "one whole object and little else",
                "only a part: one thing taken for several",
                "more than one thing taken for one",
                "the picture does not show it",
            ),
        ),
    ),
    "reasoning": (
        Ask(
            "answer",
            "Is the answer right?",
            JUDGEMENTS,
            ("the answer is true of this room", "it is not", "the picture does not show it"),
        ),
        Ask(
            "objects",
            "Are the objects it names right?",
            JUDGEMENTS,
            ("all of them, and none is missing", "one is wrong or missing", "the picture does not show it"),
        ),
    ),
    "questions": (
        Ask(
            "sense",
            "Does the question make sense, and do pictures of the room answer it?",
            VERDICTS,
            (
                "it asks for something plain to see",
                "it can be taken in two ways",
                "it cannot be answered, or is absurd",
            ),
        ),
        Ask(
            "wording",
            "Is its wording right English?",
            VERDICTS,
            ("as people say it", "understood, but said differently", "a word is wrong or missing"),
        ),
        Ask(
            "answer",
            "Is its answer right?",
            VERDICTS,
            ("all of it, and nothing is missing", "people would differ", "something is wrong or missing"),
        ),
    ),
}


@dataclass(frozen=True)
class SheetItem(_Strict):
    """One thing to judge: ``text`` is the query, the labels, or question and answer; ``asks`` names what is asked.

    ``pictures`` are file names below ``PICTURES``, ``picture_digests`` their SHA-256; ``check`` changes with all of it.
    """

    id: str
    text: str
    asks: tuple[str, ...]
    pictures: tuple[str, ...]
    picture_digests: tuple[str, ...]
    check: str


@dataclass(frozen=True)
class AnnotatorShare(_Strict):
    """Ids of the items that one annotator gets, in that annotator's order."""

    name: str
    item_ids: tuple[str, ...]


@dataclass(frozen=True)
class Sheet(_Strict):
    """What all annotators of a set together see; ``id`` is a digest of it and begins with the kind."""

    id: str
    kind: SheetKind
    seed: int
    asks: tuple[Ask, ...]
    items: tuple[SheetItem, ...]
    annotators: tuple[AnnotatorShare, ...]
    schema_version: int = SCHEMA

    def ask(self, name: str) -> Ask:
        return next(ask for ask in self.asks if ask.name == name)

    def items_of(self, share: AnnotatorShare) -> list[SheetItem]:
        """The items of one annotator in that annotator's order."""
        by_id = {item.id: item for item in self.items}
        return [by_id[item_id] for item_id in share.item_ids]


@dataclass(frozen=True)
class KeyItem(_Strict):
    """What an item is: the instance ``instance_id`` of a map of ``scene`` (``<dataset>/<scene>``).

    ``methods``: all whose answer this is, a variant such as ``opensu3d@scheme4`` a name; ``instance_ids`` its id in the
    map of each of them (-1 where an answer names several or none). No method answers in sheets of questions: the kind
    of question and ``all`` stand there instead. ``question_id`` and ``question_kind`` are those of
    the question that was asked ('' in annotation sheets). ``stands_for``: what an ask judges where that is hidden:
    ``{"label 1": ("n", "n'")}``. ``automatic``: ask -> the choice that the ground truth makes, where it is known.
    """

    id: str
    scene: str
    methods: tuple[str, ...]
    instance_ids: tuple[int, ...]
    question_id: str
    question_kind: str
    stands_for: Mapping[str, tuple[str, ...]]
    automatic: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class JudgedRun:
    """How the run that is judged was made.

    ``answered_by``: who gave the answers of reasoning sheets, or labels n'; ``profile``, ``encoder``, ``limit`` and
    ``changed`` (method -> settings other than its own) are those of the run; ``remarks``: what must stand beside its
    numbers.
    """

    answered_by: str = ""
    profile: str = ""
    encoder: str = ""
    limit: int = 0
    changed: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    schema_version: int = SCHEMA

    def how_it_was_made(self) -> dict[str, Any]:
        """These fields, for what is made of the same run."""
        return {one.name: getattr(self, one.name) for one in fields(JudgedRun)}


@dataclass(frozen=True)
class Key(JudgedRun, _Strict):
    """What the maintainer keeps: ``sheet_id`` ties it to its sheet, ``run`` names the run folder, ``run_digest`` its
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
    """An item with the check that its contents give it."""
    check = item_check(set_id, item_id, text, asks, digests)
    return SheetItem(item_id, text, tuple(asks), tuple(pictures), tuple(digests), check)


def item_check(set_id: str, item_id: str, text: str, asks: Sequence[str], digests: Sequence[str]) -> str:
    """A short key of what an annotator saw of an item.

    >>> item_check("retrieval-1", "item-0001", "chair", ["retrieval"], []) == item_check(
    ...     "retrieval-1", "item-0001", "table", ["retrieval"], [])
    False
    """
    return "c" + digest_json([set_id, item_id, text, list(asks), list(digests)])[:_DIGITS]


def sheet_id_of(kind: SheetKind, seed: int, contents: Any) -> str:
    """The id of a set: the kind and a digest of all that is in it."""
    return f"{kind}-" + digest_json([SCHEMA, kind, seed, contents])[:_DIGITS]


def write_sheet(folder: Path, sheet: Sheet) -> Path:
    """Write ``sheet.json`` into ``folder``; its path."""
    write_json(folder / SHEET_FILE, asdict(sheet))
    return folder / SHEET_FILE


def write_key(folder: Path, key: Key) -> Path:
    """Write ``key.json`` into ``folder``; its path."""
    write_json(folder / KEY_FILE, asdict(key))
    return folder / KEY_FILE


def read_sheet(path: Path) -> Sheet:
    """The set in a ``sheet.json``; a ``DataError`` where the file is not as ``sheets make`` writes it."""
    sheet = read_record(path, Sheet, SCHEMA, "sheets make", "make them again")
    where = printable(str(path), 200)
    known = [item.id for item in sheet.items]
    if len(set(known)) != len(known):
        raise DataError(f"{where}: two items have one id; make the sheets again")
    names = {ask.name for ask in sheet.asks}
    for item in sheet.items:
        if not set(item.asks) <= names:
            raise DataError(f"{where}: item '{printable(item.id, 40)}' asks what the sheet does not; make it again")
        if item.check != item_check(sheet.id, item.id, item.text, item.asks, item.picture_digests):
            raise DataError(f"{where}: item '{printable(item.id, 40)}' was changed; make the sheets again")
    for share in sheet.annotators:
        if not set(share.item_ids) <= set(known):
            raise DataError(f"{where}: annotator '{printable(share.name, 40)}' has an unknown item; make it again")
    return sheet


def read_key(path: Path) -> Key:
    """The key in a ``key.json``; a ``DataError`` where the file is not as ``sheets make`` writes it."""
    key = read_record(path, Key, SCHEMA, "sheets make", "make them again")
    for item in key.items:
        if len(item.methods) != len(item.instance_ids):
            raise DataError(
                f"{printable(str(path), 200)}: item '{printable(item.id, 40)}' names {len(item.methods)} methods and "
                f"{len(item.instance_ids)} instances; make the sheets again"
            )
    return key


Read = TypeVar("Read", bound="_Versioned")


class _Versioned(Protocol):
    """What a file holds says of which form it is."""

    @property
    def schema_version(self) -> int: ...


def read_record(path: Path, kind: type[Read], schema: int, maker: str, again: str) -> Read:
    """The value of a JSON file as the verb ``maker`` writes it; ``DataError`` where it is another."""
    where = printable(str(path), 200)
    with reading(where, DataError):
        if path.stat().st_size > MOST_BYTES:
            raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; it is no file of su3d-bench {maker}")
        content = file_bytes(path)
    try:
        record = TypeAdapter(kind).validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = printable(".".join(map(str, first["loc"])), 120) or "it"
        if first["type"] == "missing" and len(first["loc"]) == 1:
            raise DataError(f"{where}: is no file that su3d-bench {maker} writes: it has no '{place}'") from error
        raise DataError(f"{where}: {place} is not as su3d-bench {maker} writes it; {again}") from error
    if record.schema_version != schema:
        raise DataError(f"{where}: has schema {record.schema_version}, this version reads {schema}; {again}")
    return record
