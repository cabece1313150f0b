"""The ground-truth surface of a scene as scanned along the trajectory; and the cached data of a scene."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import DAMAGE, filling, read_arrays
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array
from su3d_bench.datasets.procedural.rendering.mesh import Grid, Patches, SceneMesh, at_rows, caster, cut, merge_equal
from su3d_bench.datasets.procedural.rendering.render import Renderer, camera_intrinsics
from su3d_bench.numerics.open3d_core import compiled_open3d

VIEW_WIDTH, VIEW_HEIGHT = 160, 120  # of the depth images that decide what is visible: 1 cm per pixel at 1 m
COARSE_STRIDE = 40  # frames are visited at this stride first, so that the first few decide most faces


@dataclass(frozen=True)
class SceneScan:
    """``vertices`` (V, 3) m, ``normals`` (V, 3) unit, ``colours`` (V, 3); ``faces`` (F, 4) quads, ``object_id`` (F,).

    No vertex belongs to two objects.
    """

    vertices: Float32Array
    normals: Float32Array
    colours: UInt8Array
    faces: Int32Array
    object_id: Int32Array

    def object_of_vertex(self) -> Int32Array:
        owner = np.zeros(len(self.vertices), np.int32)
        owner[self.faces] = self.object_id[:, None]
        return owner


def scan_scene(
    patches: Patches, mesh: SceneMesh, poses: Float64Array, spacing_m: float, merged_m: float = 1e-4,
    earlier: tuple[SceneMesh, Float64Array] | None = None,
) -> SceneScan:  # fmt: skip
    """The faces of about ``spacing_m`` that at least one of the poses sees.

    ``earlier``: the mesh before a change and the poses until then, which also see what has not changed since.
    Vertices of an object in one cell of ``merged_m`` are merged: parts with finer faces do not have more vertices.
    """
    grid = cut(patches, spacing_m)
    points = at_rows(patches.corners, grid.rows)
    owner = patches.object_id[grid.quad_of_face]
    seen = _visible(points, grid, owner, mesh, poses)
    if earlier is not None:
        seen |= _visible(points, grid, owner, *earlier)
    faces = grid.faces[seen]
    return _welded(points, at_rows(patches.normals, grid.rows), faces, owner[seen], mesh, merged_m)


def _visible(points: Float64Array, grid: Grid, owner: Int32Array, mesh: SceneMesh, poses: Float64Array) -> BoolArray:
    from su3d_bench.datasets.procedural.rendering.shade_kernels import aim_at_faces, drop_seen

    corners = [points[grid.faces[:, k]] for k in range(4)]
    normals = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = (normals / np.maximum(size, 1e-15)).astype(np.float32)
    centres = (sum(corners[1:], corners[0]) / 4).astype(np.float32)
    renderer = Renderer(mesh, VIEW_WIDTH, VIEW_HEIGHT)
    intrinsics = camera_intrinsics(VIEW_WIDTH, VIEW_HEIGHT).astype(np.float32)
    seen = np.zeros(len(centres), np.bool_)
    active = np.flatnonzero(size[:, 0] > 1e-10).astype(np.int32)
    n_active, n_pixels = len(active), VIEW_WIDTH * VIEW_HEIGHT
    pixel, is_hit = np.empty(n_active, np.int32), np.empty(n_pixels, np.bool_)
    depth, instance = np.zeros(n_pixels, np.float32), np.zeros(n_pixels, np.int32)
    for index in (i for start in range(COARSE_STRIDE) for i in range(start, len(poses), COARSE_STRIDE)):
        pose = poses[index].astype(np.float32)
        aim_at_faces(active, n_active, centres, normals, pose, intrinsics[0, 0], intrinsics[0, 2], intrinsics[1, 2],
                     VIEW_WIDTH, VIEW_HEIGHT, pixel, is_hit)  # fmt: skip
        pixels = np.flatnonzero(is_hit)  # a third of the image: other rays are not cast
        depth[pixels], instance[pixels] = renderer.depth_and_instance(poses[index], pixels)
        n_active = drop_seen(active, n_active, pixel, centres, normals, owner, seen, pose, depth, instance)
    return seen


def _welded(
    points: Float64Array, normals: Float64Array, faces: Int32Array, owner: Int32Array, mesh: SceneMesh, merged_m: float
) -> SceneScan:
    """Merges the corners of an object at the same position, and drops unused vertices and what has lost its area."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    object_of_point = np.zeros(len(points), np.int64)
    object_of_point[faces] = owner[:, None]
    kept = np.flatnonzero(used)
    keys = np.column_stack([np.round(points[kept] * round(1 / merged_m)).astype(np.int64), object_of_point[kept]])
    first, group = merge_equal(keys)
    vertex_of_point = np.zeros(len(points), np.int32)
    vertex_of_point[kept] = group
    summed = np.column_stack([np.bincount(group, normals[kept, k], len(first)) for k in range(3)])
    lengths = np.linalg.norm(summed, axis=1, keepdims=True)
    smooth = np.where(lengths > 1e-6, summed / np.maximum(lengths, 1e-6), normals[kept][first])
    faces = vertex_of_point[faces]
    has_area = (np.diff(np.sort(faces, axis=1), axis=1) > 0).sum(axis=1) >= 2
    in_use, corners = np.unique(faces[has_area], return_inverse=True)
    vertices = points[kept][first][in_use].astype(np.float32)
    return SceneScan(
        vertices, smooth[in_use].astype(np.float32), surface_colours(mesh, vertices),
        corners.reshape(-1, 4).astype(np.int32), owner[has_area],
    )  # fmt: skip


def surface_colours(mesh: SceneMesh, points: Float32Array) -> UInt8Array:
    """The lit colour (N, 3) of the surface nearest to each point, without highlights."""
    from su3d_bench.datasets.procedural.rendering.shade_kernels import shade

    o3d = compiled_open3d()

    nearest = caster(mesh.vertices, mesh.triangles).compute_closest_points(o3d.core.Tensor(points))  # type: ignore[attr-defined]
    n = len(points)
    dull = mesh.materials.copy()
    dull[:, 8] = 0.0  # the gloss column
    rgb, depth, instance = np.empty((n, 3), np.uint8), np.empty(n, np.float32), np.empty(n, np.int32)
    shade(np.ones(n, np.float32), nearest["primitive_ids"].numpy(), nearest["primitive_uvs"].numpy(), points,
          np.zeros(3, np.float32), mesh.triangles, mesh.normals, mesh.texture, mesh.light,
          mesh.instance_of_triangle, mesh.material_of_triangle, dull, mesh.lights, rgb, depth, instance)  # fmt: skip
    return rgb


Arrays = dict[str, Any]


def kept_arrays(
    path: Path | None,
    names: Collection[str],
    make: Callable[[], Arrays],
    forgiven: tuple[type[OSError], ...] = (OSError,),
) -> Arrays:
    """The arrays of these ``names`` in ``path`` if their checksums are right, otherwise from ``make``, then stored.

    If writing fails with one of ``forgiven``, the next process computes the arrays again.
    """
    if path is None:
        return make()
    with suppress(*DAMAGE):
        kept = read_arrays(path)
        if set(kept) == set(names):
            return kept
    made = make()
    with suppress(*forgiven), filling(path) as stream:
        np.savez(stream, **made)
    return made


def kept_scan(path: Path, dataset: str, make: Callable[[], SceneScan]) -> SceneScan:
    """The scan in ``path``; computed if missing, and then stored there, which must be possible."""
    try:
        return SceneScan(**kept_arrays(path, SceneScan.__dataclass_fields__, lambda: vars(make()), forgiven=()))
    except OSError as error:
        raise DataError(
            f"{dataset}: cannot write the scan to {path} ({error.strerror}); set SU3D_DATA to a writable folder"
        ) from error
