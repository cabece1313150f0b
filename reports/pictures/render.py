"""A point cloud as seen from above or from a corner, in software: no OpenGL, no display.

Points are drawn as squares into a depth buffer at twice the size; the shading comes from that buffer alone (eye-dome
lighting, Boucheny 2009), so that edges read without normals. What is drawn first is the *index* of the visible point,
so that one rendering serves any number of colourings.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, UInt8Array

BACKGROUND = (252, 252, 250)
OVERSAMPLING = 2
CUT_BELOW_TOP_M = 0.3  # what hangs at the ceiling goes with it
ROOM_HEIGHT_M = 1.8  # a lower cloud has no ceiling to cut away
CUT_BEHIND_WALL_M = 0.25
ELEVATION = np.deg2rad(38.0)
AZIMUTHS = (np.deg2rad(-125.0), np.deg2rad(55.0))
FIELD_OF_VIEW = np.deg2rad(38.0)
DEPTH_BINS = 3  # near points are drawn larger than far ones, in this many steps
MAX_SQUARE = 15
SHADE_STRENGTH = 60.0
SHADE_REACH = 2  # pixels of the oversampled image


@dataclass(frozen=True)
class Camera:
    """A view of a box of the world.

    ``rotation`` has the camera's right, down and forward axes as rows; ``focal`` is in pixels, or pixels a metre where
    ``is_perspective`` is false. Points outside ``box`` (2, 3) are cut away.
    """

    rotation: Float64Array
    eye: Float64Array
    focal: float
    is_perspective: bool
    box: Float64Array
    width: int
    height: int


@dataclass(frozen=True)
class View:
    """A rendering: ``point`` (h, w) int32 is the visible point, -1 for none; ``shade`` (h, w) float32 in 0..1."""

    point: Int32Array
    shade: Float32Array


def room_bounds(points: Float32Array) -> Float64Array:
    """Lowest and highest corner (2, 3) of a cloud, stray points left aside."""
    return np.percentile(points.astype(np.float64), [0.5, 99.5], axis=0)


def view_cameras(bounds: Float64Array, width: int, height: int) -> tuple[Camera, Camera, Camera]:
    """A top view and views from two opposite corners of ``bounds``, ceiling and near walls cut away; z is up."""
    width, height = width * OVERSAMPLING, height * OVERSAMPLING
    low, high = bounds[0] - 0.1, bounds[1] + 0.1
    size = high - low
    top_z = bounds[1][2] - CUT_BELOW_TOP_M if size[2] >= ROOM_HEIGHT_M else high[2]
    open_top = np.array([low, [high[0], high[1], top_z]])
    pixels_per_m = 0.96 * min(width / size[0], height / size[1])
    above = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, open_top[1, 2] + 4.0])
    top = Camera(np.diag([1.0, -1.0, -1.0]), above, pixels_per_m, False, open_top, width, height)
    first, second = (_corner_camera(open_top, azimuth, width, height) for azimuth in AZIMUTHS)
    return top, first, second


def _corner_camera(open_top: Float64Array, azimuth: float, width: int, height: int) -> Camera:
    outward = np.array([np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)])
    forward = -outward
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    box = open_top.copy()
    for axis in range(2):
        if outward[axis] > 0:
            box[1, axis] -= CUT_BEHIND_WALL_M + 0.1
        else:
            box[0, axis] += CUT_BEHIND_WALL_M + 0.1
    focal = 0.5 * height / np.tan(FIELD_OF_VIEW / 2)
    corners = np.array(list(itertools.product(*open_top.T)))
    relative = (corners - open_top.mean(axis=0)) @ rotation.T
    # The least distance at which all corners are inside the image.
    reach = np.abs(relative[:, :2]) * focal / (0.48 * np.array([width, height])) - relative[:, 2:]
    eye = open_top.mean(axis=0) + outward * float(reach.max())
    return Camera(rotation, eye, float(focal), True, box, width, height)


def render(points: Float32Array, spacing_m: float, camera: Camera) -> View:
    """The visible point of each pixel, every point drawn as a square of ``spacing_m`` across."""
    from scipy.ndimage import minimum_filter

    inside = np.flatnonzero(((points >= camera.box[0]) & (points <= camera.box[1])).all(axis=1))
    relative = (points[inside].astype(np.float64) - camera.eye) @ camera.rotation.T
    depth = relative[:, 2]
    scale = camera.focal / depth if camera.is_perspective else np.full(len(depth), camera.focal)
    column = np.floor(relative[:, 0] * scale + camera.width / 2).astype(np.int64)
    row = np.floor(relative[:, 1] * scale + camera.height / 2).astype(np.int64)
    seen = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    order = np.flatnonzero(seen)[np.argsort(-depth[seen], kind="stable")]  # far first: of equal pixels the last stays
    rank = np.arange(len(order), 0, -1, dtype=np.float64)  # 1 is the nearest; float64, which the filter works in
    nearest = np.full((camera.height, camera.width), np.inf)
    for part in np.array_split(np.arange(len(order)), DEPTH_BINS):
        if len(part) == 0:
            continue
        layer = np.full((camera.height, camera.width), np.inf)
        layer[row[order[part]], column[order[part]]] = rank[part]
        size = int(np.clip(np.rint(spacing_m * scale[order[part]].mean()), 1, MAX_SQUARE))
        np.minimum(nearest, minimum_filter(layer, size, mode="constant", cval=np.inf), out=nearest)
    is_drawn = np.isfinite(nearest)
    chosen = order[len(order) - nearest[is_drawn].astype(np.int64)]
    point = np.full(nearest.shape, -1, np.int32)
    point[is_drawn] = inside[chosen]
    depth_image = np.full(nearest.shape, np.nan)
    depth_image[is_drawn] = depth[chosen]
    return View(point, _shade(depth_image))


def project(camera: Camera, points: Float64Array) -> Float64Array:
    """Columns and rows (N, 2) in the picture of ``camera``; NaN for what lies behind it."""
    relative = (points - camera.eye) @ camera.rotation.T
    depth = np.where(relative[:, 2] > 0, relative[:, 2], np.nan)
    scale = camera.focal / depth if camera.is_perspective else np.full(len(points), camera.focal)
    middle = np.array([camera.width, camera.height]) / 2
    pixels: Float64Array = (relative[:, :2] * scale[:, None] + middle) / OVERSAMPLING
    return pixels


def _shade(depth: Float64Array) -> Float32Array:
    """How much each pixel lies behind its neighbours, as a factor: 1 on open surfaces, darker at depth edges.

    ``depth`` is NaN where nothing is drawn.
    """
    log_depth = np.log2(depth)
    behind = np.zeros_like(depth)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        neighbour = np.roll(log_depth, (dy * SHADE_REACH, dx * SHADE_REACH), axis=(0, 1))
        behind += np.nan_to_num(np.clip(log_depth - neighbour, 0.0, 0.02), nan=0.0)
    return np.exp(-SHADE_STRENGTH / 8.0 * behind).astype(np.float32)


def colour(view: View, colours: UInt8Array) -> UInt8Array:
    """The picture (h / 2, w / 2, 3) of a view, point i in ``colours[i]``, averaged down to size."""
    from su3d_bench.reports.pictures.kernels import averaged_colours

    palette = np.concatenate([colours, np.array([BACKGROUND], np.uint8)]).astype(np.float32)
    averaged: UInt8Array = averaged_colours(view.point, view.shade, palette, OVERSAMPLING)
    return averaged
