"""A set of sheets from drafts: shuffled, numbered, drawn, dealt to annotators, written; the key apart."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import ConfigError, DataError, printable
from su3d_bench.core.files.atomic import is_file, make_folder, write_bytes, write_text
from su3d_bench.core.system.files import file_bytes
from su3d_bench.formats.tables.csv_text import csv_lines
from su3d_bench.reports.sheet.page import page_html
from su3d_bench.sheets.items import (
    ANSWER_COLUMNS,
    ASKS,
    KEY_FILE,
    PICTURES,
    SHEET_FILE,
    AnnotatorShare,
    Key,
    KeyItem,
    Sheet,
    SheetKind,
    new_item,
    read_key,
    read_sheet,
    sheet_id_of,
    write_key,
    write_sheet,
)
from su3d_bench.sheets.making.drafts import Draft
from su3d_bench.sheets.making.guide import guide_of
from su3d_bench.sheets.making.workbook import workbook_bytes

MOST_ANNOTATORS = 100
PAGE, WORKBOOK, TABLE = "sheet.html", "sheet.xlsx", "sheet.csv"
TITLES = {
    "retrieval": "Is the outlined object what is asked for?",
    "annotation": "Are the labels right, and is the mask one object?",
    "reasoning": "Is the answer right?",
    "questions": "Are the question, its wording and its answer right?",
}


@dataclass(frozen=True)
class Origin:
    """Where the drafts come from, for the key."""

    run: str
    run_digest: str
    methods: tuple[str, ...]
    automatic_rule: str
    answered_by: str = ""
    profile: str = ""
    encoder: str = ""
    limit: int = 0
    changed: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class MadeSheets:
    """A set as it was made; ``pictures`` by file name."""

    sheet: Sheet
    key: Key
    pictures: dict[str, bytes]


def make_sheets(
    kind: SheetKind,
    drafts: Sequence[Draft],
    drawn: Sequence[bytes],
    origin: Origin,
    *,
    seed: int = 0,
    annotators: int = 1,
    overlap: float = 1.0,
) -> MadeSheets:
    """The set of all ``drafts``, dealt evenly to ``annotators``; a share ``overlap`` of it goes to each of them.

    ``drawn``: the picture of each draft, a PNG.
    """
    check_split(len(drafts), annotators, overlap)
    random = np.random.default_rng(seed)
    number_of = random.permutation(len(drafts))
    ids = [f"item-{number + 1:04d}" for number in number_of]
    pictures = {f"{item_id}.png": content for item_id, content in zip(ids, drawn, strict=True)}
    digests = {name: digest_bytes(content) for name, content in pictures.items()}
    order = np.argsort(number_of)
    contents = [[ids[k], drafts[k].text, list(drafts[k].asks), digests[f"{ids[k]}.png"]] for k in order]
    set_id = sheet_id_of(kind, seed, contents)
    items = tuple(
        new_item(set_id, ids[k], drafts[k].text, drafts[k].asks, (f"{ids[k]}.png",), (digests[f"{ids[k]}.png"],))
        for k in order
    )
    shares = dealt([item.id for item in items], annotators, overlap, random)
    sheet = Sheet(set_id, kind, seed, ASKS[kind], items, shares)
    key_items = tuple(_key_item(ids[k], drafts[k]) for k in order)
    key = Key(sheet_id=set_id, kind=kind, items=key_items, **asdict(origin))
    return MadeSheets(sheet, key, pictures)


def check_split(n_items: int, annotators: int, overlap: float) -> None:
    """A ``ConfigError`` where so many items cannot be dealt so."""
    if not n_items:
        raise ConfigError("there is nothing to judge: no question, or no instance, in these scenes")
    if not 1 <= annotators <= MOST_ANNOTATORS:
        raise ConfigError(f"--annotators {annotators}: expected 1 to {MOST_ANNOTATORS}")
    if not 0.0 <= overlap <= 1.0:
        raise ConfigError(f"--overlap {overlap:g}: expected a share of the items from 0 to 1")


def dealt(
    item_ids: Sequence[str], annotators: int, overlap: float, random: np.random.Generator
) -> tuple[AnnotatorShare, ...]:
    """Who gets what: a share of the items goes to all, the others are dealt in turn; each in an order of their own.

    >>> shares = dealt(["a", "b", "c", "d"], 2, 0.5, np.random.default_rng(0))
    >>> [len(one.item_ids) for one in shares], len(set(shares[0].item_ids) & set(shares[1].item_ids))
    ([3, 3], 2)
    """
    drawn = [item_ids[k] for k in random.permutation(len(item_ids))]
    n_shared = round(overlap * len(drawn)) if annotators > 1 else 0
    shared, others = drawn[:n_shared], drawn[n_shared:]
    shares = []
    for k in range(annotators):
        own = [*shared, *others[k::annotators]]
        own = own if annotators == 1 else [own[place] for place in random.permutation(len(own))]
        shares.append(AnnotatorShare(f"annotator-{k + 1}", tuple(sorted(own) if annotators == 1 else own)))
    return tuple(shares)


def _key_item(item_id: str, draft: Draft) -> KeyItem:
    return KeyItem(
        id=item_id,
        scene=draft.scene,
        methods=draft.methods,
        instance_ids=draft.instance_ids,
        question_id=draft.question_id,
        question_kind=draft.question_kind,
        stands_for=dict(draft.stands_for),
        automatic=dict(draft.automatic),
    )


def write_sheets(made: MadeSheets, folder: Path, key_folder: Path) -> list[Path]:
    """Write everything into ``folder`` and the key into ``key_folder``; the files for annotators, a folder each.

    Raises ``ConfigError``, before anything is written, where the folders hold another set, or answers.
    """
    if key_folder.resolve() == folder.resolve() or folder.resolve() in key_folder.resolve().parents:
        raise ConfigError(f"--key {printable(str(key_folder), 200)}: lies where the sheets are; keep the key apart")
    tables: dict[Path, bytes] = {}
    for share in made.sheet.annotators:
        tables[folder / share.name / WORKBOOK] = workbook_bytes(
            made.sheet, share, made.pictures, TITLES[made.sheet.kind]
        )
        tables[folder / share.name / TABLE] = table_csv(made.sheet, share).encode()
    _refuse_other_sheets(made.sheet.id, folder, key_folder, tables)
    for path in (folder, key_folder, folder / PICTURES):
        make_folder(path)
    for name, content in sorted(made.pictures.items()):  # in the order of their numbers, which is drawn
        write_bytes(folder / PICTURES / name, content)
    written = []
    for share in made.sheet.annotators:
        own = folder / share.name
        make_folder(own)
        write_text(own / PAGE, page_html(TITLES[made.sheet.kind], page_data(made, share)))
        for path in (own / WORKBOOK, own / TABLE):
            write_bytes(path, tables[path])
        written += [own / PAGE, own / WORKBOOK, own / TABLE]
    write_sheet(folder, made.sheet)
    write_key(key_folder, made.key)
    return written


def _refuse_other_sheets(sheet_id: str, folder: Path, key_folder: Path, tables: Mapping[Path, bytes]) -> None:
    """Answers belong to one set and its key: neither gives way to another, and no answer to an empty table."""
    for place, flag, held in (
        (folder, "--out", _id_in(folder / SHEET_FILE, lambda file: read_sheet(file).id)),
        (key_folder, "--key", _id_in(key_folder / KEY_FILE, lambda file: read_key(file).sheet_id)),
    ):
        if held not in (None, sheet_id):
            where = printable(str(place), 200)
            raise ConfigError(f"{flag} {where}: holds the sheets {printable(held or '')}; name another folder")
    for path, content in tables.items():
        if is_file(path) and file_bytes(path) != content:
            where = printable(str(path), 200)
            raise ConfigError(f"--out: {where} holds answers, or another set; name another folder")


def _id_in(file: Path, read: Callable[[Path], str]) -> str | None:
    """The id of the set that ``file`` is of; None where there is no such file."""
    if not is_file(file):
        return None
    try:
        return read(file)
    except DataError:
        return "of a file that cannot be read"


def page_data(made: MadeSheets, share: AnnotatorShare) -> dict[str, Any]:
    """What the page of an annotator shows; nothing of the key."""
    return {
        "id": made.sheet.id,
        "annotator": share.name,
        "columns": list(ANSWER_COLUMNS),
        "guide": list(guide_of(made.sheet)),
        "asks": [asdict(ask) for ask in made.sheet.asks],
        "items": [
            {
                "id": item.id,
                "text": item.text,
                "asks": list(item.asks),
                "check": item.check,
                "picture": base64.b64encode(made.pictures[item.pictures[0]]).decode("ascii"),
            }
            for item in made.sheet.items_of(share)
        ],
    }


def table_csv(sheet: Sheet, share: AnnotatorShare) -> str:
    """The table of one annotator, answers to be filled in; text that a spreadsheet would compute begins with ``'``."""
    rows: list[tuple[str, ...]] = [(*ANSWER_COLUMNS, "picture", "text", "asked", "choices")]
    for item in sheet.items_of(share):
        for name in item.asks:
            ask = sheet.ask(name)
            shown = (f"../{PICTURES}/{item.pictures[0]}", " / ".join(item.text.split("\n")), ask.text)
            rows.append((sheet.id, item.id, share.name, name, "", item.check, *shown, " | ".join(ask.choices)))
    return csv_lines(rows)
