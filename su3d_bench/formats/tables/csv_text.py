"""CSV texts: read with a bound on rows and cells, and written so that no spreadsheet takes a cell for a formula."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable

from su3d_bench.core.errors import printable

MOST_ROWS = 200_000
MOST_CELLS = 4_000_000

MOST_OF_A_CELL = 2000
# A spreadsheet takes what begins so for a formula (OWASP, "CSV Injection"); an apostrophe before it makes it text.
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")
# Where the semicolon parts cells, as in half of Europe, one begins behind it.
_CELL_WITHIN = re.compile(r"(?<=;)(?=[=+\-@])")
_CELL_MENDED = re.compile(r"(?<=;)'(?=[=+\-@])")


def separated_rows(text: str, separator: str = ",", most_rows: int = MOST_ROWS) -> list[list[str]]:
    """The rows of a CSV text; ``csv.Error`` where it is none, or has more rows or cells than any that people fill in.

    They are counted as they are read: a row takes one byte in a file and fifty in memory.
    """
    rows: list[list[str]] = []
    n_cells = 0
    for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True):
        n_cells += len(row)
        if len(rows) == most_rows or n_cells > MOST_CELLS:
            raise csv.Error(f"it has more than {most_rows} rows or {MOST_CELLS} cells")
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
    return no_formula(printable(value, MOST_OF_A_CELL))


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
    return _CELL_MENDED.sub("", text)
