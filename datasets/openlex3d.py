"""OpenLex3D's ground truth: labels in tiers for the objects of a scene, prompts, and queries with their objects.

The release (``gt_openlex3d.zip``) has ``<dataset>/prompt_list.txt`` and in ``<dataset>/<scene>/`` the files
``gt_categories.json``, ``gt_visible_cloud.pcd`` and ``gt_categories_query_to_object_mapping_<level>.json``; which point
belongs to which object comes from the base data. Source: openlex3d at commit 3dbad2b.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import DataError, GroundTruthMissing, printable
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.datasets.recordings.recorded_frames import parsed_json, read_text
from su3d_bench.datasets.replica.folders import find_original_scene, original_name
from su3d_bench.datasets.replica.mesh_truth import MESH_NAME, AnnotatedMesh, read_annotated_mesh
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, OpenLexTruth
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery

PROMPTS_NAME = "prompt_list.txt"
CATEGORIES_NAME = "gt_categories.json"
VISIBLE_NAME = "gt_visible_cloud.pcd"
VISIBLE_RADIUS_M = 0.05  # how far the face corner may be that says to which object a visible point belongs
MOST_ID = 2**31 - 1

Level = Literal["l0", "l1", "all"]
LEVELS: tuple[Level, ...] = ("l0", "l1", "all")  # synonyms, what depicts them, both
DATASET = "replica"  # of those that OpenLex3D labels, the one whose mesh can be read here
QUERY_LEVEL: Level = "l0"  # the level that the release evaluates unless another is asked for
VISIBLE, FACE_CORNERS = "openlex3d-visible", "openlex3d-face-corners"


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

    def visible_points(self) -> Float32Array:
        """The points (N, 3) in m that the scene's images show."""
        where, path = f"{self.where}: {VISIBLE_NAME}", self._of_scene(VISIBLE_NAME)
        if not path.exists():
            raise _missing(path, where)
        with np.errstate(over="ignore"):
            points = read_pcd_points(path, where).astype(np.float32)
        if not np.isfinite(points).all():
            row = int(np.argmin(np.isfinite(points).all(axis=1)))
            raise DataError(f"{where}: point {row} is at {points[row].tolist()}; expected finite metres")
        return points

    def _of_scene(self, name: str) -> Path:
        return self.root / self.dataset / self.scene / name


@dataclass(frozen=True)
class Corners:
    """The corners of all faces of the annotated mesh, a vertex of four faces four times.

    ``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64 as the base data numbers its objects; ``source`` says
    which mesh it is.
    """

    points: Float32Array
    object_of_point: Int64Array
    source: str


def replica_corners(mesh: AnnotatedMesh) -> Corners:
    """Of Replica: every object counts, with a class or without.

    The original takes a face whose object the scene's list does not have for one of object 0; here it keeps its number.
    """
    return Corners(
        mesh.vertices[mesh.corners.values],
        np.repeat(mesh.object_of_face, mesh.corners.lengths).astype(np.int64),
        f"the faces of {MESH_NAME}",
    )


def categories_truth(files: OpenLexFiles, corners: Corners) -> OpenLexTruth:
    """The truth of ``openlex3d-topn`` and ``openlex3d-ranking``: visible points with the objects of the nearest corner.

    A point without a corner nearer than 5 cm has no object.
    """
    points = files.visible_points()
    distance, nearest_rows = nearest(corners.points, points, VISIBLE_RADIUS_M)
    nearest_rows[distance >= VISIBLE_RADIUS_M] = -1
    return OpenLexTruth(
        points,
        np.append(corners.object_of_point, -1)[nearest_rows],
        files.objects(),
        files.prompts(),
        VISIBLE,
        f"{VISIBLE_NAME}, {CATEGORIES_NAME} and {PROMPTS_NAME} of OpenLex3D, objects from {corners.source}",
    )


def queries_truth(files: OpenLexFiles, corners: Corners, level: Level) -> QueryTruth:
    """The truth of ``openlex3d-queries``: the corners of all faces with the object of their face."""
    return QueryTruth(
        corners.points,
        corners.object_of_point,
        files.queries(level),
        FACE_CORNERS,
        f"{queries_name(level)} of OpenLex3D, objects from {corners.source}",
    )


@dataclass(frozen=True)
class OpenLexRelease:
    """The release below ``folder``, and the original release of Replica below ``data_root``."""

    folder: Path
    data_root: Path

    @staticmethod
    def is_at(folder: Path) -> bool:
        """Whether a folder of ground truth is the release."""
        return (folder / DATASET / PROMPTS_NAME).is_file()

    def scenes(self) -> tuple[str, ...]:
        """The scenes with labels, in alphabetical order."""
        return tuple(sorted(path.parent.name for path in (self.folder / DATASET).glob(f"*/{CATEGORIES_NAME}")))

    def digest(self, scene: str) -> str:
        """A key of the labels and queries of a scene; the mesh is that of Replica's release."""
        files = [self.folder / DATASET / PROMPTS_NAME, *sorted((self.folder / DATASET / scene).iterdir())]
        return digest_json({file.name: digest_file(file) for file in files if file.is_file()})

    def truth(self, scene: str, variant: str) -> OpenLexTruth | QueryTruth:
        """The truth of a scene; ``GroundTruthMissing`` where one of its files is not there."""
        files = OpenLexFiles(self.folder, DATASET, scene)
        corners = _corners(self.data_root, scene)
        if variant == VISIBLE:
            return categories_truth(files, corners)
        return queries_truth(files, corners, QUERY_LEVEL)


@lru_cache(maxsize=1)
def _corners(data_root: Path, scene: str) -> Corners:
    """The corners of a scene; the last ones are kept, because every protocol asks for them anew."""
    where = f"{DATASET}/{scene}"
    original = find_original_scene(data_root, scene)
    if original is None:
        raise GroundTruthMissing(
            f"{where}: no mesh for OpenLex3D's objects; expected {original_name(scene)}/habitat of the original "
            f"release in {data_root / 'replica_v1'}"
        )
    return replica_corners(read_annotated_mesh(original, where))


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
