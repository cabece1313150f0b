"""Text chains and questions about single objects in the style of Beacon3D, generated from ground truth.

The most specific text of a chain refers to exactly one object: by a property, by its position, or by its name. The
other text is the name, which refers to every object with it. An object has three chains; one with fewer such texts is
not used.

For an object with three chains there are three questions, each using an unambiguous text: what it stands on (class),
its colour (appearance), whether it is taller or larger than another (geometry), what it is next to or closer to
(spatial), what is next to it (existence). A question is excluded if a slightly different threshold would change its
answer, or if no frame shows the answer clearly. Templates are ours.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from su3d_bench.core.english import is_countable, is_plural, last_word, with_article, words
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.questions.grounding import CHAINS_EACH, ChainedText, Place
from su3d_bench.numerics.relations import BUILT_IN, FLAT_M, gap_m
from su3d_bench.questions.appearance import COLOURS, SHAPES, SIZES, SOFT, is_flat
from su3d_bench.questions.generator import TWICE, WITHOUT_SIZE, generate, may_be_confused
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


MIN_HEIGHT_RATIO = 1.5  # ours: the height ratio from which taller is undisputed
LEAD_M, FAR_M = 0.5, 1.5  # ours: the margin of the closer one; the distance from which it is clearly not next to it
MAX_PER_TEMPLATE = 4  # questions of one template about one object


@dataclass(frozen=True)
class ChainQuestion:
    """A question about an object; ``hint`` are the words that determine the answer: a text with them reveals it."""

    text: str
    answer: str
    tag: str
    hint: str


def metadata_of(scene: str, objects: SceneMap, max_objects: int | None = None) -> tuple[dict[str, Any], ...]:
    """The classes of a scene in the format of ``metadata_*_grounding.json`` and of ``metadata_*_qa.json``.

    Ids are one less than here, as in ScanNet. Objects with fewer than three possible questions are in neither.
    """
    grounding: dict[str, Any] = {}
    asked: dict[str, Any] = {}
    questions = generate(scene, objects, both=True)
    cases = {case.text: case for case in chains_of(questions, objects)}
    chains_by_id = {thing.id: chains for thing, chains in _chains(questions, objects)}
    candidates = {key: _candidates(objects.by_id(key), chains, objects) for key, chains in chains_by_id.items()}
    for object_id, made in _balanced(candidates, max_objects).items():
        thing, chains = objects.by_id(object_id), chains_by_id[object_id]
        texts, key = [chain[0].text for chain in chains], str(object_id - 1)
        known = {word for text in texts for word in words(text)}
        grounding.setdefault(thing.name, {})[key] = {
            f"chain_{number}": [_entry(cases[one.text]) for one in chain] for number, chain in enumerate(chains, 1)
        }
        rows: list[dict[str, Any]] = [{"question": one.text, "answer": one.answer, "tag": one.tag} for one in made]
        for row, one in zip(rows, made, strict=True):
            row["extra_knowledge"] = int(not set(words(one.hint)) <= known)
        asked.setdefault(thing.name, {})[key] = {"grounding_text": texts, "qa": rows}
    return grounding, asked


def made_files(scenes: Mapping[str, SceneMap], per_scene: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """The contents of both metadata files for scenes by name, with at most ``per_scene`` objects of each."""
    grounding: dict[str, Any] = {}
    asked: dict[str, Any] = {}
    for scene, objects in scenes.items():
        chains, questions = metadata_of(scene, objects, per_scene)
        if questions:
            grounding[scene], asked[scene] = chains, questions
    if not asked:
        raise DataError("no object has three unambiguous texts and three questions; choose other scenes")
    return grounding, asked


def _entry(case: ChainedText) -> dict[str, Any]:
    tags = sorted(case.tags, key=lambda tag: (tag != "class", tag))
    return {"text": case.text, "obj_id": [str(one - 1) for one in case.object_ids], "tag": "-".join(tags)}


def _candidates(thing: MapObject, chains: Sequence[Sequence[Question]], objects: SceneMap) -> list[ChainQuestion]:
    """The questions about an object by the texts of its chains; none that reveals its answer."""
    asked = ((one, chain[0].text) for chain in chains for one in questions_about(thing, chain[0].text, objects))
    return [one for one, text in asked if not set(words(one.hint)) & set(words(text))]


def _balanced(candidates: Mapping[int, list[ChainQuestion]], max_objects: int | None) -> dict[int, list[ChainQuestion]]:
    """Three questions each of objects by id; of each tag, both of two answers are equally frequent.

    The surplus, by a digest, is dropped, and other questions are drawn, until there is none.
    """
    dropped: set[tuple[int, str]] = set()
    while True:
        left = ((key, [one for one in every if (key, one.text) not in dropped]) for key, every in candidates.items())
        drawn = ((key, made) for key, every in left if len(made := _drawn(key, every)) == CHAINS_EACH)
        kept = dict(islice(drawn, max_objects))
        sides = defaultdict[tuple[str, bool], tuple[list[tuple[int, str]], ...]](lambda: ([], []))
        asked = ((key, one, side) for key, made in kept.items() for one in made if (side := _side(one)) is not None)
        for key, one, side in sorted(asked, key=lambda entry: _digest(entry[1].text)):
            sides[one.tag, " or " in one.text][side].append((key, one.text))
        dropped.update(entry for a, b in sides.values() for entry in (*a[len(b) :], *b[len(a) :]))
        if all(len(a) == len(b) for a, b in sides.values()):
            return kept


def _side(one: ChainQuestion) -> bool | None:
    """Whether the answer is yes or the first of two alternatives; None if it is neither of two."""
    before, either, _ = one.text.rpartition(" or ")
    return before.lower().endswith(f" {one.answer.lower()}") if either else {"Yes": True, "No": False}.get(one.answer)


def _drawn(object_id: int, every: Sequence[ChainQuestion]) -> list[ChainQuestion]:
    """Three questions, of different kinds if possible, by a digest of their texts."""
    turn = Counter[str]()
    ranked = []
    unwanted = {tag: ("Yes", "No")[_digest(f"{object_id} {tag}")[-1] % 2] for tag in {one.tag for one in every}}
    for one in sorted(every, key=lambda one: (one.answer == unwanted[one.tag], _digest(one.text))):
        turn[one.tag] += 1
        ranked.append((turn[one.tag], _digest(f"{object_id} {one.tag}"), one))
    drawn: dict[tuple[str, str], ChainQuestion] = {}
    for _, _, one in sorted(ranked, key=lambda entry: entry[:2]):
        drawn.setdefault((one.tag, one.hint), one)
    return list(drawn.values())[:CHAINS_EACH]


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def questions_about(thing: MapObject, text: str, objects: SceneMap) -> Iterator[ChainQuestion]:
    """All questions about an object referred to by an unambiguous text."""
    name, _, where = text.partition(f"{thing.name} ")
    verb = "are" if is_plural(thing.name) else "is"
    it = f"the {text}" if name or where.startswith("with ") else f"the {thing.name} that {verb} {where}"
    colours = sorted(set(thing.caption.split()) & COLOURS)
    if len(colours) == 1:
        yield ChainQuestion(f"What color is {it}?", colours[0].capitalize(), "appearance", colours[0])
        named = sorted(COLOURS - set(colours))
        other = named[_digest(it)[0] % len(named)]
        for word, answer in ((colours[0], "Yes"), (other, "No")):
            yield ChainQuestion(f"Is {it} {word}?", answer, "appearance", colours[0])
    alone = [other for other in objects.objects if _is_alone(other, objects) and other.id != thing.id]
    if name:
        yield from _support_question(thing, it, objects)
    yield from _measured(thing, it, alone, objects)
    yield from _beside(thing, it, alone, objects)
    if "next to" not in text:
        yield from _existing(thing, it, objects)


def _is_alone(thing: MapObject, objects: SceneMap) -> bool:
    """Whether an object is the only one of its name and clearly visible."""
    is_one = is_countable(thing.name) and not is_plural(thing.name)
    return thing.is_query_target and is_one and len(_called(thing.name, objects)) == 1


def _called(name: str, objects: SceneMap) -> list[MapObject]:
    """The objects whose name equals, starts or ends with the given one."""
    wanted = set(words(name))
    return [other for other in objects.objects if wanted <= set(words(other.name)) or set(words(other.name)) <= wanted]


def _support_question(thing: MapObject, it: str, objects: SceneMap) -> Iterator[ChainQuestion]:
    """The supporting object, if there is exactly one."""
    others = [other for other in objects.objects if other.id != thing.id]
    under = [other for other in others if objects.holds("on", thing, other)]
    is_sure = not any(objects.is_doubtful("on", thing, other) for other in others)
    if len(under) == 1 and is_sure and under[0].is_query_target:
        yield ChainQuestion(f"What is {it} on?", under[0].name.capitalize(), "class", under[0].name)


def _measured(thing: MapObject, it: str, alone: Sequence[MapObject], objects: SceneMap) -> Iterator[ChainQuestion]:
    """Height and size comparisons with a clear margin, between completely observed objects."""
    ways = 0
    for other in sorted(alone, key=lambda other: _digest(f"{it} {other.name}")):
        if ways == MAX_PER_TEMPLATE or not (thing.is_whole and other.is_whole):
            return
        high, low = float(thing.size[2]), float(other.size[2])
        volumes = float(np.prod(thing.size)), float(np.prod(other.size))
        built_in = {last_word(thing.name), last_word(other.name)} & BUILT_IN
        is_level = not built_in and objects.are_in_one_place(thing, other)
        if is_level and max(high, low) >= MIN_HEIGHT_RATIO * min(high, low) > FLAT_M:
            answer = "Taller" if high > low else "Shorter"
            text = f"Is {it} taller or shorter than the {other.name}?"
        elif max(volumes) >= TWICE * min(volumes) and _has_volume(thing) and _has_volume(other):
            answer = "Larger" if volumes[0] > volumes[1] else "Smaller"
            text = f"Is {it} larger or smaller than the {other.name}?"
        else:
            continue
        ways += 1
        yield ChainQuestion(text, answer, "geometry", f"{answer} {other.name}")


def _has_volume(thing: MapObject) -> bool:
    """Whether its volume is a meaningful size."""
    return not is_flat(thing.size) and last_word(thing.name) not in SOFT | WITHOUT_SIZE


def _beside(thing: MapObject, it: str, alone: Sequence[MapObject], objects: SceneMap) -> Iterator[ChainQuestion]:
    """Whether an object is next to another, and which of two is closer by a clear margin."""
    for other in alone:  # "the bowl that is on a shelf next to the pan" has two meanings
        if objects.is_doubtful("next to", thing, other) or {"that", "with"} & set(it.split()):
            continue
        is_next = objects.holds("next to", thing, other)
        if is_next or gap_m(thing.box, other.box) > FAR_M:
            answer = "Yes" if is_next else "No"
            yield ChainQuestion(f"Is {it} next to the {other.name}?", answer, "spatial", other.name)
    apart = (other for other in alone if not objects.is_of(other, thing))
    ranked = sorted(apart, key=lambda other: gap_m(thing.box, other.box))
    for near, far in zip(ranked[:MAX_PER_TEMPLATE], reversed(ranked), strict=False):
        if gap_m(thing.box, far.box) - gap_m(thing.box, near.box) < LEAD_M or near is far:
            continue
        for first, second in ((near.name, far.name), (far.name, near.name)):
            text = f"Which is closer to {it}, the {first} or the {second}?"
            yield ChainQuestion(text, near.name.capitalize(), "spatial", near.name)


def _existing(thing: MapObject, it: str, objects: SceneMap) -> Iterator[ChainQuestion]:
    """Whether an object with a name is next to an object; the answer is no if all such objects are far away."""
    seen = {other.name for other in objects.objects if other.is_query_target and other.id != thing.id}
    names = [name for name in sorted(seen) if not is_plural(name)]
    ways = Counter[str]()
    for name in sorted(names, key=lambda name: _digest(f"{it} {name}")):
        others = [other for other in _called(name, objects) if other.id != thing.id]
        beside = [other for other in others if objects.holds("next to", other, thing)]
        if any(objects.is_doubtful("next to", other, thing) for other in others):
            continue
        alike = (other for other in objects.objects if other.id != thing.id and may_be_confused(name, other.name))
        is_far = all(gap_m(thing.box, other.box) > FAR_M for other in alike)
        answer = "Yes" if any(other.is_query_target for other in beside) else "No" if is_far and not beside else ""
        if answer and ways[answer] < MAX_PER_TEMPLATE:
            ways[answer] += 1
            yield ChainQuestion(f"Is there {with_article(name)} next to {it}?", answer, "existence", name)
