"""Format-independent tables: rows of cells that record the run or publication of their number; CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from su3d_bench.core.errors import printable
from su3d_bench.core.types import Interval

NOT_MEASURED = "-"
What = Literal["value", "ceiling", "scenes"]
Unit = Literal["percent", "fraction"]


def percent(value: float | None) -> str:
    """A fraction in per cent with one decimal, as usual in papers; ``-`` for None."""
    return NOT_MEASURED if value is None else f"{100.0 * value:.1f}"


def signed(value: float | None) -> str:
    """A difference of fractions in percentage points, with its sign; ``-`` for None.

    >>> signed(0.0123), signed(-0.00001), signed(None)
    ('+1.2', '0.0', '-')
    """
    if value is None:
        return NOT_MEASURED
    text = f"{100 * value:+.1f}"
    return "0.0" if float(text) == 0 else text


def bracketed(interval: Sequence[float] | None, show: Callable[[float], str] = percent) -> str:
    """The ends of an interval formatted by ``show``; empty for None.

    >>> bracketed((0.1, 0.25)), bracketed(None)
    ('[10.0, 25.0]', '')
    """
    return "" if interval is None else f"[{show(interval[0])}, {show(interval[1])}]"


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A fraction in per cent with its interval."""
    return f"{percent(value)} {bracketed(interval)}".rstrip()


def is_count(metric: str) -> bool:
    """Whether a metric is a count and not a fraction, by its name in ``metrics.json``."""
    return metric.startswith("n_")


@dataclass(frozen=True)
class Origin:
    """The number of a run that a cell shows; ``value`` is a fraction, or the number of scored scenes.

    ``unit``: the unit in which the cell shows a fraction.
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
    """The displayed ``text``, without the mark of the best, and ``beside`` it unmarked text such as an interval.

    ``origin`` is None for numbers reported in a paper.
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
    """``mark`` refers to the note with the source of a reported row; ``group``: rows that are compared."""

    label: str
    cells: tuple[Cell, ...]
    is_reported: bool = False
    mark: str = ""
    group: str = ""

    @property
    def title(self) -> str:
        """The label, with the remark on reported rows that every format needs."""
        return f"{self.label} (as reported [{self.mark}])" if self.is_reported else self.label


@dataclass(frozen=True)
class Table:
    """``name`` is short, for references; ``head`` titles the first column, ``columns`` those of the cells.

    ``heading`` begins the caption, in bold if the format supports it.
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
    """Text above, between or below tables: the lines of a paragraph, or of a list."""

    lines: tuple[str, ...]
    is_list: bool = False


def text_table(
    name: str, rows: Sequence[Sequence[str]], *, heading: str = "", caption: str = "", notes: Iterable[str] = ()
) -> Table:
    """A table of texts without origins in a run; the first of ``rows`` is the header."""
    (head, *columns), *body = rows
    table_rows = tuple(TableRow(label, tuple(map(Cell, cells))) for label, *cells in body)
    return Table(name, caption, head, tuple(columns), table_rows, tuple(notes), heading)


def blocks_of(rows: Sequence[TableRow]) -> list[list[TableRow]]:
    """Blocks of adjacent rows with the same ``is_reported`` and ``group``, in order."""
    return [list(block) for _, block in groupby(rows, lambda row: (row.is_reported, row.group))]


MAX_ROWS = 200_000
MAX_CELLS = 4_000_000

MAX_CELL_CHARACTERS = 2000
# Spreadsheets read cells with these beginnings as formulas (OWASP, "CSV Injection"); a leading apostrophe prevents it.
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")
# If the semicolon separates cells, as in much of Europe, a cell begins after it.
_CELL_WITHIN = re.compile(r"(?<=;)(?=[=+\-@])")
_CELL_CORRECTED = re.compile(r"(?<=;)'(?=[=+\-@])")


def separated_rows(text: str, separator: str = ",", most_rows: int = MAX_ROWS) -> list[list[str]]:
    """The rows of a CSV text; ``csv.Error`` if it is invalid or has too many rows or cells.

    They are counted while reading: a row takes one byte in a file and fifty in memory.
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
    """A cell on one line that no spreadsheet reads as a formula.

    >>> harmless("=1+1"), harmless("-"), harmless(-1)
    ("'=1+1", '-', -1)
    """
    if not isinstance(value, str):
        return value
    return no_formula(printable(value, MAX_CELL_CHARACTERS))


def no_formula(text: str) -> str:
    """``text`` escaped so that a spreadsheet reads it as text; ``meant`` reverses it."""
    apart = _CELL_WITHIN.sub("'", text)
    return f"'{apart}" if apart.startswith(FORMULA_STARTS) and apart != "-" else apart


def meant(cell: str) -> str:
    """The original text of a cell from ``no_formula``.

    >>> meant("'=1+1"), meant("'chair'")
    ('=1+1', "'chair'")
    """
    text = cell[1:] if cell[:1] == "'" and cell[1:2] in FORMULA_STARTS else cell
    return _CELL_CORRECTED.sub("", text)
