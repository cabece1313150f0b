"""A table before it has a format: rows of cells that know the run or the print that they come from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from su3d_bench.core.types import Interval

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
    blocks: list[list[TableRow]] = []
    for row in rows:
        if blocks and (blocks[-1][-1].is_reported, blocks[-1][-1].group) == (row.is_reported, row.group):
            blocks[-1].append(row)
        else:
            blocks.append([row])
    return blocks
