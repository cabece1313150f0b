"""Tables, and what stands between them, as Markdown, CSV and HTML; ``FORMATS`` has LaTeX too."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from su3d_bench.core.errors import printable
from su3d_bench.reports.tables.latex import latex
from su3d_bench.reports.tables.model import Cell, Prose, Table, blocks_of

CSV_COLUMNS = (
    "table",
    "kind",
    "row",
    "column",
    "text",
    "is_best",
    "value",
    "low",
    "high",
    "what",
    "run",
    "method",
    "protocol",
    "version",
    "metric",
    "unit",
    "mark",
)
# A spreadsheet takes what begins so for a formula; an apostrophe before it makes it text.
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
MOST_OF_A_NOTE = 7_000  # characters: it may name every scene of a data set
STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color-scheme:light dark}"
    "table{border-collapse:collapse;margin:1rem 0}caption{text-align:left;padding:.3rem 0}"
    "th,td{padding:.2rem .7rem;text-align:right}th:first-child,td:first-child{text-align:left}"
    "thead{border-top:2px solid;border-bottom:1px solid}tbody{border-bottom:1px solid}tbody:last-of-type{border-bottom:"
    "2px solid}.reported{font-style:italic}.wide{overflow-x:auto}"
)


def markdown(parts: Sequence[Table | Prose]) -> str:
    """All ``parts``, each table with its caption above and its notes beneath; the best is in two asterisks a side."""
    return "\n\n".join(_markdown(part) for part in parts) + "\n"


def _markdown(part: Table | Prose) -> str:
    if isinstance(part, Prose):
        return "\n".join(f"{'- ' if part.is_list else ''}{_pipes(line, MOST_OF_A_NOTE)}" for line in part.lines)
    rows = [[row.title, *(_marked(cell) for cell in row.cells)] for row in part.rows]
    lines = aligned([[_pipes(text) for text in row] for row in [[part.head, *part.columns], *rows]]) if rows else []
    caption = _pipes(f"**{part.heading}**{part.caption}" if part.heading else part.caption)
    notes = [f"- {_pipes(note, MOST_OF_A_NOTE)}" for note in part.notes]
    return "\n\n".join(block for block in (caption, "\n".join(lines), "\n".join(notes)) if block)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table, the first row its header, with columns of one width."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return [lines[0], rule, *lines[1:]]


def _marked(cell: Cell) -> str:
    return f"**{cell.text}** {cell.beside}".rstrip() if cell.is_best else cell.whole


def _pipes(text: str, most: int = 2000) -> str:
    """``text`` without what would end a cell or begin HTML."""
    return printable(text, most).replace("|", "\\|").replace("<", "&lt;")


def csv_text(parts: Sequence[Table | Prose]) -> str:
    """One line a cell, then one a note; measured values also in full precision, as fractions."""
    rows = [row for part in parts for row in (_note_rows("", part.lines) if isinstance(part, Prose) else _rows(part))]
    return csv_lines([CSV_COLUMNS, *([harmless(row.get(name, "")) for name in CSV_COLUMNS] for row in rows)])


def _rows(table: Table) -> Iterator[Mapping[str, Any]]:
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            origin = cell.origin
            low, high = ("", "") if origin is None else origin.interval or ("", "")
            yield {
                "table": table.name,
                "kind": "reported" if row.is_reported else "measured",
                "row": row.label,
                "column": column,
                "text": cell.whole,
                "is_best": int(cell.is_best),
                "mark": row.mark,
                "low": low,
                "high": high,
            } | ({} if origin is None else asdict(origin))
    yield from _note_rows(table.name, table.notes)


def _note_rows(table: str, lines: Sequence[str]) -> Iterator[Mapping[str, Any]]:
    return ({"table": table, "kind": "note", "text": line} for line in lines)


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def harmless(value: str | int | float) -> str | int | float:
    """A cell on one line that no spreadsheet takes for a formula.

    >>> harmless("=1+1"), harmless("-"), harmless(-1)
    ("'=1+1", '-', -1)
    """
    if not isinstance(value, str):
        return value
    line = printable(value, 2000)
    return f"'{line}" if line.startswith(FORMULA_STARTS) and line != "-" else line


def html_page(parts: Sequence[Table | Prose]) -> str:
    """A page of its own without scripts, for light and dark."""
    body = "\n".join(_html(part) for part in parts)
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>su3d-bench tables</title>\n'
        f"<style>{STYLE}</style>\n{body}\n</html>\n"
    )


def _html(table: Table | Prose) -> str:
    if isinstance(table, Prose):
        return _list(table.lines) if table.is_list else "<p>" + "<br>\n".join(map(safe, table.lines)) + "</p>"
    head = "".join(f'<th scope="col">{safe(name)}</th>' for name in (table.head, *table.columns))
    bodies = []
    for block in blocks_of(table.rows):
        lines = []
        for row in block:
            cells = "".join(f"<td>{_strong(cell)}</td>" for cell in row.cells)
            kind = ' class="reported"' if row.is_reported else ""
            lines.append(f'<tr{kind}><th scope="row">{safe(row.title)}</th>{cells}</tr>')
        bodies.append("<tbody>" + "\n".join(lines) + "</tbody>")
    caption = safe(table.heading + table.caption)
    return (
        f'<section><div class="wide"><table><caption>{caption}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n" + "\n".join(bodies) + f"</table></div>{_list(table.notes)}</section>"
    )


def _list(lines: Sequence[str]) -> str:
    items = "".join(f"<li>{safe(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def _strong(cell: Cell) -> str:
    return f"<strong>{safe(cell.text)}</strong> {safe(cell.beside)}".rstrip() if cell.is_best else safe(cell.whole)


def safe(text: str) -> str:
    """``text`` on one line, without what HTML would take for its own."""
    return html.escape(printable(text, 2000))


FORMATS: Mapping[str, Callable[[Sequence[Table | Prose]], str]] = {
    "markdown": markdown,
    "latex": latex,
    "csv": csv_text,
    "html": html_page,
}
