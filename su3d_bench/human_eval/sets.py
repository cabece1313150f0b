"""Create a set of sheets from drafts: shuffle, number, assign to annotators; write HTML page, CSV and workbook."""

from __future__ import annotations

import base64
import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
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

# These include the columns of an answers file; those that annotators need not see are hidden.
COLUMNS = ("item_id", "picture", "text", "asked", "answer", "comment", "question", "sheet_id", "annotator", "check")
HIDDEN = ("question", "sheet_id", "annotator", "check")
LETTERS = dict(zip(COLUMNS, "ABCDEFGHIJ", strict=True))
WIDTHS = {"item_id": 11, "picture": 88, "text": 34, "asked": 30, "answer": 17, "comment": 30}  # in characters
HEADER_ROW = 3
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # the date of every file in a workbook
PICTURE_WIDTH = 600  # pixels as shown; the file has more
POINTS_PER_PIXEL = 0.75
MAX_ROW_POINTS = 400.0  # the maximum row height of spreadsheets is 409
FONT = "Calibri"  # the font of a plain cell; without a name a bold cell gets a different one
HEAD_FILL, OPEN_FILL = "FF1857B8", "FFFFF4CC"


def has_openpyxl() -> bool:
    """Whether workbooks can be written."""
    try:
        import openpyxl  # noqa: F401
    except ImportError:
        return False
    return True


def workbook_bytes(sheet: Sheet, share: AnnotatorShare, pictures: Mapping[str, bytes], title: str) -> bytes:
    """A deterministic XLSX file of the sheet; needs the ``sheets`` extra."""
    from openpyxl import Workbook

    book = Workbook()
    page = book.active
    page.title = "answers"
    last = _write_rows(page, sheet, share, pictures)
    _write_head(page, title, last)
    _dress(page, last)
    _write_guide(book.create_sheet(items.GUIDE), sheet, title)
    buffer = io.BytesIO()
    book.save(buffer)
    return _without_time(buffer.getvalue())


def _write_rows(page: Any, sheet: Sheet, share: AnnotatorShare, pictures: Mapping[str, bytes]) -> int:
    """The rows of all items; the number of the last one."""
    from openpyxl.styles import Alignment, Protection
    from openpyxl.worksheet.datavalidation import DataValidation

    lists: dict[tuple[str, ...], DataValidation] = {}
    row = HEADER_ROW
    for item in sheet.items_of(share):
        first = row + 1
        for name in item.asks:
            row += 1
            ask = sheet.ask(name)
            values = (item.id, "", item.text, ask.text, "", "", name, sheet.id, share.name, item.check)
            for column, value in enumerate(values, 1):
                cell = text_cell(page, row, column, value)
                cell.alignment = Alignment(wrap_text=True, vertical="top")
            answer = page.cell(row, COLUMNS.index("answer") + 1)
            answer.protection = page.cell(row, COLUMNS.index(items.COMMENT) + 1).protection = Protection(locked=False)
            if ask.choices not in lists:
                lists[ask.choices] = _choice_list(ask.choices)
            lists[ask.choices].add(answer)
        _put_picture(page, first, row, pictures[item.pictures[0]])
    for menu in lists.values():
        page.add_data_validation(menu)
    return row


def text_cell(page: Any, row: int, column: int, text: str) -> Any:
    """Write ``text`` into a cell as text, never as a formula, even after editing."""
    cell = page.cell(row, column)
    # Line breaks are kept; other non-printable characters are escaped.
    cell.value = "\n".join(printable(line, 2000) for line in text.split("\n")) or None
    if cell.value is not None:
        cell.data_type = "s"
        cell.quotePrefix = True
    return cell


def _choice_list(choices: tuple[str, ...]) -> Any:
    from openpyxl.worksheet.datavalidation import DataValidation

    menu = DataValidation(type="list", formula1='"' + ",".join(choices) + '"', allow_blank=True, showErrorMessage=True)
    menu.errorTitle, menu.error = "one of the list", f"choose {', '.join(choices)}"
    return menu


def _put_picture(page: Any, first: int, last: int, content: bytes) -> None:
    """Anchor a picture at its first row, and set the heights of its rows accordingly."""
    from openpyxl.drawing.image import Image

    picture = Image(io.BytesIO(content))
    n_rows = last - first + 1
    height = PICTURE_WIDTH * picture.height / picture.width
    shrink = min(1.0, n_rows * MAX_ROW_POINTS / (height * POINTS_PER_PIXEL))
    picture.width, picture.height = round(PICTURE_WIDTH * shrink), round(height * shrink)
    picture.anchor = f"{LETTERS['picture']}{first}"
    page.add_image(picture)
    for row in range(first, last + 1):
        page.row_dimensions[row].height = (picture.height * POINTS_PER_PIXEL + 6) / n_rows


def _write_head(page: Any, title: str, last: int) -> None:
    """Title, progress and column names, which stay visible."""
    from openpyxl.styles import Alignment, Font, PatternFill

    text_cell(page, 1, 2, title).font = Font(name=FONT, bold=True, size=15)
    cells = _answer_cells(last)
    page.cell(2, 2).value = f'=COUNTA({cells})&" of "&ROWS({cells})&" answered"'
    page.cell(2, 2).font = Font(name=FONT, bold=True, color=HEAD_FILL)
    text_cell(page, 2, 3, "Choose from the list in the column 'answer', save, and send the file back.")
    for column, name in enumerate(COLUMNS, 1):
        cell = text_cell(page, HEADER_ROW, column, name)
        cell.font = Font(name=FONT, bold=True, color="FFFFFFFF")
        cell.fill = PatternFill("solid", fgColor=HEAD_FILL)
        cell.alignment = Alignment(vertical="center")
    page.freeze_panes = page.cell(HEADER_ROW + 1, 2)


def _answer_cells(last: int) -> str:
    return f"{LETTERS['answer']}{HEADER_ROW + 1}:{LETTERS['answer']}{last}"


def _dress(page: Any, last: int) -> None:
    """Widths, hidden columns, a colour for unanswered cells, and a lock on all cells except the answers."""
    from openpyxl.formatting.rule import FormulaRule
    from openpyxl.styles import PatternFill

    for name, letter in LETTERS.items():
        page.column_dimensions[letter].width = WIDTHS.get(name, 12)
        page.column_dimensions[letter].hidden = name in HIDDEN
    fill = PatternFill("solid", start_color=OPEN_FILL, bgColor=OPEN_FILL)
    is_open = FormulaRule(formula=[f"ISBLANK({LETTERS['answer']}{HEADER_ROW + 1})"], fill=fill)
    page.conditional_formatting.add(_answer_cells(last), is_open)
    page.protection.sheet = True  # without a password: it prevents accidental changes only
    page.protection.formatColumns = page.protection.formatRows = False


def _write_guide(page: Any, sheet: Sheet, title: str) -> None:
    """Write what the pictures show, and what each choice means."""
    from openpyxl.styles import Alignment, Font

    text_cell(page, 1, 1, title).font = Font(name=FONT, bold=True, size=15)
    row = 2
    for sentence in items.guide_of(sheet):
        row += 1
        text_cell(page, row, 1, sentence)
    row += 1
    for ask in sheet.asks:
        row += 1
        text_cell(page, row, 1, ask.text).font = Font(name=FONT, bold=True)
        for choice, meaning in zip(ask.choices, ask.meanings, strict=True):
            row += 1
            text_cell(page, row, 1, choice).alignment = Alignment(indent=1)
            text_cell(page, row, 2, meaning)
        row += 1
    page.column_dimensions["A"].width, page.column_dimensions["B"].width = 48, 60


def _without_time(content: bytes) -> bytes:
    """The archive with all dates set to one day, so that the same sheet gives the same bytes."""
    stamp = datetime(*ZIP_EPOCH, tzinfo=UTC).strftime("%Y-%m-%dT%H:%M:%SZ").encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w") as new:
        for name in old.namelist():
            member = old.read(name)
            if name == "docProps/core.xml":
                member = re.sub(rb"(<dcterms:(?:created|modified)[^>]*>)[^<]*", rb"\g<1>" + stamp, member)
            entry = zipfile.ZipInfo(name, date_time=ZIP_EPOCH)
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".jpeg") else zipfile.ZIP_DEFLATED
            new.writestr(entry, member)
    return buffer.getvalue()


MAX_ANNOTATORS = 100
PAGE, WORKBOOK, TABLE = "sheet.html", "sheet.xlsx", "sheet.csv"


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
        if has_openpyxl():
            files[own / WORKBOOK] = workbook_bytes(made.sheet, share, made.pictures, title)
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
