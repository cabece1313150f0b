"""Rows of text separated by commas and the like, of bounded number."""

from __future__ import annotations

import csv
import io

MOST_ROWS = 200_000
MOST_CELLS = 4_000_000


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
