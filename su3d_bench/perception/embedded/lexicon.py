"""English for the rooms' classes, from ``lexicon.toml``: other names, uses, words for several classes, for rooms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml

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
