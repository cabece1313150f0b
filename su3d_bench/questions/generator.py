"""Questions with known answers, generated from any ground truth with classes: names, uses, sizes, colours, relations.

Every question has all its answer objects. Questions are dropped if more than a third of a scene's objects are answers,
if no frame shows an answer object clearly, or if a slightly different threshold would change the answer. Properties and
relations are asked if another object of the same name is not an answer; if the name alone gives the answer, they are a
separate kind.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import combinations

import numpy as np

from su3d_bench.core.english import last_word, with_article, words
from su3d_bench.numerics.relations import RELATIONS
from su3d_bench.perception.embedded.lexicon import SYNONYMS
from su3d_bench.questions.appearance import COLOURS, LEAD, SIZES, Appearance, is_flat, measure_of
from su3d_bench.questions.model import BY_NAME, GENERATED_KINDS, KINDS, Question, new_question, word_table
from su3d_bench.questions.scene_map import MapObject, SceneMap, is_called, noun_objects

SOURCE = "generated"
MAX_ANSWER_SHARE = 1 / 3  # ours: questions with a larger share of answer objects are too general
TWICE = 2.0  # ours: the volume ratio from which an object is clearly large
WITHOUT_SIZE = frozenset(("book",))  # in scans they are annotated per row
BETWEEN_M = 2.0  # ours: objects farther apart are not asked about with "between"


@dataclass(frozen=True)
class _Asked:
    """A text of a kind with some of its answers; ``name`` of its subject, empty if the question asks for the name."""

    kind: str
    text: str
    answers: tuple[int, ...]
    name: str = ""


def generate(scene: str, objects: SceneMap, per_kind: int | None = None, *, both: bool = False) -> tuple[Question, ...]:
    """The questions of all kinds, at most ``per_kind`` of each, drawn deterministically by a digest of the text.

    ``both``: a relation describes each of its two objects, not only one ("table with a cup on it").
    """
    right: dict[tuple[str, str, str], set[int]] = {}
    doubtful: set[str] = set()
    for asked in (*_texts(objects), *_relations(objects, both=both)):
        if asked.answers:
            right.setdefault((asked.kind, asked.text, asked.name), set()).update(asked.answers)
        else:
            doubtful.add(asked.text)
    limit = max(1, int(len(objects) * MAX_ANSWER_SHARE))
    made = []
    for (kind, text, name), ids in right.items():
        named = set(_called(objects, name)) if name else set[int]()
        is_plain = all(objects.by_id(object_id).is_query_target for object_id in ids | named)
        if len(ids) <= limit and is_plain and text not in doubtful:
            own_kind = BY_NAME.get(kind, kind) if named == ids else kind
            made.append(new_question(scene, own_kind, text, tuple(ids), SOURCE))
    return chosen(made, per_kind)


def chosen(questions: Sequence[Question], per_kind: int | None) -> tuple[Question, ...]:
    """At most ``per_kind`` questions of each kind by a digest of their text, sorted by kind and text."""
    drawn: list[Question] = []
    for kind in GENERATED_KINDS:
        of_kind = [question for question in questions if question.kind == kind]
        of_kind.sort(key=lambda question: hashlib.sha256(question.text.encode()).digest())
        drawn += sorted(of_kind[:per_kind], key=lambda question: question.text)
    return tuple(drawn)


def accuracy_by_name(question: Question, objects: SceneMap) -> float:
    """The accuracy of a system that only knows the object names; 0 without known answers.

    It picks one of the objects that the question names; if it names none (a use), the system knows which ones serve it.
    """
    if not question.answers:
        return 0.0
    if question.kind in KINDS[:2]:
        return 1.0
    names = {objects.by_id(object_id).name for object_id in question.answers if object_id in objects.ids}
    named = [thing for thing in objects.objects if thing.name in names]
    return min(1.0, len(question.answers) / max(1, len(named)))


@lru_cache(maxsize=65_536)
def may_be_confused(one: str, other: str) -> bool:
    """Whether people may use the first name for an object with the second, or for a part of it.

    They are synonyms, share a head noun, or are in one of the groups ``confused`` or ``parts`` of words.toml.

    >>> may_be_confused("desk", "table"), may_be_confused("tissue box", "box"), may_be_confused("sofa", "lamp")
    (True, True, False)
    """
    alike = _heads(one).union(word_table("parts").get(one, ()))
    return is_called(one, other) or is_called(other, one) or not alike.isdisjoint(_heads(other))


@cache
def _heads(name: str) -> frozenset[str]:
    """The head noun of a name, the name, its synonyms, and the groups of these."""
    names = (last_word(name), name, *SYNONYMS.get(name.replace(" ", "-"), ()))
    heads = {" ".join(words(one)) for one in names}
    return frozenset(heads | {group for group, nouns in word_table("confused").items() if not heads.isdisjoint(nouns)})


def _texts(objects: SceneMap) -> Iterator[_Asked]:
    """Texts, each with some of its answers; a text without an answer must not be asked."""
    names = sorted({thing.name for thing in objects.objects})
    for name in names:
        yield _Asked("instance", name, _ids(objects, name))
    for name, others in word_table("names").items():
        if name in names:
            for other in others:
                yield _Asked("instance", other, _ids(objects, other))
    for phrase, classes in word_table("uses").items():
        yield _Asked("affordance", phrase, tuple(thing for name in classes for thing in _called(objects, name)))
    yield from _sizes(objects)
    yield from _adjectives(objects)
    yield from _looks(objects)
    yield from _between(objects)


def _ids(objects: SceneMap, name: str) -> tuple[int, ...]:
    return tuple(thing.id for thing in noun_objects(name, objects).objects)


def _called(objects: SceneMap, name: str) -> tuple[int, ...]:
    """The objects whose name is or ends with ``name``: an office chair is a chair, a plant stand is not a plant."""
    wanted = words(name)
    return tuple(thing.id for thing in objects.objects if words(thing.name)[-len(wanted) :] == wanted)


def _sizes(objects: SceneMap) -> Iterator[_Asked]:
    """Large and small objects among those of one name, if their boxes are complete."""
    for name, n in Counter(thing.name for thing in objects.objects).items():
        named = [thing for thing in objects.objects if thing.name == name]
        if n < 2 or not all(thing.is_whole for thing in named) or any(is_flat(thing.size) for thing in named):
            continue
        for word, sign in (("large", 1), ("small", -1)):
            if (thing := extreme_of(named, sign)) is not None:
                yield _Asked("property", f"{word} {name}", (thing.id,), name)


def extreme_of(things: Sequence[MapObject], sign: int) -> MapObject | None:
    """The largest (``sign`` 1) or smallest (-1) in every side, if it leads twofold in volume and visibly in length."""
    ranked = sorted(things, key=lambda thing: -sign * float(np.prod(thing.size)))
    volumes = [np.prod(thing.size) for thing in ranked]
    if len(ranked) < 2 or max(volumes[:2]) < TWICE * min(volumes[:2]):
        return None
    first, *others = [np.sort(thing.size) for thing in ranked]  # a floor lamp is not larger than a wide one
    lead = np.array([1.0, 1.0, LEAD**sign])
    return ranked[0] if all((sign * (first - lead * other) >= 0).all() for other in others) else None


def _adjectives(objects: SceneMap) -> Iterator[_Asked]:
    """The known adjectives of an object before its name, "red chair".

    No colours if an object of that name has no known one; likewise for materials: a painted chair may be of wood.
    """
    words_of = {thing.id: frozenset(thing.caption.split()) for thing in objects.objects}
    without_colour = {thing.name for thing in objects.objects if not words_of[thing.id] & COLOURS}
    without_material = {thing.name for thing in objects.objects if not words_of[thing.id] - COLOURS}
    for thing in objects.objects:
        for word in sorted(words_of[thing.id]) if thing.looks is None else ():
            if thing.name not in (without_colour if word in COLOURS else without_material):
                yield _Asked("property", f"{word} {thing.name}", (thing.id,), thing.name)


def _looks(objects: SceneMap) -> Iterator[_Asked]:
    """Shapes, colours and sizes in a recording, among objects with one name or whose names end with one word.

    A word is asked if it is certain for the answers and ruled out for all others. Sizes need completely seen objects.
    """
    names = {thing.name for thing in objects.objects}
    heads = Counter(last_word(name) for name in names)
    for name in sorted(names | {head for head, n in heads.items() if n > 1 and head}):
        ids = _called(objects, name)
        named = [objects.by_id(object_id) for object_id in ids]
        known = [(thing, thing.looks) for thing in named if thing.looks is not None]
        if len(known) < len(named) or not all(is_called(name, thing.name) for thing in named):
            continue
        for word in sorted({word for _, looks in known for word in looks.words}):
            answers = tuple(thing.id for thing, looks in known if word in looks.words)
            if len(answers) == sum(word in looks.maybe for _, looks in known) and _none_is_more(word, known):
                others = [other for other in word_table("names").get(name, ()) if set(_ids(objects, other)) == set(ids)]
                for called in (name, *others):
                    yield _Asked("property", f"{word} {called}", answers, name)
        if last_word(name) not in WITHOUT_SIZE and not any(thing.is_cut for thing in named):
            yield from _measured(name, known)


def _none_is_more(word: str, known: Sequence[tuple[MapObject, Appearance]]) -> bool:
    """Whether no object not called long (tall) is as long (high) as one that is; true for any other word."""
    axis = {"long": 0, "tall": 2}.get(word)
    if axis is None:
        return True
    least = min(float(looks.sides[axis]) for _, looks in known if word in looks.words)
    return all(LEAD * float(looks.sides[axis]) <= least for _, looks in known if word not in looks.words)


def _measured(name: str, known: Sequence[tuple[MapObject, Appearance]]) -> Iterator[_Asked]:
    """The object that is large, small, long or tall compared with every other of its name."""
    if len(known) < 2 or len({is_flat(looks.sides) for _, looks in known}) > 1:
        return
    for more, less, factor in SIZES:
        measures = [(thing.id, measure_of(thing.name, looks, more), looks.sides.max()) for thing, looks in known]
        ranked = sorted(
            (value, float(side) if more == "large" else value, object_id)
            for object_id, value, side in measures
            if value is not None
        )
        if len(ranked) < len(known):
            continue
        values, sides, ids = zip(*ranked, strict=True)
        if values[-1] >= factor * values[-2] and sides[-1] >= LEAD * max(sides[:-1]):
            yield _Asked("property", f"{more} {name}", (ids[-1],), name)
        if less and factor * values[0] <= values[1] and LEAD * sides[0] <= min(sides[1:]):
            yield _Asked("property", f"{less} {name}", (ids[0],), name)


def _relations(objects: SceneMap, *, both: bool) -> Iterator[_Asked]:
    """Relations that hold with certainty, each once; if a pair of these names is doubtful, the text is not asked."""
    things = objects.objects
    for relation in RELATIONS:
        if relation == "near":
            continue
        related, doubtful = objects.relations.facts(relation), objects.doubtful[relation]
        is_usual = objects.relations.usual(relation)
        if relation == "in":
            related = related & ~objects.relations.on  # a cushion is within the box of a sofa, and on it
        for a, b in np.argwhere(related | doubtful).tolist():
            subject, other = things[a], things[b]
            text = f"{subject.name} {relation} {with_article(other.name)}"
            is_asked = subject.name != other.name and is_usual[a, b]
            is_sure = not doubtful[a, b] and other.is_query_target
            if is_asked and (both or relation != "next to" or objects.is_located_by(subject.name, other.name)):
                yield _Asked("relative", text, (subject.id,) if is_sure else (), subject.name)
            if is_asked and both and relation == "on":
                text = f"{other.name} with {with_article(subject.name)} on it"
                is_sure &= subject.is_query_target
                yield _Asked("relative", text, (other.id,) if is_sure else (), other.name)


def _between(objects: SceneMap) -> Iterator[_Asked]:
    """Objects between two others with unique names, all on one level."""
    n_of = Counter(thing.name for thing in objects.objects)
    single = [
        thing for thing in objects.objects if n_of[thing.name] == 1 and thing.is_query_target and not thing.is_cut
    ]
    for first, second in combinations(single, 2):
        is_close = objects.is_of(first, second) or objects.holds("next to", first, second)  # nothing fits between
        if is_close or float(np.linalg.norm(first.centroid - second.centroid)) > BETWEEN_M:
            continue
        for thing in objects.objects:
            if objects.may_be_between(thing, first, second):
                is_sure = objects.is_between(thing, first, second) and not thing.is_cut
                is_sure &= objects.are_in_one_place(thing, first, second)
                text = f"{thing.name} between the {first.name} and the {second.name}"
                yield _Asked("relative", text, (thing.id,) if is_sure else (), thing.name)
