"""Ground truth of a scan, one row a vertex of ``_vh_clean_2.ply`` in the order of the file.

As Mask3D and OpenMask3D prepare it: an instance id is the object's id + 1, 0 where no object claims the vertex; the
class is the NYU40 id in ``_vh_clean_2.labels.ply``, or for ScanNet200 the raw id of the object's category. Classes that
a protocol does not have stay in the truth, they are void there.

The first release differs: its ``labels.ply`` holds raw ids, which are numbers of rows in a table of its own. Classes
then come from the objects' categories, by that table or, where it is not here, by that of the second release. A file
holds raw ids when more of its labels are the raw ids of the objects' categories in a table than are their NYU40 ids;
where no table tells, when one exceeds 40. Three scans of the second release have single labels of 50 and 149 among
those of NYU40 (ScanNet's issues 20 and 86), which are void.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import Float32Array, Float64Array, GroundTruth, InstanceMesh, Int32Array, Int64Array, Surface
from su3d_bench.datasets.recordings.meshes import face_corners, vertex_positions
from su3d_bench.datasets.scannet.annotations import (
    AnnotatedObject,
    aggregation_name,
    object_of_vertex,
    read_objects,
    read_segments,
    segments_name,
)
from su3d_bench.datasets.scannet.labels import (
    FIRST_TABLE_NAME,
    MAX_NYU40_ID,
    TABLE_NAME,
    LabelTable,
    nyu40_label_set,
    raw_label_set,
)
from su3d_bench.formats.ply import ListColumn, read_ply
from su3d_bench.formats.text_files import read_text

ALIGNMENT = "axisAlignment"  # in the facts of a scan, ``<scan>.txt``
SAME_PLACE_M = 1e-3  # both files hold one mesh; text formats round its coordinates
logger = logging.getLogger(__name__)


def mesh_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.ply"


def labels_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.labels.ply"


def truth_names(scan: str) -> tuple[str, ...]:
    """The files that ground truth is read from, beside the label table."""
    return mesh_name(scan), labels_name(scan), aggregation_name(scan), segments_name(scan)


@dataclass(frozen=True)
class AnnotatedScan:
    """``vertices`` (V, 3) in the scan's frame; ``triangles`` (T, 3); ``labels`` (V,) as ``labels.ply`` has them;
    ``object_of_vertex`` (V,) rows of ``objects``, -1 for none; ``where`` begins each message."""

    where: str
    vertices: Float32Array
    triangles: Int32Array
    labels: Int64Array
    objects: Sequence[AnnotatedObject]
    object_of_vertex: Int64Array

    @property
    def instance(self) -> Int32Array:
        """Instance id of each vertex, 0 for none."""
        return np.array([*(entry.id + 1 for entry in self.objects), 0], np.int32)[self.object_of_vertex]

    def of_category(self, value_of: Mapping[str, int]) -> Int32Array:
        """What ``value_of`` says of each vertex's category; 0 where no object or no entry is."""
        values = [*(value_of.get(entry.category, 0) for entry in self.objects), 0]
        return np.array(values, np.int32)[self.object_of_vertex]


def read_annotated_scan(files: Mapping[str, Path], scan: str, where: str) -> AnnotatedScan:
    """The mesh of ``scan`` with its annotation; ``files`` has the path of each of ``truth_names``."""
    segments = read_segments(files[segments_name(scan)], scan, where)
    objects = read_objects(files[aggregation_name(scan)], scan, where)
    vertices, triangles = _mesh(files[mesh_name(scan)], f"{where}: {mesh_name(scan)}")
    _check_one_mesh(segments, vertices, scan, where)
    labels = _labels(files[labels_name(scan)], vertices, f"{where}: {labels_name(scan)}", mesh_name(scan))
    return AnnotatedScan(where, vertices, triangles, labels, objects, object_of_vertex(segments, objects))


def read_surface(mesh: Path, segments: Path | None, scan: str, where: str) -> Surface:
    """The mesh of ``scan`` without labels, with the published segments where their file is there."""
    vertices, triangles = _mesh(mesh, f"{where}: {mesh.name}")
    if segments is None:
        return Surface(vertices, triangles)
    ids = read_segments(segments, scan, where)
    _check_one_mesh(ids, vertices, scan, where)
    # Ids may exceed 32 bits, and only which of them are equal is of use.
    return Surface(vertices, triangles, np.unique(ids, return_inverse=True)[1].reshape(-1).astype(np.int32))


def _check_one_mesh(segments: Int64Array, vertices: Float32Array, scan: str, where: str) -> None:
    if len(segments) != len(vertices):
        raise DataError(
            f"{where}: {segments_name(scan)} has {len(segments)} vertices, {mesh_name(scan)} has {len(vertices)}; they "
            "belong to two meshes"
        )


def moved(vertices: Float32Array, motion: Float64Array) -> Float32Array:
    """``vertices`` (V, 3) moved by a rigid ``motion`` (4, 4)."""
    return (vertices.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)


def aligned(scan: AnnotatedScan, motion: Float64Array) -> AnnotatedScan:
    """The scan moved by a rigid ``motion`` (4, 4)."""
    return replace(scan, vertices=moved(scan.vertices, motion))


def _labels(path: Path, vertices: Float32Array, where: str, mesh: str) -> Int64Array:
    """The labels of a mesh that must be the one of ``vertices``, vertex by vertex."""
    file = read_ply(path, where)
    labelled = vertex_positions(file, where)
    if len(labelled) != len(vertices):
        raise DataError(f"{where}: has {len(labelled)} vertices, {mesh} has {len(vertices)}; they belong to two meshes")
    is_elsewhere = np.abs(labelled.astype(np.float64) - vertices).max(axis=1) > SAME_PLACE_M
    if is_elsewhere.any():
        row = int(np.argmax(is_elsewhere))
        raise DataError(
            f"{where}: vertex {row} is at {labelled[row].tolist()}, in {mesh} at {vertices[row].tolist()}; they belong "
            "to two meshes"
        )
    element = file.element("vertex")
    assert element is not None
    labels = element.columns.get("label")
    if labels is None or isinstance(labels, ListColumn) or labels.dtype.kind == "f":
        raise DataError(f"{where}: vertices have no property 'label' of whole numbers; take the file of the release")
    if labels.min() < 0:
        raise DataError(f"{where}: vertex {int(np.argmin(labels))} has the label {labels.min()}; expected 0 or more")
    return labels.astype(np.int64)


def _mesh(path: Path, where: str) -> tuple[Float32Array, Int32Array]:
    """Vertices (V, 3) and rows of three of them; none where the file has no faces."""
    file = read_ply(path, where)
    vertices, element = vertex_positions(file, where), file.element("face")
    if element is None or element.n_rows == 0:
        return vertices, np.zeros((0, 3), np.int32)
    corners = face_corners(element, len(vertices), where)
    if (corners.lengths != 3).any():
        raise DataError(f"{where}: faces are no triangles of 'vertex_indices'; expected the mesh of the release")
    return vertices, corners.values.reshape(-1, 3).astype(np.int32)


def nyu40_truth(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> GroundTruth:
    """Classes of NYU40; one of ``tables`` is needed for files of the first release alone."""
    semantic, source = nyu40_of_vertex(scan, tables)
    return GroundTruth(
        scan.vertices,
        semantic,
        scan.instance,
        nyu40_label_set(),
        "nyu40-vertices",
        f"vertices of _vh_clean_2.ply with {source} and the objects of .aggregation.json",
    )


def scannet200_truth(scan: AnnotatedScan, table: LabelTable) -> GroundTruth:
    """Raw ids of the objects' categories."""
    _say_what_is_unknown(scan, table)
    return GroundTruth(
        scan.vertices,
        scan.of_category(table.raw_id_of),
        scan.instance,
        raw_label_set(table),
        "scannet200-vertices",
        "vertices of _vh_clean_2.ply with the raw ids of the objects' categories in .aggregation.json",
    )


def nyu40_of_vertex(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> tuple[Int32Array, str]:
    """The NYU40 class of each vertex, 0 for none, and where it is from."""
    is_annotated = scan.object_of_vertex >= 0
    agrees = {
        (table.name, kind): int((scan.labels == scan.of_category(value_of))[is_annotated].sum())
        for table in tables
        for kind, value_of in (("raw", table.raw_id_of), ("nyu40", table.nyu40_of))
    }
    table = max(tables, key=lambda table: agrees[table.name, "raw"], default=None)
    n_raw = 0 if table is None else agrees[table.name, "raw"]
    n_nyu40 = max((agrees[each.name, "nyu40"] for each in tables), default=0)
    if n_raw < n_nyu40 or (n_raw == n_nyu40 and scan.labels.max() <= MAX_NYU40_ID):
        semantic = np.where(scan.labels <= MAX_NYU40_ID, scan.labels, 0)
        return semantic.astype(np.int32), "the labels of _vh_clean_2.labels.ply"
    if table is None:
        raise GroundTruthMissing(
            f"{scan.where}: the labels are raw ids of the first release (the largest: {scan.labels.max()}); their "
            f"classes are in its table {FIRST_TABLE_NAME}, or {TABLE_NAME}, and neither is beside the scans"
        )
    _say_what_is_unknown(scan, table)
    return scan.of_category(table.nyu40_of), f"the NYU40 classes of the objects' categories in {table.name}"


def _say_what_is_unknown(scan: AnnotatedScan, table: LabelTable) -> None:
    """A warning that counts the categories without a row; their vertices are void."""
    unknown = [row for row, entry in enumerate(scan.objects) if entry.category not in table.nyu40_of]
    if unknown:
        categories = sorted({scan.objects[row].category for row in unknown})
        logger.warning(
            "%s: categories without a row in %s: %d (the first: %s); vertices made void: %d",
            scan.where, table.name, len(categories), ascii(categories[0][:40]),
            int(np.isin(scan.object_of_vertex, unknown).sum()),
        )  # fmt: skip


def instance_mesh(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> InstanceMesh:
    """The triangles, each with the instance of most of its vertices, 0 where all three differ; classes of NYU40.

    The class of an instance is that of most of its vertices, the lowest where several have as many.
    """
    if len(scan.triangles) == 0:
        raise DataError(f"{scan.where}: the mesh has no faces to project; copy _vh_clean_2.ply again")
    instance = scan.instance
    first, second, third = instance[scan.triangles].T
    of_triangle = np.where((first == second) | (first == third), first, np.where(second == third, second, 0))
    semantic, _ = nyu40_of_vertex(scan, tables)
    n_classes = MAX_NYU40_ID + 1
    ids = np.unique(instance[instance > 0])
    counts = np.bincount(instance.astype(np.int64) * n_classes + semantic, minlength=(instance.max() + 1) * n_classes)
    classes = counts.reshape(-1, n_classes)[ids].argmax(axis=1)
    return InstanceMesh(
        scan.vertices,
        scan.triangles,
        of_triangle.astype(np.int32),
        {int(instance_id): int(class_id) for instance_id, class_id in zip(ids, classes, strict=True) if class_id > 0},
        nyu40_label_set(),
    )


def meta_name(scan: str) -> str:
    return f"{scan}.txt"


def read_axis_alignment(path: Path, where: str) -> Float64Array:
    """The rigid motion (4, 4) from the scan's frame to one along the walls; ``where`` begins each message.

    The identity where the file has no such line, as that of some scans. Released meshes and poses are not aligned.
    """
    where = f"{where}: {path.name}"
    facts = {}
    for number, line in enumerate(read_text(path, where).splitlines(), 1):
        key, equals, value = line.partition("=")
        if line.strip() and not equals:
            raise DataError(f"{where} line {number}: {line.strip()[:40]!r} is no 'key = value'; copy the file again")
        facts[key.strip()] = value
    if not any(facts):
        raise DataError(f"{where}: holds nothing; expected lines 'key = value'")
    return np.eye(4) if ALIGNMENT not in facts else _motion(facts[ALIGNMENT], f"{where}: '{ALIGNMENT}'")


def _motion(text: str, where: str) -> Float64Array:
    words = text.split()
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where} holds {text.strip()[:40]!r}; expected 16 numbers") from error
    if len(values) != 16 or not all(math.isfinite(value) for value in values):
        raise DataError(f"{where} has {len(values)} values; expected 16 finite numbers, a row-major 4x4 matrix")
    matrix = np.array(values).reshape(4, 4)
    if not are_rigid(matrix[None])[0]:
        raise DataError(f"{where} is not a rigid motion; copy the file again")
    return matrix
