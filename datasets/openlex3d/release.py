"""OpenLex3D's ground truth: the labels and queries of its release with the points of the base data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import DataError, GroundTruthMissing, PredictionError, converted
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.datasets.openlex3d.labels import (
    CATEGORIES_NAME,
    PROMPTS_NAME,
    QUERY_LEVEL,
    VISIBLE_NAME,
    Level,
    OpenLexFiles,
    queries_name,
)
from su3d_bench.datasets.recordings.meshes import vertex_positions
from su3d_bench.datasets.replica.folders import find_original_scene, original_name
from su3d_bench.datasets.replica.truth import MESH_NAME, AnnotatedMesh, read_annotated_mesh
from su3d_bench.datasets.scannetpp.truth import BASES as SCANNETPP_BASES
from su3d_bench.formats.arrays import MOST_POINTS, checked_points, kind_of
from su3d_bench.formats.json_models import FileModel, read_json
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary.openlex3d import SPACE as LABELS
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import SPACE as QUERIES
from su3d_bench.metrics.open_vocabulary.score import QueryTruth

SAMPLED_DATASET = "scannetpp"
SAMPLED_FOLDER = "prepared_semantics"  # beside data/ of ScanNet++
SAMPLED_POINTS, SAMPLED_OBJECTS = "sampled_coords", "sampled_instance_anno_id"
HOW_TO_SAMPLE = "semantic.prep.prepare_training_data of github.com/scannetpp/scannetpp writes it"
HM3D_BASES = (
    "hm3d", "hm3d/val", "hm3dsem_walks", "hm3dsem_walks/val", "HM3D", ".", "hm3dsem/val", "HM3DSem/val", "val"
)  # fmt: skip
HM3D_URL = "http://aisdatasets.cs.uni-freiburg.de/openlex3d/hm3d"
SCENE_INFO, OBJECTS_FOLDER = "scene_info.json", "objects"
MAX_OBJECTS = 2**16  # the original keeps ids in 16 bits


@dataclass(frozen=True)
class LabelledPoints:
    """``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64 as the base data numbers its objects, -1 for none.

    ``source`` says which data they are.
    """

    points: Float32Array
    object_of_point: Int64Array
    source: str


def points_of(dataset: str, data_root: Path, scene: str) -> LabelledPoints:
    """The points of a scene of ``replica``, ``scannetpp`` or ``hm3d``; ``GroundTruthMissing`` where they are not."""
    return {"replica": _of_replica, "scannetpp": _of_scannetpp, "hm3d": _of_hm3d}[dataset](data_root, scene)


# ---- Replica


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
    """The corners of all faces, a vertex of four faces four times: every object counts, with a class or without.

    The original takes a face whose object the scene's list does not have for one of object 0; here it keeps its number.
    """
    return LabelledPoints(
        mesh.vertices[mesh.corners.values],
        np.repeat(mesh.object_of_face, mesh.corners.lengths).astype(np.int64),
        f"the faces of {MESH_NAME}",
    )


# ---- ScanNet++


def sampled_points_file(data_root: Path, scene: str) -> Path | None:
    """Where the sampled points of a scene are; None where they are not."""
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
    """The points that ScanNet++'s toolbox sampled on the mesh, with the object of the nearest vertex; -100 for none."""
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


# ---- HM3D


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
    """The cloud of every object that ``scene_info.json`` names, one object after another."""
    advice = "unpack the release again"
    ids = [one.id for one in read_json(folder / SCENE_INFO, f"{where}: {SCENE_INFO}", SceneInfo, advice).objects]
    if len(set(ids)) != len(ids):
        raise DataError(f"{where}: {SCENE_INFO}: an object stands there twice; {advice}")
    clouds: list[Float32Array] = []
    n_points = 0
    for one in ids:
        path, beside = folder / OBJECTS_FOLDER / f"{one}.ply", f"{where}: {OBJECTS_FOLDER}/{one}.ply"
        if not path.is_file():
            raise DataError(f"{beside}: is not there, and {SCENE_INFO} names object {one}; {advice}")
        clouds.append(vertex_positions(read_ply(path, beside), beside))
        n_points += len(clouds[-1])
        if n_points > MOST_POINTS:
            raise DataError(f"{beside}: the scene has more than {MOST_POINTS} points; is it damaged?")
    return LabelledPoints(
        np.concatenate(clouds),
        np.repeat(np.array(ids, np.int64), [len(cloud) for cloud in clouds]),
        f"the clouds in {OBJECTS_FOLDER}",
    )


DATASETS = ("replica", "scannetpp", "hm3d")  # as the release calls them, and below the data root their own data
ALL_SEEN = ("scannetpp", "hm3d")  # whose scenes may have no cloud of visible points: all that the base data has counts
VISIBLE_RADIUS_M = 0.05  # how far the labelled point may be that says to which object a visible point belongs
VISIBLE, FACE_CORNERS = "openlex3d-visible", "openlex3d-face-corners"
FURTHER_TRUTHS: Mapping[str, str] = {LABELS: VISIBLE, QUERIES: FACE_CORNERS}  # label space -> ground truth
RELEASE_FOLDER = "gt_openlex3d"
PLACES = (RELEASE_FOLDER, f"openlex3d/{RELEASE_FOLDER}", f"OpenLex3D/{RELEASE_FOLDER}", "openlex3d", "OpenLex3D")
PAGE = "https://github.com/openlex3d/openlex3d"


def categories_truth(files: OpenLexFiles, labelled: LabelledPoints) -> OpenLexTruth:
    """The truth of ``openlex3d-topn`` and ``openlex3d-ranking``: visible points with the objects of the nearest point.

    One without a labelled point nearer than 5 cm has no object. Without a cloud of visible points a scene of
    ``ALL_SEEN`` is scored on all labelled points, as the original does.
    """
    if files.dataset in ALL_SEEN and not files.has_visible_points:
        points, objects, name = labelled.points, labelled.object_of_point, "all points"
    else:
        points, name = files.visible_points(), VISIBLE_NAME
        distance, nearest_rows = nearest(labelled.points, points, VISIBLE_RADIUS_M)
        nearest_rows[distance >= VISIBLE_RADIUS_M] = -1
        objects = np.append(labelled.object_of_point, -1)[nearest_rows]
    return OpenLexTruth(
        points,
        objects,
        files.objects(),
        files.prompts(),
        VISIBLE,
        f"{name}, {CATEGORIES_NAME} and {PROMPTS_NAME} of OpenLex3D, objects from {labelled.source}",
    )


def queries_truth(files: OpenLexFiles, labelled: LabelledPoints, level: Level) -> QueryTruth:
    """The truth of ``openlex3d-queries``: all points with their objects, seen or not."""
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
        """The datasets whose labels a folder of ground truth has; none where it is not the release."""
        return tuple(name for name in DATASETS if (folder / name / PROMPTS_NAME).is_file())

    def scenes(self) -> tuple[str, ...]:
        """The scenes with labels, in alphabetical order."""
        return tuple(sorted(path.parent.name for path in (self.folder / self.dataset).glob(f"*/{CATEGORIES_NAME}")))

    def digest(self, scene: str) -> str:
        """A key of the labels and queries of a scene; the points are those of the base data."""
        files = [self.folder / self.dataset / PROMPTS_NAME, *sorted((self.folder / self.dataset / scene).iterdir())]
        return digest_json({file.name: digest_file(file) for file in files if file.is_file()})

    def truth(self, scene: str, variant: str) -> OpenLexTruth | QueryTruth:
        """The truth of a scene; ``GroundTruthMissing`` where one of its files is not there."""
        files = OpenLexFiles(self.folder, self.dataset, scene)
        labelled = _kept_points(self.dataset, self.data_root, scene)
        if variant == VISIBLE:
            return categories_truth(files, labelled)
        return queries_truth(files, labelled, QUERY_LEVEL)


def label_files(root: Path, dataset: str, scene: str) -> tuple[Path, ...]:
    """The files of a scene's labels below the data root, sampled points too; none where the release is not there."""
    found = _find(root, dataset, scene)
    if found is None:
        return ()
    release, name = found
    folder = release.folder / dataset
    labels = sorted(path for path in (folder / name).iterdir() if path.is_file())
    points = sampled_points_file(root, name) if dataset == SAMPLED_DATASET else None
    return (folder / PROMPTS_NAME, *labels, *(() if points is None else (points,)))


def truth_below(root: Path, dataset: str, scene: str, variant: str) -> Any:
    """The truth of a dataset's scene, from the release and the base data below the data root.

    An ``OpenLexTruth`` or a ``QueryTruth``, as ``variant`` says; neither is a ``GroundTruth``.
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
    """The release below ``root`` with the labels of a scene, and what that calls it."""
    for place in PLACES:
        for name in _names(scene):
            if (root / place / dataset / name / CATEGORIES_NAME).is_file():
                return OpenLexRelease(root / place, root, dataset), name
    return None


def _names(scene: str) -> tuple[str, ...]:
    """What the release may call a scene: of HM3D's walks the number before the hyphen."""
    return tuple(dict.fromkeys((scene, scene.partition("-")[0])))


@lru_cache(maxsize=1)
def _kept_points(dataset: str, data_root: Path, scene: str) -> LabelledPoints:
    """The points of a scene; the last ones are kept, because every protocol asks for them anew."""
    return points_of(dataset, data_root, scene)
