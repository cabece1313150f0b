"""The frame of a recording that shows an instance of a map best, and where in that frame the instance is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame
from su3d_bench.numerics.geometry import back_project, valid_depth

PROBES = 300  # points of an instance that are looked for in every frame
NEAR_M, NEAR_SHARE = 0.05, 0.03  # a point is seen where the depth image agrees with it within this much
GOOD_AREA = 0.08  # share of the image from which a larger view of an object tells no more
PIXEL_STEP = 2  # of the depth image, in which masks are found
CAP_M = 0.05  # a pixel belongs to what owns the map point nearest to it within this distance


@dataclass(frozen=True)
class BestView:
    """``frame`` is the place in the list of frames, ``seen`` the share of the instance that it shows.

    ``box`` (4,) are the columns and rows x0 y0 x1 y1 of what is seen, in pixels.
    """

    frame: int
    seen: float
    box: Float64Array


def best_view(frames: Sequence[Frame], points: Float32Array) -> BestView | None:
    """The frame that shows most of ``points`` (N, 3), large and not at the border; None where none shows any."""
    if not len(points):
        return None
    probes = points[np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)].astype(np.float64)
    best, best_score = None, 0.0
    for k, frame in enumerate(frames):
        columns, rows, is_seen = seen_in(frame, probes)
        if not is_seen.any():
            continue
        height, width = frame.depth_m.shape
        x, y = columns[is_seen], rows[is_seen]
        box = np.array([x.min(), y.min(), x.max() + 1, y.max() + 1])
        area = float((box[2] - box[0]) * (box[3] - box[1])) / (width * height)
        share = float(is_seen.mean())
        score = share**1.5 * min(area / GOOD_AREA, 1.0) ** 0.5
        if score > best_score:
            best, best_score = BestView(k, share, box), score
    return best


def seen_in(frame: Frame, points: Float64Array) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Columns and rows (N,) of ``points`` (N, 3) in a frame, and which of them it sees, not hidden by anything."""
    height, width = frame.depth_m.shape
    in_camera = (points - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3]
    depth = np.maximum(in_camera[:, 2], 1e-6)
    columns = in_camera[:, 0] / depth * frame.intrinsics[0, 0] + frame.intrinsics[0, 2]
    rows = in_camera[:, 1] / depth * frame.intrinsics[1, 1] + frame.intrinsics[1, 2]
    is_inside = (in_camera[:, 2] > 0.05) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    is_seen: BoolArray = is_inside.copy()
    here = np.flatnonzero(is_inside)
    measured = frame.depth_m[rows[here].astype(np.int64), columns[here].astype(np.int64)]
    is_seen[here] = np.abs(measured - depth[here]) <= NEAR_M + NEAR_SHARE * depth[here]
    return columns, rows, is_seen


def mask_in_frame(frame: Frame, tree: object, is_member: BoolArray, bounds: Float64Array) -> BoolArray:
    """Where the frame shows the instance: (h, w) bool, of every ``PIXEL_STEP``-th pixel.

    ``tree`` is the ``KDTree`` of the map's points, ``is_member`` (N,) marks those of the instance, which lie within
    ``bounds`` (2, 3).
    """
    pixels = np.zeros(frame.depth_m.shape, np.bool_)
    pixels[::PIXEL_STEP, ::PIXEL_STEP] = True
    pixels &= valid_depth(frame.depth_m, 0.0, np.inf)
    places = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
    is_near = ((places >= bounds[0] - CAP_M) & (places <= bounds[1] + CAP_M)).all(axis=1)
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    if is_near.any():
        _, nearest = tree.query(places[is_near], distance_upper_bound=CAP_M)  # type: ignore[attr-defined]
        owned = np.append(is_member, False)[nearest]
        rows, columns = np.nonzero(pixels)
        mask[rows[is_near][owned], columns[is_near][owned]] = True
    return mask[::PIXEL_STEP, ::PIXEL_STEP]
