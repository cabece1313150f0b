"""Tables, and what stands between them, as text, Markdown, CSV and HTML; ``FORMATS`` has LaTeX too.

Each form has one function through which every text goes: ``markup_free``, ``harmless``, ``safe``, and ``escape`` of
LaTeX.
"""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import printable
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.tables.table import MAX_CELL_CHARACTERS, Cell, Prose, Table, blocks_of, csv_lines
from su3d_bench.reports.tables.latex import latex

CSV_COLUMNS = (
    *("table", "kind", "row", "column", "text", "is_best", "value", "low", "high"),
    *("what", "run", "method", "protocol", "version", "metric", "unit", "mark"),
)
# What CommonMark takes for markup wherever it stands; links need two of the brackets beside each other, and of names
# with underscores only the outer ones are emphasis.
_MARKUP = re.compile(
    r"""\\(?=[!-/:-@\[-`{-~]) | [`*|] | (?<![^\W_])_ | _(?![^\W_]) | ~(?=~) | (?<=\])[(:\[]""", re.VERBOSE
)
_ENTITY = re.compile(r"&(?=#?\w+;)")
_BLOCK = re.compile(r"^(?:[-+](?=\s)|[#>]|\d{1,9}(?=[.)](?:\s|$)))")
TITLE = "su3d-bench tables"
MAX_CELL_LINE = 28  # characters of a cell
MAX_NOTE_CHARACTERS = 7_000  # characters: it may name every scene of a data set


def markdown(parts: Sequence[Table | Prose]) -> str:
    """All ``parts``, each table with its caption above and its notes beneath; the best is in two asterisks a side."""
    return _laid_out(parts, markup_free)


def plain(parts: Sequence[Table | Prose], width: int | None = None) -> str:
    """As ``markdown``, for a terminal: texts stand there as they are.

    ``width``: characters that a line may have. What is longer is folded between words; a wider table is a list.
    """
    return _laid_out(parts, printable, width)


def _laid_out(parts: Sequence[Table | Prose], shown: Callable[[str, int], str], width: int | None = None) -> str:
    return "\n\n".join(_block(part, shown, width) for part in parts) + "\n"


def _block(part: Table | Prose, shown: Callable[[str, int], str], width: int | None) -> str:
    if isinstance(part, Prose):
        begin = "- " if part.is_list else ""
        return "\n".join(_folded(shown(line, MAX_NOTE_CHARACTERS), width, begin) for line in part.lines)
    head = [shown(text, MAX_CELL_CHARACTERS) for text in (part.head, *part.columns)]
    rows = [[shown(row.title, MAX_CELL_CHARACTERS), *(_marked(cell, shown) for cell in row.cells)] for row in part.rows]
    lines = aligned([head, *rows]) if rows else []
    if width is not None and lines and len(lines[0]) > width:
        lines = _on_its_side([head, *rows], width)
    heading = f"**{shown(part.heading, MAX_CELL_CHARACTERS)}**" if part.heading else ""
    gap = " " if heading and part.caption.startswith(" ") else ""
    caption = _folded(f"{heading}{gap}{shown(part.caption, MAX_CELL_CHARACTERS)}", width)
    notes = [_folded(shown(note, MAX_NOTE_CHARACTERS), width, "- ") for note in part.notes]
    return "\n\n".join(block for block in (caption, "\n".join(lines), "\n".join(notes)) if block)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table, the first row its header, with columns of one width."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return [lines[0], rule, *lines[1:]]


def _folded(text: str, width: int | None, begin: str = "") -> str:
    """``text`` behind ``begin``, folded between words where it is longer than ``width``."""
    return f"{begin}{text}" if width is None else "\n".join(_wrapped(text, width, begin))


def _wrapped(text: str, width: int, begin: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        max(width, 1),
        initial_indent=begin,
        subsequent_indent=" " * len(begin),
        break_long_words=False,  # names, paths and numbers stay whole
        break_on_hyphens=False,
    ) or [begin]


def _on_its_side(rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """The lines of a list a row: its first cell, below it the others behind the names of their columns."""
    (head, *names), *body = rows
    size = min(max(map(len, names), default=0), max(width // 2 - 4, 1))
    lines = []
    for label, *cells in body:
        lines += ["", *_wrapped(f"{head}: {label}" if head else label, width)]
        for name, cell in zip(names, cells, strict=True):
            pairs = zip_longest(_wrapped(name, size), _wrapped(cell, width - size - 4), fillvalue="")
            lines += [f"  {left:<{size}}  {right}".rstrip() for left, right in pairs]
    return lines[1:]


def _marked(cell: Cell, shown: Callable[[str, int], str]) -> str:
    if not cell.is_best:
        return shown(cell.whole, MAX_CELL_CHARACTERS)
    return f"**{shown(cell.text, MAX_CELL_CHARACTERS)}** {shown(cell.beside, MAX_CELL_CHARACTERS)}".rstrip()


def markup_free(text: str, most: int = MAX_CELL_CHARACTERS) -> str:
    r"""``text`` on one line as Markdown shows it letter for letter: no tag, link, emphasis, heading or end of a cell.

    >>> markup_free("<b> [a](http://x) | *top_m=5* [1.0, 2.0]"), markup_free("# 1"), markup_free("_a_b")
    ('&lt;b> [a]\\(http://x) \\| \\*top_m=5\\* [1.0, 2.0]', '\\# 1', '\\_a_b')
    """
    line = _ENTITY.sub(r"\\&", _MARKUP.sub(r"\\\g<0>", printable(text, most))).replace("<", "&lt;")
    return _BLOCK.sub(lambda match: f"{match[0]}\\" if match[0].isdigit() else f"\\{match[0]}", line)


def csv_text(parts: Sequence[Table | Prose]) -> str:
    """One line a cell, then one a note; measured values also in full precision, as fractions."""
    rows = [row for part in parts for row in (_note_rows("", part.lines) if isinstance(part, Prose) else _rows(part))]
    return csv_lines([CSV_COLUMNS, *([row.get(name, "") for name in CSV_COLUMNS] for row in rows)])


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


def html_page(parts: Sequence[Table | Prose]) -> str:
    """A page of its own without scripts, for light and dark."""
    style = file_text(Path(__file__).parent / "tables.css").replace("\n", "")
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{TITLE}</title>\n"
        f"<style>{style}</style>\n<main>\n<h1>{TITLE}</h1>\n{html_tables(parts)}\n</main>\n</html>\n"
    )


def html_tables(parts: Sequence[Table | Prose]) -> str:
    """The parts alone, to stand in a page or notebook of somebody else's."""
    return "\n".join(_html(part) for part in parts)


def _html(table: Table | Prose) -> str:
    if isinstance(table, Prose):
        return _list(table.lines) if table.is_list else "<p>" + "<br>\n".join(map(safe, table.lines)) + "</p>"
    head = "".join(f'<th scope="col"{_short(name)}>{safe(name)}</th>' for name in (table.head, *table.columns))
    bodies = []
    for block in blocks_of(table.rows):
        lines = []
        for row in block:
            cells = "".join(f"<td{_short(cell.whole)}>{_strong(cell)}</td>" for cell in row.cells)
            kind = ' class="reported"' if row.is_reported else ""
            lines.append(f'<tr{kind}><th scope="row"{_short(row.title)}>{safe(row.title)}</th>{cells}</tr>')
        bodies.append("<tbody>" + "\n".join(lines) + "</tbody>")
    caption = safe(table.heading + table.caption)
    return (
        f'<section><div class="wide" tabindex="0" role="region" aria-label="{caption}">'
        f"<table><caption><span>{caption}</span></caption>\n"
        f"<thead><tr>{head}</tr></thead>\n" + "\n".join(bodies) + f"</table></div>{_list(table.notes)}</section>"
    )


def _short(text: str) -> str:
    """What keeps a number with its interval, or a name, on one line: the box scrolls where the screen is narrow."""
    return ' class="short"' if len(text) <= MAX_CELL_LINE else ""


def _list(lines: Sequence[str]) -> str:
    items = "".join(f"<li>{safe(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def _strong(cell: Cell) -> str:
    return f"<strong>{safe(cell.text)}</strong> {safe(cell.beside)}".rstrip() if cell.is_best else safe(cell.whole)


def safe(text: str) -> str:
    """``text`` on one line, without what HTML would take for its own."""
    return html.escape(printable(text, MAX_CELL_CHARACTERS))


FORMATS: Mapping[str, Callable[[Sequence[Table | Prose]], str]] = {
    "text": plain,
    "markdown": markdown,
    "latex": latex,
    "csv": csv_text,
    "html": html_page,
}
