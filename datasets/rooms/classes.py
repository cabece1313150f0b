"""The vocabulary of the rooms, from ``classes.toml``: classes with Replica's ids, their colours and materials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.procedural.materials import colours_of


@dataclass(frozen=True)
class RoomClass:
    """A class: ``id`` and ``name`` as in Replica's info_semantic.json, possible materials and models.

    ``models``: the typical volume in litres of each model that can be built; ``called``: the everyday name of a
    model that differs from its class name.
    """

    id: int
    name: str
    materials: tuple[str, ...]
    colours: tuple[str, ...]
    models: Mapping[str, float]
    called: Mapping[str, str]


_TABLE: Mapping[str, Any] = parse_toml(file_text(Path(__file__).with_name("classes.toml")))


def _room_class(name: str, row: Mapping[str, Any]) -> RoomClass:
    colours, models = colours_of(row["colours"]), row.get("models", {})
    return RoomClass(row["id"], name, tuple(row["made_of"]), colours, models, row.get("called", {}))


CLASSES = tuple(_room_class(name, row) for name, row in _TABLE["classes"].items())
CLASS_BY_NAME: Mapping[str, RoomClass] = {known.name: known for known in CLASSES}
CLASS_ID: Mapping[str, int] = {known.name: known.id for known in CLASSES}
