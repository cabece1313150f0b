"""Which objects of a map a noun means: by name, by other English names, by adjectives of the caption.

The nearest name by a text encoder is the last resort, and is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from su3d_bench.core.english import words
from su3d_bench.core.errors import nearest
from su3d_bench.core.interfaces import Encoder
from su3d_bench.perception.embedded.lexicon import GROUPS, SYNONYMS
from su3d_bench.perception.embedded.naming import vocabulary
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap, is_room_surface

Words = tuple[str, ...]
# A name, and how near it is by the encoder (cosine).
NearestName = Callable[[str, Sequence[str]], tuple[str, float]]

ANYTHING = frozenset({"object", "thing", "item", "anything", "something", "everything", "one"})
GATHERED = frozenset({"row", "pile", "stack", "heap"})  # of things of one name
MOST_ADJECTIVES = 3
# Ours: by the embedded encoder other words of a thing reach 0.84 ("carpeting") to 0.93 ("armchair"), words of another
# thing up to 0.72 ("wastebasket" for a basket).
LEAST_LIKENESS = 0.8
COLOUR_SPELLINGS = {"gray": "grey", "wood": "wooden"}


@dataclass(frozen=True)
class Meant:
    """The objects that a noun means, in the map's order, and what must be said of it."""

    objects: tuple[MapObject, ...]
    notes: tuple[str, ...] = ()


@cache
def _class_of_words() -> dict[Words, str]:
    """Every known name -> the class that it names."""
    class_of = {words(name): name for name in vocabulary()}
    for name, others in SYNONYMS.items():
        for other in (name, *others):
            class_of.setdefault(words(other), name)
    return class_of


def meant_by(noun: str, scene: SceneMap, nearest: NearestName | None = None) -> Meant:
    """The objects that ``noun`` means; without relation words in it."""
    noun_words = words(noun)
    if not noun_words:
        return Meant(())
    if len(noun_words) == 1 and noun_words[0] in ANYTHING:
        return Meant(tuple(thing for thing in scene.objects if not is_room_surface(thing.name)))
    for n_adjectives in range(min(MOST_ADJECTIVES, len(noun_words) - 1) + 1):
        adjectives, rest = noun_words[:n_adjectives], noun_words[n_adjectives:]
        named = _named(rest, scene.objects)
        held = tuple(thing for thing in named if _has(thing, adjectives))
        if held:
            return Meant(held)
    if noun_words[0] in GATHERED and noun_words[1:2] == ("of",):
        return meant_by(
            " ".join(noun_words[2:]), scene, nearest
        )  # of which a map may know the single ones, or one of all
    if noun_words in _class_of_words():
        return Meant(())  # a word that is known, for a thing that is not there
    return _by_encoder(noun, scene, nearest)


def meant_instead(noun: str, scene: SceneMap) -> str:
    """A clause ``; did you mean 'x'?`` for a noun that nobody knows and that is spelt nearly as a thing of the map."""
    noun_words = words(noun)
    if not noun_words or {noun_words, noun_words[-1:]} & (_class_of_words().keys() | groups().keys()):
        return ""
    names = {thing.name for thing in scene.objects if thing.name}
    own = {_class_of_words().get(words(name)) for name in names}
    names |= {other for name in own if name is not None for other in SYNONYMS.get(name, ())}
    return nearest(noun, sorted(names)) or nearest(noun_words[-1], sorted(names))


@cache
def groups() -> dict[Words, tuple[str, ...]]:
    """Words for several classes -> the classes."""
    return {words(name): classes for name, classes in GROUPS.items()}


def _named(noun_words: Words, objects: Iterable[MapObject]) -> list[MapObject]:
    group = groups().get(noun_words)
    class_of = _class_of_words()
    if group is not None:
        return [
            thing for thing in objects if class_of.get(words(thing.name)) in group or words(thing.name) == noun_words
        ]
    kind = class_of.get(noun_words)
    return [thing for thing in objects if _means(words(thing.name), noun_words, kind)]


def _means(name: Words, noun_words: Words, kind: str | None) -> bool:
    """Whether an object called ``name`` is what ``asked`` (of class ``kind``) asks for: a coffee table is a table."""
    if name == noun_words:
        return True
    own = _class_of_words().get(name)
    if own is not None:
        # A name of its own class: a paper towel is no towel.
        return own == kind
    is_kind_of = len(name) > len(noun_words) and name[len(name) - len(noun_words) :] == noun_words
    return is_kind_of or (kind is not None and _class_of_words().get(name[-1:]) == kind)


def _has(thing: MapObject, adjectives: Words) -> bool:
    known = {*words(thing.name), *words(thing.caption)}
    return all(COLOUR_SPELLINGS.get(word, word) in known or word in known for word in adjectives)


def _by_encoder(noun: str, scene: SceneMap, nearest: NearestName | None) -> Meant:
    names = sorted({thing.name for thing in scene.objects if thing.name and not is_room_surface(thing.name)})
    if nearest is None or not names:
        return Meant(())
    name, likeness = nearest(noun, names)
    if likeness < LEAST_LIKENESS:
        return Meant(())
    things = tuple(thing for thing in scene.objects if thing.name == name)
    note = f"the map has no '{noun}'; taken for '{name}', the nearest name by the text encoder (cosine {likeness:.2f})"
    return Meant(things, (note,))


def nearest_by(encoder: Encoder) -> NearestName:
    """The nearest name by the text features of ``encoder``."""

    def nearest(noun: str, names: Sequence[str]) -> tuple[str, float]:
        features = encoder.encode_texts([noun, *names]).astype(np.float64)
        likeness = np.einsum("nd,d->n", features[1:], features[0])
        best = int(np.argmax(likeness))
        return names[best], float(likeness[best])

    return nearest
