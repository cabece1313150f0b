"""Questions with known answers, made from any ground truth that has classes: names, uses, sizes, colours, relations.

All objects that answer are carried; what more than a third of a scene's objects answer is dropped, as the built-in
rooms have it. What is true but not known here (a class without an entry in the table of uses) is not counted right.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from su3d_bench.perception.embedded.lexicon import AFFORDANCES, SYNONYMS
from su3d_bench.perception.embedded.naming import with_article
from su3d_bench.questions.known_objects import plain_name
from su3d_bench.questions.model import KINDS, Question, new_question
from su3d_bench.questions.reasoning.named_objects import meant_by
from su3d_bench.questions.reasoning.relations import (
    PairRelation,
    RelationFound,
    holds,
    is_between,
    is_container,
    is_next_to,
    relations_of,
)
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap

SOURCE = "generated"
MAX_ANSWER_SHARE = 1 / 3  # as the built-in rooms have it
MOST_SYNONYMS = 2  # of a class, so that common classes do not fill the set
LARGE = 1.5  # ours: volume of the box, as a multiple of the median of its name, from which a thing is called large
BETWEEN_M = 2.0  # ours: nobody looks farther for what something is between
FLAT_M = 0.1  # ours: a rug is under the table that stands on it, a cabinet is not under its vase
_RESTING: tuple[PairRelation, ...] = ("on", "in")


def generate(scene: str, objects: SceneMap, per_kind: int | None = None) -> tuple[Question, ...]:
    """The questions of all four kinds, ``per_kind`` of each at most, drawn by a digest of the text: always the same."""
    right: dict[tuple[str, str], set[int]] = {}
    for kind, text, answers in _texts(objects):
        right.setdefault((kind, text), set()).update(answers)
    limit = max(1, int(len(objects) * MAX_ANSWER_SHARE))
    kept = [
        new_question(scene, kind, text, tuple(ids), SOURCE) for (kind, text), ids in right.items() if len(ids) <= limit
    ]
    return chosen(kept, per_kind)


def chosen(questions: Sequence[Question], per_kind: int | None) -> tuple[Question, ...]:
    """At most ``per_kind`` questions of each kind by a digest of their text, sorted by kind and text."""
    drawn: list[Question] = []
    for kind in KINDS:
        of_kind = [question for question in questions if question.kind == kind]
        of_kind.sort(key=lambda question: hashlib.sha256(question.text.encode()).digest())
        drawn += sorted(of_kind[:per_kind], key=lambda question: question.text)
    return tuple(drawn)


def _texts(objects: SceneMap) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Kind, text and answers; the same text may come several times with some of its answers each."""
    names = sorted({thing.name for thing in objects.objects})
    for name in names:
        yield "instance", name, _ids(objects, name)
    for name, others in SYNONYMS.items():
        if plain_name(name) in names:
            for other in others[:MOST_SYNONYMS]:
                yield "instance", other, _ids(objects, other)
    for phrase, classes in AFFORDANCES.items():
        answers = tuple(object_id for name in classes for object_id in _ids(objects, name))
        if answers:
            yield "affordance", phrase, answers
    yield from _sizes(objects)
    yield from _attributes(objects)
    yield from _relations(objects)
    yield from _between(objects)


def _ids(objects: SceneMap, name: str) -> tuple[int, ...]:
    return tuple(thing.id for thing in meant_by(name, objects).objects)


def _sizes(objects: SceneMap) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Large and small things among those of one name, by the volume of the box."""
    for name, n in Counter(thing.name for thing in objects.objects).items():
        if n < 2:
            continue
        named = [thing for thing in objects.objects if thing.name == name]
        volume = np.array([float(np.prod(thing.size)) for thing in named])
        middle = float(np.median(volume))
        for word, is_so in (("large", volume >= LARGE * middle), ("small", volume * LARGE <= middle)):
            if is_so.any():
                yield "property", f"{word} {name}", tuple(named[k].id for k in np.flatnonzero(is_so))


def _attributes(objects: SceneMap) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """The words that are known of an object before its name: "red chair"."""
    for thing in objects.objects:
        for word in thing.caption.split():
            yield "property", f"{word} {thing.name}", (thing.id,)


def _relations(objects: SceneMap) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    things = objects.objects
    boxes = np.array([thing.box for thing in things]).reshape(-1, 2, 3)
    links = list(relations_of(boxes, [thing.name for thing in things]))
    held = {(link.subject, link.relation, link.object) for link in links}
    resting = {link.subject for link in links if link.relation in ("on", "in")}
    for link in links:
        subject, holder = things[link.subject], things[link.object]
        if subject.name != holder.name and _is_said(link, held, resting, things):
            yield "relative", f"{subject.name} {link.relation} {with_article(holder.name)}", (subject.id,)


def _is_said(
    link: RelationFound, held: set[tuple[int, PairRelation, int]], resting: set[int], things: Sequence[MapObject]
) -> bool:
    """Whether people would say so: a cushion is on a sofa, not in it; a book stands on its board, not above another."""
    a, b = link.subject, link.object
    if link.relation == "in":
        return (a, "on", b) not in held
    if link.relation == "above":
        return a not in resting
    if link.relation == "under":
        bears = (b, "on", a) in held
        is_flat = float(things[a].size[2]) < FLAT_M
        return not any((a, relation, b) in held for relation in _RESTING) and (is_flat if bears else b not in resting)
    return True


def _between(objects: SceneMap) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """What stands between two things of which the scene has one each, on one level with both."""
    n_of = Counter(thing.name for thing in objects.objects)
    single = [thing for thing in objects.objects if n_of[thing.name] == 1]
    for k, first in enumerate(single):
        for second in single[k + 1 :]:
            if float(np.linalg.norm(first.centroid - second.centroid)) > BETWEEN_M or _touch(first, second):
                continue
            for thing in objects.objects:
                if thing is not first and thing is not second and _stands_between(thing, first, second):
                    yield "relative", f"{thing.name} between the {first.name} and the {second.name}", (thing.id,)


def _stands_between(thing: MapObject, first: MapObject, second: MapObject) -> bool:
    if any(min(thing.box[1][2], other.box[1][2]) <= max(thing.box[0][2], other.box[0][2]) for other in (first, second)):
        return False
    return is_between(thing.centroid, first.centroid, second.centroid)


def _touch(a: MapObject, b: MapObject) -> bool:
    """Whether nothing can be between the two: they stand side by side, or one holds the other."""
    return is_next_to(a.box, b.box) or any(
        holds("on", x.box, y.box, b_is_container=is_container(y.name)) for x, y in ((a, b), (b, a))
    )
