"""Anti-aliased colour images of homes, with mirrors and glass; depth and ids are those of the nearest surface."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh
from su3d_bench.datasets.procedural.rendering.render import FOCAL_PER_WIDTH, RenderedFrame, Renderer

MAX_CONTINUATIONS = 4  # of a ray, through the two sides of two panes, or a mirror in them
MIN_PARALLEL, PIECES = 400, 8  # rays or rows for which threads pay; pieces per thread, whose costs differ
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
        self._rows = mesh.materials.view(",".join(["f4"] * mesh.materials.shape[1]))[:, 0]
        self._codes = encoding(CODES)

    def render(self, camera_to_world: Float64Array, gain: float = 1.0) -> RenderedFrame:
        """``gain`` multiplies linear light before it is encoded, as exposure does."""
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import encode, mark_edges

        mesh, n = self._mesh, self.width * self.height
        hits = rays, t, triangle, _ = self._cast(camera_to_world, self._directions)
        is_edge = np.empty(n, np.bool_)
        self._in_threads(mark_edges, self.height, self.width, t, triangle, rays, self._face_normals,
                         mesh.instance_of_triangle, mesh.material_of_triangle, is_edge)  # fmt: skip
        step = camera_to_world[:3, :2].T / (FOCAL_PER_WIDTH * self.width)
        colour = self._shaded(hits, is_edge, step.astype(np.float32))
        samples = self._border_samples(camera_to_world, is_edge)
        rgb, depth, instance = np.empty((n, 3), np.uint8), np.empty(n, np.float32), np.empty(n, np.int32)
        self._in_threads(encode, self.height, self.width, colour, is_edge, *samples, np.float32(gain), self._codes,
                         t, triangle, mesh.instance_of_triangle, rgb, depth, instance)  # fmt: skip
        shape = (self.height, self.width)
        return RenderedFrame(rgb.reshape(*shape, 3), depth.reshape(shape), instance.reshape(shape))

    def _border_samples(self, camera_to_world: Float64Array, is_edge: BoolArray) -> tuple[Int32Array, Float32Array]:
        """Linear light (N, 3) of one sample on each border of the edge pixels, shared with the pixel beyond.

        First the rows of the samples on the left and top borders of every pixel (2, H + 1, W + 1).
        Samples of a pixel form a rotated square, mirrored in the next pixel (FLIPQUAD, Akenine-Moeller, Stroem 2003).
        """
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import aim_at_borders

        number = np.empty((2, self.height + 1, self.width + 1), np.int32)
        rays = np.empty((number.size, 6), np.float32)
        n = aim_at_borders(is_edge, self._focal_inverse, camera_to_world, number, rays)
        return number, self._shaded(self._hits(rays[:n]), np.zeros(n, np.bool_), np.zeros((2, 3), np.float32))

    def _shaded(self, hits: Any, skip: BoolArray, step: Float32Array, level: int = 0) -> Float32Array:
        """Linear light (N, 3) along the rays that gave ``hits``, with what mirrors and glass show."""
        from su3d_bench.datasets.procedural.rendering.sampled_kernels import shade_rays

        mesh, n = self._mesh, len(skip)
        pixel = (1.0 if step.any() else 0.5) / (FOCAL_PER_WIDTH * self.width)
        colour, tint = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        onward = np.empty((n, 6), np.float32)
        self._in_threads(shade_rays, n, *hits, skip, step, pixel, level == MAX_CONTINUATIONS, mesh.vertices,
                         mesh.triangles, mesh.normals, mesh.texture, mesh.light, self._face_normals,
                         mesh.material_of_triangle, self._rows, mesh.lights, colour, tint, onward)  # fmt: skip
        going_on = np.flatnonzero(tint[:, 0])
        if len(going_on):
            rays = onward.take(going_on, axis=0)
            beyond = self._shaded(self._hits(rays), np.zeros(len(rays), np.bool_), np.zeros_like(step), level + 1)
            colour[going_on] += tint.take(going_on, axis=0) * beyond
        return colour

    def _in_threads(self, kernel: Callable[..., None], n: int, *values: Any) -> None:
        """``kernel(start, stop, *values)`` on pieces of ``range(n)``; the threads end with the call: forks are safe."""
        if self._threads == 1 or n < MIN_PARALLEL:
            kernel(0, n, *values)
            return
        bounds = np.linspace(0, n, PIECES * self._threads + 1).astype(np.int64).tolist()
        pieces = iter(list(pairwise(bounds)))

        def work() -> None:
            for start, stop in pieces:
                kernel(start, stop, *values)

        with ThreadPoolExecutor(self._threads - 1) as pool:
            others = [pool.submit(work) for _ in range(self._threads - 1)]
            work()
        for other in others:
            other.result()
