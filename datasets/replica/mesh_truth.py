"""Ground truth of the original Replica release: habitat/mesh_semantic.ply and habitat/info_semantic.json.

``object_id`` is an instance of a *face*; vertices carry no label. Our rules, where the release has none:

- a vertex belongs to the object of most of the faces around it, the lowest id where several have as many;
- an instance id is ``object_id`` + 1, because 0 is an object in the release and none in ground truth;
- an object without entry in ``objects``, or whose class is none of the 101, is void: class 0, instance 0.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, GroundTruth, InstanceMesh, Int32Array, Int64Array
from su3d_bench.datasets.recordings.meshes import face_corners, fans, scalar_column, vertex_positions
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.ply import ListColumn, read_ply
from su3d_bench.formats.text_files import parsed_json

MESH_NAME = "habitat/mesh_semantic.ply"
INFO_NAME = "habitat/info_semantic.json"
UNDEFINED_CLASSES = (-2, -1, 0, 256)  # what the release writes where an object has no class
MAX_OBJECT_ID = 2**31 - 2
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class AnnotatedMesh:
    """``vertices`` (V, 3); ``corners`` of F polygons; ``object_of_face`` (F,) as in the file; per face its class and
    instance id (F,), 0 where void; ``class_of_instance`` of every object that has a class."""

    vertices: Float32Array
    corners: ListColumn
    object_of_face: Int64Array
    semantic_of_face: Int32Array
    instance_of_face: Int32Array
    class_of_instance: Mapping[int, int]


def read_annotated_mesh(folder: Path, where: str) -> AnnotatedMesh:
    """The mesh of the scene in ``folder``; ``where`` begins each message. Void objects are counted in a warning."""
    class_of_object = read_object_classes(folder / INFO_NAME, where)
    vertices, corners, objects = _read_mesh(folder / MESH_NAME, f"{where}: {MESH_NAME}")
    known = {number: class_id for number, class_id in class_of_object.items() if class_id in replica_label_set().ids}
    ids, face_rows = np.unique(objects, return_inverse=True)
    semantic = np.array([known.get(int(number), 0) for number in ids], np.int32)[face_rows]
    instance = np.array([int(number) + 1 if int(number) in known else 0 for number in ids], np.int32)[face_rows]
    _say_what_is_void(ids, np.bincount(face_rows, minlength=len(ids)), class_of_object, where)
    return AnnotatedMesh(
        vertices, corners, objects, semantic, instance, {number + 1: known[number] for number in sorted(known)}
    )


def read_object_classes(path: Path, where: str) -> dict[int, int]:
    """Object id -> class id as ``info_semantic.json`` has it, undefined classes included."""
    objects = read_objects(path, where)
    where = f"{where}: {INFO_NAME}"
    class_of_object: dict[int, int] = {}
    for row in objects:
        object_id, class_id = whole_number(row, "id", where), whole_number(row, "class_id", where)
        if not 0 <= object_id <= MAX_OBJECT_ID:
            raise DataError(f"{where}: an object has the id {object_id}; expected 0 to {MAX_OBJECT_ID}")
        if class_of_object.setdefault(object_id, class_id) != class_id:
            raise DataError(
                f"{where}: object {object_id} stands there twice, as class {class_of_object[object_id]} and as class "
                f"{class_id}"
            )
    return class_of_object


def read_objects(path: Path, where: str) -> list[dict[str, Any]]:
    """The rows of ``objects`` of an ``info_semantic.json`` whose classes are Replica's."""
    where = f"{where}: {INFO_NAME}"
    content = parsed_json(read_bytes(path, where), where)
    objects = _list_of_tables(content, "objects", where)
    _check_class_names(_list_of_tables(content, "classes", where), where)
    return objects


def _list_of_tables(content: Any, key: str, where: str) -> list[dict[str, Any]]:
    rows = content.get(key) if isinstance(content, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{where}: has no list '{key}' of objects; expected the file of the original release")
    return rows


def whole_number(row: dict[str, Any], key: str, where: str) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        owner = shown(row.get("id")).strip("'")
        raise DataError(f"{where}: object {owner}: '{key}' is {shown(value)}, not a whole number")
    return value


def shown(value: Any) -> str:
    """A value of a JSON file as a message may show it: short, on one line, in quotes; a list or table by its type."""
    return ascii((str(value) if value is None or isinstance(value, str | int | float) else type(value).__name__)[:40])


def _check_class_names(classes: list[dict[str, Any]], where: str) -> None:
    """The file's own class table must be Replica's: with another one every label would be wrong."""
    labels = replica_label_set()
    for row in classes:
        class_id = row.get("id")
        if class_id in labels.ids and str(row.get("name")).replace("_", "-").lower() != labels.name_of(class_id):
            raise DataError(
                f"{where}: class {class_id} is {shown(row.get('name'))}, in Replica it is "
                f"'{labels.name_of(class_id)}'; this file has other classes"
            )


def _say_what_is_void(ids: Int64Array, n_faces: Int64Array, class_of_object: Mapping[int, int], where: str) -> None:
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
    """Vertices, corners and object ids of a mesh, checked to fit each other."""
    file = read_ply(path, where)
    face = file.element("face")
    if face is None or face.n_rows == 0:
        raise DataError(f"{where}: no annotated mesh; expected elements 'vertex' and 'face' with rows")
    vertices = vertex_positions(file, where)
    corners = face_corners(face, len(vertices), where)
    if "object_id" not in face.columns:
        raise DataError(
            f"{where}: faces have no 'object_id'; a program that drops it has saved this file, take the original"
        )
    objects = scalar_column(face, "object_id", where)
    if objects.dtype.kind == "f":
        raise DataError(f"{where}: 'object_id' is of type {objects.dtype}; expected a type of whole numbers")
    return vertices, corners, objects.astype(np.int64)


def object_of_vertex(n_vertices: int, corners: ListColumn, object_of_face: Int64Array) -> Int64Array:
    """Row in ``object_of_face`` of a face whose object has most of the faces around each vertex; -1 without faces.

    The lowest object id wins where several have as many. A face that names a vertex twice counts once.
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
        f"vertices of {MESH_NAME}, each with the object of most of its faces (the lowest id among equals)",
    )


def corner_truth(mesh: AnnotatedMesh) -> GroundTruth:
    """The corners of every face, in the order of the faces: a vertex of four faces four times."""
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
