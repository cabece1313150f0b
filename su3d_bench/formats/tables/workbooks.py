"""The worksheets of an XLSX file as texts, read by openpyxl: its XML by defusedxml, which refuses entities."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

from su3d_bench.core.errors import DataError, printable
from su3d_bench.formats.numpy_files import ZIP_DAMAGE
from su3d_bench.formats.tables.csv_text import MOST_ROWS

MOST_XML_BYTES = 32 << 20  # of all that is in the archive, beside pictures, which do not shrink in it
MOST_CELLS = 2_000_000  # of all worksheets
MOST_COLUMNS = 64  # beyond which nothing is looked at
# What openpyxl raises on damaged workbooks, beside what zipfile does.
DAMAGE = (*ZIP_DAMAGE, LookupError, TypeError, AttributeError, OSError, SyntaxError, OverflowError, RecursionError)

Row = tuple[int, list[str | None]]  # its number from 1 on, and its cells from column A on


@dataclass(frozen=True)
class Worksheet:
    """The rows of a worksheet that have cells, in the order of the file."""

    name: str
    rows: list[Row]


def read_workbook(content: bytes, where: str) -> list[Worksheet]:
    """Every worksheet in the order of the workbook; ``DataError``, which begins with ``where``, for anything else."""
    try:
        import defusedxml  # without which openpyxl would define entities
        import openpyxl
    except ImportError as error:
        raise DataError(f"{where}: reading .xlsx needs {error.name}; pip install 'su3d-bench[sheets]'") from error
    assert openpyxl.DEFUSEDXML, defusedxml.__name__
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            n_bytes = sum(info.file_size for info in archive.infolist())
        if n_bytes > 2 * len(content) + MOST_XML_BYTES:
            raise DataError(f"{where}: unpacks to {n_bytes >> 20} MiB; no workbook of su3d-bench sheets make does")
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, keep_links=False)
        n_cells, found = 0, []
        for sheet in book.worksheets:
            rows: list[Row] = []
            sheet.reset_dimensions()  # the file may state any
            for number, cells in enumerate(
                sheet.iter_rows(max_row=MOST_ROWS, max_col=MOST_COLUMNS, values_only=True), 1
            ):
                texts = [_text(cell) for cell in cells]
                n_cells += len(texts) - texts.count(None)
                if n_cells > MOST_CELLS:
                    raise DataError(f"{where}: has more than {MOST_CELLS} cells; a file of answers is smaller")
                if any(text is not None for text in texts):
                    rows.append((number, texts))
            found.append(Worksheet(sheet.title, rows))
        return found
    except DAMAGE as error:
        reason = printable(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{where}: is no whole .xlsx file ({reason}); save the workbook as .xlsx again") from error


def _text(value: object) -> str | None:
    """A cell as a text: of a formula itself, of a number as many digits as a spreadsheet shows."""
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, float):
        return f"{value:.15g}"
    return None if value is None or value == "" else str(value)
