"""Which views show a 3D mask best: OpenMask3D's projection of vertices into depth images, and the top views a mask.

Source: openmask3d/mask_features_computation/features_extractor.py and openmask3d/data/load.py at commit 3bc3fc5.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import Float32Array, Float64Array, Frame, Int32Array, Int64Array

NO_VIEW = -1


def swapped_intrinsics(intrinsics: Float64Array, resolution: tuple[int, int], height: int, width: int) -> Float64Array:
    """What OpenMask3D makes of ``intrinsics`` (3, 3) at ``resolution`` (height, width) for images of another size.

    The focal lengths are scaled by a floored width over the height, and by the width; each centre by the other axis's
    factor: that is the original's slip, which moves the centre by about a pixel.

    >>> colour = np.array([[1170.0, 0, 648], [0, 1170, 484], [0, 0, 1]])
    >>> swapped_intrinsics(colour, (968, 1296), 480, 640).round(2).tolist()
    [[577.75, 0.0, 320.98], [0.0, 577.78, 238.82], [0.0, 0.0, 1.0]]
    """
    full_height, full_width = resolution
    scaled = np.array(intrinsics, np.float64)
    scaled[0, 0] *= np.floor(width * full_height / full_width) / full_height
    scaled[1, 1] *= width / full_width
    scaled[0, 2] *= (height - 1) / (full_height - 1)
    scaled[1, 2] *= (width - 1) / (full_width - 1)
    return scaled


def as_openmask3d(frame: Frame, resolution: tuple[int, int]) -> Float64Array:
    """The intrinsics that OpenMask3D would use for ``frame``, were it a reduced image of ``resolution``.

    The camera at full resolution is the frame's own, scaled up axis by axis, centres between corner pixels.
    """
    height, width = frame.depth_m.shape
    full_height, full_width = resolution
    full = np.array(frame.intrinsics, np.float64)
    full[0, 0] *= full_width / width
    full[1, 1] *= full_height / height
    full[0, 2] *= (full_width - 1) / (width - 1)
    full[1, 2] *= (full_height - 1) / (height - 1)
    return swapped_intrinsics(full, resolution, height, width)


def visible_pixels(
    points: Float32Array, frame: Frame, intrinsics: Float64Array, depth_tolerance_m: float
) -> Int32Array:
    """The pixel (V,), row * width + column, at which each point is seen; -1 where it is not.

    A pixel is the projection truncated toward zero, so that -0.9 lies in pixel 0. A point is seen where its depth
    differs from the image's by at most ``depth_tolerance_m``. As in the original nothing asks for a positive depth:
    beside a hole of the depth image, whose depth is 0, a point within the tolerance of the camera's plane is seen,
    whichever side it is on; one in the plane itself falls on the first pixel.
    """
    from su3d_bench.baselines.openmask3d.kernels import project

    projection = intrinsics @ np.linalg.inv(frame.camera_to_world)[:3]
    pixels: Int32Array = project(points, projection, frame.depth_m, depth_tolerance_m)
    return pixels


class MaskViews:
    """The ``k`` views of each mask with the most pixels, so far; of equal views the earlier one comes first.

    ``positions`` (K, k) are positions of frames in the order of ``add``, -1 where there are fewer; ``n_pixels`` (K, k).
    The original sorts unstably: which of equal views it takes depends on NumPy and the machine.
    """

    def __init__(self, n_masks: int, k: int) -> None:
        self.positions = np.full((n_masks, k), NO_VIEW, np.int32)
        self.n_pixels = np.zeros((n_masks, k), np.int64)

    def add(self, position: int, n_pixels: Int64Array) -> None:
        """Enter the view ``position``, later than all before, in which each mask covers ``n_pixels`` (K,)."""
        if not self.positions.size:
            return
        better = np.flatnonzero(n_pixels > self.n_pixels[:, -1])
        counts = np.column_stack([self.n_pixels[better], n_pixels[better]])
        views = np.column_stack([self.positions[better], np.full(len(better), position, np.int32)])
        order = np.argsort(-counts, axis=1, kind="stable")[:, :-1]
        self.n_pixels[better] = np.take_along_axis(counts, order, axis=1)
        self.positions[better] = np.take_along_axis(views, order, axis=1)


def count_pixels(pixels: Int32Array, proposals: Proposals, n_image: int) -> Int64Array:
    """How many distinct ones of ``pixels`` (V,), of the ``n_image`` that there are, each mask covers (K,)."""
    from su3d_bench.baselines.openmask3d.kernels import count_distinct

    counts: Int64Array = count_distinct(pixels, proposals.indptr, proposals.indices, n_image)
    return counts


def pixels_of_mask(pixels: Int32Array, members: Int32Array, width: int) -> Int64Array:
    """The distinct pixels (P, 2), x y, of the points ``members``, row by row."""
    seen = np.unique(pixels[members])
    seen = seen[seen >= 0].astype(np.int64)
    return np.stack([seen % width, seen // width], axis=1)
