"""Chains of texts that lead to an object, as Beacon3D has them, made from the truth of a scene.

The finest text of a chain means one object alone: by a property, by where it is, or by its name. Before it comes the
name, which means every thing so called. An object has three chains; one with fewer such texts is not asked for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth
from su3d_bench.metrics.questions.chains import CHAINS_EACH, ChainedText, Place
from su3d_bench.questions.generator import generate
from su3d_bench.questions.looks import SHAPES, SIZES
from su3d_bench.questions.model import KINDS, Question
from su3d_bench.questions.reasoning.scene_map import SceneMap

INSTANCE, _, PROPERTY, RELATIVE = KINDS
FORMS = SHAPES | {word for more, less, _ in SIZES for word in (more, less) if word}


def chain_truth(scene: str, truth: GroundTruth, objects: SceneMap, most_objects: int | None = None) -> QueryTruth:
    """The texts of a scene in chains of objects, ``most_objects`` at most, over the instances of its truth."""
    owner = truth.instance.astype(np.int64)
    owner[owner <= 0] = -1
    cases = chains_of(generate(scene, objects), objects, most_objects)
    source = f"chains made from {truth.source}"
    return QueryTruth(truth.points, owner, cases, truth.variant, source, truth.labels.space)


def chains_of(
    questions: Sequence[Question], objects: SceneMap, most_objects: int | None = None
) -> tuple[ChainedText, ...]:
    """Every text of the chains, once, in the order of the objects.

    Of several texts that mean an object those count that come first by a digest, one of each sort in turn.
    """
    name_of = {question.text: question for question in questions if question.kind == INSTANCE}
    cases: dict[str, ChainedText] = {}
    n_objects = 0
    for thing in objects.objects:
        coarse = name_of.get(thing.name)
        fine = [] if coarse is None else _meaning(thing.id, questions)
        if coarse is None or len(fine) < CHAINS_EACH or n_objects == most_objects:
            continue
        for number, question in enumerate(fine[:CHAINS_EACH]):
            for step, one in enumerate((question, coarse)):
                known = cases.get(one.text) or ChainedText(one.text, one.answers or (), tags=_tags(one))
                places = (*known.places, Place(n_objects, number, step))
                cases[one.text] = replace(known, places=places)
        n_objects += 1
    return tuple(cases.values())


def _meaning(object_id: int, questions: Sequence[Question]) -> list[Question]:
    """Properties and relations that one object alone has, one sort after the other, each sort by a digest."""
    alone = {
        one.text: one for one in questions if one.answers == (object_id,) and one.kind.startswith((PROPERTY, RELATIVE))
    }
    turn = dict[frozenset[str], int]()
    ranked = []
    for one in sorted(alone.values(), key=lambda one: hashlib.sha256(one.text.encode()).digest()):
        tags = _tags(one)
        turn[tags] = turn.get(tags, 0) + 1
        ranked.append((turn[tags], one))
    return [one for _, one in sorted(ranked, key=lambda pair: pair[0])]


def _tags(question: Question) -> frozenset[str]:
    """By what a text tells its objects, in Beacon3D's words.

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
