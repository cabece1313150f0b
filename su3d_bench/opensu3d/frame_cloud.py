"""The point cloud of one image (P_frame): back-projected pixels with their detections."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.geometry import ray_parts, valid_depth
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int32Array, Int64Array
from su3d_bench.opensu3d.config import OpenSU3DConfig

NO_DETECTION = -1


@dataclass(frozen=True)
class IdImage:
    """``ids`` (H, W) int32: the detection of each pixel, NO_DETECTION in rings and outside masks; this is M'.

    ``owner`` (H, W) int32 is the same without rings: it differs from ``ids`` only in the rings.
    """

    ids: Int32Array
    owner: Int32Array


def paint(masks: BoolArray, border_px: int, shape: Literal["disc", "square"]) -> IdImage:
    """The ID image of ``masks`` (K, H, W).

    Larger masks are painted first, equal ones in order, so that the smaller of two overlapping masks is visible. Each
    mask erases a ring of ``border_px`` around it from the masks painted before.
    """
    from su3d_bench.opensu3d import kernels

    ids = np.full(masks.shape[1:], NO_DETECTION, np.int32)
    owner = ids.copy()
    pixels = np.require(masks, np.bool_, ["C", "W"]).view(np.uint8)
    areas, bounds = np.empty(len(masks), np.int64), np.empty((len(masks), 4), np.int64)
    kernels.extents(pixels, areas, bounds)
    reach = _reach(border_px, shape)
    for k in np.argsort(-areas, kind="stable"):
        if areas[k]:
            kernels.paint(pixels[k], k, bounds[k], reach, ids, owner)
    return IdImage(ids, owner)


def _reach(radius: int, shape: Literal["disc", "square"]) -> Int64Array:
    """Half-width of the ring of one pixel, 0, 1, ... ``radius`` rows away."""
    rows = np.arange(radius + 1)
    furthest = np.array([isqrt(radius * radius - int(row) ** 2) for row in rows], np.int64)
    return np.full(radius + 1, radius, np.int64) if shape == "square" else furthest


@dataclass(frozen=True)
class FrameCloud:
    """World points (N, 3) in metres: inside masks, then in border rings, then outside masks.

    ``owner`` (N,) holds detection indices, NO_DETECTION outside masks; the first ``n_inside`` points are the segments
    that are matched and counted, the others have no instance in the ID image. ``n_swallowed``: detections whose visible
    pixels are all in rings of other detections; ``n_too_far``: pixels beyond ``depth_max``.
    """

    points: Float64Array
    owner: Int32Array
    n_inside: int
    n_swallowed: int
    n_too_far: int


def frame_cloud(frame: Frame, masks: BoolArray, config: OpenSU3DConfig) -> FrameCloud:
    """P_frame of one image.

    Unless ``frame_voxel`` is 0, only the first point per voxel and detection (inside and outside rings) remains.
    """
    painted = paint(masks, config.border_in(frame.depth_m.shape[1]), config.border_shape)
    pixels = valid_depth(frame.depth_m, config.depth_min, config.depth_max)
    points, owner, rank = _cloud(frame, pixels, painted, config)
    order = np.argsort(rank, kind="stable")
    in_masks, outside_rings = (
        np.bincount(image.ravel() + 1, minlength=len(masks) + 1)[1:] for image in (painted.owner, painted.ids)
    )
    with np.errstate(invalid="ignore"):
        n_too_far = int(np.count_nonzero(np.isfinite(frame.depth_m) & (frame.depth_m > config.depth_max)))
    n_inside = int(np.count_nonzero(rank == 0))
    n_swallowed = int(np.count_nonzero((in_masks > 0) & (outside_rings == 0)))
    return FrameCloud(points[order], owner[order], n_inside, n_swallowed, n_too_far)


def _cloud(
    frame: Frame, pixels: BoolArray, painted: IdImage, config: OpenSU3DConfig
) -> tuple[Float64Array, Int32Array, NDArray[np.int8]]:
    """Points, owners and ranks (0 inside a mask, 1 in a ring, 2 in no mask) of ``pixels`` in row-major order."""
    from su3d_bench.opensu3d import kernels

    rings = {"owner": kernels.OWNED, "background": kernels.BACKGROUND, "drop": kernels.DROPPED}
    cloud: tuple[Float64Array, Int32Array, NDArray[np.int8]] = kernels.cloud(
        np.require(frame.depth_m, requirements=["C", "W"]),  # one array layout: avoids a second compilation
        pixels,
        *ray_parts(frame.intrinsics, frame.camera_to_world, *frame.depth_m.shape),
        np.ascontiguousarray(frame.camera_to_world[:3, 3], np.float64),
        painted.ids,
        painted.owner,
        rings[config.border_pixel_rule],
        config.background_pixel_rule == "drop",
        config.voxel_of_frame,
    )
    return cloud
