"""Tables as LaTeX with booktabs; nothing that comes from a file can be a command, and each cell names its run."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote, unquote

from su3d_bench.plain_text import printable
from su3d_bench.reports.table_model import Cell, Interval, Origin, Table, TableRow, What, blocks_of

HEADER = "% made by su3d-bench report tables; needs \\usepackage{booktabs}; su3d-bench report verify checks it"
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
    # After the end of a row these three would belong to it: \\[2pt], \\*
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",
}
_ACCENTS = {"\u0300": "`", "\u0301": "'", "\u0302": "^", "\u0303": "~", "\u0308": '"', "\u030a": "r", "\u030c": "v"}
_LIGATURE = re.compile(r"--|''|,,|[?!]`")
_SAFE = "/.-_+:@"
REPORTED = "as reported, not measured here"
GAP_PT, SMALLEST_GAP_PT = 4, 2
# Widths of one column and of the page in a paper of two columns (IEEEtran: 252 pt and 516 pt), a little narrower.
FLOATS = (("table", 238), ("table*", 480))
# Type sizes and the width of a letter: digits of Computer Modern, bold, with 10 pt as the normal size.
SIZES = ((r"\small", 5.3), (r"\footnotesize", 4.9), (r"\scriptsize", 4.4))
_ORIGIN = re.compile(
    r"% run=(?P<run>\S+) method=(?P<method>\S+) protocol=(?P<protocol>\S+) version=(?P<version>\d{1,6}) "
    r"metric=(?P<metric>\S+) what=(?P<what>value|ceiling|scenes) value=(?P<value>[0-9.e+-]{1,30})"
    r"(?: interval=(?P<low>[0-9.e+-]{1,30}),(?P<high>[0-9.e+-]{1,30}))?\s*$"
)
_MARK = re.compile(r"% run=")


def escape(text: str) -> str:
    r"""``text`` as LaTeX shows it letter for letter, in plain OT1 fonts without packages.

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


def latex(tables: Sequence[Table]) -> str:
    """All ``tables`` as floats of their own, notes beneath in small type."""
    return "\n\n".join([HEADER, *(_float(table) for table in tables)]) + "\n"


def _float(table: Table) -> str:
    kind, size, gap_pt = _place(table)
    lines = [
        f"\\begin{{{kind}}}[t]",
        r"  \centering\hbadness=10000",  # a caption of few words in a narrow column
        f"  \\caption{{{escape(table.caption)}}}",
        f"  \\label{{tab:{re.sub(r'[^A-Za-z0-9]+', '-', table.name).strip('-')}}}",
        f"  {size}\\setlength{{\\tabcolsep}}{{{gap_pt}pt}}",
        f"  \\begin{{tabular}}{{@{{}}l{'r' * len(table.columns)}@{{}}}}",
        r"    \toprule",
        f"    {escape(table.head)} & {' & '.join(map(escape, table.columns))} \\\\",
    ]
    was_reported = False
    for block in blocks_of(table.rows):
        lines.append(r"    \midrule")
        if block[0].is_reported and not was_reported:
            was_reported = True
            lines.append(f"    \\multicolumn{{{len(table.columns) + 1}}}{{@{{}}l}}{{\\emph{{{REPORTED}}}}} \\\\")
        lines += [line for row in block for line in _row(row)]
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    if table.notes:
        lines += ["", r"  \smallskip", r"  \begin{minipage}{\linewidth}", r"    \scriptsize\raggedright"]
        lines += [f"    {escape(note)}\\par" for note in table.notes]
        lines.append(r"  \end{minipage}")
    return "\n".join([*lines, f"\\end{{{kind}}}"])


def _place(table: Table) -> tuple[str, str, int]:
    """The float, the type size and half the gap between columns with which the table fits a page of two columns.

    Letters are counted, not measured: what does not fit in the smallest type may be wider than the page.
    """
    titles = [table.head, *(f"{row.label} {row.mark}" for row in table.rows)]
    columns = [
        [name, *(row.cells[k].whole for row in table.rows if k < len(row.cells))]
        for k, name in enumerate(table.columns)
    ]
    n_letters = sum(max(map(len, texts)) for texts in (titles, *columns))
    for kind, width_pt in FLOATS:
        for size, letter_pt in SIZES:
            if n_letters * letter_pt + 2 * GAP_PT * len(table.columns) <= width_pt:
                return kind, size, GAP_PT
    return FLOATS[-1][0], SIZES[-1][0], SMALLEST_GAP_PT


def _row(row: TableRow) -> list[str]:
    mark = f"\\textsuperscript{{{escape(row.mark)}}}" if row.mark else ""
    return [f"    {escape(row.label)}{mark}", *(f"      & {_cell(cell)}".rstrip() for cell in row.cells), r"      \\"]


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    text = f"\\textbf{{{text}}}" if cell.is_best else text
    text += f" {escape(cell.beside)}" if cell.beside else ""
    return text if cell.origin is None else f"{text} {origin_comment(cell.origin)}"


def origin_comment(origin: Origin) -> str:
    """The comment that tells a cell's run, in one line without a blank inside a value."""
    parts = [("run", origin.run), ("method", origin.method), ("protocol", origin.protocol)]
    told = " ".join(f"{name}={quote(value, safe=_SAFE)}" for name, value in parts)
    told += f" version={origin.version} metric={quote(origin.metric, safe=_SAFE)} what={origin.what}"
    told += f" value={origin.value!r}"
    if origin.interval is not None:
        told += f" interval={origin.interval[0]!r},{origin.interval[1]!r}"
    return f"% {told}"


@dataclass(frozen=True)
class PrintedCell:
    """A cell of a paper's source that names its run: its ``line`` from 1, the numbers in it, and its origin.

    ``origin`` is None where the comment is damaged.
    """

    line: int
    shown: str
    origin: Origin | None

    @property
    def numbers(self) -> list[str]:
        """The numbers of the cell as printed: the value, then the ends of its interval."""
        return re.findall(r"\d+(?:\.\d+)?", self.shown)


def printed_cells(text: str) -> list[PrintedCell]:
    """Every cell of a LaTeX source that carries the comment of ``origin_comment``."""
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        mark = _MARK.search(line)
        if mark is None:
            continue
        shown = re.split(r"(?<!\\)&", line[: mark.start()])[-1].strip()
        found.append(PrintedCell(number, shown, _origin(line[mark.start() :])))
    return found


def _origin(comment: str) -> Origin | None:
    match = _ORIGIN.fullmatch(comment)
    if match is None:
        return None
    try:
        value = float(match["value"])
        interval: Interval | None = None
        if match["low"] is not None:
            interval = (float(match["low"]), float(match["high"]))
    except ValueError:
        return None
    texts = {name: unquote(match[name]) for name in ("run", "method", "protocol", "metric")}
    what: dict[str, What] = {"value": "value", "ceiling": "ceiling", "scenes": "scenes"}
    return Origin(
        texts["run"],
        texts["method"],
        texts["protocol"],
        int(match["version"]),
        texts["metric"],
        what[match["what"]],
        value,
        interval,
    )
