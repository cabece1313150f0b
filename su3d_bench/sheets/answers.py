"""Answers that came back from annotators: CSV files as the page exports or a spreadsheet saves them, and workbooks.

Formulas are never evaluated: one that stands in the place of an answer is read as its text, which is no answer.
"""

from __future__ import annotations

import csv
import io
import lzma
import unicodedata
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import DataError, ModelMissing
from su3d_bench.core.plain_text import printable
from su3d_bench.formats.zip_files import DAMAGE
from su3d_bench.reports.tables.formats import FORMULA_STARTS
from su3d_bench.sheets.items import ANSWER_COLUMNS

MOST_BYTES = 256 << 20  # of one file: a workbook holds its pictures
MOST_TEXT_BYTES = 32 << 20  # of a CSV file, or of all XML in a workbook: some hundred thousand answers
MOST_MEMBERS = 50_000
MOST_ROWS = 200_000
MOST_COLUMNS = 64
MOST_CHARACTERS = 1000  # of one cell that is read
HEADER_WITHIN = 30  # rows of a worksheet above its header, which may hold instructions


@dataclass(frozen=True)
class AnswerRow:
    """One answer as it stands in a file, nothing checked but that all is text; ``at`` names file and row."""

    at: str
    sheet_id: str
    item_id: str
    annotator: str
    question: str
    answer: str
    check: str


def read_answers(path: Path) -> list[AnswerRow]:
    """Every row of a CSV file or XLSX workbook in its order; ``DataError`` where it is no file of answers."""
    where = printable(str(path), 200)
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".xlsx"):
        raise DataError(f"{where}: is neither .csv nor .xlsx; export a CSV from the page or save an .xlsx workbook")
    try:
        size = path.stat().st_size
        if size > (MOST_TEXT_BYTES if suffix == ".csv" else MOST_BYTES):
            raise DataError(f"{where}: has {size >> 20} MiB; a file of answers is smaller")
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{where}: cannot be read: {error.strerror}") from error
    return parse_csv(content, where) if suffix == ".csv" else parse_workbook(content, where)


def parse_csv(content: bytes, where: str) -> list[AnswerRow]:
    """The answers of a CSV file: UTF-8, with or without the mark that Excel writes, separated by ``,`` ``;`` or tab."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: is not UTF-8; save it as 'CSV UTF-8'") from error
    first = text.partition("\n")[0]
    separator = max(",;\t", key=first.count)
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True))
    except csv.Error as error:
        raise DataError(f"{where}: is no CSV ({printable(str(error), 120)}); export it again") from error
    if len(rows) > MOST_ROWS:
        raise DataError(f"{where}: has {len(rows)} rows; at most {MOST_ROWS} are read")
    columns = _columns(rows[0]) if rows else None
    if columns is None:
        missing = [name for name in ANSWER_COLUMNS if not rows or name not in _names(rows[0])]
        told = f"lacks {', '.join(missing)}" if missing else "names a column twice"
        raise DataError(f"{where}: the first line {told}; export it again, or put the columns' names back")
    return list(_rows(enumerate(rows[1:], 2), columns, where))


def parse_workbook(content: bytes, where: str) -> list[AnswerRow]:
    """The answers of every worksheet of an XLSX workbook that has their columns."""
    try:
        import openpyxl
    except ImportError as error:
        raise ModelMissing(f"{where}: a workbook needs the sheets extra: pip install 'su3d-bench[sheets]'") from error
    _check_archive(content, where)
    found: list[AnswerRow] = []
    has_columns = False
    try:
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=False, keep_links=False)
        for page in book.worksheets:
            place = f"{where}: {printable(page.title, 60)}"
            rows = enumerate(page.iter_rows(max_row=MOST_ROWS, max_col=MOST_COLUMNS, values_only=True), 1)
            columns = None
            for number, row in rows:
                columns = _columns(row)
                if columns is not None or number == HEADER_WITHIN:
                    break
            if columns is not None:
                has_columns = True
                found += _rows(rows, columns, place)
    except DataError:
        raise
    except Exception as error:  # openpyxl meets damage with errors of any kind
        told = printable(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{where}: is damaged ({told}); save the workbook as .xlsx again") from error
    if not has_columns:
        raise DataError(f"{where}: no worksheet has the columns {', '.join(ANSWER_COLUMNS)}; put their names back")
    return found


def _check_archive(content: bytes, where: str) -> None:
    """Refuse what would swell: sizes are those that the archive promises, beyond which zipfile never reads."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            n_bytes = sum(one.file_size for one in members if not one.filename.startswith("xl/media/"))
            if len(members) > MOST_MEMBERS or n_bytes > MOST_TEXT_BYTES:
                raise DataError(
                    f"{where}: unpacks to {len(members)} parts and {n_bytes >> 20} MiB of text; no workbook of "
                    f"su3d-bench sheets make does"
                )
            for one in members:
                if one.filename.endswith((".xml", ".rels")) and b"<!DOCTYPE" in archive.read(one):
                    raise DataError(f"{where}: defines entities, which no workbook needs; save it as .xlsx again")
    except DataError:
        raise
    except (*DAMAGE, OSError, OverflowError, LookupError, lzma.LZMAError) as error:
        raise DataError(f"{where}: is no whole .xlsx file; copy it again") from error


def _names(row: Iterable[object]) -> list[str]:
    return [one.strip().lower() if isinstance(one, str) else "" for one in row]


def _columns(row: Sequence[object]) -> dict[str, int] | None:
    """Where each column stands; None where the row is not their header."""
    names = _names(row)
    if any(names.count(name) != 1 for name in ANSWER_COLUMNS):
        return None
    return {name: names.index(name) for name in ANSWER_COLUMNS}


def _rows(rows: Iterable[tuple[int, Sequence[object]]], columns: dict[str, int], where: str) -> Iterator[AnswerRow]:
    for number, row in rows:
        if all(cell is None or cell == "" for cell in row):
            continue
        at = f"{where}: row {number}"
        cells = {name: _cell(row[k] if k < len(row) else None, name, at) for name, k in columns.items()}
        if any(cells[name] for name in ANSWER_COLUMNS if name != "annotator"):
            yield AnswerRow(at, **cells)


def _cell(value: object, name: str, at: str) -> str:
    """The text of a cell; what is no text, a number or a date, as the text of it."""
    text = "" if value is None else str(value).strip()
    # as files that a spreadsheet is to open have it before text that would be taken for a formula
    if text[:1] == "'" and text[1:2] in FORMULA_STARTS:
        text = text[1:]
    if len(text) > MOST_CHARACTERS or any(unicodedata.category(one) in ("Cc", "Cs") for one in text):
        raise DataError(f"{at}: '{name}' is too long or holds control characters: '{printable(text, 40)}'")
    return text
