"""The files of OpenLex3D's release: labels of objects in tiers, prompts, and queries with their objects.

The release (``gt_openlex3d.zip``) has ``<dataset>/prompt_list.txt`` and in ``<dataset>/<scene>/`` two files of
categories, ``gt_categories.json`` by object and ``gt_categories_query_to_object_mapping_<level>.json`` by text, and
where only a part of the scene was seen ``gt_visible_cloud.pcd``; which point belongs to which object comes from the
base data. Source: openlex3d at commit 3dbad2b.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, Strict

from su3d_bench.core.errors import DataError, GroundTruthMissing, printable
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.arrays import parsed_json, read_text
from su3d_bench.formats.json_models import FileModel, checked_json
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels
from su3d_bench.metrics.open_vocabulary.score import TextQuery

PROMPTS_NAME = "prompt_list.txt"
CATEGORIES_NAME = "gt_categories.json"
VISIBLE_NAME = "gt_visible_cloud.pcd"
MAX_ID = 2**31 - 1
Content = TypeVar("Content")

Level = Literal["l0", "l1", "all"]
LEVELS: tuple[Level, ...] = ("l0", "l1", "all")  # synonyms, what depicts them, both
QUERY_LEVEL: Level = "l0"  # the level that the release evaluates unless another is asked for


def _whole_characters(text: str) -> str:
    """JSON can write halves of characters, which no encoder takes."""
    text.encode("utf-8")
    return text


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


ObjectIds = list[Annotated[int, Strict(False), Field(ge=-MAX_ID, le=MAX_ID)]]
Text = Annotated[str, AfterValidator(_whole_characters)]


class Attributes(FileModel):
    synonyms: list[Text]
    depictions: list[Text]
    vis_sim: list[Text]
    clutter: ObjectIds | None = None


class Labels(FileModel):
    image_attributes: Attributes


class Sample(FileModel):
    object_id: Annotated[int, Field(ge=-MAX_ID, le=MAX_ID)]
    labels: Labels


class Samples(FileModel):
    samples: list[Sample]


class Categories(FileModel):
    """``gt_categories.json``."""

    dataset: Samples


def read_categories(path: Path, where: str) -> dict[int, ObjectLabels]:
    """Object id -> labels, from ``dataset.samples`` of a ``gt_categories.json``."""
    labels_of: dict[int, ObjectLabels] = {}
    for sample in _read_json(path, where, Categories).dataset.samples:
        found = sample.labels.image_attributes
        tiers = tuple(found.synonyms), tuple(found.depictions), tuple(found.vis_sim)
        labels = ObjectLabels(*tiers, tuple(found.clutter or ()))
        if labels_of.setdefault(sample.object_id, labels) != labels:
            raise DataError(f"{where}: object {sample.object_id} stands there twice with other labels; keep one")
    return labels_of


def read_queries(path: Path, where: str) -> tuple[TextQuery, ...]:
    """The queries of all levels of the file, in its order: level -> text -> object ids."""
    levels = _read_json(path, where, dict[str, dict[Text, ObjectIds]])
    queries = tuple(TextQuery(text, tuple(ids)) for level in levels.values() for text, ids in level.items())
    for query in queries:
        if len(set(query.object_ids)) != len(query.object_ids):
            raise DataError(f"{where}: query '{printable(query.text, 60)}': an object stands there twice")
    return queries


def _read_json(path: Path, where: str, kind: type[Content]) -> Content:
    return checked_json(parsed_json(_read_text(path, where), where), where, kind)


def _read_text(path: Path, where: str) -> str:
    if not os.path.exists(path):  # False, too, where the system refuses to look
        raise _missing(path, where)
    return read_text(path, where)


def _missing(path: Path, where: str) -> GroundTruthMissing:
    return GroundTruthMissing(f"{where}: is not there; expected {printable(str(path), 200)}")
