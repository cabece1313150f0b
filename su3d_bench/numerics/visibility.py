"""Which points of a scene depth images show: each point is projected into the image, not each pixel into the world."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, Int32Array

# Above the random error of structured light at the end of its range, 4 cm at 5 m (Khoshelham and Elberink, Sensors
# 2012), and below the thickness of most furniture, whose back must not count as seen from the front.
SEEN_M = 0.05
CHUNK = 1 << 18  # points projected at a time, about 20 MB


def visible(points: Float32Array, frame: Frame, distance_m: float = SEEN_M) -> BoolArray:
    """Which of ``points`` (N, 3) m a frame shows: those inside its image whose distance along the optical axis differs
    by at most ``distance_m`` from the depth at the nearest pixel.

    A farther point is occluded, a nearer one in front of the surface. A pixel without depth shows nothing.

    >>> camera = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    >>> wall = Frame(0, 0.0, np.zeros((24, 32, 3), np.uint8), np.full((24, 32), 2.0, np.float32), np.eye(4), camera)
    >>> visible(np.array([[0, 0, 2], [0, 0, 2.2], [0, 0, 1.8], [3, 0, 2]], np.float32), wall).tolist()
    [True, False, False, False]
    """
    return np.asarray(np.abs(depth_gap(points, frame)) <= distance_m, np.bool_)


def depth_gap(points: Float32Array | Float64Array, frame: Frame) -> Float64Array:
    """How far (N,) m behind each of ``points`` (N, 3) m, along the optical axis, a frame sees a surface.

    Above 0 the frame looks through the point, below 0 the point is occluded; NaN outside the image or without depth.
    """
    parts = [_depth_gap(points[start : start + CHUNK], frame) for start in range(0, len(points), CHUNK)]
    return np.concatenate([np.zeros(0), *parts])


def _depth_gap(points: Float32Array | Float64Array, frame: Frame) -> Float64Array:
    height, width = frame.depth_m.shape
    to_world, camera = frame.camera_to_world, frame.intrinsics
    offset = points.T.astype(np.float64) - to_world[:3, 3:]
    # Axis by axis: the last bit of a matrix product depends on the library and its threads.
    x, y, z = (sum(to_world[k, axis] * offset[k] for k in range(3)) for axis in range(3))
    rows = np.flatnonzero(z > 0)
    x, y, z = x[rows], y[rows], z[rows]
    column = np.rint((camera[0, 0] * x + camera[0, 1] * y) / z + camera[0, 2])
    row = np.rint(camera[1, 1] * y / z + camera[1, 2])
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth_m = frame.depth_m[row[is_inside].astype(np.int64), column[is_inside].astype(np.int64)]
    gap = np.full(len(points), np.nan)
    gap[rows[is_inside]] = np.where(depth_m > 0, depth_m - z[is_inside], np.nan)
    return gap


def first_shown(clouds: Sequence[Float32Array], frames: Iterable[Frame]) -> list[Int32Array]:
    """For each of ``clouds`` (N, 3) m, the place (N,) of the first frame that shows each point, from 0; a number above
    all places if none does."""
    never = np.iinfo(np.int32).max
    first = [np.full(len(cloud), never, np.int32) for cloud in clouds]
    for place, frame in enumerate(frames):
        for cloud, shown in zip(clouds, first, strict=True):
            left = np.flatnonzero(shown == never)
            shown[left[visible(cloud[left], frame)]] = place
    return first
