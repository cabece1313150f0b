"""The classes of the rooms, with Replica's ids, from ``classes.toml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.system.files import file_text, parse_toml


@dataclass(frozen=True)
class RoomClass:
    """``id`` and ``name`` as in Replica's info_semantic.json; ``called``: the everyday names of models with another."""

    id: int
    name: str
    called: Mapping[str, str]


CLASSES = tuple(
    RoomClass(row["id"], name, row.get("called", {}))
    for name, row in parse_toml(file_text(Path(__file__).with_name("classes.toml")))["classes"].items()
)
CLASS_BY_NAME: Mapping[str, RoomClass] = {known.name: known for known in CLASSES}
CLASS_ID: Mapping[str, int] = {known.name: known.id for known in CLASSES}
