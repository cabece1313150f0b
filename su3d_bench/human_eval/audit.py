"""A sample of illustrated questions for a manual check of questions and answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError, StoreError, printable, suggest
from su3d_bench.core.files.atomic import make_folder, write_bytes, write_text
from su3d_bench.formats.tables.table import Cell, Table, TableRow, bracketed, csv_lines, percent
from su3d_bench.human_eval.answers import MAX_CHARACTERS, rows_of_file
from su3d_bench.human_eval.drafts import Draft, with_answer
from su3d_bench.human_eval.drawing import Artist
from su3d_bench.human_eval.items import ARGUABLE, PICTURES, RIGHT, VERDICTS, WRONG
from su3d_bench.human_eval.sources import TruthSource
from su3d_bench.numerics.statistics import share_interval
from su3d_bench.questions.audit import AuditedQuestion
from su3d_bench.reports.sheet.page import Entry, list_page

FILE = "audit.csv"
COLUMNS = ("number", "scene", "kind", "text", "answer", "verdict", "remark")
ALL = "all"


@dataclass(frozen=True)
class Verdict:
    """A row of the table; ``verdict`` is empty until judged."""

    number: str
    scene: str
    kind: str
    text: str
    answer: str
    verdict: str
    remark: str

    @property
    def line(self) -> str:
        """The question on one line."""
        ends = f"; {self.remark}" if self.remark else ""
        return f"{self.verdict}: {self.number} {self.scene}, {self.kind}: {self.text} -> {self.answer}{ends}"


def read_verdicts(path: Path) -> list[Verdict]:
    """All questions of the file, in order; ``DataError`` for a missing column or an unknown verdict."""
    verdicts = []
    for at, cells in rows_of_file(path, COLUMNS):
        one = Verdict(**cells | {"verdict": cells["verdict"].lower()})
        if one.verdict and one.verdict not in VERDICTS:
            hint = suggest(one.verdict, VERDICTS, "leave it empty or use one of")
            raise DataError(f"{at}: unknown verdict '{printable(one.verdict, 40)}'{hint}")
        verdicts.append(one)
    if not verdicts:
        raise DataError(f"{printable(str(path), 200)}: contains no questions")
    return verdicts


def audit_table(verdicts: Sequence[Verdict]) -> Table:
    """Share of correct questions for each kind, followed by the incorrect ones; ``DataError`` if none is judged."""
    judged = [one for one in verdicts if one.verdict]
    if not judged:
        raise DataError(f"none of {len(verdicts)} questions is judged; fill 'verdict' with {', '.join(VERDICTS)}")
    kinds = [ALL, *sorted({one.kind for one in judged})]
    of_kind = {kind: [one.verdict for one in judged if kind in (ALL, one.kind)] for kind in kinds}
    faults = [one for verdict in (WRONG, ARGUABLE) for one in judged if one.verdict == verdict]
    n_open = len(verdicts) - len(judged)
    return Table(
        "audit",
        "Questions judged by annotators: right ones, and right or arguable ones.",
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
    """The same as JSON-compatible data."""
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
    n, n_of = len(verdicts), Counter(verdicts)
    shares = n_of[RIGHT] / n, (n_of[RIGHT] + n_of[ARGUABLE]) / n
    cells = (Cell(percent(share), bracketed(share_interval(share, n))) for share in shares)
    return (Cell(str(n)), *cells, Cell(str(n_of[WRONG])))


def make_audit(
    questions: Sequence[AuditedQuestion],
    dataset_of: Callable[[str], Any],
    out: Path,
    progress: Callable[[str], None] = lambda scene: None,
) -> Path:
    """Write pictures, a page and a table of ``questions`` into ``out``; the path of the page.

    ``dataset_of`` returns the dataset of a scene address. Raises ``StoreError`` instead of overwriting a table that
    contains verdicts.
    """
    table = out / FILE
    if table.is_file() and any(row.verdict for row in read_verdicts(table)):
        raise StoreError(f"{printable(str(table), 200)}: contains verdicts; choose another --out or remove it")
    make_folder(out / PICTURES)
    source = TruthSource(list(dict.fromkeys(one.scene for one in questions)), dataset_of)
    artist, drawn = Artist(source), ""
    rows: list[tuple[str | int, ...]] = [COLUMNS]
    entries = []
    for number, one in enumerate(questions, 1):
        if one.scene != drawn:
            drawn = one.scene
            progress(drawn)
        name = f"{number:03d}.jpg"
        write_bytes(out / PICTURES / name, artist.draw(_draft(one, source)))
        cells = (one.scene, one.kind, one.text, one.answer)
        rows.append((number, *(printable(cell, MAX_CHARACTERS) for cell in cells), "", ""))
        entries.append(Entry(f"{number}, {one.scene}, {one.kind}", one.text, _lines(one), (name,)))
    write_text(table, csv_lines(rows))
    note = "Red: answer objects. Blue: reference objects."
    write_text(out / "index.html", list_page(f"Questions to check: {len(entries)}", note, entries, PICTURES))
    return out / "index.html"


def _draft(question: AuditedQuestion, source: TruthSource) -> Draft:
    """The ids of the answer objects and reference objects to draw."""
    row_of = {instance: row for row, instance in enumerate(source.instances(question.scene).ids.tolist())}
    draft = Draft(kind="questions", scene=question.scene, methods=("",), instance_ids=(-1,))
    right, references = ([thing.id for thing in things] for things in (question.right, question.references))
    names = {number: f"#{number}" for number in (*right, *references)}
    return with_answer(draft, question.text, question.answer, (right, references), names, row_of)


def _lines(question: AuditedQuestion) -> tuple[str, ...]:
    references, others = (", ".join(one.shown for one in things) for things in (question.references, question.others))
    lines = (("answer", question.answer), ("compared with", references), ("no answer", others))
    return tuple(f"{name}: {words}" for name, words in lines if words)
