"""Question sets in files: our own TOML and CSV, and the formats of ScanRefer, Nr3D (Sr3D), SQA3D and Beacon3D.

In a CSV, a text that a spreadsheet would evaluate begins with ``'``, which is removed when it is read.

ScanRefer: a JSON list of ``scene_id``, ``object_id``, ``description``, and ``object_name``, which decides whether a
sentence is unique or multiple. Nr3D: a CSV with ``scan_id``, ``target_id``, ``utterance``, and ``stimulus_id``,
``tokens`` and ``mentions_target_class``, which decide whether one is easy or hard, view-dependent or not, or excluded.
SQA3D: a JSON with ``questions`` of ``scene_id``, ``situation``, ``question``, ``question_id``, whose answers are in a
separate annotation file. Beacon3D: ``metadata_*.json``, see ``beacon3d``. Object ids are ScanNet's own, one less than
in the ground truth here. Sources: Beacon3D's data and daveredrum/ScanRefer.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, Field, StringConstraints

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.system.files import file_text, opened, parse_toml
from su3d_bench.formats.arrays import parsed_json, read_text
from su3d_bench.formats.tables.table import no_formula
from su3d_bench.metrics.open_vocabulary.score import TextQuery
from su3d_bench.questions import query_files
from su3d_bench.questions.beacon3d import chains_of, kind_of_metadata, origin, questions_of_objects, read_metadata
from su3d_bench.questions.model import ALL_KINDS, KINDS, REASONING, Question, new_question
from su3d_bench.questions.query_files import COLUMNS, ObjectId, only_words, validated

PAPER = Path(__file__).parent / "paper_queries.toml"
PAGE = "opensu3d.github.io"
PAPER_FIGURES = ("comparison", "schemes", "teaser")


def read_questions(path: Path, dataset: str | None = None) -> tuple[Question, ...]:
    """The questions of a file, each scene as ``<dataset>/<scene>``.

    ``dataset`` completes scenes that name none; an empty one leaves them unchanged.

    A query without a kind is of kind instance. A question may occur only once per scene.
    """
    if is_foreign(path):
        return _each_once(read_external_questions(path))
    questions: dict[str, Question] = {}
    for at, row in query_files.read_query_rows(path):
        kind = row.kind or KINDS[0]
        if kind not in ALL_KINDS:
            raise DataError(f"{at}: unknown kind '{printable(kind, 40)}'; known: {', '.join(ALL_KINDS)}")
        if "/" not in row.scene and dataset is None:
            raise DataError(f"{at}: the dataset of scene '{printable(row.scene, 60)}' is missing; write dataset/scene")
        scene = f"{dataset}/{row.scene}" if dataset and "/" not in row.scene else row.scene
        source = row.source or printable(path.name, 100)
        question = new_question(scene, kind, row.text, row.objects or None, source)
        if question.id in questions:
            raise DataError(f"{at}: '{printable(row.text, 60)}' is a duplicate for {printable(scene, 60)}")
        questions[question.id] = question
    return tuple(questions.values())


def _each_once(questions: Sequence[Question]) -> tuple[Question, ...]:
    """The first of each id, because some sentences occur twice; if objects or replies differ, all are correct."""
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
    """The queries on the paper's page, for each of its 13 scenes, and its reasoning questions about one scene.

    An answer, in words, is only published for the latter.
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
    """``DataError`` if the name of an output file has no supported ending."""
    if path.suffix.lower() not in (".toml", ".csv"):
        raise DataError(f"{printable(str(path), 200)}: unsupported file type; use .toml or .csv")


def write_questions(path: Path, questions: Sequence[Question]) -> None:
    """Write a set for ``read_questions``, as TOML or CSV by the file's name; answers in words are not written."""
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
    rows.writerow((*COLUMNS, *query_files.MORE_COLUMNS))
    for question in questions:
        objects = " ".join(map(str, question.answers or ()))
        rows.writerow(map(no_formula, (question.scene, question.text, objects, question.kind, question.source)))
    return text.getvalue()


DATASET = "scannet"
MAX_BYTES = 256 << 20  # ScanRefer's training set has some 40 MB
NR3D_COLUMNS = ("scan_id", "target_id", "utterance")
ADVICE = (
    "pass ScanRefer_filtered_*.json, nr3d.csv or sr3d.csv, SQA3D's v1_balanced_questions_*.json or Beacon3D's "
    "metadata_*.json as released, or write scene, text and objects as CSV or TOML"
)
_FIRST_BYTES = 65536
Row = TypeVar("Row", bound=BaseModel)
Scene = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_]{1,100}$")]
# On one line: annotators' texts contain line breaks and tabs.
Sentence = Annotated[str, AfterValidator(lambda text: only_words(" ".join(text.split())))]
OptionalText = Annotated[str, AfterValidator(lambda text: only_words(text) if text else text)]


class _ScanRefer(BaseModel):
    scene_id: Scene
    description: Sentence
    object_id: ObjectId
    object_name: OptionalText | None = None


class _Nr3D(BaseModel):
    scan_id: Scene
    utterance: Sentence
    target_id: ObjectId
    stimulus_id: OptionalText | None = None
    tokens: OptionalText | None = None
    mentions_target_class: OptionalText | None = None


class _Situated(BaseModel):
    scene_id: Scene
    situation: Sentence | Literal[""] | None = None
    question: Sentence
    question_id: Any = None


class _Answer(BaseModel):
    answer: Sentence


class _Reply(BaseModel):
    question_id: Any = None
    answers: list[_Answer] = Field(min_length=1)


def is_foreign(path: Path) -> bool:
    """Whether a file is in one of the foreign formats, by its ending or, for a CSV, its first line."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return path.suffix.lower() in (".json", ".jsonl")
    with opened(path) as file:
        line = file.read(_FIRST_BYTES).partition(b"\n")[0].decode("utf-8", "replace")
    return len(set(NR3D_COLUMNS) & {word.strip().strip('"').lstrip("\ufeff") for word in line.split(",")}) > 1


def read_external_questions(path: Path) -> tuple[Question, ...]:
    """The sentences of a file: descriptions and utterances as relative queries, SQA3D's questions as reasoning."""
    where = printable(str(path), 200)
    text = read_text(path, where, ADVICE, MAX_BYTES)
    if path.suffix.lower() == ".csv":
        return tuple(_nr3d(text, where))
    content = parsed_json(text, where, ADVICE)
    if kind_of_metadata(content) is not None:
        return tuple(_of_objects(content, where))
    if isinstance(content, list):
        return tuple(_scanrefer(content, where))
    if isinstance(content, dict) and isinstance(content.get("questions"), list):
        return tuple(_situated(content["questions"], _replies(path), where))
    raise DataError(f"{where}: contains no readable questions; {ADVICE}")


def read_external_queries(path: Path) -> dict[str, tuple[TextQuery, ...]]:
    """The sentences of each scene that name an object, including duplicates; Beacon3D's in their chains."""
    if path.suffix.lower() == ".json" and kind_of_metadata(content := read_metadata(path)) == "grounding":
        return dict(chains_of(content, printable(str(path), 200)).cases)
    queries_of_scene: dict[str, list[TextQuery]] = {}
    for question in read_external_questions(path):
        if not question.is_known:
            raise DataError(f"{printable(str(path), 200)}: {question.source} has no answer objects to score")
        scene = question.scene.rpartition("/")[2]
        query = TextQuery(question.text, question.answers or (), question.groups, question.name)
        queries_of_scene.setdefault(scene, []).append(query)
    return {scene: tuple(queries) for scene, queries in queries_of_scene.items()}


def _of_objects(content: Any, where: str) -> Iterator[Question]:
    """Beacon3D's texts as relative queries, its questions as reasoning questions with the object they are about."""
    if kind_of_metadata(content) == "grounding":
        for scene, cases in chains_of(content, where).cases.items():
            for case in cases:
                text = " ".join(case.text.split())
                yield new_question(f"{origin(scene)[0]}/{scene}", "relative", text, case.object_ids, "Beacon3D")
        return
    for asked in questions_of_objects(content, where).entries:
        text, reply = " ".join(asked.question.split()), " ".join(asked.answer.split())
        yield new_question(f"{origin(asked.scene)[0]}/{asked.scene}", REASONING, text, None, "Beacon3D", reply)


def _scanrefer(rows: list[Any], where: str) -> Iterator[Question]:
    for row in _rows(_ScanRefer, rows, where, "entry"):
        question = new_question(
            f"{DATASET}/{row.scene_id}", "relative", row.description, (row.object_id + 1,), "ScanRefer"
        )
        yield replace(question, name=row.object_name or "")


def _nr3d(text: str, where: str) -> Iterator[Question]:
    """The utterances, in the groups of the file if it has the columns for them."""
    header, *cells = query_files.csv_rows(text, where) or [[]]
    lines = [dict(zip(header, row, strict=False)) for row in cells if row]
    for number, row in enumerate(_rows(_Nr3D, lines, where, "row", 2), 2):
        question = new_question(f"{DATASET}/{row.scan_id}", "relative", row.utterance, (row.target_id + 1,), "Nr3D")
        groups: tuple[str, ...] = ()
        if row.stimulus_id is not None:
            groups = query_files.nr3d_groups(
                row.stimulus_id, row.tokens, row.mentions_target_class, f"{where}: row {number}"
            )
        yield replace(question, groups=groups)


def _situated(rows: list[Any], replies: Mapping[str, str], where: str) -> Iterator[Question]:
    for row in _rows(_Situated, rows, where, "question"):
        text = f"{row.situation or ''} {row.question}".strip()
        reply = replies.get(str(row.question_id), "")
        yield new_question(f"{DATASET}/{row.scene_id}", REASONING, text, None, "SQA3D", reply)


def _replies(path: Path) -> dict[str, str]:
    """The first answer to each question, from ``..._sqa_annotations_...`` next to ``..._questions_...``."""
    beside = path.with_name(path.name.replace("_questions_", "_sqa_annotations_"))
    if beside == path or not beside.is_file():
        return {}
    where = printable(str(beside), 200)
    content = parsed_json(read_text(beside, where, ADVICE, MAX_BYTES), where, ADVICE)
    rows = content.get("annotations") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise DataError(f"{where}: missing key 'annotations'")
    known = _rows(_Reply, rows, where, "annotation")
    return {str(row.question_id): row.answers[0].answer for row in known}


def _rows(kind: type[Row], rows: list[Any], where: str, noun: str, first: int = 1) -> Iterator[Row]:
    if not rows:
        raise DataError(f"{where}: is empty; {ADVICE}")
    for number, row in enumerate(rows, first):
        yield validated(kind, row, f"{where}: {noun} {number}")
