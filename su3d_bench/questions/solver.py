"""The built-in solver: answers English questions from boxes and centroids without a model.

A small grammar parses a question: closer and farther, distances, counts, presence, relations, between, sizes, places.
Distances are Euclidean between centroids, as in the paper's prompting strategy; "next to" and "near" use the gap
between boxes. If a noun refers to several objects, the nearest pair counts, with a note.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.digests import digest_json
from su3d_bench.core.english import is_plural, words
from su3d_bench.core.errors import printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.questions.score import SolverAnswer, TrueAnswer
from su3d_bench.numerics.relations import NEAR_M, is_left_of
from su3d_bench.perception.language.captioner import STRATEGY, reason_of
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply, n_tokens
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.parsing import answered, is_refusal
from su3d_bench.questions import scene_map
from su3d_bench.questions.model import Answer, undecided
from su3d_bench.questions.scene_map import MapObject, NearestName, SceneMap, noun_objects

Relation = Literal["on", "under", "in", "above", "next to", "near", "left of", "right of", "between", "with"]
Size = Literal["largest", "smallest", "tallest", "lowest", "longest", "highest"]

MAX_CHARACTERS = 400


@cache
def _grammar() -> dict[str, Any]:
    """Patterns and words for English questions, and the sentences of the prompt."""
    return parse_toml(file_text(Path(__file__).with_name("grammar.toml")))


@cache
def _relation() -> re.Pattern[str]:
    """A pattern for the words of any relation; the matching group is ``r`` and the number of the relation."""
    spellings = _grammar()["relations"].values()
    return re.compile("|".join(rf"(?P<r{k}>\b(?:{pattern})\b)" for k, pattern in enumerate(spellings)))


@cache
def _patterns(kind: str) -> list[re.Pattern[str]]:
    parts = _grammar()["parts"] | {"SIZE": "|".join(_grammar()["sizes"].values())}
    return [re.compile(pattern.format(**parts)) for pattern in _grammar()["patterns"][kind]]


@dataclass(frozen=True)
class Phrase:
    """A noun phrase: ``head`` and, if it is restricted, the ``relation`` to ``others`` (two for "between")."""

    head: str
    relation: Relation | None = None
    others: tuple[Phrase, ...] = ()


@dataclass(frozen=True)
class Question:
    """A parsed question: ``kind`` with its operands; which fields are set depends on the kind.

    ``extreme``: which of ``subject`` (or of ``options``) is closest to or farthest from ``other``. ``closer``: whether
    ``subject`` is closer to (farther from) ``other`` than ``options[0]``. ``size``: which of ``subject`` is largest.
    """

    kind: Literal["extreme", "closer", "distance", "count", "exists", "holds", "list", "size", "where"]
    subject: Phrase
    other: Phrase | None = None
    options: tuple[Phrase, ...] = ()
    relation: Relation | None = None
    farthest: bool = False
    size: Size | None = None


ANYTHING = Phrase("object")


def read_question(text: str) -> Question | None:
    """The parsed question of ``text``, or None.

    >>> read_question("Which sink is closer to bed?").subject
    Phrase(head='sink', relation=None, others=())
    """
    plain = " ".join(text[: MAX_CHARACTERS + 1].lower().replace("’", "'").split())
    if len(plain) > MAX_CHARACTERS:
        return None
    for pattern, by in _grammar()["clean"]:
        plain = re.sub(pattern, by, plain)
    plain = " ".join(plain.split()).strip(" ,?.!")
    for kind, read in _READERS.items():
        match = next((match for pattern in _patterns(kind) if (match := pattern.fullmatch(plain))), None)
        question = None if match is None else read(defaultdict(str, match.groupdict("")))
        if question is not None:
            return question
    return None


def read_phrase(text: str) -> Phrase:
    """The noun phrase ``text``: "the lamp on a desk" is "lamp", on, "desk"."""
    phrase = re.sub(r"^(?:the|a|an|any|some|all|another|other|my|that|this)\s+", "", text.strip(" ,"))
    phrase = re.sub(r"^(?:the|a|an|other)\s+", "", phrase)
    relation_match = next((match for match in _relation().finditer(phrase) if match.start() > 0), None)
    if relation_match is None:
        return Phrase(phrase.strip())
    head = re.sub(r"\s+(?:that|which|who)?\s*(?:is|are|lies|stands|hangs|hanging|lying|standing|sitting)?$", "",
                  phrase[: relation_match.start()].strip())  # fmt: skip
    relation = next(name for k, name in enumerate(_grammar()["relations"]) if relation_match[f"r{k}"] is not None)
    rest = phrase[relation_match.end() :].strip()
    if not rest or not head:
        return Phrase(phrase.strip())
    others = [rest]
    if relation == "between":
        others = re.sub(r"^(?:the )?(?:two )", "", rest).split(" and ", 1)
    return Phrase(head.strip(), relation, tuple(map(read_phrase, others)))


def _options(text: str) -> tuple[Phrase, ...]:
    parts = re.split(r"\s*,\s*(?:or |and )?|\s+or\s+", text.strip(" ,:"))
    return tuple(read_phrase(re.sub(r"^(?:either|is it|the)\s+", "", part)) for part in parts if part.strip())


Groups = Mapping[str, str]  # of a matching pattern; '' for groups that did not take part


def _extreme(found: Groups) -> Question | None:
    ref, _, listed = re.sub(r"\s*[:;]\s*", ", ", found["ref"]).partition(", ")
    options = _options(found["options"] or listed)
    if not options and " or " in ref:
        return None
    subject = read_phrase(found["a"]) if found["a"] else ANYTHING
    return Question("extreme", subject, read_phrase(ref), options, farthest=bool(found["far"]))


def _closer(found: Groups) -> Question:
    options = (read_phrase(found["b"]),)
    return Question("closer", read_phrase(found["a"]), read_phrase(found["ref"]), options, farthest=bool(found["far"]))


def _size(found: Groups) -> Question:
    size = next(name for name, spelt in _grammar()["sizes"].items() if re.fullmatch(spelt, found["size"]))
    named, _, listed = (found["a"] or "object").partition(", ")
    return Question("size", read_phrase(named), options=_options(listed), size=size)


def _holds(found: Groups) -> Question | None:
    phrase = read_phrase(found["a"])
    if phrase.relation is None:
        return None
    if len(phrase.others) == 1 and phrase.others[0].relation is None:
        return Question("holds", Phrase(phrase.head), phrase.others[0], relation=phrase.relation)
    return Question("holds", Phrase(phrase.head), options=phrase.others, relation=phrase.relation)


def _list(found: Groups) -> Question | None:
    phrase = read_phrase(f"{found['a'] or 'object'} {found['rest']}")
    return None if phrase.relation is None else Question("list", phrase)


# In the order in which they are tried.
_READERS: Mapping[str, Callable[[Groups], Question | None]] = {
    "closer": _closer,
    "extreme": _extreme,
    "distance": lambda found: Question("distance", read_phrase(found["a"]), read_phrase(found["b"])),
    "count": lambda found: Question("count", read_phrase(found["a"] + found["rest"])),
    "size": _size,
    "where": lambda found: Question("where", read_phrase(found["a"])),
    "exists": lambda found: Question("exists", read_phrase(found["a"])),
    "holds": _holds,
    "list": _list,
}
CLOSE_CALL_M = 0.05  # a smaller lead gets a note
MAX_LISTED = 12
Objects = tuple[MapObject, ...]
_Solved = tuple[str, Objects, Objects, float | int | bool | None]  # text, objects, references, value

_MEASURES: dict[Size, tuple[str, Callable[[MapObject], float], bool]] = {
    "largest": ("a box of {:.3g} m³", lambda thing: float(np.prod(thing.size)), True),
    "smallest": ("a box of {:.3g} m³", lambda thing: float(np.prod(thing.size)), False),
    "tallest": ("{:.3g} m tall", lambda thing: float(thing.size[2]), True),
    "longest": ("{:.3g} m at its longest", lambda thing: float(thing.size[:2].max()), True),
    "highest": ("{:.3g} m up", lambda thing: float(thing.centroid[2]), True),
    "lowest": ("{:.3g} m up", lambda thing: float(thing.centroid[2]), False),
}


class _Unsettled(Exception):
    """The question cannot be settled; the message is the reason."""


class Solver:
    """Answers questions about one map; ``eye`` (3,) is the viewpoint for left and right (default: the middle)."""

    def __init__(self, scene: SceneMap, eye: Float64Array | None = None, nearest: NearestName | None = None) -> None:
        self._scene = scene
        self._is_eye_given = eye is not None
        self._eye = scene.middle if eye is None else eye
        self._nearest = nearest
        self._notes = dict[str, None]()

    def answer(self, text: str) -> Answer:
        """The answer to an English question; unsettled if it cannot be parsed or answered."""
        question = read_question(text)
        if question is None:
            return undecided("the built-in solver cannot read the question; try --question-solver llm")
        return self.solve(question)

    def solve(self, question: Question) -> Answer:
        """The answer to a parsed question."""
        self._notes = dict[str, None]()
        solve: Callable[[Question], _Solved] = getattr(self, f"_{question.kind}")
        try:
            text, objects, references, value = solve(question)
        except _Unsettled as reason:
            return undecided(str(reason), tuple(self._notes))
        ids, related = (tuple(thing.id for thing in things) for things in (objects, references))
        return Answer(text, ids, related, value, question.kind, notes=tuple(self._notes))

    def _note(self, note: str) -> None:
        self._notes[note] = None

    # Noun phrases.

    def _objects(self, phrase: Phrase) -> tuple[Objects, Objects]:
        """The objects of a phrase and the reference objects of its restrictions; empty if none satisfies them."""
        meant: scene_map.NounMatch = noun_objects(phrase.head, self._scene, self._nearest)
        self._notes |= dict.fromkeys(meant.notes)
        if not meant.objects:
            raise _Unsettled(self._has_no(phrase.head))
        if phrase.relation is None:
            return meant.objects, ()
        others = [self._some(other) for other in phrase.others]
        kept: list[MapObject] = []
        related: dict[int, MapObject] = {}
        for thing in meant.objects:
            witnesses = self._related_objects(thing, phrase.relation, others)
            if witnesses:
                kept.append(thing)
                related |= {other.id: other for other in witnesses}
        return tuple(kept), tuple(related.values())

    def _some(self, phrase: Phrase) -> Objects:
        objects, _ = self._objects(phrase)
        if not objects:
            raise _Unsettled(self._has_no(_shown(phrase)))
        return objects

    def _has_no(self, noun: str) -> str:
        hint = "" if read_phrase(noun).relation else scene_map.name_suggestion(noun, self._scene)
        return f"the map has no '{noun}'{hint}"

    def _there_is_no(self, phrase: Phrase) -> str:
        hint = "" if phrase.relation else scene_map.name_suggestion(phrase.head, self._scene)
        return f"there {'are' if is_plural(phrase.head) else 'is'} no {_shown(phrase)}{hint}"

    def _related_objects(self, thing: MapObject, relation: Relation, others: Sequence[Objects]) -> Objects:
        """Objects to which ``thing`` has the ``relation``."""
        if relation == "between":
            if len(others) == 1 and len(others[0]) == 2:
                others = [others[0][:1], others[0][1:]]
            if len(others) != 2:
                raise _Unsettled("'between' needs two objects, such as: between the bed and the door")
            pairs = ((a, b) for a in others[0] for b in others[1] if a.id != b.id)
            return next(((a, b) for a, b in pairs if self._scene.is_between(thing, a, b)), ())
        return tuple(
            other for other in others[0] if other.id != thing.id and self._relation_holds(thing, relation, other)
        )

    def _relation_holds(self, thing: MapObject, relation: Relation, other: MapObject) -> bool:
        if relation == "left of" or relation == "right of":  # two comparisons narrow the type
            x, y = self._eye[:2]
            where = "the given eye" if self._is_eye_given else "the middle of the map"
            self._note(f"left and right as seen from {where} ({x:.2f}, {y:.2f})")
            a, b = (thing, other) if relation == "left of" else (other, thing)
            return is_left_of(a.centroid, b.centroid, self._eye)
        if relation == "with":
            related = any(self._scene.holds(name, other, thing) for name in ("on", "in"))
            return related or self._scene.holds("next to", thing, other)
        assert relation != "between", "between has two others"
        return self._scene.holds(relation, thing, other)

    # Kinds of questions.

    def _extreme(self, question: Question) -> _Solved:
        assert question.other is not None
        references = self._some(question.other)
        if question.options:
            candidates = tuple(thing for option in question.options for thing in self._option(option, question.subject))
        else:
            candidates = self._some(question.subject)
        is_reference = {thing.id for thing in references}
        others = {thing.id: thing for thing in candidates if thing.id not in is_reference}
        if question.subject == ANYTHING and not question.options:
            others = {key: thing for key, thing in others.items() if not scene_map.is_room_surface(thing.name)}
        if not others:
            raise _Unsettled(f"the map has nothing else to compare with '{question.other.head}'")
        self._note_multiple_labels(references, question.other)
        ranked = sorted(
            (_nearest_pair((thing,), references) for thing in others.values()),
            key=lambda pair: ((-pair[0] if question.farthest else pair[0]), pair[1].id),
        )
        distance_m, best, reference = ranked[0]
        if len(ranked) == 1:
            self._note(f"there is only one '{_shown(question.subject)}'")
        elif abs(ranked[1][0] - distance_m) < CLOSE_CALL_M:
            self._note(f"a close call: {ranked[1][1].shown} is {ranked[1][0]:.2f} m away, between centres")
        rest = "".join(f"; {thing.shown} {away_m:.2f} m" for away_m, thing, _ in ranked[1:4])
        degree = "er" if len(ranked) == 2 else "est"
        end = f"farth{degree} from" if question.farthest else f"clos{degree} to"
        text = f"{best.shown} is {end} {reference.shown}: {distance_m:.2f} m between centres{rest}"
        return text, (best,), (reference,), None

    def _option(self, option: Phrase, subject: Phrase) -> Objects:
        """Objects of an option; if the map has none of that name, those of the question's own noun."""
        try:
            return self._some(option)
        except _Unsettled:
            if subject != ANYTHING:
                self._note(f"the map has no '{_shown(option)}'; every '{subject.head}' was compared")
                return self._some(subject)
            raise

    def _closer(self, question: Question) -> _Solved:
        assert question.other is not None
        references = self._some(question.other)
        a_m, a, reference = _nearest_pair(self._some(question.subject), references)
        b_m, b, _ = _nearest_pair(self._some(question.options[0]), references)
        is_so = a_m > b_m if question.farthest else a_m < b_m
        self._note_multiple_labels(references, question.other)
        away = f"{a.shown} is {a_m:.2f} m from {reference.shown}, {b.shown} {b_m:.2f} m, between centres"
        return f"{'yes' if is_so else 'no'}: {away}", (a, b), (reference,), is_so

    def _distance(self, question: Question) -> _Solved:
        assert question.other is not None
        first, second = self._some(question.subject), self._some(question.other)
        distance_m, a, b = _nearest_pair(first, second)
        if a.id == b.id:
            raise _Unsettled(f"'{_shown(question.subject)}' and '{_shown(question.other)}' are one object in the map")
        self._note_multiple_labels(first, question.subject)
        self._note_multiple_labels(second, question.other)
        return f"{distance_m:.2f} m between the centres of {a.shown} and {b.shown}", (a, b), (), distance_m

    def _count(self, question: Question) -> _Solved:
        things, related = self._found_or_none(question.subject)
        text = f"{len(things)}: {_listed(things)}" if things else f"0: {self._there_is_no(question.subject)}"
        return text, things, related, len(things)

    def _exists(self, question: Question) -> _Solved:
        things, related = self._found_or_none(question.subject)
        if not things:
            return f"no: {self._there_is_no(question.subject)}", (), (), False
        return f"yes: {_listed(things)}", things, related, True

    def _found_or_none(self, phrase: Phrase) -> tuple[Objects, Objects]:
        """As ``_objects``, but empty for a noun that the map does not have, which answers the question."""
        if not noun_objects(phrase.head, self._scene, self._nearest).objects:
            return (), ()
        return self._objects(phrase)

    def _holds(self, question: Question) -> _Solved:
        assert question.relation is not None
        others = question.options or ((question.other,) if question.other else ())
        phrase = Phrase(question.subject.head, question.relation, others)
        things, related = self._objects(phrase)
        if not things:
            return f"no: {self._there_is_no(phrase)}", self._some(question.subject), (), False
        return f"yes: {_listed(things)} {question.relation} {_listed(related)}", things, related, True

    def _list(self, question: Question) -> _Solved:
        things, related = self._objects(question.subject)
        if question.subject.relation in ("left of", "right of"):
            things = tuple(
                thing for thing in things if any(self._scene.holds("near", thing, other) for other in related)
            )
            self._note(f"no farther than {NEAR_M:g} m from it")
        if not things:
            return f"nothing: {self._there_is_no(question.subject)}", (), (), None
        return _listed(things), things, related, None

    def _size(self, question: Question) -> _Solved:
        assert question.size is not None
        phrases = question.options or (question.subject,)
        candidates = {thing.id: thing for phrase in phrases for thing in self._some(phrase)}
        shown, measure, is_most = _MEASURES[question.size]
        ranked = sorted(candidates.values(), key=lambda thing: ((-1 if is_most else 1) * measure(thing), thing.id))
        best = ranked[0]
        degree = f"{question.size[:-2]}r" if len(ranked) == 2 else question.size
        rest = "".join(f"; {thing.shown}: {shown.format(measure(thing))}" for thing in ranked[1:4])
        return f"{best.shown} is the {degree}: {shown.format(measure(best))}{rest}", (best,), (), None

    def _where(self, question: Question) -> _Solved:
        things, related = self._objects(question.subject)
        if not things:
            raise _Unsettled(self._has_no(_shown(question.subject)))
        places = [f"{thing.shown} at ({', '.join(f'{value:.2f}' for value in thing.centroid)}) m" for thing in things]
        more = f" and {len(things) - MAX_LISTED} more" if len(things) > MAX_LISTED else ""
        return "; ".join(places[:MAX_LISTED]) + more, things, related, None

    def _note_multiple_labels(self, objects: Objects, phrase: Phrase) -> None:
        if len(objects) > 1:
            self._note(f"there are {len(objects)} of '{_shown(phrase)}'; the nearest one counts")


def _nearest_pair(first: Objects, second: Objects) -> tuple[float, MapObject, MapObject]:
    """The least distance between centroids, with its objects; ties: the lower ids, an object with itself last."""
    pairs = [(a, b) for a in first for b in second if a.id != b.id] or [(first[0], second[0])]
    return min(
        ((float(np.linalg.norm(a.centroid - b.centroid)), a, b) for a, b in pairs),
        key=lambda pair: (pair[0], pair[1].id, pair[2].id),
    )


def _shown(phrase: Phrase) -> str:
    if phrase.relation is None:
        return phrase.head
    return f"{phrase.head} {phrase.relation} {' and '.join(f'the {_shown(other)}' for other in phrase.others)}"


def _listed(objects: Objects) -> str:
    shown = ", ".join(thing.shown for thing in objects[:MAX_LISTED])
    return shown if len(objects) <= MAX_LISTED else f"{shown} and {len(objects) - MAX_LISTED} more"


# Settings of the language model that affect an answer; times, prices and limits do not.
ANSWER_SETTINGS = {"text_model", "temperature", "seed", "max_answer_tokens", "context_tokens", "reasoning_effort"}
FEW_OBJECTS = 1  # always given, however small the model's context


@dataclass(frozen=True)
class Context:
    """The objects given to the model, in the map's order; ``note``: a remark if these are not all."""

    objects: tuple[MapObject, ...]
    note: str = ""


def answers_digest(config: LanguageConfig) -> str:
    """A key of everything that affects the answers of a language model."""
    return digest_json([system_prompt(), config.model_dump(mode="json", include=ANSWER_SETTINGS)])


def system_prompt() -> str:
    """The system prompt: a description of the list, the paper's six rules, the form of the answer."""
    prompt = _grammar()["prompt"]
    return "\n".join((prompt["introduction"], *(f"- {rule}" for rule in STRATEGY), prompt["form"]))


def object_line(thing: MapObject) -> str:
    """One object in the prompt of the model, lengths rounded to a millimetre."""
    entry = {
        "ID": thing.id,
        "Name": thing.name,
        "Description": thing.caption,
        "Centroid": _rounded(thing.centroid),
        "Bounding Box": [_rounded(thing.box[0]), _rounded(thing.box[1])],
    }
    return json.dumps(entry, ensure_ascii=False)


def _rounded(values: Float64Array) -> list[float]:
    return [round(float(value), 3) for value in values]


def context_for(scene: SceneMap, question: str, config: LanguageConfig) -> Context:
    """The objects that fit into the model's context, the most relevant to ``question`` if not all do."""
    room = config.context_tokens - config.max_answer_tokens - n_tokens(system_prompt()) - n_tokens(question) - 100
    costs = {thing.id: n_tokens(object_line(thing)) + 1 for thing in scene.objects}
    if sum(costs.values()) <= room:
        return Context(scene.objects)
    chosen: set[int] = set()
    for thing in by_relevance(scene, question):
        if costs[thing.id] <= room or len(chosen) < FEW_OBJECTS:
            chosen.add(thing.id)
            room -= costs[thing.id]
    note = (
        f"the map has {len(scene)} objects, more than fit into the model's context; it got the {len(chosen)} most "
        "relevant to the question"
    )
    return Context(
        tuple(thing for thing in scene.objects if thing.id in chosen), note if len(chosen) < len(scene) else ""
    )


def by_relevance(scene: SceneMap, question: str) -> list[MapObject]:
    """Objects by relevance: those that the question names, those whose name or caption shares a word with it, then by
    distance to the former; large before small if none is named."""
    named = {thing.id for phrase in _phrases(question) for thing in noun_objects(phrase, scene).objects}
    question_words = set(_every_word(question))
    sharing = {thing.id for thing in scene.objects if question_words & {*words(thing.name), *words(thing.caption)}}
    centres = np.array([thing.centroid for thing in scene.objects if thing.id in named]).reshape(-1, 3)

    def rank(thing: MapObject) -> tuple[int, float, int]:
        group = 0 if thing.id in named else 1 if thing.id in sharing else 2
        if not len(centres):
            return group, -float(np.prod(thing.size)), thing.id
        return group, float(np.linalg.norm(centres - thing.centroid, axis=1).min()), thing.id

    return sorted(scene.objects, key=rank)


def _phrases(question: str) -> list[str]:
    """Nouns in the question, if the built-in grammar can parse it."""
    read = read_question(question)
    if read is None:
        return []
    waiting: list[Phrase] = [read.subject, *([read.other] if read.other else []), *read.options]
    nouns: list[str] = []
    while waiting:
        phrase = waiting.pop()
        nouns.append(phrase.head)
        waiting += phrase.others
    return [noun for noun in nouns if noun != "object"]


def _every_word(question: str) -> list[str]:
    return [word for part in question.split() for word in words(part) if word not in _grammar()["common"]]


def ask_request(context: Context, question: str, config: LanguageConfig) -> ChatRequest:
    """The request for one question over a map."""
    lines = "\n".join(object_line(thing) for thing in context.objects)
    return ChatRequest(
        "ask",
        config.text_model,
        system_prompt(),
        f"Objects:\n{lines}\n\nQuestion: {question}",
        max_answer_tokens=config.max_answer_tokens,
        temperature=config.temperature,
        seed=config.seed,
        reasoning_effort=config.reasoning_effort,
    )


class LanguageSolver:
    """Asks the text model with the paper's prompting strategy."""

    def __init__(self, scene: SceneMap, model: LanguageModel, config: LanguageConfig) -> None:
        self._scene = scene
        self._model = model
        self._config = config

    def request(self, question: str) -> ChatRequest:
        """The request to the model."""
        return ask_request(context_for(self._scene, question, self._config), question, self._config)

    def answer(self, question: str) -> Answer:
        """The model's answer and the objects that it names; a failure or refusal as an unsettled answer."""
        return self.answers([question])[0]

    def answers(self, questions: Sequence[str]) -> list[Answer]:
        """The answers in the order of ``questions``, which may be requested in parallel."""
        contexts = [context_for(self._scene, question, self._config) for question in questions]
        requests = [ask_request(*both, self._config) for both in zip(contexts, questions, strict=True)]
        replies = self._model.ask_all(requests)
        return [self._answer(*both) for both in zip(contexts, replies, strict=True)]

    def _answer(self, context: Context, reply: Reply) -> Answer:
        notes = tuple(note for note in (context.note, _dropped(reply.dropped)) if note)
        parsed = None if reply.failure else answered(reply.text, [thing.id for thing in context.objects])
        if parsed is None or (not parsed.object_ids and is_refusal(parsed.text)):
            return replace(undecided(f"{self._config.text_model}: {reason_of(reply)}", notes), solver="llm")
        if reply.finish_reason == "length":
            notes += ("the answer was cut at max_answer_tokens",)
        if not parsed.object_ids:
            notes += ("the answer names no object of the map",)
        if parsed.reasons:
            notes += (f"reasoning: {parsed.reasons}",)
        return Answer(parsed.text, parsed.object_ids, parsed.reference_ids, kind="llm", notes=notes, solver="llm")


def _dropped(names: tuple[str, ...]) -> str:
    return f"the server does not accept {', '.join(names)}; the model ran without" if names else ""


AskMap = Callable[[SceneMap, Sequence[str]], Sequence[Answer]]
BUILT_IN = "the built-in solver"


@dataclass(frozen=True)
class MapSolver:
    """A named question solver for maps."""

    name: str
    ask: AskMap


def built_in(encoder: Encoder | None) -> AskMap:
    """Answers from geometry; ``encoder`` finds the nearest name."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = Solver(scene, None, None if encoder is None else scene_map.nearest_by(encoder))
        return [solver.answer(question) for question in questions]

    return ask


def by_language_model(model: LanguageModel, config: LanguageConfig) -> MapSolver:
    """Answers of a language model, several questions in parallel."""
    name = f"the language model {printable(config.text_model, 100)}"
    return MapSolver(name, lambda scene, questions: LanguageSolver(scene, model, config).answers(questions))


def given_answer(true: TrueAnswer, answer: Answer, scene: SceneMap) -> SolverAnswer:
    """``answer`` about ``scene`` in the form of ``true``."""
    rows = [scene.by_id(object_id).row for object_id in answer.object_ids]
    # from the text of a language model, yes or no, or the first number is read
    value = answer.value if true.value is None or answer.solver == "built-in" else answer.as_value(true.value)
    return SolverAnswer(value, np.array(rows, np.int64), answer.is_decided)
