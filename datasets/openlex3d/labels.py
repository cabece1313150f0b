"""The files of OpenLex3D's release: labels of objects in tiers, prompts, and queries with their objects.

The release (``gt_openlex3d.zip``) has ``<dataset>/prompt_list.txt`` and in ``<dataset>/<scene>/`` two files of
categories, ``gt_categories.json`` by object and ``gt_categories_query_to_object_mapping_<level>.json`` by text, and
where only a part of the scene was seen ``gt_visible_cloud.pcd``; which point belongs to which object comes from the
base data. Source: openlex3d at commit 3dbad2b.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing, printable
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.arrays import parsed_json, read_text
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels
from su3d_bench.metrics.open_vocabulary.score import TextQuery

PROMPTS_NAME = "prompt_list.txt"
CATEGORIES_NAME = "gt_categories.json"
VISIBLE_NAME = "gt_visible_cloud.pcd"
MOST_ID = 2**31 - 1

Level = Literal["l0", "l1", "all"]
LEVELS: tuple[Level, ...] = ("l0", "l1", "all")  # synonyms, what depicts them, both
QUERY_LEVEL: Level = "l0"  # the level that the release evaluates unless another is asked for


def queries_name(level: Level) -> str:
    return f"gt_categories_query_to_object_mapping_{level}.json"


@dataclass(frozen=True)
class OpenLexFiles:
    """The files of one scene below ``root``; each message begins with ``<dataset>/<scene>``."""

    root: Path
    dataset: str
    scene: str

    def __post_init__(self) -> None:
        for name in (self.dataset, self.scene):
            if name in ("", ".", "..") or any(character in name for character in "/\\\0"):
                raise DataError(f"openlex3d: '{printable(name, 60)}' is no name of a dataset or scene")

    @property
    def where(self) -> str:
        return f"{self.dataset}/{self.scene}"

    def prompts(self) -> tuple[str, ...]:
        """The labels among which a method may choose, in the order of the list."""
        where = f"{self.where}: {PROMPTS_NAME}"
        return read_prompts(self.root / self.dataset / PROMPTS_NAME, where)

    def objects(self) -> dict[int, ObjectLabels]:
        """The labels of each object by its id."""
        return read_categories(self._of_scene(CATEGORIES_NAME), f"{self.where}: {CATEGORIES_NAME}")

    def queries(self, level: Level) -> tuple[TextQuery, ...]:
        """The texts of ``level`` and the objects that each speaks of."""
        return read_queries(self._of_scene(queries_name(level)), f"{self.where}: {queries_name(level)}")

    @property
    def has_visible_points(self) -> bool:
        """Whether the release says which part of the scene its images show."""
        return os.path.exists(self._of_scene(VISIBLE_NAME))

    def visible_points(self) -> Float32Array:
        """The points (N, 3) in m that the scene's images show."""
        where, path = f"{self.where}: {VISIBLE_NAME}", self._of_scene(VISIBLE_NAME)
        if not self.has_visible_points:
            raise _missing(path, where)
        with np.errstate(over="ignore"):
            points = read_pcd_points(path, where).astype(np.float32)
        if not np.isfinite(points).all():
            row = int(np.argmin(np.isfinite(points).all(axis=1)))
            raise DataError(f"{where}: point {row} is at {points[row].tolist()}; expected finite metres")
        return points

    def _of_scene(self, name: str) -> Path:
        return self.root / self.dataset / self.scene / name


def read_prompts(path: Path, where: str) -> tuple[str, ...]:
    """One prompt a line, without the white space around it."""
    text = _read_text(path, where)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").removesuffix("\n").split("\n")
    prompts = tuple(line.strip() for line in lines)
    if not any(prompts):
        raise DataError(f"{where}: has no prompt; expected one a line")
    return prompts


def read_categories(path: Path, where: str) -> dict[int, ObjectLabels]:
    """Object id -> labels, from ``dataset.samples`` of a ``gt_categories.json``."""
    content = parsed_json(_read_text(path, where), where)
    samples = _entry(_entry(content, "dataset", dict, where), "samples", list, where)
    labels_of: dict[int, ObjectLabels] = {}
    for number, sample in enumerate(samples):
        at = f"{where}: sample {number}"
        object_id = _whole_number(_entry(sample, "object_id", int, at), at)
        attributes = _entry(_entry(sample, "labels", dict, at), "image_attributes", dict, at)
        labels = ObjectLabels(
            _texts(attributes, "synonyms", at),
            _texts(attributes, "depictions", at),
            _texts(attributes, "vis_sim", at),
            _ids(attributes.get("clutter") or [], f"{at}: 'clutter'"),
        )
        if labels_of.setdefault(object_id, labels) != labels:
            raise DataError(f"{at}: object {object_id} stands there twice with other labels; keep one of them")
    return labels_of


def read_queries(path: Path, where: str) -> tuple[TextQuery, ...]:
    """The queries of all levels of the file, in its order: level -> text -> object ids."""
    queries = []
    for level, of_level in _table(parsed_json(_read_text(path, where), where), where).items():
        at = f"{where}: '{printable(level, 40)}'"
        for text, ids in _table(of_level, at).items():
            beside = f"{at}: query '{printable(text, 60)}'"
            objects = _ids(ids, beside)
            if len(set(objects)) != len(objects):
                raise DataError(f"{beside}: an object stands there twice; name each once")
            queries.append(TextQuery(_sound(text, beside), objects))
    return tuple(queries)


def _read_text(path: Path, where: str) -> str:
    if not os.path.exists(path):  # False, too, where the system refuses to look
        raise _missing(path, where)
    return read_text(path, where)


def _missing(path: Path, where: str) -> GroundTruthMissing:
    return GroundTruthMissing(f"{where}: is not there; expected {printable(str(path), 200)}")


def _table(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise DataError(f"{where}: is {_kind(value)}; expected an object")
    return value


_NAMES: dict[type, str] = {dict: "an object", list: "a list", int: "a whole number", str: "a text"}


def _entry(value: Any, key: str, kind: type, where: str) -> Any:
    """``value[key]``, which must be of ``kind``."""
    table = _table(value, where)
    if key not in table:
        raise DataError(f"{where}: has no '{key}'; expected the file of the release")
    if not isinstance(table[key], kind) or isinstance(table[key], bool):
        raise DataError(f"{where}: '{key}' is {_kind(table[key])}; expected {_NAMES[kind]}")
    return table[key]


def _texts(attributes: Mapping[str, Any], tier: str, where: str) -> tuple[str, ...]:
    words = _entry(attributes, tier, list, where)
    for word in words:
        if not isinstance(word, str):
            raise DataError(f"{where}: '{tier}' holds {_kind(word)}; expected texts")
    return tuple(_sound(word, f"{where}: '{tier}'") for word in words)


def _sound(text: str, where: str) -> str:
    """A text of whole characters: JSON can write halves of them, which no encoder takes."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise DataError(f"{where}: '{printable(text, 60)}' holds half a character; copy the file again") from error
    return text


def _ids(values: Any, where: str) -> tuple[int, ...]:
    """Object ids; the release writes some of them as texts."""
    if not isinstance(values, list):
        raise DataError(f"{where}: is {_kind(values)}; expected a list of object ids")
    return tuple(_whole_number(value, where) for value in values)


def _whole_number(value: Any, where: str) -> int:
    if isinstance(value, str) and value.isascii() and value.isdecimal() and len(value) <= 10:
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise DataError(f"{where}: an object id is {_kind(value)}; expected a whole number")
    if not -MOST_ID <= value <= MOST_ID:
        raise DataError(f"{where}: an object id is outside -{MOST_ID} to {MOST_ID}")
    return value


def _kind(value: Any) -> str:
    """What stands in a file, for messages: the value where it is short, else its kind."""
    if isinstance(value, dict | list):
        return f"{_NAMES[type(value)]} of {len(value)}"
    return printable(json.dumps(value), 40)
