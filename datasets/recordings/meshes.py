"""PLY meshes of any dataset: vertices, faces and surfaces, checked for consistency."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, Int32Array, Int64Array, Surface
from su3d_bench.formats.ply import ListColumn, PlyElement, PlyFile, read_ply

CORNER_NAMES = ("vertex_indices", "vertex_index")


def face_corners(face: PlyElement, n_vertices: int, where: str) -> ListColumn:
    """The vertices of each polygon, all existing."""
    corners = next((face.columns[name] for name in CORNER_NAMES if name in face.columns), None)
    if not isinstance(corners, ListColumn) or corners.values.dtype.kind == "f":
        raise DataError(f"{where}: faces have no integer list 'vertex_indices'")
    is_outside = (corners.values < 0) | (corners.values >= n_vertices)
    if is_outside.any():
        first = int(np.flatnonzero(is_outside)[0])
        row = int(np.searchsorted(corners.indptr, first, side="right")) - 1
        raise DataError(
            f"{where}: face {row} uses vertex {corners.values[first]}, the mesh has {n_vertices} (0..{n_vertices - 1})"
        )
    return corners


def vertex_positions(file: PlyFile, where: str) -> Float32Array:
    """The finite vertex positions (V, 3) of a mesh, in file order."""
    vertex = file.element("vertex")
    if vertex is None or vertex.n_rows == 0:
        raise DataError(f"{where}: not a mesh; expected a non-empty element 'vertex'")
    with np.errstate(over="ignore"):
        vertices = np.stack([scalar_column(vertex, axis, where) for axis in "xyz"], axis=1).astype(np.float32)
    check_finite(vertices, where)
    return vertices


def check_finite(points: Float32Array, where: str, noun: str = "vertex") -> None:
    """Raise ``DataError`` if a point (N, 3) is not finite."""
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        raise DataError(f"{where}: {noun} {row} is at {points[row].tolist()}; copy the file again")


def scalar_column(element: PlyElement, name: str, where: str) -> NDArray[Any]:
    """One number per row of the element."""
    column = element.columns.get(name)
    if column is None or isinstance(column, ListColumn):
        raise DataError(f"{where}: element '{element.name}' has no property '{name}'")
    return column


def fans(corners: ListColumn) -> tuple[Int32Array, Int64Array]:
    """Polygons as triangles (T, 3), and the polygon of each: a quad gives (0, 1, 2), (0, 2, 3), as in habitat-sim."""
    n_triangles = np.maximum(corners.lengths - 2, 0)
    first = np.repeat(corners.indptr[:-1], n_triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(n_triangles) - n_triangles, n_triangles)
    rows = np.stack([first, first + step + 1, first + step + 2], axis=1)
    return corners.values[rows].astype(np.int32), np.repeat(np.arange(len(n_triangles)), n_triangles)


def check_one_mesh(n_segments: int, n_vertices: int, names: tuple[str, str], where: str) -> None:
    """Raise ``DataError`` if the list of segments and the mesh, called ``names``, differ in length."""
    if n_segments != n_vertices:
        raise DataError(
            f"{where}: {names[0]} has {n_segments} vertices, {names[1]} has {n_vertices}; they are of different meshes"
        )


def with_segments(surface: Surface, ids: Int64Array) -> Surface:
    """The surface with a segment number per vertex; ids may exceed 32 bits, only their equality matters."""
    return replace(surface, segments=np.unique(ids, return_inverse=True)[1].reshape(-1).astype(np.int32))


def majority(of_vertex: Int32Array, triangles: Int32Array) -> Int32Array:
    """The majority value of each triangle's (T, 3) corners; 0 if all three differ."""
    first, second, third = of_vertex[triangles].T
    same = np.where((first == second) | (first == third), first, np.where(second == third, second, 0))
    return same.astype(np.int32)


def read_surface(path: Path, where: str) -> Surface:
    """The mesh in a file, ignoring labels; ``where`` names the file and begins each message."""
    file = read_ply(path, where)
    vertices, face = vertex_positions(file, where), file.element("face")
    if face is None or face.n_rows == 0:
        raise DataError(f"{where}: has no faces; expected a mesh")
    return Surface(vertices, fans(face_corners(face, len(vertices), where))[0])
