"""OpenScan's attributes of the objects of a room, from ``attributes.toml`` and from what each is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml
from su3d_bench.core.types import Int32Array
from su3d_bench.datasets.openscan import KEYS, attribute_id

if TYPE_CHECKING:
    from su3d_bench.datasets.rooms.truth import RoomObject

MATERIAL = "material"


def attribute_of_object(objects: Sequence[RoomObject], variant: str) -> Int32Array:
    """The attribute (n + 1,) of every object in an aspect by the object's id, 0 for none; that of id 0 is 0."""
    aspect = variant.partition("-")[2]
    ids = {word: attribute_id(variant, words) for word, words in _words_of(aspect).items()}
    words = [known.material if aspect == MATERIAL else known.class_name for known in objects]
    return np.array([0, *(ids.get(word) or 0 for word in words)], np.int32)


def attribute_words(class_name: str, material: str) -> dict[str, str]:
    """What OpenScan's records say of a thing: the words of each aspect that it has, by the key of the aspect.

    >>> attribute_words("vent", "metal")
    {'element': 'air passage', 'material': 'metal'}
    """
    answer = {}
    for variant, key in KEYS.items():
        aspect = variant.partition("-")[2]
        words = _words_of(aspect).get(material if aspect == MATERIAL else class_name)
        if words is not None and attribute_id(variant, words) is not None:
            answer[key] = words
    return answer


def classes_of_type(class_name: str) -> tuple[str, ...]:
    """The other classes of the rooms that are of the type of one.

    >>> classes_of_type("lamp")
    ('candle',)
    """
    type_of = _words_of("type")
    if class_name not in type_of:
        return ()
    return tuple(name for name, words in type_of.items() if words == type_of[class_name] and name != class_name)


@cache
def _words_of(aspect: str) -> Mapping[str, str]:
    """The words of each class, or material, in an aspect."""
    table = parse_toml(file_text(Path(__file__).with_name("attributes.toml")))[aspect]
    return {name: words for words, names in table.items() for name in names}
