"""The built-in solver: English questions that boxes and centroids settle, answered without any model.

A small grammar reads a question: closer and farther, distances, counts, presence, relations, between, sizes, places.
Distances are Euclidean between centroids, as in the paper's prompting strategy; "next to" and "near" go by the gap
between boxes. Where a noun means several objects, the nearest pair counts, and it is said.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.relations import NEAR_M, is_left_of
from su3d_bench.questions.model import Answer, unsettled
from su3d_bench.questions.scene_map import (
    MapObject,
    Meant,
    NearestName,
    SceneMap,
    is_room_surface,
    meant_by,
    meant_instead,
)

Relation = Literal["on", "under", "in", "above", "next to", "near", "left of", "right of", "between", "with"]
Size = Literal["largest", "smallest", "tallest", "lowest", "longest", "highest"]

MOST_CHARACTERS = 400
# Each relation with its spellings, the longer ones first.
_SPELLINGS: tuple[tuple[Relation, str], ...] = (
    ("left of", r"(?:on|to|at) the left(?: hand)?(?: side)? of|left of"),
    ("right of", r"(?:on|to|at) the right(?: hand)?(?: side)? of|right of"),
    ("on", r"on top of|resting on|sitting on|standing on|lying on|placed on|upon|atop|on"),
    ("under", r"underneath|beneath|below|under"),
    ("next to", r"right next to|next to|beside|adjacent to|alongside"),
    ("near", r"close to|near to|nearby|near|around"),
    ("above", r"above|over"),
    ("in", r"inside of|inside|within|in"),
    ("between", r"in between|between"),
    ("with", r"with"),
)
_RELATION = re.compile("|".join(rf"(?P<r{k}>\b(?:{pattern})\b)" for k, (_, pattern) in enumerate(_SPELLINGS)))
_CLOSE, _FAR = r"clos(?:er|est)|near(?:er|est)", r"(?:farther|further|farthest|furthest)(?: away)?"
_HOW = rf"(?:the )?(?:(?P<close>{_CLOSE})|(?P<far>{_FAR}))"
_ENDS = r"(?:to|from)"
_ARE = r"(?:is|are|lies|lie|stands|stand|would be)"
_SIZES: tuple[tuple[Size, str], ...] = (
    ("largest", r"largest|biggest|larger|bigger"),
    ("smallest", r"smallest|littlest|smaller"),
    ("tallest", r"tallest|taller"),
    ("lowest", r"lowest|lower"),
    ("longest", r"longest|widest|longer|wider"),
    ("highest", r"highest|higher"),
)
_SIZE = "|".join(pattern for _, pattern in _SIZES)
_HERE = re.compile(
    r"\b(?:(?:in|inside|of|within|throughout) )?(?:the|this|my|our) (?:whole |entire )?"
    r"(?:room|scene|map|house|apartment|flat|place)\b(?! \w)|\bhere\b$"
)
_POLITE = re.compile(
    r"^(?:please|can you|could you|would you|tell me|do you know|i want to know|find out|show me|let me know)\b[ ,]*"
)
# Distances are between centres anyway.
_CENTRES = re.compile(
    r"(?:,? measured (?:between|from) (?:their |the )?cent(?:re|er)s?(?: to cent(?:re|er)s?)?|the cent(?:re|er)s? of )"
)
_EVERYTHING = r"(?:object|objects|thing|things|item|items|furniture item)"


@dataclass(frozen=True)
class Phrase:
    """A noun phrase: ``head``, and where it is restricted, the ``relation`` to ``others`` (two for "between")."""

    head: str
    relation: Relation | None = None
    others: tuple[Phrase, ...] = ()


@dataclass(frozen=True)
class Question:
    """What is asked: ``kind`` with its operands; which fields are set depends on the kind.

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
    """What ``text`` asks, or None.

    >>> read_question("Which sink is closer to bed?").subject
    Phrase(head='sink', relation=None, others=())
    """
    plain = _plain(text)
    if not plain:
        return None
    for reader in (_closer, _extreme, _distance, _count, _size, _where, _holds_or_exists, _list):
        question = reader(plain)
        if question is not None:
            return question
    return None


def _plain(text: str) -> str:
    plain = " ".join(text[: MOST_CHARACTERS + 1].lower().replace("’", "'").split())
    if len(plain) > MOST_CHARACTERS:
        return ""
    plain = plain.rstrip(" ?.!")
    while (shorter := _POLITE.sub("", plain)) != plain:
        plain = shorter
    plain = re.sub(r"\b(what|which|where|how|who)'s\b", r"\1 is", plain)
    plain = re.sub(r"\b(near|on|under|in|above|to|from|beside),\s", r"\1 ", plain)
    plain = _CENTRES.sub("", plain)
    return " ".join(_HERE.sub("", plain).split()).strip(" ,?.!")


def read_phrase(text: str) -> Phrase:
    """The noun phrase ``text``: "the lamp on a desk" is "lamp", on, "desk"."""
    phrase = re.sub(r"^(?:the|a|an|any|some|all|another|other|my|that|this)\s+", "", text.strip(" ,"))
    phrase = re.sub(r"^(?:the|a|an|other)\s+", "", phrase)
    relation_match = next((match for match in _RELATION.finditer(phrase) if match.start() > 0), None)
    if relation_match is None:
        return Phrase(phrase.strip())
    head = re.sub(r"\s+(?:that|which|who)?\s*(?:is|are|lies|stands|hangs|hanging|lying|standing|sitting)?$", "",
                  phrase[: relation_match.start()].strip())  # fmt: skip
    relation, rest = _relation_of(relation_match), phrase[relation_match.end() :].strip()
    return Phrase(head.strip(), relation, _operands(relation, rest)) if rest and head else Phrase(phrase.strip())


def _operands(relation: Relation, text: str) -> tuple[Phrase, ...]:
    if relation != "between":
        return (read_phrase(text),)
    first, joined, second = re.sub(r"^(?:the )?(?:two )", "", text).partition(" and ")
    return (read_phrase(first), read_phrase(second)) if joined else (read_phrase(first),)


def _relation_of(match: re.Match[str]) -> Relation:
    return next(name for k, (name, _) in enumerate(_SPELLINGS) if match[f"r{k}"] is not None)


def _options(text: str) -> tuple[Phrase, ...]:
    parts = re.split(r"\s*,\s*(?:or |and )?|\s+or\s+", text.strip(" ,:"))
    return tuple(read_phrase(re.sub(r"^(?:either|is it|the)\s+", "", part)) for part in parts if part.strip())


def _closer(plain: str) -> Question | None:
    match = re.fullmatch(rf"(?:is|are) (?P<a>.+?) {_HOW} {_ENDS} (?P<ref>.+?) than (?:to )?(?P<b>.+)", plain)
    if match is None:
        return None
    options = (read_phrase(match["b"]),)
    return Question("closer", read_phrase(match["a"]), read_phrase(match["ref"]), options, farthest=bool(match["far"]))


def _extreme(plain: str) -> Question | None:
    patterns = (
        rf"(?:which|what)(?: one)?(?: of the)?(?: (?P<a>(?!is |are ).+?))? {_ARE} {_HOW}(?: one| {_EVERYTHING})?"
        rf" {_ENDS} (?P<ref>.+)",
        rf"(?:which|what) (?:is|are) {_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:where (?:is|are)|find|show|give) {_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:where (?:is|are)|find|show|give|which is|what is) (?P<a>.+?) {_HOW} {_ENDS} (?P<ref>.+)",
        rf"{_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:is|are) (?P<options>.+? or .+?) {_HOW} {_ENDS} (?P<ref>.+)",
    )
    for pattern in patterns:
        match = re.fullmatch(pattern, plain)
        if match is None:
            continue
        groups = match.groupdict()
        ref, _, listed = re.sub(r"\s*[:;]\s*", ", ", match["ref"]).partition(", ")
        options = _options(groups.get("options") or listed)
        subject = read_phrase(groups["a"]) if groups.get("a") else ANYTHING
        if not options and " or " in ref:
            return None
        return Question("extreme", subject, read_phrase(ref), options, farthest=bool(match["far"]))
    return None


def _distance(plain: str) -> Question | None:
    patterns = (
        r"(?:what|how (?:large|big|long|much)) is the distance (?:between|from) (?P<a>.+?) (?:and|to) (?P<b>.+)",
        r"(?:distance (?:between|from)) (?P<a>.+?) (?:and|to) (?P<b>.+)",
        r"how (?:far|close|near)(?: away| apart)? (?:is|are) (?P<a>.+?) (?:away )?(?:from|to|and) (?P<b>.+?)"
        r"(?: apart)?",
    )
    for pattern in patterns:
        if match := re.fullmatch(pattern, plain):
            return Question("distance", read_phrase(match["a"]), read_phrase(match["b"]))
    return None


def _count(plain: str) -> Question | None:
    match = re.fullmatch(
        r"(?:how many (?P<a>.+?)(?: are| is| do| can)(?: there)?(?: you see| i have| we have)?(?P<rest> .+)?"
        r"|(?:how many|count(?: all)?|what is the number of|number of) (?P<b>.+))",
        plain,
    )
    if match is None:
        return None
    named = f"{match['a']}{match['rest'] or ''}" if match["a"] else match["b"]
    return Question("count", read_phrase(named))


def _size(plain: str) -> Question | None:
    patterns = (
        rf"(?:which|what|where) (?:is|are) (?:the )?(?P<size>{_SIZE})(?: of the| of all)?(?P<a> .+)?",
        rf"(?:which|what)(?: of the)? (?P<a>.+?) {_ARE} (?:the )?(?P<size>{_SIZE})(?: one)?",
        rf"(?:find |show )?(?:the )?(?P<size>{_SIZE}) (?P<a>.+)",
    )
    for pattern in patterns:
        if match := re.fullmatch(pattern, plain):
            size = next(name for name, spelt in _SIZES if re.fullmatch(spelt, match["size"]))
            named, _, listed = (match["a"] or "object").partition(", ")
            return Question("size", read_phrase(named), options=_options(listed), size=size)
    return None


def _where(plain: str) -> Question | None:
    match = re.fullmatch(r"(?:where (?:is|are|can i find|do i find)|locate|find|show) (?P<a>.+)", plain)
    return None if match is None else Question("where", read_phrase(match["a"]))


def _holds_or_exists(plain: str) -> Question | None:
    if match := re.fullmatch(r"(?:is|are) there (?P<a>.+)|(?:do|can) (?:i|you|we) (?:have|see|find) (?P<b>.+)", plain):
        return Question("exists", read_phrase(match["a"] or match["b"]))
    match = re.fullmatch(r"(?:is|are) (?P<a>.+)", plain)
    if match is None:
        return None
    phrase = read_phrase(match["a"])
    if phrase.relation is None:
        return None
    if len(phrase.others) == 1 and phrase.others[0].relation is None:
        return Question("holds", Phrase(phrase.head), phrase.others[0], relation=phrase.relation)
    return Question("holds", Phrase(phrase.head), options=phrase.others, relation=phrase.relation)


def _list(plain: str) -> Question | None:
    match = re.fullmatch(
        rf"(?:what|which)(?: (?P<a>(?!is |are ).+?))?(?: {_ARE}| there is| can be found| can i find)(?: there)?"
        r" (?P<rest>.+)",
        plain,
    )
    if match is None:
        return None
    head = match["a"] or "object"
    phrase = read_phrase(f"{head} {match['rest']}")
    return None if phrase.relation is None else Question("list", phrase)


CLOSE_CALL_M = 0.05  # a lead smaller than this is said
MOST_LISTED = 12
Objects = tuple[MapObject, ...]
_Solved = tuple[str, Objects, Objects, float | int | bool | None]  # text, objects, references, value

_MEASURES: dict[Size, tuple[str, Callable[[MapObject], float], bool]] = {
    "largest": ("m³ of its box", lambda thing: float(np.prod(thing.size)), True),
    "smallest": ("m³ of its box", lambda thing: float(np.prod(thing.size)), False),
    "tallest": ("m tall", lambda thing: float(thing.size[2]), True),
    "longest": ("m at its longest", lambda thing: float(thing.size[:2].max()), True),
    "highest": ("m up", lambda thing: float(thing.centroid[2]), True),
    "lowest": ("m up", lambda thing: float(thing.centroid[2]), False),
}


class _Unsettled(Exception):
    """The question cannot be settled, for the reason given."""


class Solver:
    """Answers questions about one map; ``eye`` (3,) is where one stands for left and right (the map's middle)."""

    def __init__(self, scene: SceneMap, eye: Float64Array | None = None, nearest: NearestName | None = None) -> None:
        self._scene = scene
        self._is_eye_given = eye is not None
        self._eye = scene.middle if eye is None else eye
        self._nearest = nearest
        self._notes: list[str] = []

    def answer(self, text: str) -> Answer:
        """The answer to an English question; one that says so where it cannot be read or settled."""
        question = read_question(text)
        if question is None:
            return unsettled("the question is none of those that geometry settles; try --solver llm")
        return self.solve(question)

    def solve(self, question: Question) -> Answer:
        """The answer to a question that was read."""
        self._notes = []
        solve = {
            "extreme": self._extreme, "closer": self._closer, "distance": self._distance, "count": self._count,
            "exists": self._exists, "holds": self._holds, "list": self._list, "size": self._size, "where": self._where,
        }[question.kind]  # fmt: skip
        try:
            text, objects, references, value = solve(question)
        except _Unsettled as reason:
            return unsettled(str(reason), self._said())
        return Answer(text, _ids(objects), _ids(references), value, question.kind, self._said())

    def _said(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self._notes))

    # Noun phrases.

    def _objects(self, phrase: Phrase) -> tuple[Objects, Objects]:
        """What a phrase means, and what its restrictions were held against; empty where none meets them."""
        meant: Meant = meant_by(phrase.head, self._scene, self._nearest)
        self._notes += meant.notes
        if not meant.objects:
            raise _Unsettled(self._has_no(phrase.head))
        if phrase.relation is None:
            return meant.objects, ()
        others = [self._some(other) for other in phrase.others]
        kept: list[MapObject] = []
        held: dict[int, MapObject] = {}
        for thing in meant.objects:
            witnesses = self._witnesses(thing, phrase.relation, others)
            if witnesses:
                kept.append(thing)
                held |= {other.id: other for other in witnesses}
        return tuple(kept), tuple(held.values())

    def _some(self, phrase: Phrase) -> Objects:
        objects, _ = self._objects(phrase)
        if not objects:
            raise _Unsettled(self._has_no(_shown(phrase)))
        return objects

    def _has_no(self, noun: str) -> str:
        return f"the map has no '{noun}'{meant_instead(noun, self._scene)}"

    def _witnesses(self, thing: MapObject, relation: Relation, others: Sequence[Objects]) -> Objects:
        """Objects to which ``thing`` stands in ``relation``."""
        if relation == "between":
            if len(others) == 1 and len(others[0]) == 2:
                others = [others[0][:1], others[0][1:]]
            if len(others) != 2:
                raise _Unsettled("'between' needs two things, such as: between the bed and the door")
            pairs = ((a, b) for a in others[0] for b in others[1] if a.id != b.id)
            return next(((a, b) for a, b in pairs if self._scene.is_between(thing, a, b)), ())
        return tuple(other for other in others[0] if other.id != thing.id and self._stands(thing, relation, other))

    def _stands(self, thing: MapObject, relation: Relation, other: MapObject) -> bool:
        if relation == "left of" or relation == "right of":  # two comparisons narrow the type
            self._note_eye()
            a, b = (thing, other) if relation == "left of" else (other, thing)
            return is_left_of(a.centroid, b.centroid, self._eye)
        if relation == "with":
            held = any(self._scene.holds(name, other, thing) for name in ("on", "in"))
            return held or self._scene.holds("next to", thing, other)
        assert relation != "between", "between has two others"
        return self._scene.holds(relation, thing, other)

    def _note_eye(self) -> None:
        x, y = self._eye[:2]
        where = "the eye given" if self._is_eye_given else "the middle of the map"
        self._notes.append(f"left and right as seen from {where} ({x:.2f}, {y:.2f})")

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
            others = {key: thing for key, thing in others.items() if not is_room_surface(thing.name)}
        if not others:
            raise _Unsettled(f"the map has nothing else to hold against '{question.other.head}'")
        self._note_several(references, question.other)
        ranked = sorted(
            (_nearest_pair((thing,), references) for thing in others.values()),
            key=lambda pair: ((-pair[0] if question.farthest else pair[0]), pair[1].id),
        )
        distance_m, best, reference = ranked[0]
        if len(ranked) == 1:
            self._notes.append(f"there is one '{_shown(question.subject)}' only")
        elif abs(ranked[1][0] - distance_m) < CLOSE_CALL_M:
            self._notes.append(f"a close call: {ranked[1][1].shown} is {ranked[1][0]:.2f} m away, between centres")
        rest = "".join(f"; {thing.shown} {away_m:.2f} m" for away_m, thing, _ in ranked[1:4])
        end = "farthest from" if question.farthest else "closest to"
        text = f"{best.shown} is {end} {reference.shown}: {distance_m:.2f} m between centres{rest}"
        return text, (best,), (reference,), None

    def _option(self, option: Phrase, subject: Phrase) -> Objects:
        """Objects of an option; one that the map does not name so is left to the question's own noun."""
        try:
            return self._some(option)
        except _Unsettled:
            if subject != ANYTHING:
                self._notes.append(f"the map has no '{_shown(option)}'; every '{subject.head}' was compared")
                return self._some(subject)
            raise

    def _closer(self, question: Question) -> _Solved:
        assert question.other is not None
        references = self._some(question.other)
        a_m, a, reference = _nearest_pair(self._some(question.subject), references)
        b_m, b, _ = _nearest_pair(self._some(question.options[0]), references)
        is_so = a_m > b_m if question.farthest else a_m < b_m
        self._note_several(references, question.other)
        text = f"{_yes(is_so)}: {a.shown} is {a_m:.2f} m from {reference.shown}, {b.shown} {b_m:.2f} m, between centres"
        return text, (a, b), (reference,), is_so

    def _distance(self, question: Question) -> _Solved:
        assert question.other is not None
        first, second = self._some(question.subject), self._some(question.other)
        distance_m, a, b = _nearest_pair(first, second)
        if a.id == b.id:
            raise _Unsettled(f"'{_shown(question.subject)}' and '{_shown(question.other)}' are one thing in the map")
        self._note_several(first, question.subject)
        self._note_several(second, question.other)
        return f"{distance_m:.2f} m between the centres of {a.shown} and {b.shown}", (a, b), (), distance_m

    def _count(self, question: Question) -> _Solved:
        things, held = self._found_or_none(question.subject)
        text = f"{len(things)}: {_listed(things)}" if things else f"0: {self._has_no(_shown(question.subject))}"
        return text, things, held, len(things)

    def _exists(self, question: Question) -> _Solved:
        things, held = self._found_or_none(question.subject)
        if not things:
            return f"no: {self._has_no(_shown(question.subject))}", (), (), False
        return f"yes: {_listed(things)}", things, held, True

    def _found_or_none(self, phrase: Phrase) -> tuple[Objects, Objects]:
        """As ``_objects``, but a noun that the map does not have means nothing, which answers the question."""
        if not meant_by(phrase.head, self._scene, self._nearest).objects:
            return (), ()
        return self._objects(phrase)

    def _holds(self, question: Question) -> _Solved:
        assert question.relation is not None
        others = question.options or ((question.other,) if question.other else ())
        things, held = self._objects(Phrase(question.subject.head, question.relation, others))
        shown = _shown(Phrase(question.subject.head, question.relation, others))
        if not things:
            return f"no: no {shown}", self._some(question.subject), (), False
        return f"yes: {_listed(things)} {question.relation} {_listed(held)}", things, held, True

    def _list(self, question: Question) -> _Solved:
        things, held = self._objects(question.subject)
        if question.subject.relation in ("left of", "right of"):
            things = tuple(thing for thing in things if any(self._scene.holds("near", thing, other) for other in held))
            self._notes.append(f"no farther than {NEAR_M:g} m from it")
        if not things:
            return f"nothing: {self._has_no(_shown(question.subject))}", (), (), None
        return _listed(things), things, held, None

    def _size(self, question: Question) -> _Solved:
        assert question.size is not None
        phrases = question.options or (question.subject,)
        candidates = {thing.id: thing for phrase in phrases for thing in self._some(phrase)}
        unit, measure, is_most = _MEASURES[question.size]
        ranked = sorted(candidates.values(), key=lambda thing: ((-1 if is_most else 1) * measure(thing), thing.id))
        best = ranked[0]
        rest = "".join(f"; {thing.shown} {measure(thing):.3g}" for thing in ranked[1:4])
        return f"{best.shown}: {measure(best):.3g} {unit}{rest}", (best,), (), None

    def _where(self, question: Question) -> _Solved:
        things, held = self._objects(question.subject)
        if not things:
            raise _Unsettled(self._has_no(_shown(question.subject)))
        places = [f"{thing.shown} at ({', '.join(f'{value:.2f}' for value in thing.centroid)}) m" for thing in things]
        more = f" and {len(things) - MOST_LISTED} more" if len(things) > MOST_LISTED else ""
        return "; ".join(places[:MOST_LISTED]) + more, things, held, None

    def _note_several(self, objects: Objects, phrase: Phrase) -> None:
        if len(objects) > 1:
            self._notes.append(f"there are {len(objects)} of '{_shown(phrase)}'; the nearest one counts")


def _nearest_pair(first: Objects, second: Objects) -> tuple[float, MapObject, MapObject]:
    """The least distance between centroids, and whose it is; the lower ids on ties, one thing with itself last."""
    pairs = [(a, b) for a in first for b in second if a.id != b.id] or [(first[0], second[0])]
    return min(
        ((float(np.linalg.norm(a.centroid - b.centroid)), a, b) for a, b in pairs),
        key=lambda pair: (pair[0], pair[1].id, pair[2].id),
    )


def _ids(objects: Objects) -> tuple[int, ...]:
    return tuple(thing.id for thing in objects)


def _yes(is_so: bool) -> str:
    return "yes" if is_so else "no"


def _shown(phrase: Phrase) -> str:
    if phrase.relation is None:
        return phrase.head
    return f"{phrase.head} {phrase.relation} {' and '.join(_shown(other) for other in phrase.others)}"


def _listed(objects: Objects) -> str:
    shown = ", ".join(thing.shown for thing in objects[:MOST_LISTED])
    return shown if len(objects) <= MOST_LISTED else f"{shown} and {len(objects) - MOST_LISTED} more"
