"""Sample generated questions together with the objects needed to judge them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from su3d_bench.core.english import plural, with_article
from su3d_bench.core.errors import ConfigError, printable, suggest
from su3d_bench.numerics.relations import RELATIONS
from su3d_bench.questions.generated import GeneratedQuestion, generate_questions
from su3d_bench.questions.ground_truths import MIN_VERTICES, fullest_truth, questions_of, scene_objects
from su3d_bench.questions.model import GENERATED_KINDS, REASONING, Answer, Question
from su3d_bench.questions.scene_map import MapObject, SceneMap

RETRIEVAL = "retrieval"  # selects all kinds of queries, as ``REASONING`` selects all templates
MIN_PER_TEMPLATE = 20  # minimum pool of questions per template and scene: enough for every kind to get its share
Things = tuple[MapObject, ...]


@dataclass(frozen=True, eq=False)
class AuditedQuestion:
    """A question with its answer in words, its answer objects, reference objects and other objects of the same name.

    ``kind`` is one of ``GENERATED_KINDS``, or a template of the reasoning questions. No object is in two of the three;
    ``room`` has all objects of the scene.
    """

    scene: str
    kind: str
    text: str
    answer: str
    right: Things
    references: Things
    others: Things
    room: SceneMap


def audited_questions(
    dataset: Any, scene: str, *, n_each: int = MIN_PER_TEMPLATE, seed: int = 0
) -> Iterator[AuditedQuestion]:
    """All queries of a scene and at most ``n_each`` questions of each reasoning template."""
    address = f"{dataset.name}/{scene}"
    objects = scene_objects(dataset, scene, fullest_truth(dataset, scene), MIN_VERTICES)
    for query in questions_of(dataset, scene):
        if query.answers is not None:
            right = _of_ids(objects, query.answers)
            references = _without(_related(query, right, objects), right)
            others = _without(_called_as(right, objects), (*right, *references))
            words = _listed(query.answers, objects)
            yield AuditedQuestion(address, query.kind, query.text, words, right, references, others, objects)
    for question in generate_questions(objects, n_each=n_each, seed=seed):
        mentioned = _mentioned(question.text, objects)
        right = _of_ids(objects, question.answer.object_ids)
        references = reference_objects(question, objects)
        called = (*_called_as(right, objects), *(thing for things in mentioned for thing in things))
        others = _without(called, (*right, *references))
        words = _in_words(question.answer, objects)
        yield AuditedQuestion(address, question.kind, question.text, words, right, references, others, objects)


def reference_objects(question: GeneratedQuestion, objects: SceneMap) -> Things:
    """The reference objects of an answer; for negative answers, the object at the end of the text."""
    references = _of_ids(objects, question.answer.reference_ids)
    if not references and question.answer.value is False and (mentioned := _mentioned(question.text, objects)):
        references = mentioned[-1]
    return _without(references, _of_ids(objects, question.answer.object_ids))


def of_kinds(questions: Sequence[AuditedQuestion], kinds: Sequence[str]) -> list[AuditedQuestion]:
    """The questions of some kinds (all by default); ``retrieval`` and ``reasoning`` select all of their kinds.

    Raises ``ConfigError`` for a kind without questions.
    """
    known = list(dict.fromkeys(question.kind for question in questions))
    wanted: set[str] = set()
    for kind in kinds:
        is_query = {RETRIEVAL: True, REASONING: False}.get(kind)
        named = {one for one in known if one == kind or (one in GENERATED_KINDS) is is_query}
        if not named:
            hint = suggest(kind, (*known, RETRIEVAL, REASONING), "there are:")
            raise ConfigError(f"query audit: no questions of kind '{printable(kind, 40)}'{hint}")
        wanted |= named
    return [question for question in questions if not kinds or question.kind in wanted]


def sample(questions: Sequence[AuditedQuestion], n: int, seed: int) -> list[AuditedQuestion]:
    """At most ``n`` questions by scene: kinds take turns, each draws from its least sampled scene."""
    random = np.random.default_rng(seed)
    waiting: dict[str, dict[str, list[AuditedQuestion]]] = {}
    for k in random.permutation(len(questions)).tolist():
        one = questions[k]
        waiting.setdefault(one.kind, {}).setdefault(one.scene, []).append(one)
    drawn: list[AuditedQuestion] = []
    while waiting and len(drawn) < n:
        for kind in sorted(waiting)[: n - len(drawn)]:
            scenes = waiting[kind]
            scene = min(scenes, key=lambda scene: (_n_drawn(drawn, scene, kind), _n_drawn(drawn, scene), scene))
            drawn.append(scenes[scene].pop())
            if not scenes[scene]:
                del scenes[scene]
        waiting = {kind: scenes for kind, scenes in waiting.items() if scenes}
    return sorted(drawn, key=lambda one: one.scene)


def n_of_each(n: int, n_scenes: int) -> int:
    """The pool size per template and scene for drawing ``n`` questions, which may all come from one template."""
    return max(MIN_PER_TEMPLATE, math.ceil(n / max(1, n_scenes)))


def _n_drawn(drawn: Iterable[AuditedQuestion], scene: str, kind: str | None = None) -> int:
    return sum(one.scene == scene and kind in (None, one.kind) for one in drawn)


def _of_ids(objects: SceneMap, ids: Iterable[int]) -> Things:
    known = set(objects.ids)
    return tuple(objects.by_id(one) for one in dict.fromkeys(ids) if one in known)


def _without(things: Iterable[MapObject], taken: Sequence[MapObject]) -> Things:
    ids = {thing.id for thing in taken}
    return tuple({thing.id: thing for thing in things if thing.id not in ids}.values())


def _called_as(things: Sequence[MapObject], objects: SceneMap) -> Things:
    names = {thing.name for thing in things}
    return tuple(thing for thing in objects.objects if thing.name in names)


def _related(query: Question, right: Things, objects: SceneMap) -> Things:
    """The reference objects of a relation query: those related to an answer, otherwise all with the name."""
    first, _, second = query.text.partition(" between the ")[2].partition(" and the ")
    if first and second:
        return tuple(thing for thing in objects.objects if thing.name in (first, second))
    for relation in RELATIONS:
        _, found, other = query.text.partition(f" {relation} ")
        named = [thing for thing in objects.objects if found and other in (thing.name, with_article(thing.name))]
        if named:
            references = [one for one in named if any(objects.holds(relation, thing, one) for thing in right)]
            return tuple(references or named)
    return ()


def _mentioned(text: str, objects: SceneMap) -> list[Things]:
    """The objects of each name in a text, in the order of the names; "coffee table" does not match "table"."""
    at: dict[int, Things] = {}
    left = text.lower()
    for name in sorted({thing.name for thing in objects.objects if thing.name}, key=lambda name: (-len(name), name)):
        forms = "|".join(re.escape(form.lower()) for form in (name, plural(name)))
        for match in re.finditer(rf"\b(?:{forms})\b", left):
            at[match.start()] = tuple(thing for thing in objects.objects if thing.name == name)
            left = left[: match.start()] + " " * len(match[0]) + left[match.end() :]
    return [at[place] for place in sorted(at)]


def _listed(ids: Iterable[int], objects: SceneMap) -> str:
    """Names and ids of objects; objects excluded from questions have no name."""
    shown = {thing.id: thing.shown for thing in objects.objects}
    return ", ".join(shown.get(one, f"object #{one}") for one in ids) or "nothing"


def _in_words(answer: Answer, objects: SceneMap) -> str:
    listed = _listed(answer.object_ids, objects)
    if answer.value is None:
        return listed
    if isinstance(answer.value, bool):
        value = "yes" if answer.value else "no"
    else:
        value = f"{answer.value:.2f} m" if isinstance(answer.value, float) else str(answer.value)
    return f"{value}: {listed}" if answer.object_ids else value
