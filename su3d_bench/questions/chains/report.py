"""What a system answered to a file of Beacon3D, as a table and for programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import ConfigError, DataError, counted, printable
from su3d_bench.formats.tables.table import Cell, Table, TableRow, percent
from su3d_bench.questions.chains.answered import Number, answer_numbers, grounding_numbers
from su3d_bench.questions.chains.beacon3d_files import (
    PAGE,
    Reply,
    chains_of,
    kind_of_metadata,
    questions_of_objects,
    read_found,
    read_metadata,
    read_replies,
)
from su3d_bench.questions.chains.judge import Judged, Key

NO_JUDGE = (
    "where two numbers stand, answers wait for a judge: the least and the most that one can make of them; name a "
    "language model with --judge, or give each answer its 'score', 1 to 5"
)


@dataclass(frozen=True)
class Answered:
    """The numbers of answers to a file of Beacon3D, ``grounding`` or ``qa``, and what a judge did for them."""

    kind: str
    numbers: tuple[Number, ...]
    judged: Judged | None = None


def answered_file(asked: Path, answers: Path, judge: Callable[[Mapping[Key, Reply]], Judged] | None = None) -> Answered:
    """The numbers of the answers in a file to ``asked``, a metadata file of Beacon3D."""
    kind, content = _kind_of(asked)
    if kind == "grounding":
        if judge is not None:
            raise ConfigError(f"{_where(asked)}: is of grounding, whose answers are right or not; --judge is for qa")
        chains = chains_of(content, _where(asked))
        return Answered(kind, tuple(grounding_numbers(chains, read_found(answers, chains))))
    questions = questions_of_objects(content, _where(asked))
    replies = read_replies(answers, questions)
    scored = None if judge is None else judge(replies)
    return Answered(kind, tuple(answer_numbers(questions, replies if scored is None else scored.replies)), scored)


def answers_to_questions(asked: Path, answers: Path) -> Mapping[Key, Reply]:
    """The answers in a file to a metadata file of questions; none where that is of grounding."""
    kind, content = _kind_of(asked)
    return read_replies(answers, questions_of_objects(content, _where(asked))) if kind == "qa" else {}


def _kind_of(asked: Path) -> tuple[str, Any]:
    content = read_metadata(asked)
    kind = kind_of_metadata(content)
    if kind is None:
        raise DataError(
            f"{_where(asked)}: is no metadata_*_grounding.json or metadata_*_qa.json of Beacon3D, see {PAGE}"
        )
    return kind, content


def _where(path: Path) -> str:
    return printable(str(path), 200)


def answered_table(answered: Answered) -> Table:
    """A row a number, in per cent."""
    is_open = any(one.least < one.most for one in answered.numbers)
    rows = tuple(TableRow(one.name, (Cell(_share(one)), Cell(f"{one.n:,}"))) for one in answered.numbers)
    caption = "Beacon3D's grounding." if answered.kind == "grounding" else "Beacon3D's question answering."
    notes = [_what_was_judged(answered.judged)] if answered.judged is not None else []
    if is_open and answered.judged is None:
        notes.append(NO_JUDGE)
    return Table("beacon3d", caption, "number", ("%", "of"), rows, tuple(notes))


def _what_was_judged(judged: Judged) -> str:
    model, asked = printable(judged.model, 100), counted(judged.n_asked, "answer")
    line = f"judge: {model}, asked for {asked} that match no right one, with a prompt of this program's own"
    if not judged.n_open:
        return line
    return f"{line}; it gave {judged.n_open} of them no score, for which the least and the most stand"


def answered_json(answered: Answered) -> dict[str, Any]:
    """The same for programs, as fractions."""
    judged = answered.judged
    known = None
    if judged is not None:
        known = {"model": judged.model, "n_asked": judged.n_asked, "n_without_score": judged.n_open}
    return {"kind": answered.kind, "numbers": [asdict(one) for one in answered.numbers], "judge": known}


def _share(one: Number) -> str:
    return percent(one.least) if one.least == one.most else f"{percent(one.least)} to {percent(one.most)}"
