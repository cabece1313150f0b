"""The built-in rooms in the words of ScanNet: their scan names, the categories of their classes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml

ROOM_NAME, SCAN_NAME = re.compile(r"([a-z]+)(\d{1,2})"), re.compile(r"scene9(\d)(\d\d)_00")
# The columns of scannetv2-labels.combined.tsv in the order of the release.
TABLE_COLUMNS = (
    "id", "raw_category", "category", "count", "nyu40id", "eigen13id", "nyuClass", "nyu40class", "eigen13class",
    "ModelNet40", "ModelNet10", "ShapeNetCore55", "synsetoffset", "wnsynsetid", "wnsynsetkey", "mpcat40",
    "mpcat40index",
)  # fmt: skip


@dataclass(frozen=True)
class Category:
    """A row of ScanNet's label table."""

    raw_category: str
    id: int
    nyu40id: int
    nyu40class: str


@cache
def _facts() -> Mapping[str, Any]:
    return parse_toml(file_text(Path(__file__).with_name("categories.toml")))


@cache
def categories() -> Mapping[str, Category]:
    """The category of each class of the rooms."""
    return {name: Category(*row) for name, row in _facts()["classes"].items()}


@cache
def nyu40_colours() -> tuple[tuple[int, int, int], ...]:
    """RGB of the NYU40 classes, 0 (no class) to 40."""
    return tuple((red, green, blue) for red, green, blue in _facts()["nyu40_colours"])


def scan_name(room: str) -> str:
    """The scan that a room is: kitchen7 is scene9207_00; raises ``DataError`` for a room beyond 99."""
    match = ROOM_NAME.fullmatch(room)
    if match is None or match[1] not in _facts()["kinds"]:
        raise DataError(f"rooms/{room}: has no scan name; choose a room from 0 to 99 of its kind")
    return f"scene9{_facts()['kinds'][match[1]][0]}{int(match[2]):02d}_00"


def room_of(scan: str) -> str | None:
    """The reverse of ``scan_name``; None for what is no scan of a room."""
    match = SCAN_NAME.fullmatch(scan)
    kinds = {str(digit): kind for kind, (digit, _) in _facts()["kinds"].items()}
    return f"{kinds[match[1]]}{int(match[2])}" if match is not None and match[1] in kinds else None


def scene_type(room: str) -> str:
    """What ScanNet calls a place of this kind."""
    match = ROOM_NAME.fullmatch(room)
    assert match is not None, room
    return str(_facts()["kinds"][match[1]][1])


def label_table_text() -> str:
    """``scannetv2-labels.combined.tsv`` with the categories of the rooms; columns of other vocabularies are empty."""
    rows = ["\t".join(TABLE_COLUMNS)]
    for row in sorted(set(categories().values()), key=lambda row: row.id):
        known = {"id": row.id, "raw_category": row.raw_category, "category": row.raw_category, "count": 0}
        known |= {"nyu40id": row.nyu40id, "nyu40class": row.nyu40class}
        rows.append("\t".join(str(known.get(column, "")) for column in TABLE_COLUMNS))
    return "\n".join(rows) + "\n"
