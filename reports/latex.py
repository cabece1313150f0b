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
    lines = [
        r"\begin{table}[t]",
        r"  \centering",
        f"  \\caption{{{escape(table.caption)}}}",
        f"  \\label{{tab:{re.sub(r'[^A-Za-z0-9]+', '-', table.name).strip('-')}}}",
        f"  \\begin{{tabular}}{{@{{}}l{'r' * len(table.columns)}@{{}}}}",
        r"    \toprule",
        f"    {escape(table.head)} & {' & '.join(map(escape, table.columns))} \\\\",
    ]
    for block in blocks_of(table.rows):
        lines.append(r"    \midrule")
        lines += [line for row in block for line in _row(row)]
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    if table.notes:
        lines += [r"", r"  \smallskip", r"  \begin{minipage}{\linewidth}", r"    \footnotesize\raggedright"]
        lines += [f"    {escape(note)}\\par" for note in table.notes]
        lines.append(r"  \end{minipage}")
    return "\n".join([*lines, r"\end{table}"])


def _row(row: TableRow) -> list[str]:
    return [f"    {escape(row.title)}", *(f"      & {_cell(cell)}" for cell in row.cells), r"      \\"]


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    text = f"\\textbf{{{text}}}" if cell.is_best else text
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
