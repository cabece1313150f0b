"""Ground truth of the original Replica release: habitat/mesh_semantic.ply and habitat/info_semantic.json.

``object_id`` is the instance of a *face*; vertices have no label. Our rules, not defined by the release:

- a vertex belongs to the object of most faces around it, the lowest id in a tie;
- an instance id is ``object_id`` + 1, because 0 is an object in the release and means none in ground truth;
- an object without entry in ``objects``, or whose class is not one of the 101, is void: class 0, instance 0.
"""

from __future__ import annotations

import logging
import re
from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import BoolArray, Float32Array, GroundTruth, InstanceMesh, Int32Array, Int64Array
from su3d_bench.datasets.recordings.meshes import check_finite, face_corners, fans, scalar_column, vertex_positions
from su3d_bench.datasets.replica.folders import FUSED_CLOUD, replica_label_set
from su3d_bench.formats.hdf5 import largest_column, read_rows
from su3d_bench.formats.json_models import FileModel, read_json
from su3d_bench.formats.ply import MAX_HEADER_BYTES, ListColumn, read_header, read_ply
from su3d_bench.formats.poses import moved, read_first_pose

MESH_NAME = "habitat/mesh_semantic.ply"
INFO_NAME = "habitat/info_semantic.json"
UNDEFINED_CLASSES = (-2, -1, 0, 256)  # written by the release if an object has no class
MAX_OBJECT_ID = 2**31 - 2
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class AnnotatedMesh:
    """``vertices`` (V, 3); ``corners`` of F polygons; ``object_of_face`` (F,) as in the file; per face its class and
    instance id (F,), 0 if void; ``class_of_instance`` of every object that has a class; ``is_listed`` (F,): whether
    the object has an entry in info_semantic.json."""

    vertices: Float32Array
    corners: ListColumn
    object_of_face: Int64Array
    semantic_of_face: Int32Array
    instance_of_face: Int32Array
    class_of_instance: Mapping[int, int]
    is_listed: BoolArray


def read_annotated_mesh(folder: Path, where: str) -> AnnotatedMesh:
    """The mesh of the scene in ``folder``; ``where`` begins each message. Void objects are counted in a warning."""
    class_of_object = read_info(folder / INFO_NAME, where).class_of_object
    vertices, corners, objects = _read_mesh(folder / MESH_NAME, f"{where}: {MESH_NAME}")
    known = {number: class_id for number, class_id in class_of_object.items() if class_id in replica_label_set().ids}
    ids, face_rows = np.unique(objects, return_inverse=True)
    semantic = np.array([known.get(int(number), 0) for number in ids], np.int32)[face_rows]
    instance = np.array([int(number) + 1 if int(number) in known else 0 for number in ids], np.int32)[face_rows]
    _warn_void_objects(ids, np.bincount(face_rows, minlength=len(ids)), class_of_object, where)
    is_listed = np.array([int(number) in class_of_object for number in ids], bool)[face_rows]
    of_instance = {number + 1: known[number] for number in sorted(known)}
    return AnnotatedMesh(vertices, corners, objects, semantic, instance, of_instance, is_listed)


class InfoClass(FileModel):
    id: int
    name: str


class InfoObject(FileModel):
    id: Annotated[int, Field(ge=0, le=MAX_OBJECT_ID)]
    class_id: int
    oriented_bbox: Any = None


class Info(FileModel):
    """``info_semantic.json``; ``class_of_object`` includes undefined classes."""

    classes: list[InfoClass]
    objects: list[InfoObject]

    @property
    def class_of_object(self) -> dict[int, int]:
        return {row.id: row.class_id for row in self.objects}


def read_info(path: Path, where: str) -> Info:
    """The table of the scene's objects. Its classes must be Replica's, otherwise every label would be wrong."""
    where, labels = f"{where}: {INFO_NAME}", replica_label_set()
    info = read_json(path, where, Info)
    for row in info.classes:
        if row.id in labels.ids and row.name.replace("_", "-").lower() != labels.name_of(row.id):
            raise DataError(
                f"{where}: class {row.id} is {row.name[:40]!a}, in Replica it is '{labels.name_of(row.id)}'; this file "
                "uses different classes"
            )
    class_of_object = info.class_of_object
    for one in info.objects:
        if (class_id := class_of_object[one.id]) != one.class_id:
            raise DataError(f"{where}: object {one.id} is listed twice, as class {one.class_id} and {class_id}")
    return info


def _warn_void_objects(ids: Int64Array, n_faces: Int64Array, class_of_object: Mapping[int, int], where: str) -> None:
    missing = [row for row, object_id in enumerate(ids) if int(object_id) not in class_of_object]
    if missing:
        logger.warning(
            "%s: object ids without entry in %s: %d (the first: %d); faces made void: %d",
            where, INFO_NAME, len(missing), ids[missing[0]], n_faces[missing].sum(),
        )  # fmt: skip
    allowed = {*replica_label_set().ids, *UNDEFINED_CLASSES}
    strange = sorted(object_id for object_id, class_id in class_of_object.items() if class_id not in allowed)
    if strange:
        logger.warning(
            "%s: objects with an unknown class id in %s: %d (the first: object %d, class %d; known: 1 to %d); "
            "faces made void: %d",
            where, INFO_NAME, len(strange), strange[0], class_of_object[strange[0]], replica_label_set().ids[-1],
            n_faces[np.isin(ids, strange)].sum(),
        )  # fmt: skip


def _read_mesh(path: Path, where: str) -> tuple[Float32Array, ListColumn, Int64Array]:
    """Vertices, corners and object ids of a mesh, checked for consistency."""
    file = read_ply(path, where)
    face = file.element("face")
    if face is None or face.n_rows == 0:
        raise DataError(f"{where}: no annotated mesh; expected elements 'vertex' and 'face' with rows")
    vertices = vertex_positions(file, where)
    corners = face_corners(face, len(vertices), where)
    if "object_id" not in face.columns:
        raise DataError(
            f"{where}: faces have no 'object_id'; the file was saved by a program that drops it, use the original"
        )
    objects = scalar_column(face, "object_id", where)
    if objects.dtype.kind == "f":
        raise DataError(f"{where}: 'object_id' is of type {objects.dtype}; expected an integer type")
    return vertices, corners, objects.astype(np.int64)


def object_of_vertex(n_vertices: int, corners: ListColumn, object_of_face: Int64Array) -> Int64Array:
    """Row in ``object_of_face`` of a face whose object has most faces around each vertex; -1 without faces.

    Ties go to the lowest object id. A face that lists a vertex twice counts once.
    """
    n_faces = len(object_of_face)
    face_of_corner = np.repeat(np.arange(n_faces), corners.lengths)
    pairs = np.unique(corners.values.astype(np.int64) * n_faces + face_of_corner)  # vertex and face, each pair once
    vertex, face = pairs // n_faces, pairs % n_faces
    ids, rows = np.unique(object_of_face, return_inverse=True)
    groups, first, counts = np.unique(vertex * len(ids) + rows[face], return_index=True, return_counts=True)
    order = np.lexsort((groups, -counts, groups // len(ids)))
    owners, best = np.unique(groups[order] // len(ids), return_index=True)
    face_of_vertex = np.full(n_vertices, -1, np.int64)
    face_of_vertex[owners] = face[first[order[best]]]
    return face_of_vertex


def vertex_truth(mesh: AnnotatedMesh) -> GroundTruth:
    """Every vertex once."""
    face = object_of_vertex(len(mesh.vertices), mesh.corners, mesh.object_of_face)
    return GroundTruth(
        mesh.vertices,
        np.where(face < 0, np.int32(0), mesh.semantic_of_face[face]),
        np.where(face < 0, np.int32(0), mesh.instance_of_face[face]),
        replica_label_set(),
        "mesh-vertices",
        f"vertices of {MESH_NAME}, each with the object of most of its faces (lowest id in a tie)",
    )


def corner_truth(mesh: AnnotatedMesh) -> GroundTruth:
    """The corners of every face in file order: a vertex of four faces appears four times."""
    n_corners = mesh.corners.lengths
    return GroundTruth(
        mesh.vertices[mesh.corners.values],
        np.repeat(mesh.semantic_of_face, n_corners),
        np.repeat(mesh.instance_of_face, n_corners),
        replica_label_set(),
        "face-corners",
        f"corners of the faces of {MESH_NAME}, in order, each with the object of its face",
    )


def triangle_mesh(mesh: AnnotatedMesh) -> InstanceMesh:
    """The polygons as fans of triangles, each with the instance of its polygon."""
    triangles, face_of_triangle = fans(mesh.corners)
    return InstanceMesh(
        mesh.vertices,
        triangles,
        mesh.instance_of_face[face_of_triangle],
        mesh.class_of_instance,
        replica_label_set(),
    )


INSTANCES_PER_CLASS = 1000  # ScanNet's format
BLOCK_BYTES = 1 << 20
WHOLE_NUMBER = re.compile(rb"-?\d{1,9}")
UNDEFINED_CLASS = 256  # written by the release if an object has no class; void as an instance label
CLASSLESS = (-2, -1, UNDEFINED_CLASS)
# The 51 classes of OpenNeRF's evaluation, those that occur in the eight scenes; see the module docstring.
OVO_CLASSES = (
    3, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 22, 23, 26, 29, 31, 34, 35, 37, 40, 44, 47, 52, 54, 56, 59, 60,
    61, 62, 63, 64, 65, 70, 71, 76, 78, 79, 80, 82, 83, 87, 88, 91, 92, 93, 95, 97, 98,
)  # fmt: skip


def instance_file_truth(path: Path, meshes: Mapping[str, Path], where: str) -> GroundTruth:
    """Instances from a ``class id * 1000 + instance`` file, for the first of ``meshes`` with as many vertices.

    Values below 1000 and the undefined class 256 are void. Each other value is an instance, including those ending in
    000, as in ScanNet's evaluation; instances are numbered from 1 in ascending order of value, because two
    classes may use the same number.
    """
    values, name = _labels_of_mesh(path, meshes, where)
    distinct, inverse = np.unique(values, return_inverse=True)
    label = distinct // INSTANCES_PER_CLASS
    if label[0] < 0:
        raise DataError(f"{where}: {path.name}: contains {distinct[0]}; expected class id * 1000 + instance, 0 or more")
    is_void = (label == 0) | (label == UNDEFINED_CLASS)
    is_foreign = ~is_void & ~np.isin(label, replica_label_set().ids)
    if is_foreign.any():
        first = int(np.argmax(is_foreign))
        raise DataError(
            f"{where}: {path.name}: {distinct[first]} is of class {label[first]}, Replica has 1 to "
            f"{replica_label_set().ids[-1]}; an instance number above {INSTANCES_PER_CLASS - 1} overflowed, or "
            "the labels belong to another dataset"
        )
    number = np.where(is_void, 0, np.cumsum(~is_void))
    if number.max() >= INSTANCES_PER_CLASS:
        raise DataError(
            f"{where}: {path.name}: has {number.max()} instances; a scene of this format has at most "
            f"{INSTANCES_PER_CLASS - 1}"
        )
    return GroundTruth(
        _vertices(meshes[name], f"{where}: {name}"),
        np.where(is_void, 0, label).astype(np.int32)[inverse],
        number.astype(np.int32)[inverse],
        replica_label_set(),
        "openmask3d",
        f"{path.parent.name}/{path.name}, class id * {INSTANCES_PER_CLASS} + instance of each vertex of {name}",
    )


def class_file_truth(path: Path, meshes: Mapping[str, Path], where: str) -> GroundTruth:
    """Classes from a file of Replica ids, for the first of ``meshes`` with as many vertices; no instances.

    A number that is not one of the 51 ids or 'no class' is rejected: it would mean another numbering,
    such as 0 to 50 in the order of OpenNeRF's evaluation, and every label would be wrong.
    """
    values, name = _labels_of_mesh(path, meshes, where)
    foreign = np.setdiff1d(values, (*OVO_CLASSES, *CLASSLESS))
    if len(foreign):
        raise DataError(
            f"{where}: {path.name}: has class {foreign[0]}, not one of the {len(OVO_CLASSES)} Replica ids of this "
            "evaluation; a file numbered 0 to 50 must be mapped back to Replica's ids first"
        )
    return GroundTruth(
        _vertices(meshes[name], f"{where}: {name}"),
        np.where(np.isin(values, OVO_CLASSES), values, 0).astype(np.int32),
        np.zeros(len(values), np.int32),
        replica_label_set(),
        "ovo-51",
        f"{path.parent.name}/{path.name}, the class of each vertex of {name}",
    )


def _labels_of_mesh(path: Path, meshes: Mapping[str, Path], where: str) -> tuple[Int32Array, str]:
    """The labels, and the name of the mesh with as many vertices; a ``DataError`` with all counts if there is none.

    ``meshes``: candidate meshes by their names in messages.
    """
    n_vertices = {name: _n_vertices(mesh, f"{where}: {name}") for name, mesh in meshes.items()}
    if not n_vertices:
        raise DataError(
            f"{where}: {path.name}: labels mesh vertices, but neither the mesh of the render nor that of the "
            "original release is available; copy one of them"
        )
    values, n_lines = read_whole_numbers(path, max(n_vertices.values()), f"{where}: {path.name}")
    name = next((name for name, n in n_vertices.items() if 0 < n == n_lines), None)
    if name is None:
        counts = " and ".join(f"{name} {n}" for name, n in n_vertices.items())
        raise DataError(f"{where}: {path.name}: has {n_lines} labels, {counts} vertices; expected one label per vertex")
    return values, name


def _n_vertices(mesh: Path, where: str) -> int:
    """As stated in the header; ``_vertices`` reads and checks the chosen mesh."""
    with reading(where, DataError), opened(mesh) as file:
        header = read_header(file.read(MAX_HEADER_BYTES), where)
    return next((element.n_rows for element in header.elements if element.name == "vertex"), 0)


def _vertices(mesh: Path, where: str) -> Float32Array:
    return vertex_positions(read_ply(mesh, where), where)


def read_whole_numbers(path: Path, at_most: int, where: str) -> tuple[Int32Array, int]:
    """The numbers of a text, one per line, and its line count; beyond ``at_most`` lines they are only counted.

    Lines may have any length: longer ones are cut at ``BLOCK_BYTES``.
    """
    values, n_lines = array("i"), 0
    with reading(where, DataError), opened(path) as file:
        while line := file.readline(BLOCK_BYTES):
            n_lines += 1
            word = line.strip()
            if not WHOLE_NUMBER.fullmatch(word):
                shown = ascii(word[:20].decode("ascii", "replace"))
                raise DataError(f"{where}: line {n_lines} is {shown}; expected one whole number per line")
            if n_lines <= at_most:
                values.append(int(word))
    return np.array(values, np.int32), n_lines


N_EMBEDDING = 102  # channel i is Replica's class i, 0 is 'other'
TRAJECTORY_NAME = "traj_w_c.txt"


def cloud_files(sequence: Path) -> tuple[Path, ...]:
    """The files of the labelled cloud that are read."""
    clouds = sequence / FUSED_CLOUD
    return sequence / TRAJECTORY_NAME, clouds / "pc_points.h5", clouds / "pc_embeddings.h5"


def conceptgraphs_truth(sequence: Path, reference: Path, where: str) -> GroundTruth:
    """The labelled cloud in the world, and the reference cloud as the points to score; no instances.

    The label of a point is the argmax of its 102 channels (first maximum): a row of zeros is 'other', id 0.
    """
    trajectory, points_file, labels_file = cloud_files(sequence)
    first_pose = read_first_pose(trajectory, f"{where}: {sequence.name}/{trajectory.name}")
    points = read_points(points_file, f"{where}: {FUSED_CLOUD}/{points_file.name}")
    labels_where = f"{where}: {FUSED_CLOUD}/{labels_file.name}"
    labels = largest_column(labels_file, N_EMBEDDING, labels_where)
    if len(labels) != len(points):
        raise DataError(
            f"{labels_where}: has {len(labels)} rows, {points_file.name} has {len(points)}; they must match"
        )
    return GroundTruth(
        moved(points, first_pose),
        labels,
        np.zeros(len(points), np.int32),
        replica_label_set(),
        "conceptgraphs",
        f"{sequence.parent.name}/{sequence.name}/{FUSED_CLOUD}, moved by the first pose of {TRAJECTORY_NAME}; scored "
        f"on the points of {'/'.join(reference.parts[-4:])}",
        evaluation_points=read_points(reference, f"{where}: {'/'.join(reference.parts[-3:])}"),
    )


def read_points(path: Path, where: str) -> Float32Array:
    """The finite points (N, 3) of a ``pc_points.h5``, at least one."""
    points = read_rows(path, 3, where)
    check_finite(points, where, "point")
    if not len(points):
        raise DataError(f"{where}: has no points; create or copy it again")
    return points
