"""Ground truth of a ScanNet++ scan, one row per vertex of ``mesh_aligned_0.05.ply``, as in the official toolkit.

Objects are processed in file order. Each assigns its class to its vertices, at most three per vertex; a fourth is
dropped. ``every_semantic`` are those classes, for semantic evaluation (``multilabel.max_gt`` 3). If a vertex has
several, the object with the fewest vertices determines its class and instance, the first in a tie: the
ground truth of instance evaluation.

As in the toolkit: objects whose label is not in the benchmark are skipped;
instances are numbered by their position in the file from 0, and 0 means none, so the first object of a file is
never an instance.

Source: scannetpp/scannetpp at commit f3b4712, semantic/transforms/mesh.py, semantic/prep/prepare_semantic_gt.py.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, GroundTruth, InstanceMesh, Int32Array, Int64Array, LabelSet, Surface
from su3d_bench.datasets.recordings import meshes
from su3d_bench.datasets.recordings.recorded_frames import numbers
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.json_models import FileModel, SegmentIds, read_json

MESH_NAME = "mesh_aligned_0.05.ply"
MASK_NAME = "mesh_aligned_0.05_mask.txt"
SEGMENTS_NAME, OBJECTS_NAME = "segments.json", "segments_anno.json"
MAX_VERTEX = re.compile(r"[0-9]{1,10}")


class AnnotatedObject(FileModel):
    """An object: the label typed by the annotator, and the ids of its segments."""

    label: str
    segments: SegmentIds


class Segmentation(FileModel):
    segIndices: SegmentIds  # noqa: N815 - as in the file


class Annotation(FileModel):
    segGroups: list[AnnotatedObject]  # noqa: N815 - as in the file


def read_segments(path: Path, where: str) -> Int64Array:
    """The segment id of every vertex, in the order of the mesh; ``where`` begins each message."""
    return np.array(read_json(path, f"{where}: {path.name}", Segmentation).segIndices, np.int64)


def vertices_of_segments(segments: Int64Array) -> _Members:
    """A lookup from segment ids to the vertices in them."""
    ids, row_of_vertex = np.unique(segments, return_inverse=True)
    rows = row_of_vertex.reshape(-1)
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(ids)))]).astype(np.int64)
    return _Members(ids, starts, np.argsort(rows, kind="stable"))


@dataclass(frozen=True)
class _Members:
    ids: Int64Array
    starts: Int64Array
    vertices: Int64Array

    def of(self, segments: Int64Array) -> Int64Array:
        """The vertices in any of ``segments``; unknown segments are ignored."""
        places = np.searchsorted(self.ids, segments)
        is_known = places < len(self.ids)
        is_known[is_known] = self.ids[places[is_known]] == segments[is_known]
        rows = np.unique(places[is_known])
        lengths = self.starts[rows + 1] - self.starts[rows]
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        members: Int64Array = self.vertices[np.repeat(self.starts[rows], lengths) + within]
        return members


def read_mask(path: Path, n_vertices: int, where: str) -> BoolArray:
    """The vertices (V,) excluded by evaluations: the file lists their numbers, and may be empty."""
    where = f"{where}: {path.name}"
    is_masked = np.zeros(n_vertices, np.bool_)
    words: Sequence[str] = read_text(path, where).split()
    wrong = next((word for word in words if not MAX_VERTEX.fullmatch(word) or int(word) >= n_vertices), None)
    if wrong is not None:
        raise DataError(f"{where}: {wrong[:20]!a} is not a vertex of {MESH_NAME}, which has {n_vertices} (from 0)")
    is_masked[[int(word) for word in words]] = True
    return is_masked


BASES = ("", "scannetpp", "ScanNetPP", "ScanNet++", "scannetpp_v2", "scannetpp_v1", "scannetpp/v2", "scannetpp/v1")
LABEL_SPACE = "scannetpp"
BENCHMARK_FOLDER = "metadata/semantic_benchmark"
CLASSES_NAME, INSTANCES_NAME, MAP_NAME = LIST_NAMES = ("top100.txt", "top100_instance.txt", "map_benchmark.csv")
WORD, COUNT, TARGET = COLUMNS = ("class", "count", "semantic_map_to")
NO_CLASS = "None"  # in the mapping file: annotated, but not in the benchmark
MAX_CLASSES = 10_000
MAX_LETTERS = 200  # of the name of a class


@dataclass(frozen=True)
class BenchmarkClasses:
    """``id_of``: class id of every annotated label that the mapping sends to a benchmark class;
    ``with_instances``: the class ids of ``top100_instance.txt``."""

    labels: LabelSet
    id_of: Mapping[str, int]
    with_instances: frozenset[int]


def read_benchmark_classes(folder: Path, where: str) -> BenchmarkClasses:
    """The lists in ``folder``; ``where`` begins each message.

    A label maps to the class in its row; to nothing if that class is not listed or no row has the label.
    """
    names = _read_names(folder / CLASSES_NAME, f"{where}: {CLASSES_NAME}")
    instances = _read_names(folder / INSTANCES_NAME, f"{where}: {INSTANCES_NAME}")
    row_of = {name: row for row, name in enumerate(names, 1)}
    if unknown := [name for name in instances if name not in row_of]:
        raise DataError(f"{where}: {INSTANCES_NAME} has {unknown[0][:40]!a}, which is missing in {CLASSES_NAME}")
    target_of = _read_map(folder / MAP_NAME, f"{where}: {MAP_NAME}")
    return BenchmarkClasses(
        LabelSet(LABEL_SPACE, tuple(row_of.values()), names),
        {word: row_of[target] for word, target in target_of.items() if target in row_of},
        frozenset(row_of[name] for name in instances),
    )


def _read_names(path: Path, where: str) -> tuple[str, ...]:
    names = read_text(path, where).splitlines()
    while names and not names[-1].strip():  # blank lines at the end are not classes
        names.pop()
    for number, name in enumerate(names, 1):
        if not name.strip() or not name.isprintable() or len(name) > MAX_LETTERS:
            raise DataError(f"{where} line {number}: {name[:40]!a} is not a class name; copy the file again")
    if not 1 <= len(names) <= MAX_CLASSES:
        raise DataError(f"{where}: has {len(names)} lines; expected one per class")
    if len(set(names)) != len(names):
        twice = next(name for row, name in enumerate(names) if name in names[:row])
        raise DataError(f"{where}: has {twice[:40]!a} twice; copy the file again")
    return tuple(names)


def _read_map(path: Path, where: str) -> dict[str, str]:
    """Label -> class of each row with a count; an empty cell maps a label to itself, ``None`` to nothing."""
    text = read_text(path, where)
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({error}); copy the file again") from error
    header = rows[0] if rows else []
    if missing := [name for name in COLUMNS if name not in header]:
        raise DataError(f"{where}: has no column '{missing[0]}'; expected the mapping file of the release")
    at = {name: header.index(name) for name in COLUMNS}
    target_of: dict[str, str] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        if len(row) <= max(at.values()):
            raise DataError(f"{where} row {number}: has {len(row)} cells of {len(header)}; copy the file again")
        word, count, target = (row[at[name]] for name in COLUMNS)
        # A row counts if count >= 0, which is false for a missing count.
        if not count.strip() or not numbers([count.strip()], f"{where} row {number}: '{COUNT}'")[0] >= 0:
            continue
        if not target:
            target_of.setdefault(word, word)
        elif target != NO_CLASS:
            target_of[word] = target
    return target_of


VARIANT = "scannetpp"
TRUTH_NAMES = (MESH_NAME, MASK_NAME, SEGMENTS_NAME, OBJECTS_NAME)
MAX_CLASSES_PER_VERTEX = 3  # multilabel_max of the toolkit
LEFT_OUT = -1
# Ground truth is class * 1000 + instance: a larger instance would overflow into the next class.
MAX_OBJECTS = 1000


@dataclass(frozen=True)
class AnnotatedScan:
    """The mesh of a scan with its annotation: ``every_class`` and ``every_object`` (V, 3), 0 for none.

    Objects are numbered by their position in the file from 1; ``chosen`` (V,) is the column that counts for the vertex.
    """

    surface: Surface
    is_masked: BoolArray
    classes: BenchmarkClasses
    every_class: Int32Array
    every_object: Int32Array
    chosen: Int64Array
    class_of_object: Mapping[int, int]

    @property
    def class_of_vertex(self) -> Int32Array:
        return self._chosen(self.every_class)

    @property
    def object_of_vertex(self) -> Int32Array:
        return self._chosen(self.every_object)

    def _chosen(self, every: Int32Array) -> Int32Array:
        column: Int32Array = np.take_along_axis(every, self.chosen[:, None], axis=1)[:, 0]
        return column


def read_annotated_scan(files: Mapping[str, Path], classes: BenchmarkClasses, where: str) -> AnnotatedScan:
    """The mesh with its annotation; ``files`` has the path of each of ``TRUTH_NAMES``."""
    segments = read_segments(files[SEGMENTS_NAME], where)
    objects = read_json(files[OBJECTS_NAME], f"{where}: {OBJECTS_NAME}", Annotation).segGroups
    surface = read_surface(files[MESH_NAME], None, where)
    n = len(surface.vertices)
    meshes.check_one_mesh(len(segments), n, (SEGMENTS_NAME, MESH_NAME), where)
    class_of = {number: classes.id_of[one.label] for number, one in enumerate(objects, 1) if one.label in classes.id_of}
    if any(number > MAX_OBJECTS and class_of[number] in classes.with_instances for number in class_of):
        raise DataError(
            f"{where}: {OBJECTS_NAME} has {len(objects)} objects; ground truth is class * 1000 + object, which allows "
            f"at most {MAX_OBJECTS}"
        )
    members = vertices_of_segments(segments)
    every_class, every_object = (np.zeros((n, MAX_CLASSES_PER_VERTEX), np.int32) for _ in range(2))
    size = np.full((n, MAX_CLASSES_PER_VERTEX), np.inf)
    n_laid = np.zeros(n, np.int64)
    for number, class_id in class_of.items():
        vertices = members.of(np.array(objects[number - 1].segments, np.int64))
        vertices = vertices[n_laid[vertices] < MAX_CLASSES_PER_VERTEX]
        at = vertices, n_laid[vertices]
        every_class[at], every_object[at], size[at] = class_id, number, len(vertices)
        n_laid[vertices] += 1
    return AnnotatedScan(
        surface,
        read_mask(files[MASK_NAME], n, where),
        classes,
        every_class,
        every_object,
        size.argmin(axis=1).astype(np.int64),
        class_of,
    )


def vertex_truth(scan: AnnotatedScan) -> GroundTruth:
    """The ground truth of both official evaluations; excluded vertices have the class ``LEFT_OUT``."""
    instance = scan.object_of_vertex
    has_instance = np.isin(scan.class_of_vertex, list(scan.classes.with_instances)) & (instance > 1)
    return GroundTruth(
        scan.surface.vertices,
        np.where(scan.is_masked, LEFT_OUT, scan.class_of_vertex).astype(np.int32),
        np.where(has_instance & ~scan.is_masked, instance, 0).astype(np.int32),
        scan.classes.labels,
        VARIANT,
        f"vertices of {MESH_NAME} with the objects of {OBJECTS_NAME}, labels mapped to the benchmark's classes",
        every_semantic=np.where(scan.is_masked[:, None], 0, scan.every_class).astype(np.int32),
    )


def instance_mesh(scan: AnnotatedScan) -> InstanceMesh:
    """The triangles, each with the object of most of its vertices, 0 if all three differ; walls and floors are
    objects here."""
    return InstanceMesh(
        scan.surface.vertices,
        scan.surface.triangles,
        meshes.majority(scan.object_of_vertex, scan.surface.triangles),
        dict(scan.class_of_object),
        scan.classes.labels,
    )


def read_surface(mesh: Path, segments: Path | None, where: str) -> Surface:
    """The mesh without labels, with the published segments if their file is given."""
    surface = meshes.read_surface(mesh, f"{where}: {mesh.name}")
    if segments is None:
        return surface
    ids = read_segments(segments, where)
    meshes.check_one_mesh(len(ids), len(surface.vertices), (SEGMENTS_NAME, MESH_NAME), where)
    return meshes.with_segments(surface, ids)
