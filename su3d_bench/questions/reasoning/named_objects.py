"""Which objects of a map a noun means: by name, by other English names, by adjectives of the caption.

The nearest name by a text encoder is the last resort, and is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.perception.embedded.lexicon import GROUPS, SYNONYMS
from su3d_bench.perception.embedded.naming import vocabulary
from su3d_bench.perception.embedded.text import words
from su3d_bench.questions.reasoning.relations import is_room_surface
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap

Words = tuple[str, ...]
# A name, and how near it is by the encoder (cosine).
NearestName = Callable[[str, Sequence[str]], tuple[str, float]]

ANYTHING = frozenset({"object", "thing", "item", "anything", "something", "everything", "one"})
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
    found = {words(name): name for name in vocabulary()}
    for name, others in SYNONYMS.items():
        for other in (name, *others):
            found.setdefault(words(other), name)
    return found


def meant_by(noun: str, scene: SceneMap, nearest: NearestName | None = None) -> Meant:
    """The objects that ``noun`` means; without relation words in it."""
    asked = words(noun)
    if not asked:
        return Meant(())
    if len(asked) == 1 and asked[0] in ANYTHING:
        return Meant(tuple(one for one in scene.objects if not is_room_surface(one.name)))
    for n_adjectives in range(min(MOST_ADJECTIVES, len(asked) - 1) + 1):
        adjectives, rest = asked[:n_adjectives], asked[n_adjectives:]
        named = _named(rest, scene.objects)
        held = tuple(one for one in named if _has(one, adjectives))
        if held:
            return Meant(held)
    if asked in _class_of_words():
        return Meant(())  # a word that is known, for a thing that is not there
    return _by_encoder(noun, scene, nearest)


def _named(asked: Words, objects: Iterable[MapObject]) -> list[MapObject]:
    group = GROUPS.get(" ".join(asked))
    if group is not None:
        return [one for one in objects if _class_of_words().get(words(one.name)) in group or words(one.name) == asked]
    kind = _class_of_words().get(asked)
    return [one for one in objects if _means(words(one.name), asked, kind)]


def _means(name: Words, asked: Words, kind: str | None) -> bool:
    """Whether an object called ``name`` is what ``asked`` (of class ``kind``) asks for: a coffee table is a table."""
    if name == asked:
        return True
    own = _class_of_words().get(name)
    if own is not None:
        # A name of its own class: a paper towel is no towel.
        return own == kind
    is_kind_of = len(name) > len(asked) and name[len(name) - len(asked) :] == asked
    return is_kind_of or (kind is not None and _class_of_words().get(name[-1:]) == kind)


def _has(one: MapObject, adjectives: Words) -> bool:
    told = {*words(one.name), *words(one.caption)}
    return all(COLOUR_SPELLINGS.get(word, word) in told or word in told for word in adjectives)


def _by_encoder(noun: str, scene: SceneMap, nearest: NearestName | None) -> Meant:
    names = sorted({one.name for one in scene.objects if one.name and not is_room_surface(one.name)})
    if nearest is None or not names:
        return Meant(())
    name, likeness = nearest(noun, names)
    if likeness < LEAST_LIKENESS:
        return Meant(())
    found = tuple(one for one in scene.objects if one.name == name)
    note = f"the map has no '{noun}'; taken for '{name}', the nearest name by the text encoder (cosine {likeness:.2f})"
    return Meant(found, (note,))


def nearest_by(encoder: Encoder) -> NearestName:
    """The nearest name by the text features of ``encoder``."""

    def nearest(noun: str, names: Sequence[str]) -> tuple[str, float]:
        features = encoder.encode_texts([noun, *names]).astype(np.float64)
        likeness = np.einsum("nd,d->n", features[1:], features[0])
        best = int(np.argmax(likeness))
        return names[best], float(likeness[best])

    return nearest
