"""Tables as Markdown, CSV and HTML."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence

from su3d_bench.core.errors import printable
from su3d_bench.reports.tables.model import Cell, Table, blocks_of
from su3d_bench.reports.tables.run import aligned

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
    "mark",
)
# A spreadsheet takes what begins so for a formula; an apostrophe before it makes it text.
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color-scheme:light dark}"
    "table{border-collapse:collapse;margin:1rem 0}caption{text-align:left;padding:.3rem 0}"
    "th,td{padding:.2rem .7rem;text-align:right}th:first-child,td:first-child{text-align:left}"
    "thead{border-top:2px solid;border-bottom:1px solid}tbody{border-bottom:1px solid}tbody:last-of-type{border-bottom:"
    "2px solid}.reported{font-style:italic}.wide{overflow-x:auto}"
)


def markdown(tables: Sequence[Table]) -> str:
    """All ``tables``, each with its caption above and its notes beneath; the best is between two asterisks a side."""
    return "\n\n".join(_markdown(table) for table in tables) + "\n"


def _markdown(table: Table) -> str:
    rows = [[row.title, *(_marked(cell) for cell in row.cells)] for row in table.rows]
    lines = aligned([[_pipes(text) for text in row] for row in [[table.head, *table.columns], *rows]]) if rows else []
    notes = [f"- {_pipes(note)}" for note in table.notes]
    return "\n\n".join("\n".join(part) for part in ([_pipes(table.caption)], lines, notes) if part)


def _marked(cell: Cell) -> str:
    return f"**{cell.text}** {cell.beside}".rstrip() if cell.is_best else cell.whole


def _pipes(text: str) -> str:
    """``text`` without what would end a cell or begin HTML."""
    return printable(text, 2000).replace("|", "\\|").replace("<", "&lt;")


def csv_text(tables: Sequence[Table]) -> str:
    """One line a cell, then one a note; measured values also in full precision, as fractions."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for table in tables:
        for row in table.rows:
            for column, cell in zip(table.columns, row.cells, strict=True):
                values: dict[str, str | int | float] = {
                    "table": table.name,
                    "kind": "reported" if row.is_reported else "measured",
                    "row": row.label,
                    "column": column,
                    "text": cell.whole,
                    "is_best": int(cell.is_best),
                    "mark": row.mark,
                }
                if (origin := cell.origin) is not None:
                    low, high = origin.interval or ("", "")
                    values |= {"value": origin.value, "low": low, "high": high, "what": origin.what, "run": origin.run}
                    values |= {"method": origin.method, "protocol": origin.protocol, "version": origin.version}
                    values |= {"metric": origin.metric}
                writer.writerow({key: harmless(value) for key, value in values.items()})
        for note in table.notes:
            writer.writerow({"table": harmless(table.name), "kind": "note", "text": harmless(note)})
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


def html_page(tables: Sequence[Table]) -> str:
    """A page of its own without scripts, for light and dark."""
    body = "\n".join(_html(table) for table in tables)
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>su3d-bench tables</title>\n'
        f"<style>{STYLE}</style>\n{body}\n</html>\n"
    )


def _html(table: Table) -> str:
    head = "".join(f'<th scope="col">{_text(name)}</th>' for name in (table.head, *table.columns))
    bodies = []
    for block in blocks_of(table.rows):
        lines = []
        for row in block:
            cells = "".join(f"<td>{_strong(cell)}</td>" for cell in row.cells)
            kind = ' class="reported"' if row.is_reported else ""
            lines.append(f'<tr{kind}><th scope="row">{_text(row.title)}</th>{cells}</tr>')
        bodies.append("<tbody>" + "\n".join(lines) + "</tbody>")
    notes = "".join(f"<li>{_text(note)}</li>" for note in table.notes)
    return (
        f'<section><div class="wide"><table><caption>{_text(table.caption)}</caption>\n<thead><tr>{head}</tr></thead>\n'
        + "\n".join(bodies)
        + f"</table></div>{f'<ul>{notes}</ul>' if notes else ''}</section>"
    )


def _strong(cell: Cell) -> str:
    return f"<strong>{_text(cell.text)}</strong> {_text(cell.beside)}".rstrip() if cell.is_best else _text(cell.whole)


def _text(text: str) -> str:
    return html.escape(printable(text, 2000))
