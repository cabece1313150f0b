"""English for the rooms' classes, from ``lexicon.toml``: other names, uses, words for several classes, for rooms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.perception.embedded.naming import COLOURS, vocabulary
from su3d_bench.perception.embedded.text import words

Words = Mapping[str, tuple[str, ...]]
_TABLE: Mapping[str, Any] = parse_toml(file_text(Path(__file__).with_name("lexicon.toml")))


def _words(section: str) -> Words:
    return {name: tuple(words) for name, words in _TABLE[section].items()}


SYNONYMS = _words("synonyms")  # other names that mean this class and no other
GROUPS = _words("groups")  # words that cover several classes
AFFORDANCES = _words("uses")  # a phrase and every class of which it is true
ROOM_NAMES = _words("rooms")
COLOUR_WORDS, SIZE_WORDS, RELATION_WORDS = map(_words, ("colours", "sizes", "relations"))
SURFACES = frozenset(_TABLE["surfaces"])  # what nearly everything stands on; captions prefer another neighbour
MATERIALS = tuple(_TABLE["materials"])
# The captions of the training around a name; ``{a}`` stands for the name after its article.
CLASS_TEMPLATES = ("{a} in a scene", "an image of {a}", "{}", "{a}", "{} in scene", "a picture of {a}", "there is {a}")
ANYTHING = ("thing", "object", "item")


def class_words(class_name: str) -> tuple[str, ...]:
    """Every name of a class, its own first: "tv screen", "tv", "television", ..."""
    return (class_name.replace("-", " "), *SYNONYMS.get(class_name, ()))


@cache
def trained_words() -> frozenset[str]:
    """Every word that a caption of the training may hold, as the tokenizer reads it."""
    names = (*vocabulary(), *SURFACES, *SYNONYMS)
    texts = [*CLASS_TEMPLATES, *ANYTHING, *(word for name in names for word in class_words(name))]
    texts += [*GROUPS, *AFFORDANCES, "room", *(name for name, _ in COLOURS), *MATERIALS]
    for table in (ROOM_NAMES, COLOUR_WORDS, SIZE_WORDS, RELATION_WORDS):
        texts += [word for spellings in table.values() for word in spellings]
    return frozenset(word for text in texts for word in words(text))
