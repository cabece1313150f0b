"""Tables as LaTeX with booktabs; no text from a file can become a command, and each cell records its run."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import quote, unquote

from su3d_bench.core.errors import printable
from su3d_bench.formats.tables.table import Cell, Origin, Prose, Table, TableRow, blocks_of

HEADER = "% created by su3d-bench report tables; needs \\usepackage{booktabs}; su3d-bench report verify checks it"
_ESCAPES = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "`": r"\textasciigrave{}",
    # At the start of a row, these three would be read as options of the row end before it: \\[2pt], \\*
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",
}
_ACCENTS = {"\u0300": "`", "\u0301": "'", "\u0302": "^", "\u0303": "~", "\u0308": '"', "\u030a": "r", "\u030c": "v"}
_LIGATURE = re.compile(r"--|''|,,|[?!]`")
_SAFE = "/.-_+:@"
REPORTED = "as reported, not measured here"
GAP_PT, SMALLEST_GAP_PT = 4, 2
MAX_PAGE_ROWS = 62  # of the smallest type on a page, titles included
MAX_TITLE = 22  # characters of a line of a column's title, which may have several
MAX_LABEL_PT = 150  # of labels in a table wider than the page; longer labels are wrapped
# Column and page width of a two-column paper (IEEEtran: 252 pt and 516 pt), slightly reduced.
FLOATS = (("table", 238), ("table*", 480))
# Font sizes and width of a letter: bold Computer Modern digits at a normal size of 10 pt.
SIZES = ((r"\small", 5.3), (r"\footnotesize", 4.9), (r"\scriptsize", 4.4))
_ORIGIN = re.compile(
    r"% run=(?P<run>\S+) method=(?P<method>\S+) protocol=(?P<protocol>\S+) version=(?P<version>\d{1,6}) "
    r"metric=(?P<metric>\S+) what=(?P<what>value|ceiling|scenes) value=(?P<value>[0-9.e+-]{1,30})"
    r"(?: unit=(?P<unit>percent|fraction))?"
    r"(?: interval=(?P<low>[0-9.e+-]{1,30}),(?P<high>[0-9.e+-]{1,30}))?\s*$"
)
_MARK = re.compile(r"% run=")


def escape(text: str) -> str:
    r"""Escape ``text`` so that LaTeX prints it literally, in plain OT1 fonts without packages.

    >>> escape("50_% & é")
    "50\\_\\% \\& \\'{e}"
    """
    line = unicodedata.normalize("NFC", printable(text, 2000))
    line = _LIGATURE.sub(lambda match: match[0][0] + "\x00" + match[0][1], line)
    return "".join(_letter(character) for character in line)


def _letter(character: str) -> str:
    if character == "\x00":
        return "{}"
    if character in _ESCAPES:
        return _ESCAPES[character]
    if character.isascii():
        return character
    parts = unicodedata.normalize("NFD", character)
    if len(parts) == 2 and parts[0].isascii() and parts[0].isalpha() and parts[1] in _ACCENTS:
        letter = {"i": r"\i", "j": r"\j"}.get(parts[0], parts[0])
        return f"\\{_ACCENTS[parts[1]]}{{{letter}}}"
    return f"U+{ord(character):04X}"


def latex(parts: Sequence[Table | Prose]) -> str:
    """Return each table as a float, or several if it is too long for a page, with notes below in small type."""
    blocks = [HEADER]
    for part in parts:
        if isinstance(part, Prose):
            blocks.append("\n".join(f"\\noindent {escape(line)}\\par" for line in part.lines))
        else:
            blocks += _floats(part)
    return "\n\n".join(blocks) + "\n"


@dataclass(frozen=True)
class _Place:
    """The layout of a table on a two-column page: float, font size and half the gap between columns.

    ``label_pt``: the width at which labels are wrapped, None if they need not be; ``parts``: the columns of each
    tabular; the tabulars are stacked.
    """

    kind: str
    size: str
    gap_pt: int
    label_pt: float | None
    parts: tuple[tuple[int, ...], ...]


def _floats(table: Table) -> list[str]:
    place, name = _place(table), re.sub(r"[^A-Za-z0-9]+", "-", table.name).strip("-")
    n_parts = max(1, MAX_PAGE_ROWS // (len(table.rows) + 2))
    floats = []
    for start in range(0, max(1, len(place.parts)), n_parts):
        rest = replace(table, heading=f"{table.heading or table.caption} (continued)", caption="") if start else table
        parts, is_last = place.parts[start : start + n_parts], start + n_parts >= len(place.parts)
        kept = rest if is_last else replace(rest, notes=())
        floats.append(_float(kept, replace(place, parts=parts), f"{name}-{start}" if start else name))
    return floats


def _float(table: Table, place: _Place, name: str) -> str:
    lines = [
        f"\\begin{{{place.kind}}}[t]",
        r"  \centering\hbadness=10000",  # no warning about short captions in a narrow column
        f"  \\caption{{{escape(table.heading + table.caption)}}}",
        f"  \\label{{tab:{name}}}",
        f"  {place.size}\\setlength{{\\tabcolsep}}{{{place.gap_pt}pt}}",
    ]
    for k, columns in enumerate(place.parts):
        lines += [*(["", r"  \medskip"] if k else []), *_tabular(table, columns, place.label_pt)]
    if table.notes:
        lines += ["", r"  \smallskip", r"  \begin{minipage}{\linewidth}", r"    \scriptsize\raggedright"]
        lines += [f"    {escape(note)}\\par" for note in table.notes]
        lines.append(r"  \end{minipage}")
    return "\n".join([*lines, f"\\end{{{place.kind}}}"])


def _tabular(table: Table, columns: Sequence[int], label_pt: float | None) -> list[str]:
    first = "l" if label_pt is None else f"p{{{label_pt:.0f}pt}}"
    titles = [_title(table.columns[k]) for k in columns]
    lines = [f"  \\begin{{tabular}}{{@{{}}{first}{'r' * len(columns)}@{{}}}}", r"    \toprule"]
    lines.append(f"    {' & '.join([_label(table.head, label_pt), *titles])} \\\\")
    was_reported = False
    for block in blocks_of(table.rows):
        lines.append(r"    \midrule")
        if block[0].is_reported and not was_reported:
            was_reported = True
            lines.append(f"    \\multicolumn{{{len(columns) + 1}}}{{@{{}}l}}{{\\emph{{{REPORTED}}}}} \\\\")
        lines += [line for row in block for line in _row(row, columns, label_pt)]
    return [*lines, r"    \bottomrule", r"  \end{tabular}"]


def _place(table: Table) -> _Place:
    """Choose the layout from character counts; widths are not measured."""
    label = max(len(text) for text in (table.head, *(f"{row.label} {row.mark}" for row in table.rows)))
    columns = [
        max(map(len, (*_title_lines(name), *(row.cells[k].whole for row in table.rows if k < len(row.cells)))))
        for k, name in enumerate(table.columns)
    ]
    everything = tuple(range(len(columns)))
    for kind, width_pt in FLOATS:
        for size, letter_pt in SIZES:
            if (label + sum(columns)) * letter_pt + 2 * GAP_PT * len(columns) <= width_pt:
                return _Place(kind, size, GAP_PT, None, (everything,))
    (kind, width_pt), (size, letter_pt) = FLOATS[-1], SIZES[-1]
    label_pt = min(label * letter_pt, MAX_LABEL_PT)
    parts: list[list[int]] = [[]]
    left_pt = width_pt - label_pt
    for k, n_letters in enumerate(columns):
        needed_pt = n_letters * letter_pt + 2 * SMALLEST_GAP_PT
        if parts[-1] and needed_pt > left_pt:
            parts.append([])
            left_pt = width_pt - label_pt
        parts[-1].append(k)
        left_pt -= needed_pt
    broken = label_pt if label * letter_pt > MAX_LABEL_PT else None
    return _Place(kind, size, SMALLEST_GAP_PT, broken, tuple(map(tuple, parts)))


def _title(text: str) -> str:
    stacked = r"\\".join(map(escape, _title_lines(text)))
    return rf"\shortstack[r]{{{stacked}}}" if len(_title_lines(text)) > 1 else stacked


def _title_lines(text: str) -> list[str]:
    return textwrap.wrap(text, MAX_TITLE, break_long_words=False, break_on_hyphens=False) or [""]


def _label(text: str, width_pt: float | None, mark: str = "") -> str:
    """Return a label; with a width, it may wrap after separators."""
    raised = f"\\textsuperscript{{{escape(mark)}}}" if mark else ""
    if width_pt is None:
        return escape(text) + raised
    pieces = re.split(r"(?<=[@=,/])(?=\S)", text)
    shown = r"\allowbreak{}".join(map(escape, pieces))
    return rf"\raggedright {shown}{raised}"


def _row(row: TableRow, columns: Sequence[int], label_pt: float | None) -> list[str]:
    cells = [row.cells[k] for k in columns if k < len(row.cells)]
    lines = [f"      & {_cell(cell)}".rstrip() for cell in cells]
    return [f"    {_label(row.label, label_pt, row.mark)}", *lines, r"      \\"]


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    text = f"\\textbf{{{text}}}" if cell.is_best else text
    text += f" {escape(cell.beside)}" if cell.beside else ""
    return text if cell.origin is None else f"{text} {origin_comment(cell.origin)}"


def origin_comment(origin: Origin) -> str:
    """Return the one-line comment that records a cell's origin, without spaces inside values."""
    parts = [("run", origin.run), ("method", origin.method), ("protocol", origin.protocol)]
    comment = " ".join(f"{name}={quote(value, safe=_SAFE)}" for name, value in parts)
    comment += f" version={origin.version} metric={quote(origin.metric, safe=_SAFE)} what={origin.what}"
    comment += f" value={origin.value!r}"
    comment += "" if origin.unit == "percent" else f" unit={origin.unit}"
    if origin.interval is not None:
        comment += f" interval={origin.interval[0]!r},{origin.interval[1]!r}"
    return f"% {comment}"


@dataclass(frozen=True)
class PrintedCell:
    """A cell of a LaTeX source that records its run: its ``line`` (1-based), its text, and its origin.

    ``origin`` is None if the comment is malformed.
    """

    line: int
    shown: str
    origin: Origin | None

    @property
    def numbers(self) -> list[str]:
        """The numbers of the cell as printed: the value, then the bounds of its interval."""
        return re.findall(r"\d+(?:\.\d+)?", self.shown)


def printed_cells(text: str) -> list[PrintedCell]:
    """Return every cell of a LaTeX source that has a comment of ``origin_comment``."""
    cells = []
    for number, line in enumerate(text.splitlines(), start=1):
        mark = _MARK.search(line)
        if mark is None:
            continue
        shown = re.split(r"(?<!\\)&", line[: mark.start()])[-1].strip()
        cells.append(PrintedCell(number, shown, _origin(line[mark.start() :])))
    return cells


def _origin(comment: str) -> Origin | None:
    match = _ORIGIN.fullmatch(comment)
    if match is None:
        return None
    fields: dict[str, Any] = match.groupdict()
    low, high = fields.pop("low"), fields.pop("high")
    fields["unit"] = fields["unit"] or "percent"
    fields |= {name: unquote(fields[name]) for name in ("run", "method", "protocol", "metric")}
    try:
        fields |= {"version": int(fields["version"]), "value": float(fields["value"])}
        return Origin(**fields, interval=None if low is None else (float(low), float(high)))
    except ValueError:
        return None
