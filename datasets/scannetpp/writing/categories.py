"""The built-in rooms in the words of ScanNet++: their scene names, what annotators would have typed, the lists."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml
from su3d_bench.datasets.scannetpp.labels import CLASSES_NAME, INSTANCES_NAME, MAP_NAME
from su3d_bench.metrics.protocols.loading import CLASS_TABLES

ROOM_NAME, SCENE_NAME = re.compile(r"([a-z]+)(\d{1,2})"), re.compile(r"0000000(\d)(\d\d)")
MAP_COLUMNS = ("class", "count", "semantic_map_to", "instance_map_to")


@cache
def _facts() -> Mapping[str, Any]:
    return parse_toml(file_text(Path(__file__).with_name("categories.toml")))


@cache
def words() -> Mapping[str, str]:
    """What an annotator would have typed for each class of the rooms."""
    return {name: str(word) for name, (word, _) in _facts()["classes"].items()}


def scene_name(room: str) -> str:
    """The scene that a room is: kitchen7 is 0000000207; raises ``DataError`` for a room beyond 99."""
    match = ROOM_NAME.fullmatch(room)
    if match is None or match[1] not in _facts()["kinds"]:
        raise DataError(f"rooms/{room}: has no scene name; choose a room from 0 to 99 of its kind")
    return f"0000000{_facts()['kinds'][match[1]]}{int(match[2]):02d}"


def room_of(scene: str) -> str | None:
    """The reverse of ``scene_name``; None for what is no scene of a room."""
    match = SCENE_NAME.fullmatch(scene)
    kinds = {str(digit): kind for kind, digit in _facts()["kinds"].items()}
    return f"{kinds[match[1]]}{int(match[2])}" if match is not None and match[1] in kinds else None


@cache
def benchmark_names() -> tuple[str, ...]:
    """The 100 classes of the benchmark in the order of its list."""
    return tuple(str(row[1]) for row in parse_toml(file_text(CLASS_TABLES / "scannetpp-100.toml"))["classes"])


def without_instances() -> frozenset[str]:
    """The classes of the benchmark that its list of 84 leaves out."""
    return frozenset(_facts()["without_instances"])


def list_texts() -> dict[str, str]:
    """The benchmark's lists by their names; the map has the words of the rooms alone."""
    table = io.StringIO(newline="")
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(MAP_COLUMNS)
    for word, target in sorted({(word, target) for word, target in _facts()["classes"].values()}):
        rows.writerow((word, 1, target, target))
    names = benchmark_names()
    return {
        CLASSES_NAME: "".join(f"{name}\n" for name in names),
        INSTANCES_NAME: "".join(f"{name}\n" for name in names if name not in without_instances()),
        MAP_NAME: table.getvalue(),
    }
