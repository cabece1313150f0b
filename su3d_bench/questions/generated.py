"""Questions about a scene generated from templates, with answers computed from geometry.

Each question is about object names of the scene and has one undisputed answer: the closest object leads by a margin,
references are single objects, pairs near a threshold are excluded, yes and no are equally frequent, and objects that no
frame shows clearly are neither asked about nor answers. Left and right depend on the viewpoint and are not asked.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import combinations, zip_longest
from pathlib import Path

import numpy as np

from su3d_bench.core.english import is_countable, is_plural, plural, with_article, words
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.questions.presence import SAMPLINGS
from su3d_bench.metrics.questions.score import PresenceQuery
from su3d_bench.numerics.relations import FLAT_M, Relation, gap_m
from su3d_bench.perception.embedded.lexicon import vocabulary
from su3d_bench.questions.appearance import is_flat
from su3d_bench.questions.generator import extreme_of, may_be_confused
from su3d_bench.questions.model import Answer, word_table
from su3d_bench.questions.scene_map import MapObject, SceneMap, is_called, is_room_surface, noun_objects, plain_name
from su3d_bench.questions.solver import Solver

MARGIN_M, MARGIN_SHARE = 0.25, 0.25  # lead of the closest: metres, and fraction of its distance and the longest side
LEVEL_M = 0.75  # objects whose centres differ more in height are not compared by distance
FAR_M = 1.5  # minimum distance of objects in questions with the answer no
MAX_BETWEEN = 2  # questions with more objects between two are not asked
BETWEEN_M = 2.5  # objects farther apart are not asked about with "between"
MAX_SINGLE = 30  # maximum number of objects with a unique name that are used: the number of triples is cubic
DISTANCE_M, DISTANCE_SHARE = 0.25, 0.1  # a guess within this is correct
PILED = frozenset({("book",), ("magazine",), ("newspaper",), ("shoe",), ("dish",), ("towel",), ("blind",)})  # as sets
ASKED_RELATIONS: tuple[Relation, ...] = ("on", "under", "above", "next to", "in")
Random = np.random.Generator


@dataclass(frozen=True)
class GeneratedQuestion:
    """A question with its ground-truth answer; ``kind`` names the template.

    ``by_chance``: how often a random guess among the possible answers is correct; ``by_name``: how often a guess is
    correct that only uses the object names.
    """

    text: str
    kind: str
    answer: Answer
    by_chance: float = math.nan
    by_name: float = math.nan


@dataclass(frozen=True)
class _Draft:
    """A text with its accuracies ``by_chance`` and ``by_name``; each ``part`` is drawn equally often."""

    text: str
    by_chance: float
    by_name: float
    part: str = ""


def generate_questions(scene: SceneMap, *, n_each: int = 5, seed: int = 0) -> tuple[GeneratedQuestion, ...]:
    """Up to ``n_each`` questions of each kind, drawn with ``seed``; the built-in solver computes the answers."""
    random = np.random.default_rng(seed)
    solver = Solver(scene)
    questions: list[GeneratedQuestion] = []
    for kind, drafts in _Drafts(scene, random).of_kinds().items():
        for draft in _drawn(drafts, n_each, random):
            answer = solver.answer(draft.text)
            mentioned = [one for one in scene.objects if one.id in answer.object_ids or one.shown in answer.text]
            is_seen = all(thing.is_query_target for thing in mentioned)
            if answer.is_decided and is_seen:
                questions.append(GeneratedQuestion(draft.text, kind, answer, draft.by_chance, draft.by_name))
    return tuple(questions)


def _drawn(drafts: Sequence[_Draft], n: int, random: Random) -> list[_Draft]:
    """At most ``n``, ordered by text: equally many of two parts, or of several parts in turn.

    A single draft may be of any part.
    """
    parts: dict[str, list[_Draft]] = {}
    for draft in sorted({draft.text: draft for draft in drafts}.values(), key=lambda draft: draft.text):
        parts.setdefault(draft.part, []).append(draft)
    waiting = [[part[k] for k in random.permutation(len(part))] for _, part in sorted(parts.items())]
    waiting = [waiting[k] for k in random.permutation(len(waiting))]
    turns = zip(*waiting, strict=False) if len(waiting) == 2 else zip_longest(*waiting)
    drawn = [draft for turn in turns for draft in turn if draft is not None]
    return sorted(drawn[: n - n % 2 if len(waiting) == 2 and n > 1 else n], key=lambda draft: draft.text)


class _Drafts:
    """The texts of each kind for one scene."""

    def __init__(self, scene: SceneMap, random: Random) -> None:
        self._scene = scene
        self._random = random
        self._all = [thing for thing in scene.objects if thing.name and not is_room_surface(thing.name)]
        hidden = {thing.name for thing in self._all if not thing.is_query_target}
        self._things = [thing for thing in self._all if thing.name not in hidden]
        self._n_of = Counter(thing.name for thing in self._things)
        single = [one for one in self._things if self._n_of[one.name] == 1]
        single = [one for one in single if is_countable(one.name) and not is_plural(one.name) and not one.is_cut]
        self._single = [single[k] for k in sorted(random.permutation(len(single))[:MAX_SINGLE])]

    def of_kinds(self) -> Mapping[str, list[_Draft]]:
        kinds: dict[str, Callable[[], Iterator[_Draft]]] = {
            "closer": partial(self._extreme, 1),
            "nearest": self._nearest,
            "farthest": partial(self._extreme, -1),
            "distance": self._distances,
            "count": self._counts,
            "largest": self._largest,
            "compare": self._compared,
            "between": self._between,
        }
        for relation in ASKED_RELATIONS:
            kinds[f"what {relation}"] = partial(self._what, relation)
            kinds[f"is {relation}"] = partial(self._is, relation)
        return {kind: list(drafts()) for kind, drafts in kinds.items()}

    def _extreme(self, sign: int) -> Iterator[_Draft]:
        """Which of several objects is nearest to (``sign`` 1) or farthest from (-1) a reference."""
        of_two, of_more = ("closer to", "closest to") if sign > 0 else ("farther from", "farthest from")
        for reference in self._single:
            for name, n in self._n_of.items():
                several = [thing for thing in self._things if thing.name == name]
                is_apart = not any(self._scene.is_of(thing, reference) for thing in several)
                if n > 1 and is_countable(name) and is_apart and _leads(several, reference, sign):
                    verb = "are" if is_plural(name) else "is"
                    words = of_two if n == 2 else of_more
                    yield _Draft(f"Which {name} {verb} {words} the {reference.name}?", 1 / n, 1 / n)

    def _nearest(self) -> Iterator[_Draft]:
        for reference in self._single:
            others = [thing for thing in self._all if thing is not reference]
            ranked = sorted(others, key=partial(_away_m, reference))
            is_clear = len(ranked) > 1 and not self._scene.is_of(ranked[0], reference)
            if is_clear and _leads(ranked[:2], reference, 1) and _leads_by_gap(ranked, reference, 1):
                share = 1 / len(others)
                yield _Draft(f"Which object is closest to the {reference.name}?", share, share)

    def _distances(self) -> Iterator[_Draft]:
        pairs = [(a, b, _away_m(a, b)) for a, b in combinations(self._single, 2)]
        every = np.array([away_m for *_, away_m in pairs])
        for a, b, away_m in pairs:
            share = float((np.abs(every - away_m) <= max(DISTANCE_M, DISTANCE_SHARE * away_m)).mean())
            yield _Draft(f"What is the distance between the centres of the {a.name} and the {b.name}?", share, share)

    def _counts(self) -> Iterator[_Draft]:
        """Counts for every name, and for some absent names, unless other objects might be called so."""
        absent = [name for name in map(plain_name, vocabulary()) if _is_name(name)]
        names = [name for name in (*self._n_of, *absent) if _is_counted(name) and self._is_distinct(name)]
        n_of = {name: len(noun_objects(name, self._scene).objects) for name in names}
        counted = {name: n for name, n in n_of.items() if name in self._n_of}
        absent = [name for name, n in n_of.items() if not n]
        counted |= {absent[k]: 0 for k in self._random.permutation(len(absent))[: max(1, len(counted) // 4)]}
        of_value = Counter(counted.values())
        for name, n in counted.items():
            yield _Draft(f"How many {plural(name)} are there?", of_value[n] / len(counted), 1.0, str(n))

    def _is_distinct(self, name: str) -> bool:
        """Whether no object might be called so except those that the solver finds by the name."""
        meant = noun_objects(name, self._scene).objects
        return not any(may_be_confused(name, thing.name) for thing in self._all if thing not in meant)

    def _largest(self) -> Iterator[_Draft]:
        for name, n in self._n_of.items():
            named = [thing for thing in self._things if thing.name == name]
            if n < 3 or any(is_flat(thing.size) for thing in named) or not all(thing.is_whole for thing in named):
                continue
            if extreme_of(named, 1) is not None:
                yield _Draft(f"Which {name} is the largest?", 1 / n, 1 / n)

    def _compared(self) -> Iterator[_Draft]:
        for reference in self._single:
            for a, b in combinations([thing for thing in self._single if not self._scene.is_of(thing, reference)], 2):
                if _leads([a, b], reference, 1):
                    text = f"Which is closer to the {reference.name}, the {a.name} or the {b.name}?"
                    yield _Draft(text, 0.5, 0.5, "first" if _away_m(a, reference) < _away_m(b, reference) else "second")

    def _between(self) -> Iterator[_Draft]:
        for a, b in combinations(self._single, 2):
            if _away_m(a, b) > BETWEEN_M or gap_m(a.box, b.box) == 0 or not self._scene.are_in_one_place(a, b):
                continue
            between = [thing for thing in self._all if self._scene.is_between(thing, a, b)]
            is_plain = all(self._scene.are_in_one_place(thing, a, b) and not thing.is_cut for thing in between)
            is_plain &= not any(self._scene.may_be_between(thing, a, b) for thing in self._all if thing not in between)
            if 0 < len(between) <= MAX_BETWEEN and is_plain:
                share = 1 / math.comb(len(self._all), len(between))
                yield _Draft(f"What is between the {a.name} and the {b.name}?", share, share)

    def _what(self, relation: Relation) -> Iterator[_Draft]:
        for reference in self._single:
            pairs = [(thing, reference) for thing in self._all if thing is not reference]
            if not self._are_facts(relation, pairs):
                continue
            related = [pair for pair in pairs if self._holds(relation, *pair)]
            if related and not any(self._scene.is_doubtful(relation, *pair) for pair in pairs):
                share = 1 / math.comb(len(pairs), len(related))
                yield _Draft(f"What is {relation} the {reference.name}?", share, share)

    def _is(self, relation: Relation) -> Iterator[_Draft]:
        """Whether an object of a name is in a relation; negative examples are far away."""
        # a table is on a rug, but on nothing else
        holders = [thing for thing in self._single if thing.size[2] > FLAT_M]
        subjects = {a.name for a in self._things if any(self._holds(relation, a, b) for b in holders if a is not b)}
        for reference in self._single:
            pairs_of = {
                name: [(a, reference) for a in self._things if a.name == name]
                for name in self._n_of
                if name != reference.name and (relation != "next to" or self._scene.is_located_by(name, reference.name))
            }
            is_locked = {name: any(self._holds(relation, *pair) for pair in pairs) for name, pairs in pairs_of.items()}
            for name, pairs in pairs_of.items():
                alike = [thing for thing in self._all if may_be_confused(name, thing.name)]
                is_far = all(gap_m(thing.box, reference.box) > FAR_M for thing in alike)
                is_sure = not any(self._scene.is_doubtful(relation, *pair) for pair in pairs)
                is_sure &= self._are_facts(relation, pairs)
                if is_sure and (is_locked[name] or (is_far and name in subjects and any(is_locked.values()))):
                    verb, noun = ("Are", name) if is_plural(name) else ("Is", with_article(name))
                    text = f"{verb} there {noun} {relation} the {reference.name}?"
                    yield _Draft(text, 0.5, 0.5, "yes" if is_locked[name] else "no")

    def _are_facts(self, relation: Relation, pairs: Iterable[tuple[MapObject, MapObject]]) -> bool:
        """Whether every pair in the relation is natural and repeats no other relation."""
        return all(self._scene.is_fact(relation, *pair) for pair in pairs if self._scene.holds(relation, *pair))

    def _holds(self, relation: Relation, a: MapObject, b: MapObject) -> bool:
        """Whether the relation holds in common usage: a cushion within the box of a sofa is on it, not in it."""
        is_also_on = relation == "in" and self._scene.holds("on", a, b)
        return self._scene.is_fact(relation, a, b) and not is_also_on


def _is_counted(name: str) -> bool:
    return is_countable(name) and words(name) not in PILED


def _away_m(a: MapObject, b: MapObject) -> float:
    return float(np.linalg.norm(a.centroid - b.centroid))


def _leads(things: Sequence[MapObject], reference: MapObject, sign: int) -> bool:
    """Whether the nearest object (farthest, ``sign`` -1) leads clearly, between centres and between sides."""
    heights = [thing.centroid[2] for thing in (*things, reference)]
    if len(things) < 2 or any(thing.is_cut for thing in things) or max(heights) - min(heights) > LEVEL_M:
        return False
    ranked = sorted(things, key=lambda thing: sign * _away_m(thing, reference))
    sides = [float(thing.size.max()) for thing in (*ranked[:2], reference)]
    first_m, second_m = sorted(_away_m(thing, reference) for thing in ranked[:2])
    margin_m = max(MARGIN_M, MARGIN_SHARE * max(first_m, *sides))
    return second_m - first_m >= margin_m and _leads_by_gap(ranked, reference, sign)


def _leads_by_gap(ranked: Sequence[MapObject], reference: MapObject, sign: int) -> bool:
    """Whether the first object also leads in the distance from side to side, which others may have in mind."""
    first, *others = [sign * gap_m(thing.box, reference.box) for thing in ranked]
    return min(others) - first >= MARGIN_M


RANDOM, POPULAR, ADVERSARIAL = SAMPLINGS
# Labels of unsorted points, which are not objects to ask for.
_NO_NAMES = frozenset((
    "object", "objects", "other", "undefined", "background", "unannotated", "void",
    "unknown", "unknown/remove", "partial",  # HM3DSem's
))  # fmt: skip
Rooms = Sequence[Sequence[str]]


def presence_questions(
    scene: str, truth: GroundTruth, objects: SceneMap, n_things: int, rooms: Rooms
) -> tuple[PresenceQuery, ...]:
    """At most ``n_things`` object names of a scene, each with an absent one, under every sampling.

    Present names are of objects that a frame shows clearly; absent names match no object of the scene, seen or not.
    ``rooms`` lists the object names in each of several rooms.
    """
    seen = {thing.name for thing in objects.objects if thing.is_query_target}
    there = _by_digest(scene, (name for name in seen if _is_name(name)))[:n_things]
    absent = absent_names(truth, objects)
    answer = []
    for sampling in SAMPLINGS:
        for name, other in drawn(scene, sampling, there, absent, rooms):
            answer.append(PresenceQuery(name, sampling, is_there=True))
            if other is not None:
                answer.append(PresenceQuery(other, sampling, is_there=False))
    return tuple(answer)


def absent_names(truth: GroundTruth, objects: SceneMap) -> tuple[str, ...]:
    """The classes of the label set that nobody would name an object of the scene by, however small."""
    ids = np.unique(truth.semantic)
    there = {plain_name(truth.labels.name_of(int(class_id))) for class_id in ids[ids > 0]}
    there |= {thing.name for thing in objects.objects}
    names = dict.fromkeys(plain_name(name) for name in truth.labels.names)
    return tuple(name for name in names if _is_name(name) and not any(may_be_confused(name, known) for known in there))


def _is_name(name: str) -> bool:
    is_known = name not in ("", *_NO_NAMES, *word_table("unclear")["names"])
    return is_known and not name.startswith("other ") and not is_room_surface(name)


@lru_cache(maxsize=65_536)
def _may_be(one: str, other: str) -> bool:
    return is_called(one, other) or is_called(other, one)


def drawn(
    scene: str, sampling: str, there: Sequence[str], absent: Sequence[str], rooms: Rooms
) -> Iterator[tuple[str, str | None]]:
    """Each name in ``there`` with the next ``absent`` one, each used once; None if none is left.

    Random: by a digest of scene and name. Popular: by decreasing number of rooms that contain it. Adversarial: by
    decreasing number of rooms that contain both. Ties keep the order of first appearance, as in POPE; if none of these
    is left, random.

    >>> rooms = [["bed", "lamp", "pillow"], ["bed", "pillow"], ["sink", "lamp"], ["lamp"]]
    >>> [list(drawn("a/b", way, ["bed"], ["pillow", "lamp", "sink"], rooms)) for way in ("popular", "adversarial")]
    [[('bed', 'lamp')], [('bed', 'pillow')]]
    """
    left = dict.fromkeys(_by_digest(scene, absent))
    listed = tuple(dict.fromkeys(name for room in rooms for name in room))
    listed_as = {} if sampling == RANDOM else {name: _listed(name, listed) for name in (*there, *absent)}
    often = _often(rooms) if sampling == POPULAR else []
    for name in there:
        order = _often_with(listed_as[name], rooms) if sampling == ADVERSARIAL else often
        ranked = (known for one in order for known in absent if known in left and listed_as[known] == one)
        chosen = next(ranked, None) or next(iter(left), None)
        if chosen is not None:
            del left[chosen]
        yield name, chosen


def _by_digest(scene: str, names: Iterable[str]) -> list[str]:
    return sorted(names, key=lambda name: hashlib.sha256(f"{scene}\0{name}".encode()).digest())


def _listed(name: str, listed: Sequence[str]) -> str | None:
    """The name used for an object in the room lists: its own name, otherwise the first with the same meaning."""
    return name if name in listed else next((one for one in listed if _may_be(name, one)), None)


def _often(rooms: Rooms) -> list[str]:
    """Object names by decreasing number of rooms that contain them."""
    return [name for name, _ in Counter(name for room in rooms for name in room).most_common()]


def _often_with(name: str | None, rooms: Rooms) -> list[str]:
    """Object names by decreasing number of rooms that contain them together with ``name``."""
    return [] if name is None else [one for one in _often([room for room in rooms if name in room]) if one != name]


@cache
def counted_scenes(dataset: str) -> tuple[tuple[str, ...], ...]:
    """The class names in each of 48 rooms or homes, for the popular and adversarial samplings."""
    table = parse_toml(file_text(Path(__file__).with_name(f"{dataset}.toml")))
    return tuple(tuple(names) for names in table[dataset].values())
