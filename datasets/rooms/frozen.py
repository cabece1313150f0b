"""The rooms as stored: ``scenes/NAME.npz`` has the shapes, materials and places of every object."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.files.atomic import read_npz
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.items import Box, Item, Light, Part, Placed, box_of
from su3d_bench.datasets.procedural.materials import Material, Texture
from su3d_bench.datasets.procedural.shapes import Shape

FOLDER = Path(__file__).with_name("scenes")


@dataclass(frozen=True)
class FrozenRoom:
    """A furnished room. ``mount``: how each object is held, by id; ``size``: width, depth and height in metres."""

    kind: str
    size: tuple[float, float, float]
    lights: tuple[Light, ...]
    placed: list[Placed]
    mount: dict[int, str]

    @property
    def boxes(self) -> list[Box]:
        """Boxes of everything that is not part of the room itself."""
        return [box_of(one) for one in self.placed if self.mount[one.id] != "room"]


def read_room(scene: str) -> FrozenRoom:
    """Read a stored room.

    Its arrays: unique ``corners`` (N, 3) and ``normals`` (M, 3) in object coordinates, their rows for each quad (Q, 4),
    per part the number of its quads and its row of ``materials`` (fields of ``Material``); ``facts`` is JSON in UTF-8.
    """
    arrays = read_npz(FOLDER / f"{scene}.npz")
    facts = json.loads(arrays["facts"].tobytes())
    parts = _parts(arrays)
    placed: list[Placed] = []
    for row in facts["objects"]:
        made_of = tuple(next(parts) for _ in range(row["n_parts"]))
        words = row["class_name"], row["colour"], row["material"], row["size_word"]
        item = Item(*words, made_of, (), np.array(row["size"]), row["model"])
        placed.append(Placed(len(placed) + 1, item, row["yaw"], np.array(row["position"])))
    lights = tuple(Light(tuple(row["position"]), tuple(row["colour"]), row["radius"]) for row in facts["lights"])
    mount = {one.id: row["mount"] for one, row in zip(placed, facts["objects"], strict=True)}
    return FrozenRoom(facts["kind"], tuple(facts["size"]), lights, placed, mount)


def _parts(arrays: Mapping[str, NDArray[Any]]) -> Iterator[Part]:
    """The parts of all objects in their order."""
    quads, normals = arrays["corners"][arrays["corner_of_quad"]], arrays["normals"][arrays["normal_of_quad"]]
    materials = [_material(row) for row in arrays["materials"]]
    end = np.cumsum(arrays["n_quads_of_part"])
    for start, stop, row in zip(end - arrays["n_quads_of_part"], end, arrays["material_of_part"], strict=True):
        yield Part(Shape(quads[start:stop], normals[start:stop]), materials[row])


def _material(row: Float64Array) -> Material:
    """A material from its fields in the order of ``Material``."""
    texture, ar, ag, ab, br, bg, bb, scale, gloss, glow, axis, u0, u1, v0, v1, seed, *shares = row.tolist()
    return Material(
        Texture(int(texture)), (ar, ag, ab), (br, bg, bb), scale, gloss, glow, int(axis), (u0, u1, v0, v1), int(seed),
        *shares,
    )  # fmt: skip
