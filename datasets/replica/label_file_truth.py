"""Released text files that label the vertices of a Replica mesh, one whole number a line.

- *Instances* (``openmask3d``): ``class id * 1000 + instance``, from OpenMask3D's authors; the archives of Open-YOLO 3D
  and OpenIns3D carry them (``ground_truth/office0.txt``), the repository of OpenNeRF carries some
  (``replica_gt_instances/instance_labels_office0.txt``). How faces became vertices is not published.
- *Classes* (``ovo-51``): OpenNeRF's ``replica_gt_semantics/semantic_labels_office0.txt``, which OVO keeps as
  ``semantic_gt/office0.txt``. The numbers are Replica's own ids: ``datasets/replica.py`` of OpenNeRF (commit 3544eec)
  has 51 of them, and -1, -2 and 256 for what has no class.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float32Array, GroundTruth, Int32Array
from su3d_bench.datasets.recordings.meshes import vertex_positions
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.formats.ply import MAX_HEADER_BYTES, read_header, read_ply

INSTANCES_PER_CLASS = 1000  # ScanNet's format
BLOCK_BYTES = 1 << 20
WHOLE_NUMBER = re.compile(rb"-?\d{1,9}")
UNDEFINED_CLASS = 256  # what the release writes where an object has no class; as label of an instance it is void
CLASSLESS = (-2, -1, UNDEFINED_CLASS)
# The 51 classes of OpenNeRF's evaluation, which are those that occur in the eight scenes; see the head of this file.
OVO_CLASSES = (
    3, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 22, 23, 26, 29, 31, 34, 35, 37, 40, 44, 47, 52, 54, 56, 59, 60,
    61, 62, 63, 64, 65, 70, 71, 76, 78, 79, 80, 82, 83, 87, 88, 91, 92, 93, 95, 97, 98,
)  # fmt: skip


@dataclass(frozen=True)
class LabelledMesh:
    """A mesh whose vertices a label file may describe; ``name`` is what messages call it."""

    path: Path
    name: str


def instance_file_truth(path: Path, meshes: Sequence[LabelledMesh], where: str) -> GroundTruth:
    """Instances of a ``class id * 1000 + instance`` file on the vertices of the first of ``meshes`` that has as many.

    Values below 1000 and those of the undefined class 256 are void. Each other value is an instance, one ending in
    000 too, as ScanNet's evaluation has it; instances are numbered from 1 in the order of their values, because two
    classes may use the same number.
    """
    values, mesh = _labels_of_mesh(path, meshes, where)
    distinct, inverse = np.unique(values, return_inverse=True)
    label = distinct // INSTANCES_PER_CLASS
    if label[0] < 0:
        raise DataError(f"{where}: {path.name}: holds {distinct[0]}; expected class id * 1000 + instance, 0 or more")
    is_void = (label == 0) | (label == UNDEFINED_CLASS)
    is_foreign = ~is_void & ~np.isin(label, replica_label_set().ids)
    if is_foreign.any():
        first = int(np.argmax(is_foreign))
        raise DataError(
            f"{where}: {path.name}: {distinct[first]} is of class {label[first]}, Replica has 1 to "
            f"{replica_label_set().ids[-1]}; an instance number above {INSTANCES_PER_CLASS - 1} has spilled over, or "
            "the labels are of another dataset"
        )
    number = np.where(is_void, 0, np.cumsum(~is_void))
    if number.max() >= INSTANCES_PER_CLASS:
        raise DataError(
            f"{where}: {path.name}: holds {number.max()} instances; a scene of this format has at most "
            f"{INSTANCES_PER_CLASS - 1}"
        )
    return GroundTruth(
        _vertices(mesh, where),
        np.where(is_void, 0, label).astype(np.int32)[inverse],
        number.astype(np.int32)[inverse],
        replica_label_set(),
        "openmask3d",
        f"{path.parent.name}/{path.name}, class id * {INSTANCES_PER_CLASS} + instance of each vertex of {mesh.name}",
    )


def class_file_truth(path: Path, meshes: Sequence[LabelledMesh], where: str) -> GroundTruth:
    """Classes of a file of Replica's ids on the vertices of the first of ``meshes`` that has as many; no instances.

    Any number that is none of the 51 and does not stand for 'no class' is refused: it would mean another numbering,
    such as 0 to 50 in the order of OpenNeRF's evaluation, and every label would be wrong.
    """
    values, mesh = _labels_of_mesh(path, meshes, where)
    foreign = np.setdiff1d(values, (*OVO_CLASSES, *CLASSLESS))
    if len(foreign):
        raise DataError(
            f"{where}: {path.name}: holds the class {foreign[0]}, none of the {len(OVO_CLASSES)} Replica ids of this "
            "evaluation; a file numbered 0 to 50 must be brought back to Replica's ids first"
        )
    return GroundTruth(
        _vertices(mesh, where),
        np.where(np.isin(values, OVO_CLASSES), values, 0).astype(np.int32),
        np.zeros(len(values), np.int32),
        replica_label_set(),
        "ovo-51",
        f"{path.parent.name}/{path.name}, the class of each vertex of {mesh.name}",
    )


def _labels_of_mesh(path: Path, meshes: Sequence[LabelledMesh], where: str) -> tuple[Int32Array, LabelledMesh]:
    """The labels, and the mesh that has as many vertices; a ``DataError`` that names all counts where none has."""
    n_vertices = [_n_vertices(mesh, where) for mesh in meshes]
    if not n_vertices:
        raise DataError(
            f"{where}: {path.name}: labels the vertices of a mesh, but neither the mesh of the render nor that of the "
            "original release is here; copy one of them"
        )
    values, n_lines = read_whole_numbers(path, max(n_vertices), f"{where}: {path.name}")
    for mesh, n in zip(meshes, n_vertices, strict=True):
        if 0 < n == n_lines:
            return values, mesh
    counts = " and ".join(f"{mesh.name} {n}" for mesh, n in zip(meshes, n_vertices, strict=True))
    raise DataError(f"{where}: {path.name}: has {n_lines} labels, {counts} vertices; expected one label a vertex")


def _n_vertices(mesh: LabelledMesh, where: str) -> int:
    """As the header says it; ``_vertices`` reads and checks the chosen mesh."""
    where = f"{where}: {mesh.name}"
    with reading(where, DataError), opened(mesh.path) as file:
        header = read_header(file.read(MAX_HEADER_BYTES), where)
    return next((element.n_rows for element in header.elements if element.name == "vertex"), 0)


def _vertices(mesh: LabelledMesh, where: str) -> Float32Array:
    return vertex_positions(read_ply(mesh.path, f"{where}: {mesh.name}"), f"{where}: {mesh.name}")


def read_whole_numbers(path: Path, at_most: int, where: str) -> tuple[Int32Array, int]:
    """The numbers of a text, one a line, and how many lines it has; beyond ``at_most`` lines they are only counted.

    A line may be of any length: one without end is cut at ``BLOCK_BYTES``.
    """
    values, n_lines = array("i"), 0
    with reading(where, DataError), opened(path) as file:
        while line := file.readline(BLOCK_BYTES):
            n_lines += 1
            word = line.strip()
            if not WHOLE_NUMBER.fullmatch(word):
                shown = ascii(word[:20].decode("ascii", "replace"))
                raise DataError(f"{where}: line {n_lines} is {shown}; expected one whole number a line")
            if n_lines <= at_most:
                values.append(int(word))
    return np.array(values, np.int32), n_lines
