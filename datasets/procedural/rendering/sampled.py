"""Anti-aliased colour images of homes, with mirrors and glass; depth and ids are those of the nearest surface."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from su3d_bench.core.types import Float32Array, Float64Array, Int64Array, UInt8Array
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh
from su3d_bench.datasets.procedural.rendering.render import FOCAL_PER_WIDTH, RenderedFrame, Renderer
from su3d_bench.numerics.open3d_core import compiled_open3d

MAX_CONTINUATIONS = 4  # of a ray, through the two sides of two panes, or a mirror in them
BORDER_SHIFT = 0.25  # of a sample along its border, in pixels
SHOULDER = 0.55  # linear light from which brightness is compressed, so that sunlit surfaces keep their colour


def encoding(n: int) -> UInt8Array:
    """sRGB 0..255 (n,) of linear light (4 k / n)^2, compressed above ``SHOULDER``."""
    value = (4 * (np.arange(n) + 0.5) / n) ** 2
    room = 1 - SHOULDER
    over = np.maximum(value - SHOULDER, 0) / room
    value = np.minimum(value, SHOULDER) + room * over / (1 + over)
    return np.asarray(255 * value ** (1 / 2.2) + 0.5, np.uint8)


class SampledRenderer(Renderer):
    """Renders a home with four samples per pixel; ``threads`` changes the time, not the images."""

    def __init__(
        self, mesh: SceneMesh, width: int, height: int, like: Renderer | None = None, threads: int | None = None
    ) -> None:
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import CODES

        super().__init__(mesh, width, height, like)
        self._threads = threads or min(4, len(os.sched_getaffinity(0)))
        a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
        crossed = np.cross(b - a, c - a)
        length = np.maximum(np.linalg.norm(crossed, axis=1, keepdims=True), 1e-15)
        self._face_normals: Float32Array = (crossed / length).astype(np.float32)
        self._codes = encoding(CODES)

    def render(self, camera_to_world: Float64Array, gain: float = 1.0) -> RenderedFrame:
        """``gain`` multiplies linear light before it is encoded, as exposure does."""
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import encode, mark_edges

        mesh, n = self._mesh, self.width * self.height
        rays, t, triangle, uv = self._cast(camera_to_world, self._directions)
        is_edge = np.empty(n, np.bool_)
        self._in_threads(mark_edges, self.height, self.width, t, triangle, rays, self._face_normals,
                         mesh.instance_of_triangle, mesh.material_of_triangle, is_edge)  # fmt: skip
        step = camera_to_world[:3, :2].T / (FOCAL_PER_WIDTH * self.width)
        colour = self._shaded((rays, t, triangle, uv), is_edge, step.astype(np.float32))
        edge = np.flatnonzero(is_edge)
        colour[edge] = self._border_means(camera_to_world, edge)
        rgb = np.empty((n, 3), np.uint8)
        self._in_threads(encode, n, colour, np.float32(gain), self._codes, rgb)
        hit = np.isfinite(t)
        ids = mesh.instance_of_triangle[np.where(hit, triangle, 0)]
        shape = (self.height, self.width)
        depth, instance = np.where(hit, t, np.float32(0)), np.where(hit, ids, np.int32(0))
        return RenderedFrame(rgb.reshape(*shape, 3), depth.reshape(shape), instance.reshape(shape))

    def _border_means(self, camera_to_world: Float64Array, pixels: Int64Array) -> Float32Array:
        """Linear light (P, 3) of ``pixels`` (P,): the mean of one sample on each border, shared with the pixel beyond.

        Samples of a pixel form a rotated square, mirrored in the next pixel (FLIPQUAD, Akenine-Moeller, Stroem 2003).
        """
        shape = (2, self.height + 1, self.width + 1)  # left and top borders
        row, column = np.divmod(pixels, self.width)
        wanted = np.zeros(shape, np.bool_)
        ends = [(0, row, column), (0, row, column + 1), (1, row, column), (1, row + 1, column)]
        for end in ends:
            wanted[end] = True
        border, row, column = np.nonzero(wanted)
        shift = np.where((row + column) % 2 == 0, BORDER_SHIFT, -BORDER_SHIFT)
        u, v = column - np.where(border == 0, 0.5, shift), row + np.where(border == 0, shift, -0.5)
        directions = np.stack([u, v, np.ones(len(u))], axis=1) @ self._focal_inverse.T
        n = len(directions)
        hits = self._cast(camera_to_world, directions)
        sample = self._shaded(hits, np.zeros(n, np.bool_), np.zeros((2, 3), np.float32))
        number = np.empty(shape, np.int32)
        number[wanted] = np.arange(n, dtype=np.int32)
        return np.asarray(sum(sample[number[end]] for end in ends) / np.float32(4), np.float32)

    def _shaded(self, hits: Any, skip: Any, step: Float32Array, level: int = 0) -> Float32Array:
        """Linear light (N, 3) along the rays that gave ``hits``, with what mirrors and glass show."""
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import shade_rays

        mesh, n = self._mesh, len(skip)
        pixel = (1.0 if step.any() else 0.5) / (FOCAL_PER_WIDTH * self.width)
        colour, tint = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        onward = np.empty((n, 6), np.float32)
        self._in_threads(shade_rays, n, *hits, skip, step[0], step[1], pixel, level == MAX_CONTINUATIONS, mesh.vertices,
                         mesh.triangles, mesh.normals, mesh.texture, mesh.light, self._face_normals,
                         mesh.material_of_triangle, mesh.materials, mesh.lights, colour, tint, onward)  # fmt: skip
        going_on = np.flatnonzero(tint.any(axis=1))
        if len(going_on):
            rays = onward[going_on]
            answer = self._scene.cast_rays(compiled_open3d().core.Tensor(rays))
            found = rays, *(answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs"))
            beyond = self._shaded(found, np.zeros(len(rays), np.bool_), np.zeros_like(step), level + 1)
            colour[going_on] += tint[going_on] * beyond
        return colour

    def _in_threads(self, kernel: Callable[..., None], n: int, *values: Any) -> None:
        """``kernel(start, stop, *values)`` on pieces of ``range(n)``; the threads end with the call: forks are safe."""
        if self._threads == 1:
            kernel(0, n, *values)
            return
        bounds = np.linspace(0, n, 2 * self._threads + 1).astype(np.int64).tolist()
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(lambda k: kernel(bounds[k], bounds[k + 1], *values), range(2 * self._threads)))
