"""What people said of a sample of questions: how many are right, by kind, and which are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError, printable, reading, suggest
from su3d_bench.core.system.files import file_bytes
from su3d_bench.formats.tables.table import Cell, Table, TableRow, bracketed, percent
from su3d_bench.numerics.statistics import share_interval
from su3d_bench.sheets.items import ARGUABLE, RIGHT, VERDICTS, WRONG
from su3d_bench.sheets.judging.answers import MOST_TEXT_BYTES, cell_text, csv_rows

FILE = "audit.csv"
COLUMNS = ("number", "scene", "kind", "text", "answer", "verdict", "remark")
ALL = "all"


@dataclass(frozen=True)
class Verdict:
    """A line of the table; ``verdict`` is empty where nobody has judged yet."""

    number: str
    scene: str
    kind: str
    text: str
    answer: str
    verdict: str
    remark: str

    @property
    def line(self) -> str:
        """The question in one line."""
        ends = f"; {self.remark}" if self.remark else ""
        return f"{self.verdict}: {self.number} {self.scene}, {self.kind}: {self.text} -> {self.answer}{ends}"


def read_verdicts(path: Path) -> list[Verdict]:
    """Every question of the file in its order; ``DataError`` for a missing column or an unknown verdict."""
    where = printable(str(path), 200)
    with reading(where, DataError):
        if path.stat().st_size > MOST_TEXT_BYTES:
            raise DataError(f"{where}: has {path.stat().st_size >> 20} MiB; an audit is smaller")
        rows = csv_rows(file_bytes(path), where)
    header = [name.strip().lower() for name in rows[0]] if rows else []
    missing = [name for name in COLUMNS if header.count(name) != 1]
    if missing:
        raise DataError(
            f"{where}: the first line lacks the column {', '.join(missing)}, or has it twice; expected "
            f"{','.join(COLUMNS)}"
        )
    verdicts = []
    for number, row in enumerate(rows[1:], 2):
        at = f"{where}: row {number}"
        cells = {name: cell_text(value, name, at) for name, value in zip(header, row, strict=False) if name in COLUMNS}
        if not any(cells.values()):
            continue
        one = Verdict(**dict.fromkeys(COLUMNS, "") | cells | {"verdict": cells.get("verdict", "").lower()})
        if one.verdict and one.verdict not in VERDICTS:
            hint = suggest(one.verdict, VERDICTS, "write nothing, or one of")
            raise DataError(f"{at}: unknown verdict '{printable(one.verdict, 40)}'{hint}")
        verdicts.append(one)
    if not verdicts:
        raise DataError(f"{where}: holds no question")
    return verdicts


def audit_table(verdicts: Sequence[Verdict]) -> Table:
    """How many of each kind are right, and below it what is not; ``DataError`` where nothing is judged."""
    judged = [one for one in verdicts if one.verdict]
    if not judged:
        raise DataError(f"none of {len(verdicts)} questions is judged; write {', '.join(VERDICTS)} into 'verdict'")
    kinds = [ALL, *sorted({one.kind for one in judged})]
    of_kind = {kind: [one.verdict for one in judged if kind in (ALL, one.kind)] for kind in kinds}
    faults = [one for verdict in (WRONG, ARGUABLE) for one in judged if one.verdict == verdict]
    n_open = len(verdicts) - len(judged)
    return Table(
        "audit",
        "Questions judged by people: plainly right, and with the arguable ones.",
        "kind",
        ("judged", "right", "right or arguable", "wrong"),
        tuple(TableRow(kind, _cells(of_kind[kind])) for kind in kinds),
        (
            "in brackets: Wilson's 95 % interval over questions",
            *([f"{n_open} of {len(verdicts)} questions are not judged yet"] if n_open else []),
            *(one.line for one in faults),
        ),
    )


def audit_json(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """The same for programs."""
    judged = [one for one in verdicts if one.verdict]
    counts = {
        kind: {verdict: sum(one.verdict == verdict and one.kind == kind for one in judged) for verdict in VERDICTS}
        for kind in sorted({one.kind for one in judged})
    }
    return {
        "n": len(verdicts),
        "n_judged": len(judged),
        "kinds": counts,
        "wrong": [asdict(one) for one in judged if one.verdict == WRONG],
    }


def _cells(verdicts: Sequence[str]) -> tuple[Cell, ...]:
    n_wrong = sum(verdict == WRONG for verdict in verdicts)
    shares = [_share([verdict in wanted for verdict in verdicts]) for wanted in ((RIGHT,), (RIGHT, ARGUABLE))]
    return (Cell(str(len(verdicts))), *shares, Cell(str(n_wrong)))


def _share(is_so: Sequence[bool]) -> Cell:
    share = sum(is_so) / len(is_so)
    return Cell(percent(share), bracketed(share_interval(share, len(is_so))))
