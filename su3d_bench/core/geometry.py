"""Shared geometry: back-projection, voxel grids, rigid transforms."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.arguments import typed
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array, UpAxis

RIGID_TOLERANCE = 1e-2  # finds scaled, mirrored and transposed matrices, but accepts the rounding of text files


def valid_depth(depth_m: Float32Array, depth_min: float, depth_max: float) -> BoolArray:
    """Pixels whose depth is finite and in ``[depth_min, depth_max]`` metres and above 0."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth_m) & (depth_m > 0) & (depth_m >= depth_min) & (depth_m <= depth_max)


@typed
def back_project(
    depth_m: Float32Array, intrinsics: Float64Array, camera_to_world: Float64Array, pixels: BoolArray
) -> Float64Array:
    """World points (N, 3) m of the chosen ``pixels`` (H, W) in row-major order: T (D(u,v) K^-1 (u,v,1)).

    Integer pixel indices, no half-pixel shift.

    >>> import numpy as np, su3d_bench as su3d
    >>> camera, is_centre = np.array([[30.0, 0, 1], [0, 30.0, 1], [0, 0, 1]]), np.zeros((3, 3), bool)
    >>> is_centre[1, 1] = True
    >>> su3d.back_project(np.full((3, 3), 2.0, np.float32), camera, np.eye(4), is_centre).tolist()
    [[0.0, 0.0, 2.0]]
    """
    if depth_m.ndim != 2 or pixels.shape != depth_m.shape or pixels.dtype != np.bool_:
        raise DataError(f"back-projection: depth {depth_m.shape}, pixels {pixels.shape}; expected (H, W), and bools")
    if (intrinsics.shape, camera_to_world.shape) != ((3, 3), (4, 4)):
        raise DataError("back-projection: expected intrinsics (3, 3) and a pose (4, 4)")
    of_row, of_column = ray_parts(intrinsics, camera_to_world, *depth_m.shape)
    z = depth_m[pixels].astype(np.float64)
    points = np.empty((len(z), 3))
    # No matrix product over the pixels: a threaded one waits for cores that other processes use.
    for axis in range(3):
        ray = of_row[axis][:, None] + of_column[axis]
        points[:, axis] = ray[pixels] * z + camera_to_world[axis, 3]
    return points


def ray_parts(
    intrinsics: Float64Array, camera_to_world: Float64Array, height: int, width: int
) -> tuple[Float64Array, Float64Array]:
    """The row (3, H) and column (3, W) terms of the pixels' rays in the world, at a depth of 1 m."""
    if not np.linalg.det(intrinsics):
        raise DataError(f"back-projection: the intrinsics {intrinsics.tolist()} cannot be inverted")
    to_world = np.asarray(camera_to_world[:3, :3] @ np.linalg.inv(intrinsics), np.float64)
    return to_world[:, 1:2] * np.arange(height) + to_world[:, 2:], to_world[:, :1] * np.arange(width)


def voxel_coordinates(points: Float64Array | Float32Array, voxel: float) -> Int64Array:
    """Integer cell (N, 3) of each point in a grid of side ``voxel`` metres anchored at the world origin."""
    return np.floor(np.asarray(points, np.float64) / voxel).astype(np.int64)


def are_rigid(matrices: Float64Array) -> BoolArray:
    """Whether each of (n, 4, 4) finite matrices is a rotation and a translation."""
    rotations, last_rows = matrices[:, :3, :3], matrices[:, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        products = rotations @ rotations.transpose(0, 2, 1)
        is_orthogonal = np.abs(products - np.eye(3)).max(axis=(1, 2)) < RIGID_TOLERANCE
        is_proper = np.linalg.det(rotations) > 0
        is_affine = np.abs(last_rows - (0, 0, 0, 1)).max(axis=1) < RIGID_TOLERANCE
    result: BoolArray = is_orthogonal & is_proper & is_affine
    return result


def turn_to_z(axis: UpAxis) -> Float64Array:
    """The rotation (3, 3) about x, or for an x axis about y, that maps ``axis`` to z; exact for every number."""
    rows = {
        "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
        "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
        "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
        "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
        "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    }
    return np.array(rows[axis], np.float64)


def rotations_of(quaternions: Float64Array) -> Float64Array:
    """The rotation matrices (n, 3, 3) of unit quaternions (n, 4) in the order x y z w.

    >>> rotations_of(np.array([[0.0, 0.0, 0.6, 0.8]]))[0, :, 0].round(12).tolist()
    [0.28, 0.96, 0.0]
    """
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
