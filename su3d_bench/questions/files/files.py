"""Question sets in files: read from TOML, CSV and the forms of ScanRefer, Nr3D and SQA3D; written as TOML and CSV.

In a CSV a text that a spreadsheet would compute begins with ``'``, which is left out again where it is read.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml
from su3d_bench.formats.tables.csv_text import no_formula
from su3d_bench.questions.files.datasets import is_foreign, read_foreign
from su3d_bench.questions.files.queries import COLUMNS, MORE_COLUMNS, read_query_rows
from su3d_bench.questions.model import ALL_KINDS, KINDS, REASONING, Question, new_question

PAPER = Path(__file__).parent / "paper_queries.toml"
PAGE = "opensu3d.github.io"
PAPER_FIGURES = ("comparison", "schemes", "teaser")


def read_questions(path: Path, dataset: str | None = None) -> tuple[Question, ...]:
    """The questions of a file, each scene as ``<dataset>/<scene>``.

    ``dataset`` completes scenes that name none; an empty one leaves them as they are.

    A query without a kind is one of kind instance. The same question of the same scene may stand there once.
    """
    if is_foreign(path):
        return _each_once(read_foreign(path))
    questions: dict[str, Question] = {}
    for row in read_query_rows(path):
        kind = row.kind or KINDS[0]
        if kind not in ALL_KINDS:
            raise DataError(f"{row.at}: unknown kind '{printable(kind, 40)}'; known: {', '.join(ALL_KINDS)}")
        if "/" not in row.scene and dataset is None:
            raise DataError(f"{row.at}: of which dataset is scene '{printable(row.scene, 60)}'? write dataset/scene")
        scene = f"{dataset}/{row.scene}" if dataset and "/" not in row.scene else row.scene
        source = row.source or printable(path.name, 100)
        question = new_question(scene, kind, row.text, row.objects or None, source)
        if question.id in questions:
            raise DataError(f"{row.at}: '{printable(row.text, 60)}' stands there twice for {printable(scene, 60)}")
        questions[question.id] = question
    return tuple(questions.values())


def _each_once(questions: Sequence[Question]) -> tuple[Question, ...]:
    """The first of each id: people wrote some sentences twice; where objects or replies differ, all are right."""
    answers: dict[str, set[int]] = {}
    replies: dict[str, dict[str, None]] = {}
    for question in questions:
        answers.setdefault(question.id, set()).update(question.answers or ())
        replies.setdefault(question.id, {}).update({question.reply: None} if question.reply else {})
    first = {question.id: question for question in reversed(questions)}
    return tuple(
        replace(first[key], answers=tuple(sorted(ids)) or None, reply=" or ".join(replies[key]))
        for key, ids in answers.items()
    )


def paper_queries() -> tuple[Question, ...]:
    """The queries that the paper's page shows, for each of its 13 scenes, and its questions to reasoning of one scene.

    Of these alone an answer is published, in words.
    """
    content = _paper()
    asked = [(kind, text) for kind in KINDS for text in content["queries"][kind]]
    asked += [(kind, text) for name in PAPER_FIGURES for kind, text in content["figures"][name]]
    queries = (
        new_question(scene, kind, text, None, PAGE)
        for scene in content["scenes"]
        for kind, text in dict.fromkeys(asked)
    )
    reasoning = (
        new_question(one["scene"], REASONING, one["text"], None, PAGE, one["reply"]) for one in content["reasoning"]
    )
    return (*queries, *reasoning)


def figure_texts(figure: str) -> tuple[str, ...]:
    """The texts of a figure of the paper or its page, one of ``PAPER_FIGURES``, each once.

    >>> figure_texts("teaser")
    ('a musical instrument', 'which sink is closer to bed?')
    """
    return tuple(dict.fromkeys(text for _, text in _paper()["figures"][figure]))


def _paper() -> dict[str, Any]:
    return parse_toml(file_text(PAPER))


def check_form(path: Path) -> None:
    """``DataError`` where the name of a file to be written says no form."""
    if path.suffix.lower() not in (".toml", ".csv"):
        raise DataError(f"{printable(str(path), 200)}: is neither .toml nor .csv; name the file so")


def write_questions(path: Path, questions: Sequence[Question]) -> None:
    """Write a set as ``read_questions`` reads it, TOML or CSV by the file's name; answers in words are not kept."""
    check_form(path)
    make_folder(path.parent)
    write_text(path, csv_text(questions) if path.suffix.lower() == ".csv" else toml_text(questions))


def toml_text(questions: Sequence[Question]) -> str:
    """The set as ``[[query]]`` tables."""
    blocks = []
    for question in questions:
        values = {"scene": question.scene, "kind": question.kind, "text": question.text}
        values_more = {"objects": list(question.answers or ()), "source": question.source}
        lines = [f"{key} = {toml_value(value)}" for key, value in (values | values_more).items()]
        blocks.append("\n".join(["[[query]]", *lines]))
    return "\n\n".join(blocks) + "\n"


def csv_text(questions: Sequence[Question]) -> str:
    """The set as rows."""
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow((*COLUMNS, *MORE_COLUMNS))
    for question in questions:
        objects = " ".join(map(str, question.answers or ()))
        rows.writerow(map(no_formula, (question.scene, question.text, objects, question.kind, question.source)))
    return text.getvalue()
