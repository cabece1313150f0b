"""A table for a paper before it has a format: rows of cells that know the run or the print that they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

NOT_MEASURED = "-"
Interval = tuple[float, float]
What = Literal["value", "ceiling", "scenes"]


def is_count(metric: str) -> bool:
    """Whether a metric is a number of something and no share, by its name as in ``metrics.json``."""
    return metric.startswith("n_")


@dataclass(frozen=True)
class Origin:
    """Which number of which run a cell shows; ``value`` is a fraction, or the number of scored scenes."""

    run: str
    method: str
    protocol: str
    version: int
    metric: str
    what: What
    value: float
    interval: Interval | None = None


@dataclass(frozen=True)
class Cell:
    """``text`` as it is shown, without the mark of the best, and ``beside`` it, an interval, which is never marked.

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
    """``name`` is short and for references; ``head`` titles the first column, ``columns`` those of the cells."""

    name: str
    caption: str
    head: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]


def blocks_of(rows: Sequence[TableRow]) -> list[list[TableRow]]:
    """Rows that belong together, in order: measured before reported, one group after the other."""
    blocks: list[list[TableRow]] = []
    for row in rows:
        if blocks and (blocks[-1][-1].is_reported, blocks[-1][-1].group) == (row.is_reported, row.group):
            blocks[-1].append(row)
        else:
            blocks.append([row])
    return blocks
