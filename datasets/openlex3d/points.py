"""The points of the scenes that OpenLex3D labels, each with its object, from the base data below the data root.

Replica: the corners of all faces of the annotated mesh. ScanNet++: points that its toolbox sampled on the mesh. HM3D:
the cloud of each object in the release of the walks. Source: openlex3d/datasets of openlex3d at commit 3dbad2b.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing, PredictionError, converted
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.datasets.recordings.meshes import vertex_positions
from su3d_bench.datasets.replica.folders import find_original_scene, original_name
from su3d_bench.datasets.replica.mesh_truth import MESH_NAME, AnnotatedMesh, read_annotated_mesh
from su3d_bench.datasets.scannetpp.labels import BASES as SCANNETPP_BASES
from su3d_bench.formats.arrays import MOST_POINTS, checked_points, kind_of
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.text_files import parsed_json, read_text
from su3d_bench.formats.torch_files import read_torch

SAMPLED_DATASET = "scannetpp"
SAMPLED_FOLDER = "prepared_semantics"  # beside data/ of ScanNet++
SAMPLED_POINTS, SAMPLED_OBJECTS = "sampled_coords", "sampled_instance_anno_id"
HOW_TO_SAMPLE = "semantic.prep.prepare_training_data of github.com/scannetpp/scannetpp writes it"
HM3D_BASES = (
    "hm3d", "hm3d/val", "hm3dsem_walks", "hm3dsem_walks/val", "HM3D", ".", "hm3dsem/val", "HM3DSem/val", "val"
)  # fmt: skip
HM3D_URL = "http://aisdatasets.cs.uni-freiburg.de/openlex3d/hm3d"
SCENE_INFO, OBJECTS_FOLDER = "scene_info.json", "objects"
MOST_OBJECTS = 2**16  # the original keeps ids in 16 bits


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


def read_object_clouds(folder: Path, where: str) -> LabelledPoints:
    """The cloud of every object that ``scene_info.json`` names, one object after another."""
    ids = _object_ids(folder / SCENE_INFO, f"{where}: {SCENE_INFO}")
    clouds: list[Float32Array] = []
    n_points = 0
    for one in ids:
        path, beside = folder / OBJECTS_FOLDER / f"{one}.ply", f"{where}: {OBJECTS_FOLDER}/{one}.ply"
        if not path.is_file():
            raise DataError(f"{beside}: is not there, and {SCENE_INFO} names object {one}; unpack the release again")
        clouds.append(vertex_positions(read_ply(path, beside), beside))
        n_points += len(clouds[-1])
        if n_points > MOST_POINTS:
            raise DataError(f"{beside}: the scene has more than {MOST_POINTS} points; is it damaged?")
    return LabelledPoints(
        np.concatenate(clouds),
        np.repeat(np.array(ids, np.int64), [len(cloud) for cloud in clouds]),
        f"the clouds in {OBJECTS_FOLDER}",
    )


def _object_ids(path: Path, where: str) -> list[int]:
    content = parsed_json(read_text(path, where), where)
    objects = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(objects, list) or not objects:
        raise DataError(f"{where}: has no list 'objects' with entries; unpack the release again")
    ids: dict[int, None] = {}
    for number, entry in enumerate(objects):
        one = entry.get("id") if isinstance(entry, dict) else None
        if isinstance(one, bool) or not isinstance(one, int) or not 0 <= one < MOST_OBJECTS:
            raise DataError(
                f"{where}: object {number} has no 'id' from 0 to {MOST_OBJECTS - 1}; unpack the release again"
            )
        if one in ids:
            raise DataError(f"{where}: object {one} stands there twice; unpack the release again")
        ids[one] = None
    return list(ids)
