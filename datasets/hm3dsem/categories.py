"""The built-in rooms in the words of HM3DSem: the names of their scenes, the categories of their classes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml

ROOM_NAME = re.compile(r"([a-z]{1,8})(\d{1,3})")
NAME_LENGTH = 11


@cache
def _facts() -> Mapping[str, Any]:
    return parse_toml(file_text(Path(__file__).with_name("categories.toml")))


def category_of(class_name: str) -> str:
    """What HM3DSem calls a class of the rooms."""
    return str(_facts()["classes"].get(class_name, class_name.replace("-", " ")))


def scene_name(room: str) -> str:
    """The scene that a room is: kitchen7 is 00000-kitchen0007; raises ``DataError`` for what has no such name.

    >>> scene_name("bathroom12")
    '00000-bathroom012'
    """
    match = ROOM_NAME.fullmatch(room)
    if match is None or match[1] not in _facts()["rooms"]:
        raise DataError(f"rooms/{room}: has no scene name; choose a room from 0 to 999 of its kind")
    return f"00000-{match[1]}{int(match[2]):0{NAME_LENGTH - len(match[1])}d}"


def room_category(room: str) -> str:
    """What HM3DSem calls a room of this kind."""
    match = ROOM_NAME.fullmatch(room)
    return str(_facts()["rooms"][match[1]]) if match else "unknown room"
