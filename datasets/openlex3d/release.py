"""OpenLex3D's ground truth: labels and queries of its release, with the points of the base data.

The release (``gt_openlex3d.zip``) has ``<dataset>/prompt_list.txt`` and in ``<dataset>/<scene>/`` two files of
categories, ``gt_categories.json`` per object and ``gt_categories_query_to_object_mapping_<level>.json`` per text, and
``gt_visible_cloud.pcd`` where only a part of the scene was seen; which point belongs to which object comes from the
base data. Source: openlex3d at commit 3dbad2b.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, Strict

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import DataError, GroundTruthMissing, PredictionError, converted, printable
from su3d_bench.core.types import BoolArray, Float32Array, Int64Array
from su3d_bench.datasets.recordings.meshes import vertex_positions
from su3d_bench.datasets.replica.folders import find_original_scene, original_name
from su3d_bench.datasets.replica.truth import MESH_NAME, AnnotatedMesh, read_annotated_mesh
from su3d_bench.datasets.scannetpp.truth import BASES as SCANNETPP_BASES
from su3d_bench.formats.arrays import MAX_POINTS, checked_points, kind_of, parsed_json, read_text
from su3d_bench.formats.json_models import FileModel, checked_json, read_json
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.metrics.matching.nearest import ball_tree, nearest_as_found
from su3d_bench.metrics.open_vocabulary.openlex3d import SPACE as LABELS
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import SPACE as QUERIES
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery

PROMPTS_NAME = "prompt_list.txt"
CATEGORIES_NAME = "gt_categories.json"
VISIBLE_NAME = "gt_visible_cloud.pcd"
MAX_ID = 2**31 - 1
Content = TypeVar("Content")

Level = Literal["l0", "l1", "all"]
LEVELS: tuple[Level, ...] = ("l0", "l1", "all")  # synonyms, depictions, both
QUERY_LEVEL: Level = "l0"  # the release's default


def _whole_characters(text: str) -> str:
    """JSON strings may contain lone surrogates, which cannot be encoded."""
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
                raise DataError(f"openlex3d: '{printable(name, 60)}' is not a dataset or scene name")

    @property
    def where(self) -> str:
        return f"{self.dataset}/{self.scene}"

    def prompts(self) -> tuple[str, ...]:
        """The labels that a method may choose from, in list order."""
        where = f"{self.where}: {PROMPTS_NAME}"
        return read_prompts(self.root / self.dataset / PROMPTS_NAME, where)

    def objects(self) -> dict[int, ObjectLabels]:
        """Object id -> labels."""
        return read_categories(self._of_scene(CATEGORIES_NAME), f"{self.where}: {CATEGORIES_NAME}")

    def queries(self, level: Level) -> tuple[TextQuery, ...]:
        """The texts of ``level`` and the objects to which each refers."""
        return read_queries(self._of_scene(queries_name(level)), f"{self.where}: {queries_name(level)}")

    @property
    def has_visible_points(self) -> bool:
        """Whether the release has the part of the scene that its images show."""
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
    """One prompt per line, stripped."""
    text = _read_text(path, where)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").removesuffix("\n").split("\n")
    prompts = tuple(line.strip() for line in lines)
    if not any(prompts):
        raise DataError(f"{where}: has no prompts; expected one per line")
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
            raise DataError(f"{where}: object {sample.object_id} is listed twice with other labels; keep one")
    return labels_of


def read_queries(path: Path, where: str) -> tuple[TextQuery, ...]:
    """The queries of all levels in file order: level -> text -> object ids."""
    levels = _read_json(path, where, dict[str, dict[Text, ObjectIds]])
    try:
        return tuple(TextQuery(text, tuple(ids)) for level in levels.values() for text, ids in level.items())
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def _read_json(path: Path, where: str, kind: type[Content]) -> Content:
    return checked_json(parsed_json(_read_text(path, where), where), where, kind)


def _read_text(path: Path, where: str) -> str:
    if not os.path.exists(path):  # also False without permission
        raise _missing(path, where)
    return read_text(path, where)


def _missing(path: Path, where: str) -> GroundTruthMissing:
    return GroundTruthMissing(f"{where}: is missing; expected {printable(str(path), 200)}")


SAMPLED_DATASET = "scannetpp"
SAMPLED_FOLDER = "prepared_semantics"  # next to ScanNet++'s data/
SAMPLED_POINTS, SAMPLED_OBJECTS = "sampled_coords", "sampled_instance_anno_id"
HOW_TO_SAMPLE = "create it with semantic.prep.prepare_training_data of github.com/scannetpp/scannetpp"
HM3D_BASES = (
    "hm3d", "hm3d/val", "hm3dsem_walks", "hm3dsem_walks/val", "HM3D", ".", "hm3dsem/val", "HM3DSem/val", "val"
)  # fmt: skip
HM3D_URL = "http://aisdatasets.cs.uni-freiburg.de/openlex3d/hm3d"
SCENE_INFO, OBJECTS_FOLDER = "scene_info.json", "objects"
MAX_OBJECTS = 2**16  # the original keeps ids in 16 bits


@dataclass(frozen=True)
class LabelledPoints:
    """``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64 object numbers of the base data, -1 for none.

    ``source`` names the data; ``is_listed`` (N,): whether the scene's list has the object.
    """

    points: Float32Array
    object_of_point: Int64Array
    source: str
    is_listed: BoolArray | bool = True


def points_of(dataset: str, data_root: Path, scene: str) -> LabelledPoints:
    """The points of a scene of ``replica``, ``scannetpp`` or ``hm3d``; ``GroundTruthMissing`` if unavailable."""
    return {"replica": _of_replica, "scannetpp": _of_scannetpp, "hm3d": _of_hm3d}[dataset](data_root, scene)


def _of_replica(data_root: Path, scene: str) -> LabelledPoints:
    where = f"replica/{scene}"
    original = find_original_scene(data_root, scene)
    if original is None:
        raise GroundTruthMissing(
            f"{where}: no mesh for OpenLex3D's objects; expected {original_name(scene)}/habitat of the original "
            f"release in {data_root / 'replica_v1'}"
        )
    return face_corners_of(read_annotated_mesh(original, where))


def face_corners_of(mesh: AnnotatedMesh) -> LabelledPoints:
    """The corners of all faces (a vertex of four faces four times); every object counts, with or without a class."""
    return LabelledPoints(
        mesh.vertices[mesh.corners.values],
        np.repeat(mesh.object_of_face, mesh.corners.lengths).astype(np.int64),
        f"the faces of {MESH_NAME}",
        np.repeat(mesh.is_listed, mesh.corners.lengths),
    )


def sampled_points_file(data_root: Path, scene: str) -> Path | None:
    """Path of the sampled points of a scene; None if missing."""
    name = f"{SAMPLED_FOLDER}/{scene}.pth"
    return next((file for base in SCANNETPP_BASES if (file := data_root / base / name).is_file()), None)


def _of_scannetpp(data_root: Path, scene: str) -> LabelledPoints:
    path = sampled_points_file(data_root, scene)
    if path is None:
        raise GroundTruthMissing(
            f"scannetpp/{scene}: no points for OpenLex3D's objects; expected {SAMPLED_FOLDER}/{scene}.pth in "
            f"{data_root / 'scannetpp'}, {HOW_TO_SAMPLE}"
        )
    return read_sampled_points(path, f"scannetpp/{scene}: {path.name}")


def read_sampled_points(path: Path, where: str) -> LabelledPoints:
    """The points that ScanNet++'s toolbox sampled on the mesh, with the nearest vertex's object; -100 for none."""
    with converted(PredictionError, DataError):
        content = read_torch(path)
        if not isinstance(content, dict) or not {SAMPLED_POINTS, SAMPLED_OBJECTS} <= set(content):
            raise DataError(f"{where}: has no '{SAMPLED_POINTS}' with '{SAMPLED_OBJECTS}'; {HOW_TO_SAMPLE}")
        points = checked_points(content[SAMPLED_POINTS], where)
    objects = content[SAMPLED_OBJECTS]
    if not isinstance(objects, np.ndarray) or objects.shape != (len(points),) or objects.dtype.kind not in "iu":
        raise DataError(
            f"{where}: '{SAMPLED_OBJECTS}' is {kind_of(objects)}; expected one whole number for each of the "
            f"{len(points)} points"
        )
    if not len(points):
        raise DataError(f"{where}: has no points; {HOW_TO_SAMPLE}")
    return LabelledPoints(points, np.maximum(objects.astype(np.int64), -1), f"the sampled points in {SAMPLED_FOLDER}")


def _of_hm3d(data_root: Path, scene: str) -> LabelledPoints:
    folders = [
        folder
        for base in HM3D_BASES
        for folder in (data_root / base / scene, *sorted((data_root / base).glob(f"{scene}-*")))
        if (folder / SCENE_INFO).is_file()
    ]
    if not folders:
        raise GroundTruthMissing(
            f"hm3d/{scene}: no points for OpenLex3D's objects; expected {scene}/{SCENE_INFO} and "
            f"{scene}/{OBJECTS_FOLDER} in {data_root / 'hm3d'}; they are in {HM3D_URL}/{scene}.zip"
        )
    return read_object_clouds(folders[0], f"hm3d/{scene}")


class CloudObject(FileModel):
    id: Annotated[int, Field(ge=0, lt=MAX_OBJECTS)]


class SceneInfo(FileModel):
    objects: Annotated[list[CloudObject], Field(min_length=1)]


def read_object_clouds(folder: Path, where: str) -> LabelledPoints:
    """The clouds of all objects in ``scene_info.json``, concatenated."""
    advice = "unpack the release again"
    ids = [one.id for one in read_json(folder / SCENE_INFO, f"{where}: {SCENE_INFO}", SceneInfo, advice).objects]
    if len(set(ids)) != len(ids):
        raise DataError(f"{where}: {SCENE_INFO}: an object is listed twice; {advice}")
    clouds: list[Float32Array] = []
    n_points = 0
    for one in ids:
        path, beside = folder / OBJECTS_FOLDER / f"{one}.ply", f"{where}: {OBJECTS_FOLDER}/{one}.ply"
        if not path.is_file():
            raise DataError(f"{beside}: is missing, but {SCENE_INFO} lists object {one}; {advice}")
        clouds.append(vertex_positions(read_ply(path, beside), beside))
        n_points += len(clouds[-1])
        if n_points > MAX_POINTS:
            raise DataError(f"{beside}: the scene has more than {MAX_POINTS} points; check for damage")
    return LabelledPoints(
        np.concatenate(clouds),
        np.repeat(np.array(ids, np.int64), [len(cloud) for cloud in clouds]),
        f"the clouds in {OBJECTS_FOLDER}",
    )


DATASETS = ("replica", "scannetpp", "hm3d")  # names in the release, and of the base data's folders below the data root
ALL_SEEN = ("scannetpp", "hm3d")  # scenes may lack a cloud of visible points: all base points count
VISIBLE_RADIUS_M = 0.05  # maximum distance from a visible point to the labelled point that gives its object
VISIBLE, FACE_CORNERS = "openlex3d-visible", "openlex3d-face-corners"
EXTRA_GROUND_TRUTHS: Mapping[str, str] = {LABELS: VISIBLE, QUERIES: FACE_CORNERS}  # label space -> ground truth
RELEASE_FOLDER = "gt_openlex3d"
PLACES = (RELEASE_FOLDER, f"openlex3d/{RELEASE_FOLDER}", f"OpenLex3D/{RELEASE_FOLDER}", "openlex3d", "OpenLex3D")
PAGE = "https://github.com/openlex3d/openlex3d"


def categories_truth(files: OpenLexFiles, labelled: LabelledPoints) -> OpenLexTruth:
    """Ground truth of ``openlex3d-topn`` and ``openlex3d-ranking``: visible points with the nearest point's object.

    Points without a labelled point within 5 cm have no object. Without a cloud of visible points, a scene of
    ``ALL_SEEN`` is scored on all labelled points, as the original does. Objects that the scene's list lacks are object
    0 here, though not in queries, also as in the original.
    """
    objects = np.where(labelled.is_listed, labelled.object_of_point, 0)
    if files.dataset in ALL_SEEN and not files.has_visible_points:
        points, name = labelled.points, "all points"
    else:
        points, name = files.visible_points(), VISIBLE_NAME
        distance, rows, _ = nearest_as_found(ball_tree, labelled.points, objects, points, VISIBLE_RADIUS_M)
        rows[distance >= VISIBLE_RADIUS_M] = -1
        objects = np.append(objects, -1)[rows]
    return OpenLexTruth(
        points,
        objects,
        files.objects(),
        files.prompts(),
        VISIBLE,
        f"{name}, {CATEGORIES_NAME} and {PROMPTS_NAME} of OpenLex3D, objects from {labelled.source}",
    )


def queries_truth(files: OpenLexFiles, labelled: LabelledPoints, level: Level) -> QueryTruth:
    """Ground truth of ``openlex3d-queries``: all points with their objects, visible or not."""
    return QueryTruth(
        labelled.points,
        labelled.object_of_point,
        files.queries(level),
        FACE_CORNERS,
        f"{queries_name(level)} of OpenLex3D, objects from {labelled.source}",
    )


@dataclass(frozen=True)
class OpenLexRelease:
    """The labels of ``dataset`` in the release below ``folder``, and its base data below ``data_root``."""

    folder: Path
    data_root: Path
    dataset: str

    @staticmethod
    def datasets_at(folder: Path) -> tuple[str, ...]:
        """The datasets with labels in a ground-truth folder; none if it is not the release."""
        return tuple(name for name in DATASETS if (folder / name / PROMPTS_NAME).is_file())

    def scenes(self) -> tuple[str, ...]:
        """The scenes with labels, in alphabetical order."""
        return tuple(sorted(path.parent.name for path in (self.folder / self.dataset).glob(f"*/{CATEGORIES_NAME}")))

    def digest(self, scene: str) -> str:
        """A key of the labels and queries of a scene; the points are those of the base data."""
        files = [self.folder / self.dataset / PROMPTS_NAME, *sorted((self.folder / self.dataset / scene).iterdir())]
        return digest_json({file.name: digest_file(file) for file in files if file.is_file()})

    def truth(self, scene: str, variant: str) -> OpenLexTruth | QueryTruth:
        """The ground truth of a scene; ``GroundTruthMissing`` if one of its files is missing."""
        files = OpenLexFiles(self.folder, self.dataset, scene)
        labelled = points_of(self.dataset, self.data_root, scene)
        if variant == VISIBLE:
            return categories_truth(files, labelled)
        return queries_truth(files, labelled, QUERY_LEVEL)


def label_files(root: Path, dataset: str, scene: str) -> tuple[Path, ...]:
    """The files of a scene's labels below the data root, including sampled points; none without the release."""
    found = _find(root, dataset, scene)
    if found is None:
        return ()
    release, name = found
    folder = release.folder / dataset
    labels = sorted(path for path in (folder / name).iterdir() if path.is_file())
    points = sampled_points_file(root, name) if dataset == SAMPLED_DATASET else None
    return (folder / PROMPTS_NAME, *labels, *(() if points is None else (points,)))


def truth_below(root: Path, dataset: str, scene: str, variant: str) -> Any:
    """The ground truth of a dataset's scene, from the release and the base data below the data root.

    An ``OpenLexTruth`` or a ``QueryTruth``, depending on ``variant``; neither is a ``GroundTruth``.
    """
    found = _find(root, dataset, scene)
    if found is None:
        raise GroundTruthMissing(
            f"{dataset}/{scene}: no ground truth '{variant}'; expected {RELEASE_FOLDER}/{dataset}/{_names(scene)[-1]}/"
            f"{CATEGORIES_NAME} of OpenLex3D ({PAGE}) in {root}"
        )
    release, name = found
    return release.truth(name, variant)


def _find(root: Path, dataset: str, scene: str) -> tuple[OpenLexRelease, str] | None:
    """The release below ``root`` that has labels of a scene, and the scene's name in it."""
    for place in PLACES:
        for name in _names(scene):
            if (root / place / dataset / name / CATEGORIES_NAME).is_file():
                return OpenLexRelease(root / place, root, dataset), name
    return None


def _names(scene: str) -> tuple[str, ...]:
    """Possible names of a scene in the release: for HM3D walks, the number before the hyphen."""
    return tuple(dict.fromkeys((scene, scene.partition("-")[0])))
