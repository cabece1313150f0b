"""Question sets in files: TOML and CSV of our own, and the forms of ScanRefer, Nr3D (Sr3D), SQA3D and Beacon3D.

In a CSV a text that a spreadsheet would compute begins with ``'``, which is left out again where it is read.

ScanRefer: a JSON list of ``scene_id``, ``object_id``, ``description``, and ``object_name`` by which a sentence is
unique or multiple. Nr3D: a CSV with ``scan_id``, ``target_id``, ``utterance``, and ``stimulus_id``, ``tokens`` and
``mentions_target_class`` by which one is easy or hard, by the view or not, or left out. SQA3D: a JSON with
``questions`` of ``scene_id``, ``situation``, ``question``, ``question_id``, whose answers stand in a file of
annotations beside it. Beacon3D: ``metadata_*.json``, see ``beacon3d``. Object ids are ScanNet's own, one less than the
ground truth's here. Sources: Beacon3D's data and daveredrum/ScanRefer.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.system.files import file_bytes, file_text, opened
from su3d_bench.core.toml import parse_toml
from su3d_bench.formats.tables.csv_text import no_formula
from su3d_bench.metrics.open_vocabulary.query_ap import TextQuery
from su3d_bench.questions.beacon3d import chains_of, kind_of_metadata, questions_of_objects, read_metadata
from su3d_bench.questions.model import ALL_KINDS, KINDS, REASONING, Question, new_question
from su3d_bench.questions.query_files import (
    COLUMNS,
    MORE_COLUMNS,
    MOST_OBJECTS_ID,
    is_text,
    nr3d_groups,
    read_query_rows,
)

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


DATASET = "scannet"
MOST_BYTES = 256 << 20  # ScanRefer's training set has some 40 MB
MOST_QUESTIONS = 300_000  # Sr3D+ has 114,532 sentences
NR3D_COLUMNS = ("scan_id", "target_id", "utterance")
OWN_FORM = "write scene, text and objects of such questions as CSV or TOML"
OWN_OR_BEACON = f"of Beacon3D give metadata_*_qa.json, or {OWN_FORM}"
# What is no set of questions with objects: the keys of its entries, whose file it is, and what to do.
REFUSED_ENTRIES = (
    ({"question", "answer", "episode_history"}, "OpenEQA's questions, answered in words from a walk", OWN_FORM),
    ({"question", "answers", "object_ids"}, "ScanQA's form, answered in words", OWN_OR_BEACON),
    (
        {"scan_id", "target_id", "utterance"},
        "Nr3D, Sr3D or Beacon3D's list as JSON",
        "give nr3d.csv or sr3d.csv as released, or Beacon3D's metadata_*_grounding.json",
    ),
    ({"scene_id", "object_id", "caption"}, "captions for ScanRefer", "give ScanRefer_filtered_train.json or _val.json"),
    ({"scene_id", "object_id", "bbox"}, "boxes predicted for ScanRefer", "give ScanRefer_filtered_val.json itself"),
)
ONE_A_LINE = (
    "one JSON object a line, as ScanRefer and Nr3D are handed on in SceneVerse and 3D-VisTA; give "
    "ScanRefer_filtered_train.json or nr3d.csv as released"
)
_FIRST_BYTES = 65536


def is_foreign(path: Path) -> bool:
    """Whether a file is of one of these forms, by its ending or, for a CSV and a list of scenes, its first line."""
    suffix = path.suffix.lower()
    if suffix in (".json", ".jsonl"):
        return True
    if suffix not in (".csv", ".txt") or not path.is_file():
        return False
    with opened(path) as file:
        line = file.read(_FIRST_BYTES).partition(b"\n")[0].decode("utf-8", "replace")
    if suffix == ".txt":
        return _is_scene(line.strip())
    return len(set(NR3D_COLUMNS) & {word.strip().strip('"').lstrip("\ufeff") for word in line.split(",")}) > 1


def read_foreign(path: Path) -> tuple[Question, ...]:
    """The sentences of a file: descriptions and utterances as relative queries, SQA3D's as reasoning questions."""
    where, suffix = printable(str(path), 200), path.suffix.lower()
    text = _text_of(path, where)
    if suffix == ".txt":
        raise DataError(f"{where}: a list of scenes, as beside ScanRefer's and Nr3D's files; give its .json or .csv")
    if suffix == ".jsonl" or (text.lstrip().startswith("{") and _is_one_a_line(text)):
        raise DataError(f"{where}: {ONE_A_LINE}")
    if suffix == ".csv":
        rows = _placed(_csv_rows(text, where), where, "row", 2)
        return tuple(_sentences(rows, ("scan_id", "utterance", "target_id"), "Nr3D"))
    content = _json_of(text, where)
    if kind_of_metadata(content) is not None:
        return tuple(_of_objects(content, where))
    _refuse_others(content, where)
    if isinstance(content, list):
        rows = _placed(content, where, "entry")
        return tuple(_sentences(rows, ("scene_id", "description", "object_id"), "ScanRefer"))
    if isinstance(content, dict) and isinstance(content.get("questions"), list):
        return tuple(_situated(content["questions"], _replies(path), where))
    raise DataError(f"{where}: is neither a list of descriptions (ScanRefer) nor has it 'questions' (SQA3D)")


def read_foreign_queries(path: Path) -> dict[str, tuple[TextQuery, ...]]:
    """The sentences of each scene that name an object, each as often as the file has it; Beacon3D's in their chains."""
    if path.suffix.lower() == ".json" and kind_of_metadata(content := read_metadata(path)) == "grounding":
        return dict(chains_of(content, printable(str(path), 200)).cases)
    queries_of_scene: dict[str, list[TextQuery]] = {}
    for question in read_foreign(path):
        if not question.is_known:
            raise DataError(
                f"{printable(str(path), 200)}: {question.source} names no objects; nothing can be scored by it"
            )
        scene = question.scene.rpartition("/")[2]
        query = TextQuery(question.text, question.answers or (), question.groups, question.name)
        queries_of_scene.setdefault(scene, []).append(query)
    return {scene: tuple(queries) for scene, queries in queries_of_scene.items()}


def _refuse_others(content: Any, where: str) -> None:
    """``DataError`` where the content of a JSON file is of a known form that is not read."""
    if isinstance(content, list) and content and isinstance(content[0], Mapping) and "description" not in content[0]:
        for keys, whose, advice in REFUSED_ENTRIES:
            if keys <= set(content[0]):
                raise DataError(f"{where}: {whose}; {advice}")
    if isinstance(content, list) and content and isinstance(content[0], str) and _is_scene(content[0]):
        raise DataError(f"{where}: a list of scenes; give the file of their descriptions")
    if not isinstance(content, dict) or not content or "questions" in content:
        return
    if isinstance(content.get("annotations"), list):
        raise DataError(f"{where}: SQA3D's answers; give the file of questions beside it, ..._questions_...")


def _of_objects(content: Any, where: str) -> Iterator[Question]:
    """Beacon3D's texts as relative queries, its questions as reasoning questions with the object they are about."""
    if kind_of_metadata(content) == "grounding":
        for scene, cases in chains_of(content, where).cases.items():
            for case in cases:
                text = " ".join(case.text.split())
                yield new_question(f"{DATASET}/{scene}", "relative", text, case.object_ids, "Beacon3D")
        return
    for asked in questions_of_objects(content, where).entries:
        text, reply = " ".join(asked.question.split()), " ".join(asked.answer.split())
        yield new_question(f"{DATASET}/{asked.scene}", REASONING, text, None, "Beacon3D", reply)


def _is_one_a_line(text: str) -> bool:
    first, _, rest = text.lstrip().partition("\n")
    try:
        return isinstance(json.loads(first), dict) and bool(rest.strip())
    except (ValueError, RecursionError):
        return False


def _is_scene(word: str) -> bool:
    return re.fullmatch(r"scene_?\d{4,5}_\d\d", word) is not None


def _text_of(path: Path, where: str) -> str:
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise DataError(f"{where}: has {size} bytes; expected at most {MOST_BYTES}")
        return file_bytes(path).decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"{where}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text file in UTF-8") from error


def _json_of(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not JSON ({printable(str(error), 120)})") from error


def _sentences(rows: Iterable[tuple[str, Any]], keys: tuple[str, str, str], source: str) -> Iterator[Question]:
    """A question for each row, which comes with its place; ``keys``: those of scene, sentence and object."""
    for at, row in rows:
        scene, text = _word(row, keys[0], at), _sentence(row, keys[1], at)
        question = new_question(f"{DATASET}/{scene}", "relative", text, _answer(row, keys[2], at), source)
        yield replace(question, name=_optional(row, "object_name", at) or "", groups=_groups(row, at))


def _groups(row: Any, at: str) -> tuple[str, ...]:
    """The groups of a row of Nr3D; none where its file has no such column."""
    stimulus = _optional(row, "stimulus_id", at)
    if stimulus is None:
        return ()
    return nr3d_groups(stimulus, _optional(row, "tokens", at), _optional(row, "mentions_target_class", at), at)


def _optional(row: Any, key: str, at: str) -> str | None:
    value = row.get(key)
    if value is not None and (not isinstance(value, str) or not is_text(value)):
        raise DataError(f"{at}: '{key}' must be a text; found {printable(repr(value), 40)}")
    return value


def _csv_rows(text: str, where: str) -> list[Any]:
    try:
        return list(islice(csv.DictReader(io.StringIO(text, newline=""), strict=True), MOST_QUESTIONS + 1))
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)})") from error


def _situated(rows: list[Any], replies: Mapping[str, str], where: str) -> Iterator[Question]:
    for at, row in _placed(rows, where, "question"):
        scene, question = _word(row, "scene_id", at), _sentence(row, "question", at)
        situation = _sentence(row, "situation", at) if row.get("situation") else ""
        text = f"{situation} {question}".strip()
        reply = replies.get(str(row.get("question_id")), "")
        yield new_question(f"{DATASET}/{scene}", REASONING, text, None, "SQA3D", reply)


def _replies(path: Path) -> dict[str, str]:
    """The first answer to each question, from ``..._sqa_annotations_...`` beside ``..._questions_...``."""
    beside = path.with_name(path.name.replace("_questions_", "_sqa_annotations_"))
    if beside == path or not beside.is_file():
        return {}
    where = printable(str(beside), 200)
    content = _json_of(_text_of(beside, where), where)
    rows = content.get("annotations") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise DataError(f"{where}: has no 'annotations'")
    reply_of = {}
    for at, row in _placed(rows, where, "annotation"):
        answers = row.get("answers") if isinstance(row, Mapping) else None
        if not isinstance(answers, list) or not answers:
            raise DataError(f"{at}: has no answers")
        reply_of[str(row.get("question_id"))] = _sentence(answers[0], "answer", at)
    return reply_of


def _placed(rows: list[Any], where: str, noun: str, first: int = 1) -> Iterator[tuple[str, Any]]:
    """Each row with the words that say where it stands."""
    if not rows or len(rows) > MOST_QUESTIONS:
        raise DataError(f"{where}: has {len(rows)} entries; expected 1 to {MOST_QUESTIONS}")
    for number, row in enumerate(rows, first):
        yield f"{where}: {noun} {number}", row


def _value(row: Any, key: str, at: str) -> Any:
    if not isinstance(row, Mapping) or row.get(key) is None:
        raise DataError(f"{at}: has no '{key}'")
    return row[key]


def _word(row: Any, key: str, at: str) -> str:
    value = _value(row, key, at)
    if not isinstance(value, str) or not value or not value.replace("_", "").isalnum() or len(value) > 100:
        raise DataError(f"{at}: '{key}' must be a scene such as scene0000_00; found {printable(repr(value), 40)}")
    return value


def _sentence(row: Any, key: str, at: str) -> str:
    """The text on one line: what people typed holds line ends and tabs."""
    value = _value(row, key, at)
    text = " ".join(value.split()) if isinstance(value, str) else ""
    if not text or not is_text(text):
        raise DataError(f"{at}: '{key}' must be a sentence; found {printable(repr(value), 40)}")
    return text


def _answer(row: Any, key: str, at: str) -> tuple[int, ...]:
    value = str(_value(row, key, at)).strip()
    if not (value.isascii() and value.isdigit() and len(value) < 11 and int(value) < MOST_OBJECTS_ID):
        raise DataError(f"{at}: '{key}' must be an object id; found {printable(value, 40)}")
    return (int(value) + 1,)
