"""Ground truth of a scan of ScanNet++, one row a vertex of ``mesh_aligned_0.05.ply``, as the official toolkit makes it.

Objects go in the order of the file. Each lays its class on its vertices, on each vertex at most three; a fourth finds
no room. ``every_semantic`` are those classes, the truth of semantic evaluation (``multilabel.max_gt`` 3). Where there
are several, that of the object that laid itself on fewest vertices stands for the vertex, of as many the first: the
truth of instance evaluation.

What the toolkit does besides, and so does this: an object whose word the benchmark does not have is passed over;
instances are numbered by their place in the file from 0, and 0 counts as none, so that the first object of a file is
never an instance.

Source: scannetpp/scannetpp at commit f3b4712, semantic/transforms/mesh.py, semantic/prep/prepare_semantic_gt.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, GroundTruth, InstanceMesh, Int32Array, Int64Array, Surface
from su3d_bench.datasets.recordings import meshes
from su3d_bench.datasets.scannetpp.annotations import (
    MASK_NAME,
    MESH_NAME,
    OBJECTS_NAME,
    SEGMENTS_NAME,
    read_mask,
    read_objects,
    read_segments,
    vertices_of_segments,
)
from su3d_bench.datasets.scannetpp.labels import BenchmarkClasses

VARIANT = "scannetpp"
TRUTH_NAMES = (MESH_NAME, MASK_NAME, SEGMENTS_NAME, OBJECTS_NAME)
MOST_CLASSES_OF_A_VERTEX = 3  # multilabel_max of the toolkit
LEFT_OUT = -1
# Ground truth is class * 1000 + instance: a larger instance would spill into the next class.
MAX_OBJECTS = 1000


@dataclass(frozen=True)
class AnnotatedScan:
    """The mesh of a scan with what lies on each vertex: ``every_class`` and ``every_object`` (V, 3), 0 for none.

    Objects are numbered by their place in the file from 1; ``chosen`` (V,) is the column that stands for the vertex.
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
    objects = read_objects(files[OBJECTS_NAME], where)
    surface = read_surface(files[MESH_NAME], None, where)
    n = len(surface.vertices)
    _check_one_mesh(segments, n, where)
    class_of = {number: classes.id_of[one.word] for number, one in enumerate(objects, 1) if one.word in classes.id_of}
    if any(number > MAX_OBJECTS and class_of[number] in classes.with_instances for number in class_of):
        raise DataError(
            f"{where}: {OBJECTS_NAME} has {len(objects)} objects; ground truth is class * 1000 + object, which cannot "
            f"tell more than {MAX_OBJECTS} apart"
        )
    members = vertices_of_segments(segments)
    every_class, every_object = (np.zeros((n, MOST_CLASSES_OF_A_VERTEX), np.int32) for _ in range(2))
    size = np.full((n, MOST_CLASSES_OF_A_VERTEX), np.inf)
    n_laid = np.zeros(n, np.int64)
    for number, class_id in class_of.items():
        vertices = members.of(objects[number - 1].segments)
        vertices = vertices[n_laid[vertices] < MOST_CLASSES_OF_A_VERTEX]
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
    """The truth of both official evaluations; vertices that they leave out have the class ``LEFT_OUT``."""
    instance = scan.object_of_vertex
    has_instance = np.isin(scan.class_of_vertex, list(scan.classes.with_instances)) & (instance > 1)
    return GroundTruth(
        scan.surface.vertices,
        np.where(scan.is_masked, LEFT_OUT, scan.class_of_vertex).astype(np.int32),
        np.where(has_instance & ~scan.is_masked, instance, 0).astype(np.int32),
        scan.classes.labels,
        VARIANT,
        f"vertices of {MESH_NAME} with the objects of {OBJECTS_NAME}, words mapped to the benchmark's classes",
        every_semantic=np.where(scan.is_masked[:, None], 0, scan.every_class).astype(np.int32),
    )


def instance_mesh(scan: AnnotatedScan) -> InstanceMesh:
    """The triangles, each with the object of most of its vertices, 0 where all three differ; walls and floors are
    objects here."""
    first, second, third = scan.object_of_vertex[scan.surface.triangles].T
    of_triangle = np.where((first == second) | (first == third), first, np.where(second == third, second, 0))
    return InstanceMesh(
        scan.surface.vertices,
        scan.surface.triangles,
        of_triangle.astype(np.int32),
        dict(scan.class_of_object),
        scan.classes.labels,
    )


def read_surface(mesh: Path, segments: Path | None, where: str) -> Surface:
    """The mesh without labels, with the published segments where their file is named."""
    surface = meshes.read_surface(mesh, f"{where}: {mesh.name}")
    if segments is None:
        return surface
    ids = read_segments(segments, where)
    _check_one_mesh(ids, len(surface.vertices), where)
    # Ids may exceed 31 bits, and only which of them are equal is of use.
    return Surface(
        surface.vertices, surface.triangles, np.unique(ids, return_inverse=True)[1].reshape(-1).astype(np.int32)
    )


def _check_one_mesh(segments: Int64Array, n_vertices: int, where: str) -> None:
    if len(segments) != n_vertices:
        raise DataError(
            f"{where}: {SEGMENTS_NAME} has {len(segments)} vertices, {MESH_NAME} has {n_vertices}; they belong to two "
            "meshes"
        )
