"""The workbook of one annotator: a picture and a row for each answer, with a list to choose from."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from su3d_bench.core.errors import ModelMissing, printable
from su3d_bench.datasets.openlex3d.writing import ZIP_EPOCH
from su3d_bench.sheets.items import AnnotatorShare, Sheet
from su3d_bench.sheets.making.guide import GUIDE, guide_of

# The columns of an answers file stand among these; what nobody needs to see is hidden.
COLUMNS = ("item_id", "picture", "text", "asked", "answer", "question", "sheet_id", "annotator", "check")
HIDDEN = ("question", "sheet_id", "annotator", "check")
WIDTHS = {"item_id": 11, "picture": 88, "text": 34, "asked": 30, "answer": 17}  # in characters
HEADER_ROW = 3
PICTURE_WIDTH = 600  # pixels as shown; the file has more
POINTS_A_PIXEL = 0.75
MOST_ROW_POINTS = 400.0  # a spreadsheet's rows end at 409
FONT = "Calibri"  # that of a plain cell; without a name a bold one gets another
HEAD_FILL, OPEN_FILL, EDGE = "FF1857B8", "FFFFF4CC", "FFD4D4CF"


def workbook_bytes(sheet: Sheet, share: AnnotatorShare, pictures: Mapping[str, bytes], title: str) -> bytes:
    """An XLSX file, the same bytes for the same sheet. Needs the ``sheets`` extra."""
    try:
        from openpyxl import Workbook
    except ImportError as error:
        raise ModelMissing("a workbook needs the sheets extra: pip install 'su3d-bench[sheets]'") from error
    book = Workbook()
    page = book.active
    page.title = "answers"
    last = _write_rows(page, sheet, share, pictures)
    _write_head(page, title, last)
    _dress(page, last)
    _write_guide(book.create_sheet(GUIDE), sheet, title)
    buffer = io.BytesIO()
    book.save(buffer)
    return _without_time(buffer.getvalue())


def _write_rows(page: Any, sheet: Sheet, share: AnnotatorShare, pictures: Mapping[str, bytes]) -> int:
    """The rows of all items; the number of the last one."""
    from openpyxl.styles import Alignment, Border, Protection, Side
    from openpyxl.worksheet.datavalidation import DataValidation

    lists: dict[tuple[str, ...], DataValidation] = {}
    line = Side(style="thin", color=EDGE)
    row = HEADER_ROW
    for item in sheet.items_of(share):
        first = row + 1
        for name in item.asks:
            row += 1
            ask = sheet.ask(name)
            values = (item.id, "", item.text, ask.text, "", name, sheet.id, share.name, item.check)
            for column, value in enumerate(values, 1):
                cell = text_cell(page, row, column, value)
                cell.alignment = Alignment(wrap_text=True, vertical="top")
                cell.border = Border(top=line if row == first else None, bottom=line)
            answer = page.cell(row, COLUMNS.index("answer") + 1)
            answer.protection = Protection(locked=False)
            if ask.choices not in lists:
                lists[ask.choices] = _choice_list(ask.choices)
            lists[ask.choices].add(answer)
        _put_picture(page, first, row, pictures[item.pictures[0]])
    for menu in lists.values():
        page.add_data_validation(menu)
    return row


def text_cell(page: Any, row: int, column: int, text: str) -> Any:
    """Write ``text`` into a cell as text, never as a formula, also when somebody edits it."""
    cell = page.cell(row, column)
    # Line breaks stay; whatever else cannot be printed is shown as its escape.
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
    """Anchor a picture at its first row, and make its rows high enough for it."""
    from openpyxl.drawing.image import Image

    picture = Image(io.BytesIO(content))
    n_rows = last - first + 1
    height = PICTURE_WIDTH * picture.height / picture.width
    shrink = min(1.0, n_rows * MOST_ROW_POINTS / (height * POINTS_A_PIXEL))
    picture.width, picture.height = round(PICTURE_WIDTH * shrink), round(height * shrink)
    picture.anchor = f"{'ABCDEFGHI'[COLUMNS.index('picture')]}{first}"
    page.add_image(picture)
    for row in range(first, last + 1):
        page.row_dimensions[row].height = (picture.height * POINTS_A_PIXEL + 6) / n_rows


def _write_head(page: Any, title: str, last: int) -> None:
    """Title, progress and the names of the columns, which stay in sight."""
    from openpyxl.styles import Alignment, Font, PatternFill

    text_cell(page, 1, 2, title).font = Font(name=FONT, bold=True, size=15)
    letter = "ABCDEFGHI"[COLUMNS.index("answer")]
    cells = f"{letter}{HEADER_ROW + 1}:{letter}{last}"
    page.cell(2, 2).value = f'=COUNTA({cells})&" of "&ROWS({cells})&" answered"'
    page.cell(2, 2).font = Font(name=FONT, bold=True, color=HEAD_FILL)
    text_cell(page, 2, 3, "Choose from the list in the column 'answer', save, and send the file back.")
    for column, name in enumerate(COLUMNS, 1):
        cell = text_cell(page, HEADER_ROW, column, name)
        cell.font = Font(name=FONT, bold=True, color="FFFFFFFF")
        cell.fill = PatternFill("solid", fgColor=HEAD_FILL)
        cell.alignment = Alignment(vertical="center")
    page.freeze_panes = page.cell(HEADER_ROW + 1, 2)


def _dress(page: Any, last: int) -> None:
    """Widths, hidden columns, a colour for what is open, and a lock on all but the answers."""
    from openpyxl.formatting.rule import FormulaRule
    from openpyxl.styles import PatternFill

    for column, name in enumerate(COLUMNS):
        dimension = page.column_dimensions["ABCDEFGHI"[column]]
        dimension.width = WIDTHS.get(name, 12)
        dimension.hidden = name in HIDDEN
    letter = "ABCDEFGHI"[COLUMNS.index("answer")]
    is_open = FormulaRule(
        formula=[f"ISBLANK({letter}{HEADER_ROW + 1})"],
        fill=PatternFill("solid", start_color=OPEN_FILL, bgColor=OPEN_FILL),
    )
    page.conditional_formatting.add(f"{letter}{HEADER_ROW + 1}:{letter}{last}", is_open)
    page.protection.sheet = True  # without a password: it keeps from slips, not from intent
    page.protection.formatColumns = page.protection.formatRows = False
    page.sheet_view.zoomScale = 90
    page.page_setup.orientation = "landscape"
    page.page_setup.fitToHeight = 0
    page.sheet_properties.pageSetUpPr.fitToPage = True
    page.print_title_rows = f"{HEADER_ROW}:{HEADER_ROW}"


def _write_guide(page: Any, sheet: Sheet, title: str) -> None:
    """What the pictures show, and what each choice means."""
    from openpyxl.styles import Alignment, Font

    text_cell(page, 1, 1, title).font = Font(name=FONT, bold=True, size=15)
    row = 2
    for sentence in guide_of(sheet):
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
    """The archive with every date in it set to one day, so that the same sheet gives the same bytes."""
    stamp = datetime(*ZIP_EPOCH, tzinfo=UTC).strftime("%Y-%m-%dT%H:%M:%SZ").encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w") as new:
        for name in old.namelist():
            member = old.read(name)
            if name == "docProps/core.xml":
                member = re.sub(rb"(<dcterms:(?:created|modified)[^>]*>)[^<]*", rb"\g<1>" + stamp, member)
            entry = zipfile.ZipInfo(name, date_time=ZIP_EPOCH)
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
            new.writestr(entry, member)
    return buffer.getvalue()
