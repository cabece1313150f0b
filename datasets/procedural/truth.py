"""Ground truth of a generated scene: its objects, their relations, and their attributes as in OpenScan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array, Int32Array, WholeObject
from su3d_bench.datasets.openscan import attribute_id
from su3d_bench.datasets.procedural.items import Item, Placed, box_of
from su3d_bench.datasets.procedural.materials import Texture
from su3d_bench.numerics.relations import Relations

STRUCTURE = frozenset(("wall", "floor", "ceiling"))
OPENINGS = frozenset(("door", "window"))
# Materials recognizable in a picture: the textures that only they have.
TEXTURE_WORDS = {"wooden": Texture.WOOD, "wicker": Texture.WICKER}
WOOD_COLOURS = frozenset(("brown", "beige", "orange"))  # wood of other colours looks painted
MIN_SHOWN = 0.6  # of the surface


@dataclass(frozen=True)
class SceneObject:
    """One object; ``id`` is its number in instance images, scans and meshes. Boxes are axis-aligned, world metres.

    ``size_word`` compares with the typical size of the class; ``support`` is floor, wall, ceiling, object, or room for
    parts of the room itself. ``called``: everyday name, "pile of books"; ``shows_material``: whether a
    picture shows the material; ``model``: the model that was built.
    """

    id: int
    class_id: int
    class_name: str
    colour: str
    material: str
    size_m: tuple[float, float, float]
    size_word: str
    centre: tuple[float, float, float]
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    support: str
    called: str = ""
    shows_material: bool = False
    model: str = ""

    def whole(self) -> WholeObject:
        """The object in the form from which questions are created."""
        box = np.array([self.box_min, self.box_max])
        return WholeObject(self.id, self.called, box, (self.material,) if self.shows_material else (), self.colour)


class Described(Protocol):
    """What the truth needs of a class: its id, and the everyday names of models that differ from its name."""

    @property
    def id(self) -> int: ...

    @property
    def called(self) -> Mapping[str, str]: ...


@dataclass(frozen=True)
class Relation:
    """``subject`` has the ``relation`` to ``object``; both are object ids."""

    subject: int
    relation: str
    object: int


@dataclass(frozen=True)
class SceneTruth:
    scene: str
    kind: str
    objects: tuple[SceneObject, ...]
    relations: tuple[Relation, ...]

    def by_id(self, object_id: int) -> SceneObject:
        return self.objects[object_id - 1]


def truth_of(
    scene: str, kind: str, placed: Sequence[Placed], mount: Mapping[int, str], classes: Mapping[str, Described]
) -> SceneTruth:
    """The truth of a furnished scene; ``mount``: how each object is held, by id; ``classes`` by name."""
    objects = tuple(_object(one, mount[one.id], classes[one.item.class_name]) for one in placed)
    return SceneTruth(scene, kind, objects, _relations(objects))


def _triple(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _object(placed: Placed, mount: str, known: Described) -> SceneObject:
    box, item = box_of(placed), placed.item
    support = "room" if item.class_name in STRUCTURE | OPENINGS else mount
    return SceneObject(
        placed.id, known.id, item.class_name, item.colour, item.material, _triple(item.size), item.size_word,
        _triple((box.low + box.high) / 2), _triple(box.low), _triple(box.high), support,
        known.called.get(item.model, item.class_name.replace("-", " ")), _shows_material(item), item.model,
    )  # fmt: skip


def _shows_material(item: Item) -> bool:
    """Whether most of the surface has a texture unique to this material and, for wood, a wooden colour."""
    if item.material == "wooden" and item.colour not in WOOD_COLOURS:
        return False
    area = {True: 0.0, False: 0.0}
    for part in item.parts:
        a, b, _, d = np.moveaxis(part.shape.quads, 1, 0)
        size = float(np.linalg.norm(np.cross(b - a, d - a), axis=1).sum())
        area[part.material.texture == TEXTURE_WORDS.get(item.material)] += size
    return area[True] > 0 and area[True] >= MIN_SHOWN * (area[True] + area[False])


def _relations(objects: tuple[SceneObject, ...]) -> tuple[Relation, ...]:
    boxes = np.array([(known.box_min, known.box_max) for known in objects])
    links = Relations(boxes, [known.class_name.rpartition("-")[2] for known in objects]).links()
    return tuple(Relation(objects[link.subject].id, link.relation, objects[link.object].id) for link in links)


MATERIAL = "material"


def attribute_of_object(objects: Sequence[SceneObject], variant: str) -> Int32Array:
    """The attribute (n + 1,) of every object in an aspect, by object id; 0 for none and for id 0."""
    aspect = variant.partition("-")[2]
    ids = {word: attribute_id(variant, words) for word, words in _words_of(aspect).items()}
    words = [known.material if aspect == MATERIAL else known.class_name for known in objects]
    return np.array([0, *(ids.get(word) or 0 for word in words)], np.int32)


@cache
def _words_of(aspect: str) -> Mapping[str, str]:
    """The words of each class, or material, for an aspect."""
    table = parse_toml(file_text(Path(__file__).with_name("attributes.toml")))[aspect]
    return {name: words for words, names in table.items() for name in names}
