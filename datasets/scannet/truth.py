"""Ground truth of a scan, one row per vertex of ``_vh_clean_2.ply`` in file order.

As in Mask3D and OpenMask3D: an instance id is the object's id + 1, 0 if no object contains the vertex; the
class is the NYU40 id in ``_vh_clean_2.labels.ply``, or for ScanNet200 the raw id of the object's category. Classes that
unknown to a protocol stay in the ground truth and are void there.

The first release differs: its ``labels.ply`` has raw ids, which are row numbers of its own table. Classes
then come from the objects' categories, by that table or, if missing, by that of the second release. A file
has raw ids if more of its labels match the raw ids of the objects' categories in a table than their NYU40 ids;
if no table decides, if one exceeds 40. Three scans of the second release have a few labels of 50 and 149 among
those of NYU40 (ScanNet's issues 20 and 86), which are void.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, Strict, StringConstraints

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import (
    Float32Array,
    Float64Array,
    GroundTruth,
    InstanceMesh,
    Int32Array,
    Int64Array,
    LabelSet,
    Surface,
)
from su3d_bench.datasets.recordings import meshes
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.json_models import FileModel, SegmentIds, read_json
from su3d_bench.formats.ply import ListColumn, read_ply

PREFIX = "scannet."  # prefix of scene ids and file names in the second release only
# Ground truth is label * 1000 + instance, and instances are ids + 1: a larger id would overflow into the next label.
MAX_OBJECT_ID = 998


class AnnotatedObject(FileModel):
    """An object: its number in the scan, the raw category, and the ids of its segments."""

    id: Annotated[int, Strict(False), Field(ge=0, le=MAX_OBJECT_ID)]
    category: Annotated[str, StringConstraints(strip_whitespace=True)] = Field(alias="label")
    segments: SegmentIds


class ScanFile(FileModel):
    """A file that states its scan; Segmentator names it after the mesh file."""

    sceneId: str  # noqa: N815 - as in the file

    def check_scan(self, scan: str, where: str) -> None:
        if self.sceneId.removeprefix(PREFIX) not in (scan, f"{scan}_vh_clean_2"):
            raise DataError(
                f"{where}: 'sceneId' is {ascii(self.sceneId)[:80]}, not '{scan}'; this file belongs to another scan"
            )


class Segmentation(ScanFile):
    segIndices: SegmentIds  # noqa: N815 - as in the file


class Aggregation(ScanFile):
    segmentsFile: str  # noqa: N815 - as in the file
    segGroups: list[AnnotatedObject]  # noqa: N815 - as in the file


def segments_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.0.010000.segs.json"


def aggregation_name(scan: str) -> str:
    return f"{scan}.aggregation.json"


def read_segments(path: Path, scan: str, where: str) -> Int64Array:
    """The segment id of every vertex, in the order of the mesh; ``where`` begins each message."""
    content = read_json(path, f"{where}: {path.name}", Segmentation)
    content.check_scan(scan, f"{where}: {path.name}")
    return np.array(content.segIndices, np.int64)


def read_objects(path: Path, scan: str, where: str) -> list[AnnotatedObject]:
    """The objects in file order; they must refer to the segments of the decimated mesh."""
    where = f"{where}: {path.name}"
    content = read_json(path, where, Aggregation)
    content.check_scan(scan, where)
    if content.segmentsFile.removeprefix(PREFIX) != segments_name(scan):
        raise DataError(
            f"{where}: 'segmentsFile' is {ascii(content.segmentsFile)[:80]}, but {segments_name(scan)} is read; use "
            "the aggregation that belongs to it"
        )
    category_of: dict[int, str] = {}
    for entry in content.segGroups:
        if category_of.setdefault(entry.id, entry.category) != entry.category:
            raise DataError(f"{where}: object {entry.id} is listed twice, with two categories; copy the file again")
    return content.segGroups


def object_of_vertex(segments: Int64Array, objects: Sequence[AnnotatedObject]) -> Int64Array:
    """Row in ``objects`` of each vertex; -1 if its segment is in none."""
    ids, segment_rows = np.unique(segments, return_inverse=True)
    owner = np.full(len(ids), -1, np.int64)
    for row, entry in enumerate(objects):
        owner[np.isin(ids, np.array(entry.segments, np.int64))] = row
    return owner[segment_rows.reshape(-1)] if len(ids) else np.zeros(0, np.int64)


LABEL_SPACE = "scannet"
TABLE_NAME = "scannetv2-labels.combined.tsv"
FIRST_TABLE_NAME = "scannet-labels.combined.tsv"  # of the first release
CATEGORY, RAW_ID, NYU40_ID = COLUMNS = ("raw_category", "id", "nyu40id")
FIRST_COLUMNS = ("category", NYU40_ID)
MAX_RAW_ID, MAX_NYU40_ID = 65535, 40  # labels are stored as 16 bits; the released table ends at 1357


@dataclass(frozen=True)
class LabelTable:
    """``nyu40_of`` and ``raw_id_of`` map a raw category; ``name_of_id``: the first category of each raw id.

    ``name``: the file name, which identifies the release.
    """

    nyu40_of: Mapping[str, int]
    raw_id_of: Mapping[str, int]
    name_of_id: Mapping[int, str]
    name: str = TABLE_NAME


@cache
def _known_classes() -> dict[str, dict[int, str]]:
    """NYU40 with the names of nyu40class, except the benchmark's names for its 20 classes; ScanNet200."""
    tables = json.loads(file_text(Path(__file__).with_name("labels.json")))
    return {name: {int(row["id"]): str(row["name"]) for row in rows} for name, rows in tables.items()}


@cache
def nyu40_label_set() -> LabelSet:
    """The 40 classes of NYU40, including the 20 of the benchmark."""
    classes = _known_classes()["nyu40"]
    return LabelSet(LABEL_SPACE, tuple(classes), tuple(classes.values()))


def raw_label_set(table: LabelTable) -> LabelSet:
    """Every raw id of the table and of ScanNet200, whose 200 names come first and are used for no other id."""
    classes = dict(_known_classes()["scannet200"])
    taken = set(classes.values())
    for raw_id, name in sorted(table.name_of_id.items()):
        classes.setdefault(raw_id, f"{name} ({raw_id})" if name in taken else name)
    return LabelSet(LABEL_SPACE, tuple(classes), tuple(classes.values()))


def read_label_table(path: Path, where: str) -> LabelTable:
    """The table in ``path``; ``where`` begins each message.

    The first of several rows with the same category counts, as in ScanNet's scripts. Cells are stripped, and lines
    may end in CR, LF or both, even mixed. In the first release's table, a row may lack its NYU40 class.
    """
    is_first = path.name == FIRST_TABLE_NAME
    columns = FIRST_COLUMNS if is_first else COLUMNS
    where = f"{where}: {path.name}"
    text = read_text(path, where)
    lines = [(n, line) for n, line in enumerate(re.split(r"\r\n|\r|\n", text), 1) if line.strip()]
    header = [cell.strip() for cell in lines[0][1].split("\t")] if lines else []
    missing = [name for name in columns if name not in header]
    if missing:
        raise DataError(f"{where}: has no column '{missing[0]}'; expected the release's tab-separated table")
    at = [header.index(name) for name in columns]
    nyu40_of: dict[str, int] = {}
    raw_id_of: dict[str, int] = {}
    name_of_id: dict[int, str] = {}
    for row, (number, line) in enumerate(lines[1:], 1):
        cells = [cell.strip() for cell in line.split("\t")]
        if len(cells) <= max(at) or not cells[at[0]].isprintable() or not cells[at[0]]:
            raise DataError(f"{where} line {number}: has no {', '.join(columns)}; copy the file again")
        place = f"{where} line {number}"
        raw_id = row if is_first else _id_in_table(cells[at[1]], MAX_RAW_ID, f"{place}: '{RAW_ID}'")
        raw_id_of.setdefault(cells[at[0]], raw_id)
        name_of_id.setdefault(raw_id, cells[at[0]])
        if not is_first or cells[at[-1]]:
            nyu40_of.setdefault(cells[at[0]], _id_in_table(cells[at[-1]], MAX_NYU40_ID, f"{place}: '{NYU40_ID}'"))
    if not nyu40_of:
        raise DataError(f"{where}: has no rows below the header; copy the file again")
    return LabelTable(nyu40_of, raw_id_of, name_of_id, path.name)


def _id_in_table(text: str, most: int, where: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", text) or not 1 <= int(text) <= most:
        raise DataError(f"{where} is {text[:20]!r}; expected a whole number from 1 to {most}")
    return int(text)


ALIGNMENT = "axisAlignment"  # in a scan's ``<scan>.txt``
SAME_PLACE_M = 1e-3  # both files have the same mesh; text formats round coordinates
logger = logging.getLogger(__name__)


def mesh_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.ply"


def labels_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.labels.ply"


def truth_names(scan: str) -> tuple[str, ...]:
    """The files of the ground truth, except the label table."""
    return mesh_name(scan), labels_name(scan), aggregation_name(scan), segments_name(scan)


@dataclass(frozen=True)
class AnnotatedScan:
    """``vertices`` (V, 3) in the scan's frame; ``triangles`` (T, 3); ``labels`` (V,) as in ``labels.ply``;
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
        """``value_of`` each vertex's category; 0 if there is no object or entry."""
        values = [*(value_of.get(entry.category, 0) for entry in self.objects), 0]
        return np.array(values, np.int32)[self.object_of_vertex]


def read_annotated_scan(files: Mapping[str, Path], scan: str, where: str) -> AnnotatedScan:
    """The mesh of ``scan`` with its annotation; ``files`` has the path of each of ``truth_names``."""
    segments = read_segments(files[segments_name(scan)], scan, where)
    objects = read_objects(files[aggregation_name(scan)], scan, where)
    vertices, triangles = _mesh(files[mesh_name(scan)], f"{where}: {mesh_name(scan)}")
    meshes.check_one_mesh(len(segments), len(vertices), (segments_name(scan), mesh_name(scan)), where)
    labels = _labels(files[labels_name(scan)], vertices, f"{where}: {labels_name(scan)}", mesh_name(scan))
    return AnnotatedScan(where, vertices, triangles, labels, objects, object_of_vertex(segments, objects))


def read_surface(mesh: Path, segments: Path | None, scan: str, where: str) -> Surface:
    """The mesh of ``scan`` without labels, with the published segments if available."""
    vertices, triangles = _mesh(mesh, f"{where}: {mesh.name}")
    if segments is None:
        return Surface(vertices, triangles)
    ids = read_segments(segments, scan, where)
    meshes.check_one_mesh(len(ids), len(vertices), (segments_name(scan), mesh_name(scan)), where)
    return meshes.with_segments(Surface(vertices, triangles), ids)


def moved(vertices: Float32Array, motion: Float64Array) -> Float32Array:
    """``vertices`` (V, 3) transformed by a rigid ``motion`` (4, 4)."""
    return (vertices.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)


def aligned(scan: AnnotatedScan, motion: Float64Array) -> AnnotatedScan:
    """The scan transformed by a rigid ``motion`` (4, 4)."""
    return replace(scan, vertices=moved(scan.vertices, motion))


def _labels(path: Path, vertices: Float32Array, where: str, mesh: str) -> Int64Array:
    """The labels of a mesh that must match ``vertices``, vertex by vertex."""
    file = read_ply(path, where)
    labelled = meshes.vertex_positions(file, where)
    if len(labelled) != len(vertices):
        raise DataError(f"{where}: has {len(labelled)} vertices, {mesh} has {len(vertices)}; the meshes differ")
    is_elsewhere = np.abs(labelled.astype(np.float64) - vertices).max(axis=1) > SAME_PLACE_M
    if is_elsewhere.any():
        row = int(np.argmax(is_elsewhere))
        raise DataError(
            f"{where}: vertex {row} is at {labelled[row].tolist()}, in {mesh} at {vertices[row].tolist()}; they belong "
            "to different meshes"
        )
    element = file.element("vertex")
    assert element is not None
    labels = element.columns.get("label")
    if labels is None or isinstance(labels, ListColumn) or labels.dtype.kind == "f":
        raise DataError(f"{where}: vertices have no integer property 'label'; use the file of the release")
    if labels.min() < 0:
        raise DataError(f"{where}: vertex {int(np.argmin(labels))} has the label {labels.min()}; expected 0 or more")
    return labels.astype(np.int64)


def _mesh(path: Path, where: str) -> tuple[Float32Array, Int32Array]:
    """Vertices (V, 3) and triangles (T, 3) of vertex indices; no triangles if the file has no faces."""
    file = read_ply(path, where)
    vertices, element = meshes.vertex_positions(file, where), file.element("face")
    if element is None or element.n_rows == 0:
        return vertices, np.zeros((0, 3), np.int32)
    corners = meshes.face_corners(element, len(vertices), where)
    if (corners.lengths != 3).any():
        raise DataError(f"{where}: faces are not triangles in 'vertex_indices'; expected the mesh of the release")
    return vertices, corners.values.reshape(-1, 3).astype(np.int32)


def nyu40_truth(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> GroundTruth:
    """NYU40 classes; one of ``tables`` is needed only for files of the first release."""
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
    _warn_unknown_categories(scan, table)
    return GroundTruth(
        scan.vertices,
        scan.of_category(table.raw_id_of),
        scan.instance,
        raw_label_set(table),
        "scannet200-vertices",
        "vertices of _vh_clean_2.ply with the raw ids of the objects' categories in .aggregation.json",
    )


def nyu40_of_vertex(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> tuple[Int32Array, str]:
    """The NYU40 class of each vertex, 0 for none, and its source."""
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
            f"classes are in its table {FIRST_TABLE_NAME}, or {TABLE_NAME}, and neither is next to the scans"
        )
    _warn_unknown_categories(scan, table)
    return scan.of_category(table.nyu40_of), f"the NYU40 classes of the objects' categories in {table.name}"


def _warn_unknown_categories(scan: AnnotatedScan, table: LabelTable) -> None:
    """Warn with the number of categories without a row; their vertices are void."""
    unknown = [row for row, entry in enumerate(scan.objects) if entry.category not in table.nyu40_of]
    if unknown:
        categories = sorted({scan.objects[row].category for row in unknown})
        logger.warning(
            "%s: categories without a row in %s: %d (the first: %s); vertices made void: %d",
            scan.where, table.name, len(categories), ascii(categories[0][:40]),
            int(np.isin(scan.object_of_vertex, unknown).sum()),
        )  # fmt: skip


def instance_mesh(scan: AnnotatedScan, tables: Sequence[LabelTable]) -> InstanceMesh:
    """The triangles, each with the instance of most of its vertices, 0 if all three differ; NYU40 classes.

    The class of an instance is that of most of its vertices, the lowest in a tie.
    """
    if len(scan.triangles) == 0:
        raise DataError(f"{scan.where}: the mesh has no faces to project; copy _vh_clean_2.ply again")
    instance = scan.instance
    semantic, _ = nyu40_of_vertex(scan, tables)
    n_classes = MAX_NYU40_ID + 1
    ids = np.unique(instance[instance > 0])
    counts = np.bincount(instance.astype(np.int64) * n_classes + semantic, minlength=(instance.max() + 1) * n_classes)
    classes = counts.reshape(-1, n_classes)[ids].argmax(axis=1)
    return InstanceMesh(
        scan.vertices,
        scan.triangles,
        meshes.majority(instance, scan.triangles),
        {int(instance_id): int(class_id) for instance_id, class_id in zip(ids, classes, strict=True) if class_id > 0},
        nyu40_label_set(),
    )


def meta_name(scan: str) -> str:
    return f"{scan}.txt"


def read_axis_alignment(path: Path, where: str) -> Float64Array:
    """The rigid motion (4, 4) that aligns the scan with the walls; ``where`` begins each message.

    The identity if the file has no such line, as for some scans. Released meshes and poses are not aligned.
    """
    where = f"{where}: {path.name}"
    facts = {}
    for number, line in enumerate(read_text(path, where).splitlines(), 1):
        key, equals, value = line.partition("=")
        if line.strip() and not equals:
            raise DataError(f"{where} line {number}: {line.strip()[:40]!r} is not 'key = value'; copy the file again")
        facts[key.strip()] = value
    if not any(facts):
        raise DataError(f"{where}: is empty; expected lines 'key = value'")
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
