"""Beacon3D's files: chains of texts and questions of each object (``metadata_*.json``), and what was answered to them.

A metadata file has scenes, in these classes, in these objects by their numbers. Of grounding an object has three chains
of ``text``, ``obj_id`` and ``tag``, the finest text first; of question answering it has ``qa``, three of ``question``,
``answer``, ``tag`` and ``extra_knowledge``. The lists without ``metadata`` in their names, in whose order systems
answer, have each text of a scene once. Source: README.md, data/ and both evaluations of beacon-3d/beacon-3d at 9cd8f1f.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError, printable
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.text_files import parsed_json
from su3d_bench.metrics.questions.chains import CHAINS_EACH, ChainedText, Place
from su3d_bench.questions.files.queries import MOST_OBJECTS_ID, is_text

PAGE = "https://github.com/beacon-3d/beacon-3d"
MOST_BYTES = 64 << 20  # the largest of the release has half of one MiB
MOST_ENTRIES = 300_000
MOST_CHARACTERS = 10_000  # of an answer
GROUNDING_KEYS = ("text", "obj_id", "tag")
QA_KEYS = ("question", "answer", "tag", "extra_knowledge")
ANSWER_KEYS = ("response_pred", "answer_pred", "text", "answer_top10", "pred_response", "pred")  # in this order


@dataclass(frozen=True)
class AskedOfObject:
    """A question of an object with its right answer in words, and of what sort it is."""

    scene: str
    question: str
    answer: str
    tag: str


@dataclass(frozen=True)
class Chains:
    """The cases of each scene, and of every entry of the list in whose order answers come: scene and case."""

    cases: Mapping[str, tuple[ChainedText, ...]]
    entries: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Reply:
    """What was answered, what is right, and the score of a judge, 1 to 5, where there is one."""

    given: str
    right: str
    score: float | None


@dataclass(frozen=True)
class Questions:
    """Three questions of each object, one after the other; ``entries``: those of the list, each text once a scene."""

    asked: tuple[AskedOfObject, ...]
    entries: tuple[AskedOfObject, ...]


def kind_of_metadata(content: Any) -> str | None:
    """``grounding`` or ``qa``, as the first object of a metadata file has chains or questions; None for others."""
    for _ in range(3):
        if not isinstance(content, Mapping) or not content:
            return None
        content = next(iter(content.values()))
    if not isinstance(content, Mapping) or not content:
        return None
    return "qa" if "qa" in content else "grounding" if next(iter(content)).startswith("chain") else None


def read_metadata(path: Path) -> Any:
    """The content of a file; a ``DataError`` of one line where it is no JSON."""
    where = printable(str(path), 200)
    advice = f"get Beacon3D's files by {PAGE}, data/<domain>/"
    return parsed_json(read_bytes(path, where, advice, MOST_BYTES), where)


def chains_of(content: Any, where: str) -> Chains:
    """The chains of all objects; an object's id is one more than in the file, as ScanNet's truth numbers them here.

    A text that is spelt in several ways is one case, with the objects of the spelling that comes last, as the original
    has it. Its tags must agree wherever it stands.
    """
    spelt: dict[str, dict[str, ChainedText]] = {}
    order: list[tuple[str, str]] = []
    places: dict[str, dict[str, list[Place]]] = {}
    tags: dict[tuple[str, str], frozenset[str]] = {}
    n_objects: dict[str, int] = {}
    for scene, at, chains in _objects(content, where):
        if len(chains) != CHAINS_EACH:
            raise DataError(f"{at}: has {len(chains)} chains; expected {CHAINS_EACH}")
        number = n_objects.setdefault(scene, 0)
        n_objects[scene] += 1
        for k, (name, chain) in enumerate(chains.items()):
            for step, entry in enumerate(_list(chain, f"{at} {printable(str(name), 20)}")):
                case = _case(entry, f"{at} {printable(str(name), 20)}")
                key = case.text.lower()
                if tags.setdefault((scene, key), case.tags) != case.tags:
                    raise DataError(f"{at}: '{printable(case.text, 60)}' has other tags than where it stood before")
                if case.text not in spelt.setdefault(scene, {}):
                    spelt[scene][case.text] = case
                    order.append((scene, case.text))
                places.setdefault(scene, {}).setdefault(key, []).append(Place(number, k, step))
    cases = {
        scene: {text.lower(): replace(case, places=tuple(places[scene][text.lower()])) for text, case in texts.items()}
        for scene, texts in spelt.items()
    }
    row_of = {scene: {key: row for row, key in enumerate(of_scene)} for scene, of_scene in cases.items()}
    entries = tuple((scene, row_of[scene][text.lower()]) for scene, text in order)
    return Chains({scene: tuple(of_scene.values()) for scene, of_scene in cases.items()}, entries)


def questions_of_objects(content: Any, where: str) -> Questions:
    """Every question in the order of the objects."""
    asked: list[AskedOfObject] = []
    entries: dict[tuple[str, str], AskedOfObject] = {}
    tags: dict[tuple[str, str], str] = {}
    for scene, at, known in _objects(content, where):
        rows = _list(known.get("qa"), f"{at} qa")
        if len(rows) != CHAINS_EACH:
            raise DataError(f"{at}: has {len(rows)} questions; expected {CHAINS_EACH}")
        for row in rows:
            if not isinstance(row, Mapping) or not set(QA_KEYS) <= set(row):
                raise DataError(f"{at}: a question must have {', '.join(QA_KEYS)}")
            question, answer, tag = (_words(row[key], key, at) for key in QA_KEYS[:3])
            if tags.setdefault((scene, question.lower()), tag) != tag:
                raise DataError(f"{at}: '{printable(question, 60)}' has another tag than where it stood before")
            asked.append(AskedOfObject(scene, question, answer, tag.lower()))
            entries.setdefault((scene, question), asked[-1])
    return Questions(tuple(asked), tuple(entries.values()))


def read_found(path: Path, chains: Chains) -> dict[str, dict[int, bool]]:
    """Whether each case of each scene is right, from answers in the order of the list.

    An answer says ``correct``, or ``object_id``, which is right where the text means that object.
    """
    where, rows = _answers(path, len(chains.entries))
    right: dict[str, dict[int, bool]] = {}
    for at, row, (scene, case) in zip(_numbered(where), rows, chains.entries, strict=False):
        correct, object_id = row.get("correct"), row.get("object_id")
        if correct in (0, 1):
            is_right = bool(correct)
        elif type(object_id) is int:
            is_right = object_id + 1 in chains.cases[scene][case].object_ids
        else:
            raise DataError(f"{at}: needs 'correct', true or false, or 'object_id', a whole number")
        right.setdefault(scene, {})[case] = is_right
    return right


def read_replies(path: Path, questions: Questions) -> dict[tuple[str, str], Reply]:
    """What was answered to each question of a scene, by the question in lower case.

    Where the first answer is of another scene than the first question, answers come in the order of the scenes' names,
    as the original takes them.
    """
    where, rows = _answers(path, len(questions.entries))
    entries = list(questions.entries)
    if rows[0].get("scene_id", entries[0].scene) != entries[0].scene:
        entries.sort(key=lambda entry: entry.scene)
    replies: dict[tuple[str, str], Reply] = {}
    for at, row, entry in zip(_numbered(where), rows, entries, strict=False):
        value = next((row[key] for key in ANSWER_KEYS if key in row), None)
        value = value[0] if isinstance(value, list) and value else value
        if not isinstance(value, str) or len(value) > MOST_CHARACTERS:
            raise DataError(f"{at}: needs an answer in words under one of {', '.join(ANSWER_KEYS)}")
        score = row.get("score")
        if score is not None and (isinstance(score, bool) or not (isinstance(score, int | float) and 1 <= score <= 5)):
            raise DataError(f"{at}: 'score' must be a number from 1 to 5; found {printable(repr(score), 40)}")
        judged = None if score is None else float(score)
        replies[entry.scene, entry.question.lower()] = Reply(value, entry.answer, judged)
    return replies


def _answers(path: Path, n: int) -> tuple[str, list[Mapping[str, Any]]]:
    where, rows = printable(str(path), 200), read_metadata(path)
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise DataError(f"{where}: expected a list of answers, a table each")
    if len(rows) != n:
        raise DataError(f"{where}: has {len(rows)} answers, the file asks {n}; answer every one, in its order")
    return where, rows


def _numbered(where: str) -> Iterator[str]:
    for number in range(1, MOST_ENTRIES + 1):
        yield f"{where}: answer {number}"


def _objects(content: Any, where: str) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Every object with its scene and the words that say where it stands."""
    n = 0
    for scene, classes in _table(content, where).items():
        at = f"{where}: {printable(str(scene), 60)}"
        for name, objects in _table(classes, at).items():
            of_class = f"{at} {printable(str(name), 40)}"
            for object_id, known in _table(objects, of_class).items():
                n += 1
                if n > MOST_ENTRIES:
                    raise DataError(f"{where}: has more than {MOST_ENTRIES} objects")
                here = f"{of_class} {printable(str(object_id), 20)}"
                yield str(scene), here, _table(known, here)
    if not n:
        raise DataError(f"{where}: has no objects")


def _table(content: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(content, Mapping):
        raise DataError(f"{where}: expected scenes, classes and objects one in the other, as in metadata_*.json")
    return content


def _list(content: Any, where: str) -> list[Any]:
    if not isinstance(content, list) or not 1 <= len(content) <= MOST_ENTRIES:
        raise DataError(f"{where}: expected a list that is not empty")
    return content


def _case(entry: Any, at: str) -> ChainedText:
    if not isinstance(entry, Mapping) or not set(GROUNDING_KEYS) <= set(entry):
        raise DataError(f"{at}: a text must have {', '.join(GROUNDING_KEYS)}")
    text, tag = (_words(entry[key], key, at) for key in ("text", "tag"))
    ids: dict[int, None] = {}
    for value in _list(entry["obj_id"], f"{at} obj_id"):
        word = str(value)
        if not (word.isascii() and word.isdigit() and len(word) < 11 and int(word) < MOST_OBJECTS_ID):
            raise DataError(f"{at}: 'obj_id' must hold object ids; found {printable(word, 40)}")
        ids[int(word) + 1] = None
    return ChainedText(text, tuple(ids), tags=frozenset(tag.lower().split("-")))


def _words(value: Any, key: str, at: str) -> str:
    if not isinstance(value, str) or not value.strip() or not is_text(value):
        raise DataError(f"{at}: '{key}' must be words; found {printable(repr(value), 40)}")
    return value
