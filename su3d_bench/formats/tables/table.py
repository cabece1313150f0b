"""A table before it has a format: rows of cells that know the run or the print that they come from."""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.types import Interval
from su3d_bench.formats.numpy_files import ZIP_DAMAGE

NOT_MEASURED = "-"
What = Literal["value", "ceiling", "scenes"]
Unit = Literal["percent", "fraction"]


def percent(value: float | None) -> str:
    """A fraction in per cent with one decimal, as papers of this field print it; ``-`` where there is none."""
    return NOT_MEASURED if value is None else f"{100.0 * value:.1f}"


def signed(value: float | None) -> str:
    """A difference of fractions in percentage points, with its sign; ``-`` where there is none.

    >>> signed(0.0123), signed(-0.00001), signed(None)
    ('+1.2', '0.0', '-')
    """
    if value is None:
        return NOT_MEASURED
    text = f"{100 * value:+.1f}"
    return "0.0" if float(text) == 0 else text


def bracketed(interval: Sequence[float] | None, show: Callable[[float], str] = percent) -> str:
    """The ends of an interval as ``show`` has them; nothing where there is none.

    >>> bracketed((0.1, 0.25)), bracketed(None)
    ('[10.0, 25.0]', '')
    """
    return "" if interval is None else f"[{show(interval[0])}, {show(interval[1])}]"


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A fraction in per cent, its interval behind it."""
    return f"{percent(value)} {bracketed(interval)}".rstrip()


def is_count(metric: str) -> bool:
    """Whether a metric is a number of something and no share, by its name as in ``metrics.json``."""
    return metric.startswith("n_")


@dataclass(frozen=True)
class Origin:
    """Which number of which run a cell shows; ``value`` is a fraction, or the number of scored scenes.

    ``unit``: in what the cell shows a share.
    """

    run: str
    method: str
    protocol: str
    version: int
    metric: str
    what: What
    value: float
    interval: Interval | None = None
    unit: Unit = "percent"


@dataclass(frozen=True)
class Cell:
    """``text`` as it is shown, without the mark of the best, and ``beside`` it what is never marked, as an interval.

    ``origin`` is None for what a paper reports.
    """

    text: str
    beside: str = ""
    is_best: bool = False
    origin: Origin | None = None

    @property
    def whole(self) -> str:
        return f"{self.text} {self.beside}" if self.beside else self.text


@dataclass(frozen=True)
class TableRow:
    """``mark`` points to the note that says where a reported row is from; ``group``: rows that are compared."""

    label: str
    cells: tuple[Cell, ...]
    is_reported: bool = False
    mark: str = ""
    group: str = ""

    @property
    def title(self) -> str:
        """The label, with what must stand beside it in any format."""
        return f"{self.label} (as reported [{self.mark}])" if self.is_reported else self.label


@dataclass(frozen=True)
class Table:
    """``name`` is short and for references; ``head`` titles the first column, ``columns`` those of the cells.

    ``heading`` begins the caption, and stands out where the format has bold type.
    """

    name: str
    caption: str
    head: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]
    heading: str = ""


@dataclass(frozen=True)
class Prose:
    """What stands above, between or beneath tables: the lines of a paragraph, or of a list."""

    lines: tuple[str, ...]
    is_list: bool = False


def text_table(
    name: str, rows: Sequence[Sequence[str]], *, heading: str = "", caption: str = "", notes: Iterable[str] = ()
) -> Table:
    """A table of texts that stand for no number of a run alone; the first of ``rows`` is the header."""
    (head, *columns), *body = rows
    table_rows = tuple(TableRow(label, tuple(map(Cell, cells))) for label, *cells in body)
    return Table(name, caption, head, tuple(columns), table_rows, tuple(notes), heading)


def blocks_of(rows: Sequence[TableRow]) -> list[list[TableRow]]:
    """Rows that belong together, in order: measured before reported, one group after the other."""
    return [list(block) for _, block in groupby(rows, lambda row: (row.is_reported, row.group))]


MAX_ROWS = 200_000
MAX_CELLS = 4_000_000

MAX_CELL_CHARACTERS = 2000
# A spreadsheet takes what begins so for a formula (OWASP, "CSV Injection"); an apostrophe before it makes it text.
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")
# Where the semicolon parts cells, as in half of Europe, one begins behind it.
_CELL_WITHIN = re.compile(r"(?<=;)(?=[=+\-@])")
_CELL_CORRECTED = re.compile(r"(?<=;)'(?=[=+\-@])")


def separated_rows(text: str, separator: str = ",", most_rows: int = MAX_ROWS) -> list[list[str]]:
    """The rows of a CSV text; ``csv.Error`` where it is none, or has more rows or cells than any that people fill in.

    They are counted as they are read: a row takes one byte in a file and fifty in memory.
    """
    rows: list[list[str]] = []
    n_cells = 0
    for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True):
        n_cells += len(row)
        if len(rows) == most_rows or n_cells > MAX_CELLS:
            raise csv.Error(f"it has more than {most_rows} rows or {MAX_CELLS} cells")
        rows.append(row)
    return rows


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as CSV, each cell ``harmless``."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(harmless, row) for row in rows)
    return text.getvalue()


def harmless(value: object) -> object:
    """A cell on one line that no spreadsheet takes for a formula.

    >>> harmless("=1+1"), harmless("-"), harmless(-1)
    ("'=1+1", '-', -1)
    """
    if not isinstance(value, str):
        return value
    return no_formula(printable(value, MAX_CELL_CHARACTERS))


def no_formula(text: str) -> str:
    """``text`` as a spreadsheet takes it for text; ``meant`` gives it back."""
    apart = _CELL_WITHIN.sub("'", text)
    return f"'{apart}" if apart.startswith(FORMULA_STARTS) and apart != "-" else apart


def meant(cell: str) -> str:
    """What ``no_formula`` was given.

    >>> meant("'=1+1"), meant("'chair'")
    ('=1+1', "'chair'")
    """
    text = cell[1:] if cell[:1] == "'" and cell[1:2] in FORMULA_STARTS else cell
    return _CELL_CORRECTED.sub("", text)


MAX_XML_BYTES = 32 << 20  # of all that is in the archive, beside pictures, which do not shrink in it
MAX_SHEET_CELLS = 2_000_000  # of all worksheets
MAX_COLUMNS = 64  # beyond which nothing is looked at
# What openpyxl raises on damaged workbooks, beside what zipfile does.
WORKBOOK_DAMAGE = (*ZIP_DAMAGE, LookupError, TypeError, AttributeError, OSError, SyntaxError, OverflowError)

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
        if n_bytes > 2 * len(content) + MAX_XML_BYTES:
            raise DataError(f"{where}: unpacks to {n_bytes >> 20} MiB; no workbook of su3d-bench sheets make does")
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, keep_links=False)
        n_cells, found = 0, []
        for sheet in book.worksheets:
            rows: list[Row] = []
            sheet.reset_dimensions()  # the file may state any
            for number, cells in enumerate(sheet.iter_rows(max_row=MAX_ROWS, max_col=MAX_COLUMNS, values_only=True), 1):
                texts = [_text(cell) for cell in cells]
                n_cells += len(texts) - texts.count(None)
                if n_cells > MAX_SHEET_CELLS:
                    raise DataError(f"{where}: has more than {MAX_SHEET_CELLS} cells; a file of answers is smaller")
                if any(text is not None for text in texts):
                    rows.append((number, texts))
            found.append(Worksheet(sheet.title, rows))
        return found
    except WORKBOOK_DAMAGE as error:
        reason = printable(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{where}: is no whole .xlsx file ({reason}); save the workbook as .xlsx again") from error


def _text(value: object) -> str | None:
    """A cell as a text: of a formula itself, of a number as many digits as a spreadsheet shows."""
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, float):
        return f"{value:.15g}"
    return None if value is None or value == "" else str(value)
