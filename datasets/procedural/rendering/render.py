"""Colour, depth and instance images of a room by ray casting, with simulated sensor noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, caster
from su3d_bench.numerics.open3d_core import compiled_open3d

FOCAL_PER_WIDTH = 400.0 / 640.0  # a horizontal field of view of 77 degrees


@dataclass(frozen=True)
class RenderedFrame:
    """``rgb`` (H, W, 3), ``depth_m`` (H, W) along the axis, ``instance`` (H, W) object ids; 0 if a ray misses."""

    rgb: UInt8Array
    depth_m: Float32Array
    instance: Int32Array


def camera_intrinsics(width: int, height: int) -> Float64Array:
    focal = FOCAL_PER_WIDTH * width
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


class Renderer:
    """Renders a room at one image size; ``like`` is another renderer of the same mesh, whose tree is shared."""

    def __init__(self, mesh: SceneMesh, width: int, height: int, like: Renderer | None = None) -> None:
        self.width, self.height = width, height
        self._mesh = mesh
        self._scene: Any = caster(mesh.vertices, mesh.triangles) if like is None else like._scene
        self._focal_inverse = np.linalg.inv(camera_intrinsics(width, height))
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(width * height)], axis=1, dtype=np.float64)
        self._directions = pixels @ self._focal_inverse.T  # camera z is 1: the distance along a ray is the depth

    def render(self, camera_to_world: Float64Array) -> RenderedFrame:
        from su3d_bench.datasets.procedural.rendering.shade_kernels import shade

        rays, t_hit, primitive, uv = self._cast(camera_to_world, self._directions)
        n, mesh = len(rays), self._mesh
        rgb, depth, instance = np.empty((n, 3), np.uint8), np.empty(n, np.float32), np.empty(n, np.int32)
        origin = camera_to_world[:3, 3].astype(np.float32)
        shade(t_hit, primitive, uv, rays[:, 3:], origin, mesh.triangles, mesh.normals, mesh.texture,
              mesh.light, mesh.instance_of_triangle, mesh.material_of_triangle, mesh.materials, mesh.lights,
              rgb, depth, instance)  # fmt: skip
        shape = (self.height, self.width)
        return RenderedFrame(rgb.reshape(*shape, 3), depth.reshape(shape), instance.reshape(shape))

    def depth_and_instance(self, camera_to_world: Float64Array, pixels: Int64Array) -> tuple[Float32Array, Int32Array]:
        """Depth in metres (N,), 0 for a miss, and object ids (N,) at ``pixels`` (N,), in row-major order."""
        _, t_hit, primitive, _ = self._cast(camera_to_world, self._directions[pixels])
        hit = np.isfinite(t_hit)
        ids = self._mesh.instance_of_triangle[np.where(hit, primitive, 0)]
        return np.where(hit, t_hit, np.float32(0)), np.where(hit, ids, np.int32(0))

    def material_rows(self, camera_to_world: Float64Array) -> Float32Array:
        """The row (H, W, columns) of ``SceneMesh.materials`` of the surface in each pixel; zeros for a miss."""
        _, t_hit, primitive, _ = self._cast(camera_to_world, self._directions)
        hit, mesh = np.isfinite(t_hit), self._mesh
        rows = mesh.materials[mesh.material_of_triangle[np.where(hit, primitive, 0)]] * hit[:, None]
        return np.asarray(rows.reshape(self.height, self.width, -1), np.float32)

    def _cast(
        self, pose: Float64Array, directions: Float64Array
    ) -> tuple[Float32Array, Float32Array, Int32Array, Float32Array]:
        from su3d_bench.datasets.procedural.rendering.shade_kernels import aim

        rays = np.empty((len(directions), 6), np.float32)
        aim(directions, pose, rays)
        return self._hits(rays)

    def _hits(self, rays: Float32Array) -> tuple[Float32Array, Float32Array, Int32Array, Float32Array]:
        """``rays`` (N, 6), and for each the distance, triangle and barycentric coordinates of what it hits."""
        answer = self._scene.cast_rays(compiled_open3d().core.Tensor.from_numpy(rays))
        return rays, answer["t_hit"].numpy(), answer["primitive_ids"].numpy(), answer["primitive_uvs"].numpy()


@dataclass(frozen=True)
class SensorNoise:
    """``depth_per_m2``: standard deviation of depth at 1 m, growing with its square (Khoshelham and Elberink 2012,
    for structured light); ``step_per_m2``: quantisation likewise; ``edge_px``: how far holes extend from a jump in
    depth; ``colour``: standard deviation of a channel in 0..255."""

    depth_per_m2: float
    step_per_m2: float
    edge_px: int
    colour: float


LEVELS = (
    SensorNoise(0.0, 0.0, 0, 0.0),
    SensorNoise(0.0010, 0.0010, 1, 2.0),
    SensorNoise(0.0025, 0.0028, 2, 5.0),
)
JUMP_M = 0.04  # second difference between pixels, so that a slanted plane is not an edge


def add_noise(
    rgb: UInt8Array, depth_m: Float32Array, level: int, rng: np.random.Generator
) -> tuple[UInt8Array, Float32Array]:
    """The images with sensor noise of ``level``; level 0 changes nothing."""
    noise = LEVELS[level]
    if level == 0:
        return rgb, depth_m
    square = depth_m.astype(np.float64) ** 2
    depth = depth_m + noise.depth_per_m2 * square * rng.standard_normal(depth_m.shape)
    step = np.maximum(noise.step_per_m2 * square, 0.001)
    depth = np.round(depth / step) * step
    hole = _near_jumps(depth_m, noise.edge_px) & (rng.random(depth_m.shape) < 0.7)
    depth[hole | (depth_m <= 0)] = 0.0
    noisy = rgb + noise.colour * rng.standard_normal(rgb.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), np.maximum(depth, 0.0).astype(np.float32)


def _near_jumps(depth_m: Float32Array, reach: int) -> BoolArray:
    from scipy.ndimage import binary_dilation

    jump = np.zeros(depth_m.shape, bool)
    jump[:, 1:-1] = np.abs(np.diff(depth_m, 2, axis=1)) > JUMP_M
    jump[1:-1] |= np.abs(np.diff(depth_m, 2, axis=0)) > JUMP_M
    return np.asarray(binary_dilation(jump, iterations=reach), bool)
