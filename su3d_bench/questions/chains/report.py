"""What a system answered to a file of Beacon3D, as a table and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError, printable
from su3d_bench.questions.chains.answered import Number, answer_numbers, grounding_numbers
from su3d_bench.questions.chains.beacon3d_files import (
    PAGE,
    chains_of,
    kind_of_metadata,
    questions_of_objects,
    read_found,
    read_metadata,
    read_replies,
)
from su3d_bench.reports.tables.model import Cell, Table, TableRow, percent

JUDGE = (
    "where two numbers stand, answers wait for a judge: the least and the most that one can make of them; let a "
    "language model score them as evaluate_qa.py of Beacon3D does, and give each answer its 'score', 1 to 5"
)


def answered_numbers(asked: Path, answers: Path) -> tuple[str, list[Number]]:
    """``grounding`` or ``qa``, as ``asked``, a metadata file of Beacon3D, is; and the numbers of the answers to it."""
    where = printable(str(asked), 200)
    content = read_metadata(asked)
    kind = kind_of_metadata(content)
    if kind is None:
        raise DataError(f"{where}: is no metadata_*_grounding.json or metadata_*_qa.json of Beacon3D, see {PAGE}")
    if kind == "grounding":
        chains = chains_of(content, where)
        return kind, grounding_numbers(chains, read_found(answers, chains))
    questions = questions_of_objects(content, where)
    return kind, answer_numbers(questions, read_replies(answers, questions))


def answered_table(kind: str, numbers: Sequence[Number]) -> Table:
    """A row a number, in per cent."""
    is_open = any(one.least < one.most for one in numbers)
    rows = tuple(TableRow(one.name, (Cell(_share(one)), Cell(f"{one.n:,}"))) for one in numbers)
    caption = "Beacon3D's grounding." if kind == "grounding" else "Beacon3D's question answering."
    return Table("beacon3d", caption, "number", ("%", "of"), rows, (JUDGE,) if is_open else ())


def answered_json(kind: str, numbers: Sequence[Number]) -> dict[str, Any]:
    """The same for programs, as fractions."""
    return {"kind": kind, "numbers": [asdict(one) for one in numbers]}


def _share(one: Number) -> str:
    return percent(one.least) if one.least == one.most else f"{percent(one.least)} to {percent(one.most)}"
