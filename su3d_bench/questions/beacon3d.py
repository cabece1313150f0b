"""Beacon3D: file formats, metrics and an LLM judge for free-form answers.

A metadata file (``metadata_*.json``) has the nested levels scene, class, and object by number. For grounding an object
has three chains of ``text``, ``obj_id`` and ``tag``, the most specific text first; for question answering it has
``qa``, three entries of ``question``, ``answer``, ``tag`` and ``extra_knowledge``. The lists without ``metadata`` in
their names, which define the order of answers, have each text of a scene once. Numbers are fractions of 1.

Source: README.md, data/, utils.py, evaluate_grounding.py and evaluate_qa.py of beacon-3d/beacon-3d at 9cd8f1f. There a
language model scores answers that do not match a correct one from 1 to 5; here such scores are read if answers have
them, otherwise the minimum and maximum over all possible scores are reported. Answers are cleaned as in SQA3D. These
oddities are the original's: any correct answer containing "no", such as north, counts as one to a yes-no question, and
an empty answer is a part of every correct one. The judge's prompt is ours; a reply whose first number is not 1 to 5
leaves the answer open, whereas the original would stop or accept it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictBool, StrictInt

from su3d_bench.core.errors import ConfigError, DataError, counted, printable, shown
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.tables.table import Cell, Table, TableRow, percent
from su3d_bench.metrics.questions.grounding import CHAINS_EACH, ChainedText, Place, judge_chains
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig
from su3d_bench.perception.language.chat import Reply as ModelReply
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.questions.query_files import ObjectId, Words, only_words, validated

PAGE = "https://github.com/beacon-3d/beacon-3d"
MAX_BYTES = 64 << 20  # the largest file of the release has 0.5 MiB
MAX_CHARACTERS = 10_000  # per answer
# Datasets by the form of a scene's name, and the ground-truth value of their object 0 (0 itself is no object).
ORIGINS = (
    (re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}"), "3rscan", 0),
    (re.compile(r"scene_\d{5}_\d{2}"), "multiscan", 0),
    (re.compile(""), "scannet", 1),
)
ANSWER_KEYS = ("response_pred", "answer_pred", "text", "answer_top10", "pred_response", "pred")  # in this order


@dataclass(frozen=True)
class ObjectQuestion:
    """A question about an object with its correct answer and its type."""

    scene: str
    question: str
    answer: str
    tag: str


@dataclass(frozen=True)
class Chains:
    """The cases of each scene, and (scene, case) of every entry of the list that defines the order of answers."""

    cases: Mapping[str, tuple[ChainedText, ...]]
    entries: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Reply:
    """The given and the correct answer, and the judge's score (1 to 5) if available."""

    given: str
    right: str
    score: float | None


@dataclass(frozen=True)
class Questions:
    """Three questions per object, in order; ``entries``: those of the list, each text once per scene."""

    asked: tuple[ObjectQuestion, ...]
    entries: tuple[ObjectQuestion, ...]


def kind_of_metadata(content: Any) -> str | None:
    """``grounding`` or ``qa``, if the first object of a metadata file has chains or questions; otherwise None."""
    for _ in range(3):
        if not isinstance(content, Mapping) or not content:
            return None
        content = next(iter(content.values()))
    if not isinstance(content, Mapping) or not content:
        return None
    return "qa" if "qa" in content else "grounding" if next(iter(content)).startswith("chain") else None


def read_metadata(path: Path) -> Any:
    """The content of a JSON file; ``DataError`` if it is not valid."""
    where = shown(path)
    advice = f"download the Beacon3D files from {PAGE}, data/<domain>/"
    return parsed_json(read_bytes(path, where, advice, MAX_BYTES), where)


def origin(scene: str) -> tuple[str, int]:
    """The dataset of a scene, and the ground-truth value of its object 0.

    >>> origin("scene0011_00"), origin("scene_00116_03")
    (('scannet', 1), ('multiscan', 0))
    """
    return next((dataset, first) for pattern, dataset, first in ORIGINS if pattern.match(scene))


def _verbatim(text: str) -> str:
    only_words(" ".join(text.split()))
    return text


# A text of the release, which may end in a line break: answers are in the order of the different texts.
Text = Annotated[str, AfterValidator(_verbatim)]


class _Case(BaseModel):
    text: Text
    obj_id: list[ObjectId] = Field(min_length=1)
    tag: Words


class _Asked(BaseModel):
    question: Text
    answer: Words
    tag: Words
    extra_knowledge: Any


class _AskedObject(BaseModel):
    qa: list[_Asked] = Field(min_length=CHAINS_EACH, max_length=CHAINS_EACH)


class _Found(BaseModel):
    correct: StrictBool | Literal[0, 1] | None = None
    object_id: StrictInt | None = None


class _Replied(BaseModel):
    model_config = ConfigDict(extra="allow")

    scene_id: str | None = None
    score: float | None = Field(default=None, ge=1, le=5, strict=True)


Answer = TypeVar("Answer", bound=BaseModel)
Chain = Annotated[list[_Case], Field(min_length=1)]
OfObject = Annotated[dict[str, Chain], Field(min_length=CHAINS_EACH, max_length=CHAINS_EACH)]
# scene -> class -> object
Grounding = Annotated[dict[str, dict[str, dict[str, OfObject]]], Field(min_length=1)]
Asking = Annotated[dict[str, dict[str, dict[str, _AskedObject]]], Field(min_length=1)]


def chains_of(content: Any, where: str) -> Chains:
    """The chains of all objects; object ids become ground-truth values (see ``ORIGINS``).

    A text with several spellings is one case, with the objects of the last spelling, as in the original. Its tags must
    agree in all places.
    """
    cases: dict[str, dict[str, ChainedText]] = {}
    order: dict[tuple[str, str], None] = {}
    for scene, classes in validated(Grounding, content, where).items():
        known = cases.setdefault(scene, {})
        _, first = origin(scene)
        objects = (chains for of_class in classes.values() for chains in of_class.values())
        for number, chains in enumerate(objects):
            for k, chain in enumerate(chains.values()):
                for step, entry in enumerate(chain):
                    key, tags = entry.text.lower(), frozenset(entry.tag.lower().split("-"))
                    ids = tuple(dict.fromkeys(object_id + first for object_id in entry.obj_id))
                    before = known.get(key) or ChainedText(entry.text, ids, tags=tags)
                    if before.tags != tags:
                        raise DataError(f"{where}: '{printable(entry.text, 60)}' of {scene} has two different tags")
                    is_new = (scene, entry.text) not in order
                    text, ids = (entry.text, ids) if is_new else (before.text, before.object_ids)
                    order[scene, entry.text] = None
                    places = (*before.places, Place(number, k, step))
                    known[key] = replace(before, text=text, object_ids=ids, places=places)
    row_of = {scene: {key: row for row, key in enumerate(texts)} for scene, texts in cases.items()}
    entries = tuple((scene, row_of[scene][text.lower()]) for scene, text in order)
    return Chains({scene: tuple(texts.values()) for scene, texts in cases.items()}, entries)


def questions_of_objects(content: Any, where: str) -> Questions:
    """All questions in the order of the objects."""
    asked: list[ObjectQuestion] = []
    entries: dict[tuple[str, str], ObjectQuestion] = {}
    tags: dict[tuple[str, str], str] = {}
    for scene, classes in validated(Asking, content, where).items():
        for row in (row for of_class in classes.values() for known in of_class.values() for row in known.qa):
            if tags.setdefault((scene, row.question.lower()), row.tag) != row.tag:
                raise DataError(f"{where}: '{printable(row.question, 60)}' of {scene} has two different tags")
            asked.append(ObjectQuestion(scene, row.question, row.answer, row.tag.lower()))
            entries.setdefault((scene, row.question), asked[-1])
    if not asked:
        raise DataError(f"{where}: contains no objects")
    return Questions(tuple(asked), tuple(entries.values()))


def read_found(path: Path, chains: Chains) -> dict[str, dict[int, bool]]:
    """Correctness of each case per scene, from answers in the order of the list.

    An answer has ``correct``, or ``object_id``, which is correct if the text refers to that object.
    """
    found = _answers(path, _Found, len(chains.entries))
    right: dict[str, dict[int, bool]] = {}
    for number, (answer, (scene, case)) in enumerate(zip(found, chains.entries, strict=True), 1):
        if answer.correct is None and answer.object_id is None:
            fault = "expected 'correct' (true or false) or 'object_id' (integer)"
            raise DataError(f"{shown(path)}: answer {number}: {fault}")
        object_id = -1 if answer.object_id is None else answer.object_id + origin(scene)[1]
        is_right = object_id in chains.cases[scene][case].object_ids
        right.setdefault(scene, {})[case] = is_right if answer.correct is None else bool(answer.correct)
    return right


def read_replies(path: Path, questions: Questions) -> dict[tuple[str, str], Reply]:
    """The answers of each scene, keyed by the lower-case question.

    If the first answer and the first question are of different scenes, answers are in the order of the scene names, as
    in the original.
    """
    found = _answers(path, _Replied, len(questions.entries))
    entries = list(questions.entries)
    if (found[0].scene_id or entries[0].scene) != entries[0].scene:
        entries.sort(key=lambda entry: entry.scene)
    replies: dict[tuple[str, str], Reply] = {}
    for number, (answer, entry) in enumerate(zip(found, entries, strict=True), 1):
        given = answer.model_extra or {}
        value = next((given[key] for key in ANSWER_KEYS if key in given), None)
        value = value[0] if isinstance(value, list) and value else value
        if not isinstance(value, str) or len(value) > MAX_CHARACTERS:
            fault = f"expected an answer text under one of {', '.join(ANSWER_KEYS)}"
            raise DataError(f"{shown(path)}: answer {number}: {fault}")
        replies[entry.scene, entry.question.lower()] = Reply(value, entry.answer, answer.score)
    return replies


def _answers(path: Path, kind: type[Answer], n: int) -> list[Answer]:
    rows: list[Answer] = validated(list[kind], read_metadata(path), shown(path))  # type: ignore[valid-type]
    if len(rows) != n:
        raise DataError(f"{shown(path)}: {len(rows)} answers for {n} questions; give one per question, in file order")
    return rows


@cache
def _judging() -> dict[str, Any]:
    """The ``rules`` for normalizing answers and the ``prompt`` of the judge."""
    return parse_toml(file_text(Path(__file__).with_suffix(".toml")))


def cleaned(answer: str) -> str:
    """An answer without articles and punctuation, with small numbers in words.

    >>> cleaned(" The  2 chairs. ")
    'two chairs'
    """
    answer = answer.lower()
    for pattern, by in _judging()["rules"]:
        answer = re.sub(pattern, by, answer)
    return answer


def match(given: str, right: Sequence[str]) -> tuple[bool, bool]:
    """Whether a cleaned answer equals a correct one (EM), and whether one contains the other (EM-R).

    >>> match("white", ["off-white"]), match("white", ["white"]), match("red", ["white"])
    ((False, True), (True, True), (False, False))
    """
    for one in right:
        if given == one:
            return True, True
        a, b = "".join(given.split()), "".join(one.split())
        if a in b or b in a:
            return False, True
    return False, False


def is_yes_or_no(right: Sequence[str]) -> bool:
    """Whether a correct answer contains "yes" or "no"."""
    return any(word in one.lower() for one in right for word in ("yes", "no"))


MIN_SCORE, MAX_SCORE = 1.0, 5.0
RIGHT_FROM = 4.0  # the score from which an answer counts as correct for its object
FIRST = ("case", "object")  # the first of the numbers
TAGS = ("class", "appearance", "geometry", "spatial", "existence", "functionality")


@dataclass(frozen=True)
class Number:
    """A fraction of ``n``; ``least`` and ``most`` differ if answers have no judge score."""

    name: str
    least: float
    most: float
    n: int


def grounding_numbers(chains: Chains, right: Mapping[str, Mapping[int, bool]]) -> list[Number]:
    """The numbers over all scenes, without those for which there are no questions.

    ``right``: for each scene and each case by position, whether it was found.
    """
    rows: dict[str, list[bool]] = {}
    for scene, cases in chains.cases.items():
        is_right = np.array([right[scene][row] for row in range(len(cases))], bool)
        for name, of_scene in judge_chains(cases, is_right).items():
            rows.setdefault(name, []).extend(of_scene.tolist())
    asked = {name: rows[name] for name in (*FIRST, *rows) if rows[name]}
    shares = {name: float(np.mean(values)) for name, values in asked.items()}
    return [Number(name, share, share, len(asked[name])) for name, share in shares.items()]


def answer_numbers(questions: Questions, replies: Mapping[tuple[str, str], Reply]) -> list[Number]:
    """EM, EM-R, the share with a final score, and the scores per case, object and kind of knowledge."""
    each = [scored(replies[one.scene, one.question.lower()]) for one in questions.asked]
    em, em_r, low, high = (np.array(column, float) for column in zip(*each, strict=True))
    n, tags = len(each), [one.tag for one in questions.asked]
    plain = {"EM": em, "EM-R": em_r, "settled": low == high}
    numbers = [Number(name, float(row.mean()), float(row.mean()), n) for name, row in plain.items()]
    numbers.append(Number("case", _share(low), _share(high), n))
    least, most = (float((scores.reshape(-1, CHAINS_EACH) >= RIGHT_FROM).all(axis=1).mean()) for scores in (low, high))
    numbers.append(Number("object", least, most, n // CHAINS_EACH))
    for tag in TAGS:
        of_tag = np.array([one == tag for one in tags])
        if of_tag.any():
            numbers.append(Number(tag, _share(low[of_tag]), _share(high[of_tag]), int(of_tag.sum())))
    return numbers


def scored(reply: Reply) -> tuple[bool, bool, float, float]:
    """EM and EM-R of an answer and its minimum and maximum score.

    >>> scored(Reply("Yes, there is.", "Yes", None))
    (False, True, 5.0, 5.0)
    """
    given, right = cleaned(reply.given), [cleaned(reply.right)]
    em, em_r = match(given, right)
    if em or (em_r and is_yes_or_no(right)):
        return em, em_r, MAX_SCORE, MAX_SCORE
    if reply.score is not None:
        return em, em_r, reply.score, reply.score
    return em, em_r, MIN_SCORE, MAX_SCORE


def _share(scores: Float64Array | Sequence[float]) -> float:
    return float((np.mean(scores) - MIN_SCORE) / (MAX_SCORE - MIN_SCORE))


_NUMBER = re.compile(r"\d+")
MAX_READ = 8000  # characters per reply

Key = tuple[str, str]  # of a question: its scene and its lower-case text


@dataclass(frozen=True)
class Judged:
    """Answers with judge scores, the number of judge requests and the number of replies without a score."""

    replies: Mapping[Key, Reply]
    model: str
    n_asked: int
    n_open: int


def is_open(reply: Reply) -> bool:
    """Whether an answer matches no correct one and has no score yet."""
    _, _, least, most = scored(reply)
    return least < most


def judge_requests(replies: Mapping[Key, Reply], config: LanguageConfig) -> dict[Key, ChatRequest]:
    """The judge request for each unscored answer."""
    return {
        key: ChatRequest(
            "judge",
            config.text_model,
            _judging()["prompt"],
            f"Question: {key[1]}\nRight answer: {cleaned(reply.right)}\nGiven answer: {cleaned(reply.given)}",
            max_answer_tokens=config.max_answer_tokens,
            temperature=config.temperature,
            seed=config.seed,
        )
        for key, reply in replies.items()
        if is_open(reply)
    }


def judged(replies: Mapping[Key, Reply], model: LanguageModel, config: LanguageConfig) -> Judged:
    """The answers, with judge scores filled in."""
    requests = judge_requests(replies, config)
    as_value = model.ask_all(list(requests.values()))
    scores = {key: score_of(reply) for key, reply in zip(requests, as_value, strict=True)}
    known = {key: replace(replies[key], score=score) for key, score in scores.items() if score is not None}
    return Judged({**replies, **known}, config.text_model, len(requests), len(requests) - len(known))


def score_of(reply: ModelReply) -> float | None:
    """The first number of a reply if it is a valid score, otherwise None.

    >>> score_of(ModelReply("Score: 4")), score_of(ModelReply("10")), score_of(ModelReply("good"))
    (4.0, None, None)
    """
    found = None if reply.failure else _NUMBER.search(reply.text[:MAX_READ])
    score = float(found[0][:9]) if found else 0.0
    return score if MIN_SCORE <= score <= MAX_SCORE else None


JUDGE_HINT = (
    "ranges are the minimum and maximum over unscored answers; pass a "
    "language model with --judge, or give each answer its 'score', 1 to 5"
)


@dataclass(frozen=True)
class Answered:
    """Metrics for a Beacon3D file (``grounding`` or ``qa``) and the judge's contribution."""

    kind: str
    numbers: tuple[Number, ...]
    judged: Judged | None = None


def answered_file(asked: Path, answers: Path, judge: Callable[[Mapping[Key, Reply]], Judged] | None = None) -> Answered:
    """Metrics of an answers file for ``asked``, a Beacon3D metadata file."""
    kind, content = _kind_of(asked)
    if kind == "grounding":
        if judge is not None:
            raise ConfigError(f"{shown(asked)}: grounding answers need no judge; use --judge with qa files only")
        chains = chains_of(content, shown(asked))
        return Answered(kind, tuple(grounding_numbers(chains, read_found(answers, chains))))
    questions = questions_of_objects(content, shown(asked))
    replies = read_replies(answers, questions)
    scores = None if judge is None else judge(replies)
    return Answered(kind, tuple(answer_numbers(questions, replies if scores is None else scores.replies)), scores)


def answers_to_questions(asked: Path, answers: Path) -> Mapping[Key, Reply]:
    """The answers to a metadata file of questions; empty for grounding."""
    kind, content = _kind_of(asked)
    return read_replies(answers, questions_of_objects(content, shown(asked))) if kind == "qa" else {}


def _kind_of(asked: Path) -> tuple[str, Any]:
    content = read_metadata(asked)
    kind = kind_of_metadata(content)
    if kind is None:
        raise DataError(f"{shown(asked)}: not a Beacon3D metadata_*_grounding.json or metadata_*_qa.json; see {PAGE}")
    return kind, content


def answered_table(answered: Answered) -> Table:
    """One row per metric, in percent."""
    is_open = any(one.least < one.most for one in answered.numbers)
    rows = tuple(TableRow(one.name, (Cell(_shown_share(one)), Cell(f"{one.n:,}"))) for one in answered.numbers)
    caption = "Beacon3D's grounding." if answered.kind == "grounding" else "Beacon3D's question answering."
    notes = [_judge_summary(answered.judged)] if answered.judged is not None else []
    if is_open and answered.judged is None:
        notes.append(JUDGE_HINT)
    return Table("beacon3d", caption, "number", ("%", "of"), rows, tuple(notes))


def _judge_summary(judged: Judged) -> str:
    model, asked = printable(judged.model, 100), counted(judged.n_asked, "answer")
    line = f"judge: {model}, asked for {asked} that match no correct one, with this program's own prompt"
    if not judged.n_open:
        return line
    return f"{line}; {counted(judged.n_open, 'reply')} without a score, shown as a range"


def answered_json(answered: Answered) -> dict[str, Any]:
    """The same as JSON-compatible data, as fractions."""
    judged = answered.judged
    known = None
    if judged is not None:
        known = {"model": judged.model, "n_asked": judged.n_asked, "n_without_score": judged.n_open}
    return {"kind": answered.kind, "numbers": [asdict(one) for one in answered.numbers], "judge": known}


def _shown_share(one: Number) -> str:
    return percent(one.least) if one.least == one.most else f"{percent(one.least)} to {percent(one.most)}"
