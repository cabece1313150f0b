"""The built-in solver: questions that boxes and centroids settle, answered without any model.

Distances are Euclidean between centroids, as in the paper's prompting strategy; "next to" and "near" go by the gap
between boxes. Where a noun means several objects, the nearest pair counts, and it is said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.relations import NEAR_M, is_left_of
from su3d_bench.questions.reasoning.answers import Answer, unsettled
from su3d_bench.questions.reasoning.named_objects import Meant, NearestName, meant_by, meant_instead
from su3d_bench.questions.reasoning.question_words import ANYTHING, Phrase, Question, Relation, Size, read_question
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap, is_room_surface

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
