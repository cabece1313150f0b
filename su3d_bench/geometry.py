"""Geometry that more than one part needs: back-projection, voxel grids, nearest neighbours."""

from __future__ import annotations

import numpy as np

from su3d_bench.types import BoolArray, Float32Array, Float64Array, Int64Array


def transform_points(matrix: Float64Array, points: Float64Array | Float32Array) -> Float64Array:
    """Points (N, 3) moved by a 4x4 rigid ``matrix``, in float64."""
    return np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def valid_depth(depth_m: Float32Array, depth_min: float, depth_max: float) -> BoolArray:
    """Pixels whose depth is finite and in ``[depth_min, depth_max]`` metres and above 0."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth_m) & (depth_m > 0) & (depth_m >= depth_min) & (depth_m <= depth_max)


def back_project(
    depth_m: Float32Array, intrinsics: Float64Array, camera_to_world: Float64Array, pixels: BoolArray
) -> Float64Array:
    """World points (N, 3) m of the chosen ``pixels`` (H, W) in row-major order: T (D(u,v) K^-1 (u,v,1)).

    Integer pixel indices, no half-pixel shift (as every Replica loader has it).
    """
    v, u = np.nonzero(pixels)
    z = depth_m[v, u].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], axis=1) @ np.linalg.inv(intrinsics).T
    return transform_points(camera_to_world, rays * z[:, None])


def voxel_coordinates(points: Float64Array | Float32Array, voxel: float) -> Int64Array:
    """Integer cell (N, 3) of each point in a grid of side ``voxel`` metres anchored at the world origin."""
    return np.floor(np.asarray(points, np.float64) / voxel).astype(np.int64)
