"""Create a set of sheets from drafts: shuffle, number, assign to annotators; write HTML page and CSV."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.files.atomic import is_file, make_folder, write_bytes
from su3d_bench.core.system.files import file_bytes
from su3d_bench.formats.tables.table import csv_lines
from su3d_bench.human_eval import items
from su3d_bench.human_eval.drafts import Draft
from su3d_bench.human_eval.items import PICTURES, AnnotatorShare, Key, KeyItem, Sheet
from su3d_bench.reports.sheet.page import page_html

MAX_ANNOTATORS = 100
PAGE, TABLE = "sheet.html", "sheet.csv"


@dataclass(frozen=True)
class GeneratedSheets:
    """A new set; ``pictures`` by file name."""

    sheet: Sheet
    key: Key
    pictures: dict[str, bytes]


def make_sheets(
    origin: Key, drafts: Sequence[Draft], drawn: Sequence[bytes], *, seed: int, annotators: int, overlap: float
) -> GeneratedSheets:
    """The set of all ``drafts``, assigned evenly to ``annotators``; a share ``overlap`` of it goes to all of them.

    ``origin``: the key without an id and items; ``drawn``: the picture of each draft, a JPEG.
    """
    check_split(len(drafts), annotators, overlap)
    random = np.random.default_rng(seed)
    order = np.argsort(random.permutation(len(drafts))).tolist()
    chosen = [drafts[k] for k in order]
    ids = [f"item-{number:04d}" for number in range(1, len(order) + 1)]
    pictures = {f"{item_id}.jpg": drawn[k] for item_id, k in zip(ids, order, strict=True)}
    digests = [digest_bytes(content) for content in pictures.values()]
    shown = list(zip(ids, chosen, pictures, digests, strict=True))
    contents = [[item_id, draft.text, list(draft.asks), digest] for item_id, draft, _, digest in shown]
    set_id = items.sheet_id_of(origin.kind, seed, contents)
    asked = tuple(
        items.new_item(set_id, item_id, draft.text, draft.asks, (name,), (digest,))
        for item_id, draft, name, digest in shown
    )
    shares = assign_items(ids, annotators, overlap, random)
    sheet = Sheet(set_id, origin.kind, seed, items.ASKS[origin.kind], asked, shares)
    key_items = tuple(_key_item(item_id, draft) for item_id, draft, *_ in shown)
    return GeneratedSheets(sheet, replace(origin, sheet_id=set_id, items=key_items), pictures)


def check_split(n_items: int, annotators: int, overlap: float) -> None:
    """Raise ``ConfigError`` if the items cannot be assigned this way."""
    if not n_items:
        raise ConfigError("nothing to judge: the scenes have no questions or instances")
    if not 1 <= annotators <= MAX_ANNOTATORS:
        raise ConfigError(f"--annotators {annotators}: expected 1 to {MAX_ANNOTATORS}")
    if not 0.0 <= overlap <= 1.0:
        raise ConfigError(f"--overlap {overlap:g}: expected a share of the items from 0 to 1")


def assign_items(
    item_ids: Sequence[str], annotators: int, overlap: float, random: np.random.Generator
) -> tuple[AnnotatorShare, ...]:
    """Items per annotator: a share goes to all, the others are assigned in turn; each annotator has a random order.

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
    return KeyItem(item_id, **{one.name: getattr(draft, one.name) for one in fields(KeyItem) if one.name != "id"})


def write_sheets(made: GeneratedSheets, folder: Path, key_folder: Path) -> list[Path]:
    """Write everything into ``folder`` and the key into ``key_folder``; returns the files for annotators.

    Raises ``ConfigError``, before anything is written, if the folders contain another set, or answers.
    """
    if key_folder.resolve() == folder.resolve() or folder.resolve() in key_folder.resolve().parents:
        raise ConfigError(f"--key {printable(str(key_folder), 200)}: is among the sheets; choose a separate folder")
    title = items.SHEET_KINDS[made.sheet.kind].title
    files: dict[Path, bytes] = {}
    for share in made.sheet.annotators:
        own = folder / share.name
        files[own / PAGE] = page_html(title, page_data(made, share)).encode()
        files[own / TABLE] = table_csv(made.sheet, share).encode()
    _check_same_sheets(made.sheet.id, folder, key_folder, files)
    for path in (folder, key_folder, folder / PICTURES):
        make_folder(path)
    for name, content in made.pictures.items():  # in the order of their numbers, which is random
        write_bytes(folder / PICTURES / name, content)
    for path, content in files.items():
        make_folder(path.parent)
        write_bytes(path, content)
    items.write_record(folder / items.SHEET_FILE, made.sheet)
    items.write_record(key_folder / items.KEY_FILE, made.key)
    return list(files)


def _check_same_sheets(sheet_id: str, folder: Path, key_folder: Path, files: Mapping[Path, bytes]) -> None:
    """``ConfigError`` if files of another set, or a table with answers, would be overwritten."""
    sheet, key = folder / items.SHEET_FILE, key_folder / items.KEY_FILE
    known = {
        "--out": items.read_sheet(sheet).id if is_file(sheet) else sheet_id,
        "--key": items.read_key(key).sheet_id if is_file(key) else sheet_id,
    }
    for flag, other in known.items():
        if other != sheet_id:
            raise ConfigError(f"{flag}: contains the sheets {printable(other)}; choose another folder")
    for path, content in files.items():
        if path.name != PAGE and is_file(path) and file_bytes(path) != content:
            where = printable(str(path), 200)
            raise ConfigError(f"--out: {where} contains answers or another set; choose another folder")


def page_data(made: GeneratedSheets, share: AnnotatorShare) -> dict[str, Any]:
    """The content of an annotator's page, without the key."""
    return {
        "id": made.sheet.id,
        "annotator": share.name,
        "columns": [*items.ANSWER_COLUMNS, items.COMMENT],
        "guide": list(items.guide_of(made.sheet)),
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
    """The table of one annotator, answers to be filled in; text that looks like a formula starts with ``'``."""
    rows: list[tuple[str, ...]] = [(*items.ANSWER_COLUMNS, items.COMMENT, "picture", "text", "asked", "choices")]
    for item in sheet.items_of(share):
        for name in item.asks:
            ask = sheet.ask(name)
            shown = (f"../{PICTURES}/{item.pictures[0]}", " / ".join(item.text.split("\n")), ask.text)
            rows.append((sheet.id, item.id, share.name, name, "", item.check, "", *shown, " | ".join(ask.choices)))
    return csv_lines(rows)
