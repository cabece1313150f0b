"""Text chains of single objects in the style of Beacon3D, generated from ground truth.

The most specific text of a chain refers to exactly one object: by a property, by its position, or by its name. The
other text is the name, which refers to every object with it. An object has three chains; one with fewer such texts is
not used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from su3d_bench.core.english import is_countable
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.questions.grounding import CHAINS_EACH, ChainedText, Place
from su3d_bench.questions.appearance import SHAPES, SIZES
from su3d_bench.questions.generator import generate
from su3d_bench.questions.model import KINDS, Question
from su3d_bench.questions.scene_map import MapObject, SceneMap

INSTANCE, _, PROPERTY, RELATIVE = KINDS
FORMS = SHAPES | {word for more, less, _ in SIZES for word in (more, less) if word}


def chain_truth(scene: str, truth: GroundTruth, objects: SceneMap, max_objects: int | None = None) -> QueryTruth:
    """The text chains of at most ``max_objects`` objects of a scene, over its ground-truth instances."""
    owner = truth.instance.astype(np.int64)
    owner[owner <= 0] = -1
    cases = chains_of(generate(scene, objects, both=True), objects, max_objects)
    source = f"chains made from {truth.source}"
    return QueryTruth(truth.points, owner, cases, truth.variant, source, truth.labels.space)


def chains_of(
    questions: Sequence[Question], objects: SceneMap, max_objects: int | None = None
) -> tuple[ChainedText, ...]:
    """All distinct texts of the chains, in the order of the objects.

    If several texts refer to an object, those that come first by a digest are used, alternating between the sorts.
    """
    cases: dict[str, ChainedText] = {}
    for number, (_, chains) in enumerate(islice(_chains(questions, objects), max_objects)):
        for k, chain in enumerate(chains):
            for step, one in enumerate(chain):
                known = cases.get(one.text) or ChainedText(one.text, one.answers or (), tags=_tags(one))
                cases[one.text] = replace(known, places=(*known.places, Place(number, k, step)))
    return tuple(cases.values())


def _chains(questions: Sequence[Question], objects: SceneMap) -> Iterator[tuple[MapObject, list[list[Question]]]]:
    """Each object with three chains, and the chains with the most specific text first."""
    name_of = {question.text: question for question in questions if question.kind == INSTANCE}
    for thing in objects.objects:
        coarse = name_of.get(thing.name) if is_countable(thing.name) else None
        fine = [] if coarse is None else _meaning(thing.id, questions)
        if coarse is not None and len(fine) >= CHAINS_EACH:
            yield thing, [[one, coarse] for one in fine[:CHAINS_EACH]]


def _meaning(object_id: int, questions: Sequence[Question]) -> list[Question]:
    """Properties and relations of only this object, alternating between the sorts, each sort ordered by a digest."""
    alone = {
        one.text: one for one in questions if one.answers == (object_id,) and one.kind.startswith((PROPERTY, RELATIVE))
    }
    turn = dict[frozenset[str], int]()
    ranked = []
    for one in sorted(alone.values(), key=lambda one: _digest(one.text)):
        tags = _tags(one)
        turn[tags] = turn.get(tags, 0) + 1
        ranked.append((turn[tags], one))
    return [one for _, one in sorted(ranked, key=lambda pair: pair[0])]


def _tags(question: Question) -> frozenset[str]:
    """The tags of what a text refers to its objects by, as in Beacon3D.

    >>> from su3d_bench.questions.model import new_question
    >>> sorted(_tags(new_question("a/b", "property", "red chair", (1,), "")))
    ['appearance', 'class']
    """
    if question.kind == INSTANCE:
        return frozenset(("class",))
    if question.kind.startswith(RELATIVE):
        return frozenset(("class", "spatial"))
    is_form = question.text.partition(" ")[0] in FORMS
    return frozenset(("class", "geometry" if is_form else "appearance"))


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()
