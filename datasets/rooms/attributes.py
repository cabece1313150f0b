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
from su3d_bench.datasets.openscan import attribute_id

if TYPE_CHECKING:
    from su3d_bench.datasets.rooms.truth import RoomObject

MATERIAL = "material"


def attribute_of_object(objects: Sequence[RoomObject], variant: str) -> Int32Array:
    """The attribute (n + 1,) of every object in an aspect by the object's id, 0 for none; that of id 0 is 0."""
    aspect = variant.partition("-")[2]
    ids = {word: attribute_id(variant, words) for word, words in _words_of(aspect).items()}
    words = [known.material if aspect == MATERIAL else known.class_name for known in objects]
    return np.array([0, *(ids.get(word) or 0 for word in words)], np.int32)


@cache
def _words_of(aspect: str) -> Mapping[str, str]:
    """The words of each class, or material, in an aspect."""
    table = parse_toml(file_text(Path(__file__).with_name("attributes.toml")))[aspect]
    return {name: words for words, names in table.items() for name in names}
