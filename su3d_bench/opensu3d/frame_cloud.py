"""The cloud of one image P_frame: back-projected pixels, each with the detection it belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.errors import DataError
from su3d_bench.geometry import back_project, valid_depth
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.id_image import BACKGROUND, BORDER, paint
from su3d_bench.types import BoolArray, Float64Array, Frame, Int32Array, Int64Array


@dataclass(frozen=True)
class FrameCloud:
    """World points (N, 3) m in row-major pixel order; ``segment`` (N,) holds detection indices, BACKGROUND for none."""

    points: Float64Array
    segment: Int32Array


def frame_cloud(frame: Frame, masks: BoolArray, config: OpenSU3DConfig) -> FrameCloud:
    """P_frame of one image, reduced to one point a voxel and a detection where ``frame_voxel`` is above 0."""
    if len(masks) and masks.shape[1:] != frame.depth_m.shape:
        (rows, columns), (height, width) = masks.shape[1:], frame.depth_m.shape
        raise DataError(f"frame {frame.index}: masks are {columns}x{rows} and the image is {width}x{height}")
    id_image = paint(masks, config.border_in(frame.depth_m.shape[1]), config.border_shape)
    pixels = valid_depth(frame.depth_m, config.depth_min, config.depth_max)
    if config.border_pixels == "drop":
        pixels &= id_image != BORDER
    if config.background_pixels == "drop":
        pixels &= id_image != BACKGROUND
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
    segment = np.maximum(id_image[pixels], BACKGROUND)
    if config.frame_voxel > 0:
        kept = _first_of_voxel(points, segment, config.frame_voxel)
        points, segment = points[kept], segment[kept]
    return FrameCloud(points, segment)


def _first_of_voxel(points: Float64Array, segment: Int32Array, voxel: float) -> Int64Array:
    from su3d_bench.opensu3d import _kernels

    kept = np.empty(len(points), np.int64)
    table = np.full(1 << (2 * len(points) + 1).bit_length(), -1, np.int32)
    n = _kernels.first_of_voxel(points, segment, voxel, table, kept)
    return kept[:n]
