"""Colour and depth of two cameras brought onto one image grid, without touching what need not be touched.

Which camera a pose belongs to: ScanNet's own reader (``saveToPointCloud`` in sensorData.h, commit 3830fce) puts a depth
pixel into the world with the pose and the depth intrinsics alone, and reaches the colour image through the depth
extrinsic. So poses are those of the depth camera, and ``depth_to_colour`` maps its points into the colour camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array
from su3d_bench.datasets.recordings.source import SensorPair

Grid = Literal["depth", "colour"]
SAME_RAY_PX = 0.01  # two images whose pixels differ by less in their rays are taken as one; text files keep six digits
IDENTITY_TOLERANCE = 1e-6
MAX_INTRINSIC = 1e6  # pixels; no lens comes near it, and nothing computed from it overflows


@dataclass(frozen=True)
class Registration:
    """From a pair of cameras to images of one size, those of the ``grid`` camera.

    ``depth``, the default: depth stays as it is to the bit, each of its pixels gets the colour, bilinearly, at which
    its point is seen by the colour camera. A pixel without depth borrows that of the nearest one that has some. A point
    beside the colour image or behind its camera gets the nearest colour on the border. What the colour camera cannot
    see because something stands before it gets the colour of what stands there.

    ``colour``: colour stays as it is to the bit; depth is that of the points seen by the colour camera, each at the
    pixel nearest to it, the nearest point where several fall on one. Other pixels have no depth: where the colour image
    is larger, most of them.
    """

    camera: SensorPair
    grid: Grid

    @cached_property
    def depth_to_colour(self) -> Float64Array:
        """Points of the depth camera in the colour camera (4, 4)."""
        # The colour extrinsic is the identity in all of ScanNet; else both lead into one common frame.
        matrix: Float64Array = np.linalg.solve(self.camera.colour_extrinsic, self.camera.depth_extrinsic).astype(
            np.float64
        )
        return matrix

    @property
    def intrinsics(self) -> Float64Array:
        """Of the registered images (3, 3)."""
        return self.camera.depth_intrinsics if self.grid == "depth" else self.camera.colour_intrinsics

    @cached_property
    def is_needless(self) -> bool:
        """Whether both images have one size and each pixel of one the same ray as in the other."""
        if self.camera.colour_size != self.camera.depth_size:
            return False
        if np.abs(self.depth_to_colour - np.eye(4)).max() > IDENTITY_TOLERANCE:
            return False
        width, height = self.camera.depth_size
        corners = np.array([[u, v, 1.0] for u in (0, width - 1) for v in (0, height - 1)])
        seen = corners @ np.linalg.inv(self.camera.depth_intrinsics).T @ self.camera.colour_intrinsics.T
        return bool(np.abs(seen[:, :2] / seen[:, 2:] - corners[:, :2]).max() < SAME_RAY_PX)

    @cached_property
    def _from_pose(self) -> Float64Array | None:
        """What a pose of the depth camera is multiplied with; None where poses stay as they are."""
        if self.grid == "depth" or self.is_needless:
            return None
        return np.linalg.inv(self.depth_to_colour).astype(np.float64)

    def camera_to_world(self, depth_camera_to_world: Float64Array) -> Float64Array:
        """The pose of the registered images."""
        return depth_camera_to_world if self._from_pose is None else depth_camera_to_world @ self._from_pose

    def images(self, colour: UInt8Array, depth_m: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Colour (H, W, 3) and depth in metres (H, W) on the grid; 0 is no depth."""
        if self.is_needless:
            return colour, depth_m
        if self.grid == "depth":
            return self._colour_at_depth(colour, depth_m), depth_m
        return colour, self._depth_at_colour(depth_m)

    @cached_property
    def _rays(self) -> Float32Array:
        """Per pixel of the depth image its ray in homogeneous coordinates of the colour image (3, H, W), at depth 1."""
        width, height = self.camera.depth_size
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        pixels = np.stack([u, v, np.ones_like(u)])
        turn = (
            self.camera.colour_intrinsics @ self.depth_to_colour[:3, :3] @ np.linalg.inv(self.camera.depth_intrinsics)
        )
        return np.tensordot(turn, pixels, axes=1).astype(np.float32)

    @cached_property
    def _shift(self) -> Float32Array:
        """What the distance of the two cameras adds to ``_rays`` times depth (3,)."""
        return (self.camera.colour_intrinsics @ self.depth_to_colour[:3, 3]).astype(np.float32)

    def _seen_at(self, depth_m: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Column, row and depth in the colour camera of each depth pixel; column and row are -1 behind it."""
        z = self._rays[2] * depth_m + self._shift[2]
        divisor = np.where(z > 0, z, 1)
        x = np.where(z > 0, (self._rays[0] * depth_m + self._shift[0]) / divisor, -1)
        y = np.where(z > 0, (self._rays[1] * depth_m + self._shift[1]) / divisor, -1)
        return x, y, z

    @cached_property
    def _fixed_places(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows for cameras that look from one point: they do not depend on depth."""
        return self._seen_at(np.ones(self._rays.shape[1:], np.float32))[:2]

    def _colour_at_depth(self, colour: UInt8Array, depth_m: Float32Array) -> UInt8Array:
        import cv2

        x, y = self._seen_at(filled(depth_m))[:2] if self._shift.any() else self._fixed_places
        seen = cv2.remap(colour, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, np.uint8)

    def _depth_at_colour(self, depth_m: Float32Array) -> Float32Array:
        width, height = self.camera.colour_size
        x, y, z_m = self._seen_at(depth_m)
        x, y = np.rint(x), np.rint(y)
        is_seen = (depth_m > 0) & (z_m > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        nearest = np.full(width * height, np.inf, np.float32)
        at = y[is_seen].astype(np.int64) * width + x[is_seen].astype(np.int64)
        np.minimum.at(nearest, at, z_m[is_seen])
        nearest[np.isinf(nearest)] = 0
        return nearest.reshape(height, width)


def filled(depth_m: Float32Array) -> Float32Array:
    """Depth with that of the nearest pixel that has some where there is none; 1 m where none has any."""
    is_empty = depth_m <= 0
    if not is_empty.any():
        return depth_m
    if is_empty.all():
        return np.ones_like(depth_m)
    import cv2

    _, source = cv2.distanceTransformWithLabels(
        is_empty.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels count the pixels with depth in row-major order, from 1.
    return np.asarray(depth_m[~is_empty][source - 1], np.float32)


def make_registration(camera: SensorPair, grid: Grid, where: str) -> Registration:
    """The registration of a pair of cameras; a ``DataError`` where they are no pinhole cameras a rigid motion apart."""
    for name, matrix in (("colour", camera.colour_extrinsic), ("depth", camera.depth_extrinsic)):
        if not are_rigid(matrix[None])[0]:
            raise DataError(f"{where}: the {name} extrinsic is not a rigid motion; expected a 4x4 pose, metres")
    for name, matrix in (("colour", camera.colour_intrinsics), ("depth", camera.depth_intrinsics)):
        is_upper = matrix[1, 0] == 0 and (matrix[2] == (0, 0, 1)).all()
        if not is_upper or np.abs(matrix).max() > MAX_INTRINSIC:
            raise DataError(f"{where}: the {name} intrinsics are no camera matrix; expected fx 0 cx / 0 fy cy / 0 0 1")
    return Registration(camera, grid)
