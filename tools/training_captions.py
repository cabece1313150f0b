"""Captions of a crop from a generator's ground truth, each with the statement that it makes.

``Caption.is_true_of`` checks a caption for one crop, ``TruthTable`` for whole batches:
training uses every positive pair of a batch, not only pairs drawn together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.english import with_article
from su3d_bench.core.types import BoolArray
from su3d_bench.perception.embedded.lexicon import (
    AFFORDANCES,
    ANYTHING,
    CLASS_TEMPLATES,
    COLOUR_WORDS,
    GROUPS,
    RELATION_WORDS,
    ROOM_NAMES,
    SIZE_WORDS,
    SURFACES,
    class_words,
)

Word = TypeVar("Word")
Generator = np.random.Generator


@dataclass(frozen=True)
class Neighbour:
    """A relation of the crop's object to something else visible in the crop: "on" a "brown" "table"."""

    relation: str
    class_name: str
    colour: str


@dataclass(frozen=True)
class CropTruth:
    """Content of a crop: ``class_name`` is "" for a whole image, ``room`` is "" if little of the room is visible.

    ``model`` is the model of the object.
    """

    class_name: str
    colour: str
    material: str
    size_word: str
    neighbours: tuple[Neighbour, ...] = ()
    room: str = ""
    model: str = ""


@dataclass(frozen=True)
class Caption:
    """A text and the conditions under which it is true; an empty field imposes none."""

    text: str
    classes: tuple[str, ...] = ()
    colour: str = ""
    material: str = ""
    size_word: str = ""
    relation: str = ""
    others: tuple[str, ...] = ()
    other_colour: str = ""
    room: str = ""
    is_whole_image: bool = False

    def is_true_of(self, crop: CropTruth) -> bool:
        """Whether every part of the statement holds for ``crop``."""
        if self.is_whole_image != (not crop.class_name):
            return False
        pairs = ((self.colour, crop.colour), (self.material, crop.material), (self.size_word, crop.size_word))
        if any(want and want != have for want, have in (*pairs, (self.room, crop.room))):
            return False
        if self.classes and crop.class_name not in self.classes:
            return False
        return not self.relation or any(
            neighbour.relation == self.relation
            and (not self.others or neighbour.class_name in self.others)
            and (not self.other_colour or neighbour.colour == self.other_colour)
            for neighbour in crop.neighbours
        )


def class_caption(class_name: str, random: Generator) -> Caption:
    """A caption that only states the class; half of the time by the class's own name."""
    names = class_words(class_name)
    name = names[0] if random.random() < 0.5 else draw(names, random)
    return Caption(fill(draw(CLASS_TEMPLATES, random), name), classes=(class_name,))


def fixed_captions(known: frozenset[str]) -> tuple[Caption, ...]:
    """The captions of affordances and of words for several classes, without those of none of the ``known`` classes."""
    words = [*AFFORDANCES.items(), *GROUPS.items()]
    return tuple(Caption(text, classes=classes) for text, classes in words if not known.isdisjoint(classes))


def room_caption(room: str, random: Generator) -> Caption:
    """A caption of a whole image: "a kitchen", "an image of a kitchen"."""
    name = draw(ROOM_NAMES.get(room, (room,)), random)
    return Caption(fill(draw(CLASS_TEMPLATES[1:4], random), name), room=room, is_whole_image=True)


def draw_caption(crop: CropTruth, random: Generator) -> Caption:
    """A random true caption of ``crop``: attributes, relations and use."""
    if not crop.class_name:
        return _whole_caption(crop, random)
    if crop.neighbours and random.random() < 0.5:
        telling = tuple(neighbour for neighbour in crop.neighbours if neighbour.class_name not in SURFACES)
        chosen = telling if telling and random.random() < 0.9 else crop.neighbours
        return _relation_caption(crop, draw(chosen, random), random)
    if crop.room and random.random() < 0.3:
        name = draw(class_words(crop.class_name), random)
        room = draw(ROOM_NAMES.get(crop.room, (crop.room,)), random)
        return Caption(f"{name} in {room}", classes=(crop.class_name,), room=crop.room)
    return _attribute_caption(crop, random)


def _attribute_caption(crop: CropTruth, random: Generator) -> Caption:
    has_colour = random.random() < 0.7
    has_size = bool(SIZE_WORDS.get(crop.size_word)) and random.random() < (0.3 if has_colour else 0.5)
    has_material = bool(crop.material) and random.random() < 0.25
    colour = _colour(crop.colour, random) if has_colour else ""
    size = draw(SIZE_WORDS[crop.size_word], random) if has_size else ""
    is_anything = (has_colour or has_material) and random.random() < 0.15
    noun = draw(ANYTHING if is_anything else class_words(crop.class_name), random)
    phrase = " ".join(word for word in (size, colour, crop.material if has_material else "", noun) if word)
    template = CLASS_TEMPLATES[2] if random.random() < 0.5 else draw(CLASS_TEMPLATES, random)
    return Caption(
        fill(template, phrase),
        classes=() if is_anything else (crop.class_name,),
        colour=crop.colour if has_colour else "",
        size_word=crop.size_word if has_size else "",
        material=crop.material if has_material else "",
    )


def _relation_caption(crop: CropTruth, neighbour: Neighbour, random: Generator) -> Caption:
    has_colour, has_other_colour = random.random() < 0.35, random.random() < 0.15
    noun = draw(class_words(crop.class_name), random)
    other = draw(class_words(neighbour.class_name), random)
    colour = _colour(crop.colour, random) if has_colour else ""
    other_colour = _colour(neighbour.colour, random) if has_other_colour else ""
    subject = " ".join(word for word in (colour, noun) if word)
    target = " ".join(word for word in (other_colour, other) if word)
    relation = draw(RELATION_WORDS.get(neighbour.relation, (neighbour.relation,)), random)
    text = f"{subject} {relation} {target}"
    return Caption(
        fill("{a}", text) if random.random() < 0.3 else text,
        classes=(crop.class_name,),
        colour=crop.colour if has_colour else "",
        relation=neighbour.relation,
        others=(neighbour.class_name,),
        other_colour=neighbour.colour if has_other_colour else "",
    )


def _whole_caption(crop: CropTruth, random: Generator) -> Caption:
    shown = [neighbour for neighbour in crop.neighbours if neighbour.relation == "with"]
    if not shown or random.random() < 0.4:
        return room_caption(crop.room, random)
    other = draw(shown, random)
    if random.random() < 0.5:
        text, room = "room", ""
    else:
        text, room = draw(ROOM_NAMES.get(crop.room, (crop.room,)), random), crop.room
    text = f"{text} with {draw(class_words(other.class_name), random)}"
    return Caption(text, relation="with", others=(other.class_name,), room=room, is_whole_image=True)


def wrong_relation(caption: Caption, class_names: Sequence[str], random: Generator) -> Caption:
    """A relational ``caption`` about another class or reversed: hard to distinguish from the true one."""
    subject, other = caption.classes[0], caption.others[0]
    if random.random() < 0.5:
        other = class_names[int(random.integers(len(class_names)))]
    else:
        subject, other = other, subject
    words = draw(class_words(subject), random), draw(RELATION_WORDS[caption.relation], random)
    text = " ".join((*words, draw(class_words(other), random)))
    return Caption(text, classes=(subject,), relation=caption.relation, others=(other,))


def fill(template: str, name: str) -> str:
    """``name`` in a template, where ``{a}`` is replaced by the name with its article."""
    return template.replace("{a}", with_article(name)).replace("{}", name)


def _colour(name: str, random: Generator) -> str:
    return draw(COLOUR_WORDS.get(name, (name,)), random)


def draw(choices: Sequence[Word], random: Generator) -> Word:
    return choices[int(random.integers(len(choices)))]


Names = dict[str, int]

# The words shared by captions and crops.
_WORDS = (attrgetter("colour"), attrgetter("material"), attrgetter("size_word"), attrgetter("room"))


class TruthTable:
    """Ground truth of N crops as numbers, so that ``matches`` of a batch takes a millisecond."""

    def __init__(self, truths: Sequence[CropTruth]) -> None:
        self.class_names = tuple(sorted({truth.class_name for truth in truths} - {""}))
        self._classes = _numbers(self.class_names)
        self._words = [_numbers(sorted({word_of(truth) for truth in truths} - {""})) for word_of in _WORDS]
        pairs = {(near.relation, near.class_name, near.colour) for truth in truths for near in truth.neighbours}
        self._pairs = {pair: index for index, pair in enumerate(sorted(pairs))}
        self._pairs_by_key: dict[tuple[str, str, str], list[int]] = {}
        for (relation, name, colour), index in self._pairs.items():
            for key in ((relation, name, colour), (relation, name, ""), (relation, "", colour), (relation, "", "")):
                self._pairs_by_key.setdefault(key, []).append(index)
        self.class_of = np.array([self._classes.get(truth.class_name, -1) for truth in truths], np.int64)
        self._word_of = np.array(
            [
                [numbers.get(word_of(truth), -1) for truth in truths]
                for numbers, word_of in zip(self._words, _WORDS, strict=True)
            ],
            np.int64,
        )
        self._pairs_of = [
            np.array([self._pairs[near.relation, near.class_name, near.colour] for near in truth.neighbours], np.int64)
            for truth in truths
        ]

    def matches(self, captions: Sequence[Caption], crops: NDArray[np.int64]) -> BoolArray:
        """(T, B): whether caption t is true of the crop at ``crops[b]``."""
        is_whole = self.class_of[crops] < 0
        result = np.array([caption.is_whole_image for caption in captions])[:, None] == is_whole[None]
        classes = np.zeros((len(captions), len(self._classes) + 1), bool)
        for row, caption in enumerate(captions):
            if caption.classes:
                classes[row, [self._classes[name] for name in caption.classes if name in self._classes]] = True
            else:
                classes[row] = True
        result &= classes[:, self.class_of[crops]]
        for numbers, of_crop, word_of in zip(self._words, self._word_of, _WORDS, strict=True):
            wanted = np.array([numbers.get(word_of(caption), -2) if word_of(caption) else -1 for caption in captions])
            result &= (wanted[:, None] == -1) | (wanted[:, None] == of_crop[crops][None])
        return np.asarray(result & self._relations(captions, crops))

    def _relations(self, captions: Sequence[Caption], crops: NDArray[np.int64]) -> BoolArray:
        result = np.ones((len(captions), len(crops)), bool)
        related = [row for row, caption in enumerate(captions) if caption.relation]
        wanted = _rows_with_ones([self._wanted_pairs(captions[row]) for row in related], len(self._pairs))
        shown = _rows_with_ones([self._pairs_of[crop] for crop in crops], len(self._pairs))
        result[related] = (wanted @ shown.T).toarray() > 0
        return result

    def _wanted_pairs(self, caption: Caption) -> list[int]:
        keys = [(caption.relation, name, caption.other_colour) for name in caption.others or ("",)]
        return [pair for key in keys for pair in self._pairs_by_key.get(key, ())]


def _rows_with_ones(columns: Sequence[Sequence[int] | NDArray[np.int64]], n_columns: int) -> Any:
    """A sparse matrix with ones in the given columns of each row."""
    from scipy.sparse import csr_array

    ends = np.concatenate([[0], np.cumsum([len(row) for row in columns])])
    places = np.concatenate([np.asarray(row, np.int64) for row in columns]) if len(columns) else np.zeros(0, np.int64)
    return csr_array((np.ones(len(places), np.float32), places, ends), shape=(len(columns), n_columns))


def _numbers(words: Iterable[str]) -> Names:
    return {word: index for index, word in enumerate(words)}
