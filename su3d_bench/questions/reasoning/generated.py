"""Questions about a map made from templates, with the answers that geometry gives them.

Each question is about names that stand in the map, asked so that the answer is one: what is closest leads by a margin,
references are single objects. Left and right depend on who looks, and are asked only where an eye is given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.perception.embedded.naming import with_article
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.relations import PairRelation, is_between, is_room_surface, relations_of
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap
from su3d_bench.questions.reasoning.solver import Solver

MARGIN_M = 0.25  # by which the closest leads
SIZE_MARGIN = 1.3  # by which the largest leads
FEW_BETWEEN = 4  # more things between two are no answer that one would give
MOST_SINGLE = 30  # of the objects whose name no other has, so many are asked about: there are cubically many triples
ASKED_RELATIONS: tuple[PairRelation, ...] = ("on", "under", "above", "next to", "in")


@dataclass(frozen=True)
class GeneratedQuestion:
    """A question with its true answer; ``kind`` names the template."""

    text: str
    kind: str
    answer: Answer


def generate_questions(
    scene: SceneMap, *, n_each: int = 5, seed: int = 0, eye: Float64Array | None = None
) -> tuple[GeneratedQuestion, ...]:
    """Up to ``n_each`` questions of each kind, drawn with ``seed``; the built-in solver supplies the truth."""
    random = np.random.default_rng(seed)
    solver = Solver(scene, eye)
    questions: list[GeneratedQuestion] = []
    for kind, texts in _texts(scene, random, eye is not None).items():
        distinct = sorted(dict.fromkeys(texts))
        chosen = [distinct[k] for k in sorted(random.permutation(len(distinct))[:n_each])]
        answers = [(text, solver.answer(text)) for text in chosen]
        questions += [GeneratedQuestion(text, kind, answer) for text, answer in answers if answer.is_settled]
    return tuple(questions)


def _texts(scene: SceneMap, random: np.random.Generator, with_sides: bool) -> dict[str, list[str]]:
    things = [thing for thing in scene.objects if thing.name and not is_room_surface(thing.name)]
    n_of = Counter(thing.name for thing in things)
    single = [thing for thing in things if n_of[thing.name] == 1]
    single = [single[k] for k in sorted(random.permutation(len(single))[:MOST_SINGLE])]
    kinds: dict[str, list[str]] = {
        "closer": list(_extreme(things, single, n_of, 1, "closer to")),
        "nearest": list(_nearest(things, single)),
        "farthest": list(_extreme(things, single, n_of, -1, "farthest from")),
        "distance": [f"What is the distance between the {a.name} and the {b.name}?" for a, b in _pairs(single)],
        "count": [f"How many {_plural(name)} are there?" for name in n_of],
        "largest": list(_largest(things, n_of)),
        "compare": list(_compared(single)),
        "between": list(_between(things, single)),
    }
    return kinds | _related(scene, things, single, n_of) | (_sides(single) if with_sides else {})


def _pairs(objects: list[MapObject]) -> Iterator[tuple[MapObject, MapObject]]:
    return ((a, b) for k, a in enumerate(objects) for b in objects[k + 1 :])


def _away_m(a: MapObject, b: MapObject) -> float:
    return float(np.linalg.norm(a.centroid - b.centroid))


def _leads(distances: list[float]) -> bool:
    return len(distances) > 1 and distances[1] - distances[0] >= MARGIN_M


def _extreme(
    things: list[MapObject], single: list[MapObject], n_of: Counter[str], sign: int, words: str
) -> Iterator[str]:
    """Which of several is nearest to (``sign`` 1) or farthest from (-1) a reference."""
    for reference in single:
        for name in (name for name, n in n_of.items() if n > 1):
            if _leads(sorted(sign * _away_m(thing, reference) for thing in things if thing.name == name)):
                yield f"Which {name} is {words} the {reference.name}?"


def _nearest(things: list[MapObject], single: list[MapObject]) -> Iterator[str]:
    for reference in single:
        if _leads(sorted(_away_m(thing, reference) for thing in things if thing is not reference)):
            yield f"Which object is closest to the {reference.name}?"


def _compared(single: list[MapObject]) -> Iterator[str]:
    for reference in single:
        for a, b in _pairs([thing for thing in single if thing is not reference]):
            if abs(_away_m(a, reference) - _away_m(b, reference)) >= MARGIN_M:
                yield f"Which is closer to the {reference.name}, the {a.name} or the {b.name}?"


def _between(things: list[MapObject], single: list[MapObject]) -> Iterator[str]:
    for a, b in _pairs(single):
        n_between = sum(is_between(thing.centroid, a.centroid, b.centroid) for thing in things if thing not in (a, b))
        if 0 < n_between <= FEW_BETWEEN:
            yield f"What is between the {a.name} and the {b.name}?"


def _largest(things: list[MapObject], n_of: Counter[str]) -> Iterator[str]:
    for name in (name for name, n in n_of.items() if n > 1):
        sizes = sorted((float(np.prod(thing.size)) for thing in things if thing.name == name), reverse=True)
        if sizes[0] >= SIZE_MARGIN * sizes[1]:
            yield f"Which {name} is the largest?"


def _related(
    scene: SceneMap, things: list[MapObject], single: list[MapObject], n_of: Counter[str]
) -> dict[str, list[str]]:
    """Questions on relations, as many with the answer no as with the answer yes."""
    boxes = np.array([thing.box for thing in things]).reshape(-1, 2, 3)
    names = [thing.name for thing in things]
    is_single = {thing.id for thing in single}
    held: dict[str, set[tuple[str, str]]] = {relation: set() for relation in ASKED_RELATIONS}
    for link in relations_of(boxes, names):
        if things[link.object].id in is_single:
            held[link.relation].add((names[link.subject], names[link.object]))
    held["in"] -= held["on"]  # a cushion is within the box of a sofa, and on it
    questions: dict[str, list[str]] = {}
    for relation in ASKED_RELATIONS:
        pairs = sorted(held[relation])
        objects = sorted({b for _, b in pairs})
        questions[f"what {relation}"] = [f"What is {relation} the {b}?" for b in objects]
        turned = [(b, a) for a, b in pairs if n_of[a] == 1 and (b, a) not in held[relation]]
        questions[f"is {relation}"] = [f"Is there {with_article(a)} {relation} the {b}?" for a, b in [*pairs, *turned]]
    return questions


def _sides(single: list[MapObject]) -> dict[str, list[str]]:
    near = [(a, b) for a, b in _pairs(single) if _away_m(a, b) < 2.0]
    return {"left of": [f"Is the {a.name} left of the {b.name}?" for a, b in near]}


def _plural(name: str) -> str:
    if name.endswith(("s", "x", "ch", "sh")):
        return name if name.endswith("s") and not name.endswith("ss") else f"{name}es"
    if name.endswith("y") and name[-2:-1] not in "aeiou":
        return f"{name[:-1]}ies"
    return f"{name[:-1]}ves" if name.endswith("lf") else f"{name}s"
