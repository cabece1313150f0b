"""The cloud of one image P_frame: back-projected pixels, each with the detection it belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.errors import DataError
from su3d_bench.geometry import back_project, valid_depth
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.id_image import NO_DETECTION, paint
from su3d_bench.types import BoolArray, Float64Array, Frame, Int32Array, Int64Array


@dataclass(frozen=True)
class FrameCloud:
    """World points (N, 3) m, those inside masks first, then those of border rings, then those of no mask.

    ``owner`` (N,) holds detection indices, NO_DETECTION in no mask; the first ``n_inside`` points are the segments that
    are matched and counted, the others have no instance in the ID image.
    """

    points: Float64Array
    owner: Int32Array
    n_inside: int


def frame_cloud(frame: Frame, masks: BoolArray, config: OpenSU3DConfig) -> FrameCloud:
    """P_frame of one image.

    Where ``frame_voxel`` is above 0 it is reduced to the first point of each voxel and detection (in and out of rings).
    """
    if len(masks) and masks.shape[1:] != frame.depth_m.shape:
        (rows, columns), (height, width) = masks.shape[1:], frame.depth_m.shape
        raise DataError(f"frame {frame.index}: masks are {columns}x{rows} and the image is {width}x{height}")
    painted = paint(masks, config.border_in(frame.depth_m.shape[1]), config.border_shape)
    pixels = valid_depth(frame.depth_m, config.depth_min, config.depth_max)
    is_ring = (painted.owner != NO_DETECTION) & (painted.ids == NO_DETECTION)
    if config.border_pixels == "drop":
        pixels &= ~is_ring
    if config.background_pixels == "drop":
        pixels &= painted.owner != NO_DETECTION
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
    owner = painted.owner[pixels]
    if config.border_pixels == "background":
        owner[is_ring[pixels]] = NO_DETECTION
    # 0 inside a mask, 1 in a ring, 2 in no mask
    rank = np.where(owner == NO_DETECTION, 2, is_ring[pixels]).astype(np.int8)
    if config.frame_voxel > 0:
        kept = _first_of_voxel(points, owner * 3 + rank, config.frame_voxel)
        points, owner, rank = points[kept], owner[kept], rank[kept]
    order = np.argsort(rank, kind="stable")
    return FrameCloud(points[order], owner[order], int(np.count_nonzero(rank == 0)))


def _first_of_voxel(points: Float64Array, labels: Int32Array, voxel: float) -> Int64Array:
    from su3d_bench.opensu3d import _kernels

    kept = np.empty(len(points), np.int64)
    table = np.full(1 << (2 * len(points) + 1).bit_length(), -1, np.int32)
    n = _kernels.first_of_voxel(points, labels, voxel, table, kept)
    return kept[:n]
