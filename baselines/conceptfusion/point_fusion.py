"""PointFusion as gradslam has it: a map of points that images are associated with by projection and averaged into.

Source: gradslam, branch conceptfusion at 59ca872 (slam/fusionutils.py, structures/rgbdimages.py). Colours are left out:
nothing that is scored reads them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from su3d_bench.baselines.conceptfusion.feature_table import with_room
from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import valid_depth
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int64Array

LEAST_ALPHA, MOST_ALPHA = 1e-7, 1.01  # get_alpha
ABSENT = -1


class View(NamedTuple):
    """One image at the size of fusion, a row a pixel in row-major order, P = height * width; kernels take it as it is.

    ``points`` (P, 3) m and ``normals`` (P, 3) in the world, both zero without depth; ``has_depth`` (P,); ``alpha`` (P,)
    confidence; ``intrinsics`` (3, 3) at this size.
    """

    height: int
    width: int
    points: Float64Array
    normals: Float64Array
    has_depth: BoolArray
    alpha: Float64Array
    intrinsics: Float64Array
    camera_to_world: Float64Array


def alpha(points_camera: Float64Array, sigma: float) -> Float64Array:
    """Confidence of points (..., 3) m in the camera's frame: clamp(exp(-|p|^2 / (2 sigma^2)), 1e-7, 1.01).

    At gradslam's sigma of 0.6 it stands at its floor beyond 3.4 m.

    >>> alpha(np.array([[0.0, 0, 0], [0, 0, 0.6], [0, 0, 4]]), 0.6).round(7).tolist()
    [1.0, 0.6065307, 1e-07]
    """
    squared = (points_camera**2).sum(axis=-1)
    clamped: Float64Array = np.clip(np.exp(-squared / (2 * sigma**2)), LEAST_ALPHA, MOST_ALPHA)
    return clamped


def normals_of(vertices: Float64Array) -> Float64Array:
    """Unit normals (h, w, 3) of an image of points: the cross product of the steps to the right and down.

    The last column and row repeat the step before; a normal is zero where the steps are parallel.
    """
    right, down = np.zeros_like(vertices), np.zeros_like(vertices)
    right[:, :-1] = vertices[:, 1:] - vertices[:, :-1]
    down[:-1] = vertices[1:] - vertices[:-1]
    if vertices.shape[1] > 1:
        right[:, -1] = right[:, -2]
    if vertices.shape[0] > 1:
        down[-1] = down[-2]
    cross = np.cross(right, down)
    length = np.sqrt((cross**2).sum(axis=-1, keepdims=True))
    normals: Float64Array = cross / np.where(length == 0, 1.0, length)
    return normals


def view_of(frame: Frame, rows: Int64Array, columns: Int64Array, sigma: float) -> View:
    """``frame`` reduced to the pixels at ``rows`` and ``columns``.

    The intrinsics are scaled as gradslam scales them, by the ratio of the sizes and without regard to which pixel of
    a cell was taken. gradslam moves all poses into the first camera's frame; the map here is in the world from the
    start, which changes no distance and no angle.
    """
    (n_rows, n_columns), height, width = frame.depth_m.shape, len(rows), len(columns)
    intrinsics = frame.intrinsics * np.array([[width / n_columns], [height / n_rows], [1.0]])
    if not (intrinsics[0, 0] and intrinsics[1, 1]):
        raise DataError(f"frame {frame.index}: the intrinsics {frame.intrinsics.tolist()} have no focal length")
    depth_m = frame.depth_m[rows[:, None], columns]
    has_depth = valid_depth(depth_m, 0.0, np.inf)
    z = np.where(has_depth, depth_m, 0.0).astype(np.float64)
    v, u = np.mgrid[:height, :width]
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (u - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    vertices = np.stack([x * z, y * z, z], axis=-1)
    rotation, translation = frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3]
    # einsum, not a matrix product: a threaded one waits for cores that others use
    points = np.einsum("ij,hwj->hwi", rotation, vertices) + translation
    normals = np.einsum("ij,hwj->hwi", rotation, normals_of(vertices))
    shown = has_depth[..., None]
    return View(
        height,
        width,
        (points * shown).reshape(-1, 3),
        (normals * shown).reshape(-1, 3),
        has_depth.reshape(-1),
        alpha(vertices, sigma).reshape(-1),
        intrinsics,
        np.ascontiguousarray(frame.camera_to_world, np.float64),
    )


class PointFusion:
    """Points (N, 3) m with normals and confidence counts, in the order in which they were first seen."""

    def __init__(self, distance_m: float, normal_angle_deg: float) -> None:
        self._distance_m = distance_m
        self._least_cosine = float(np.cos(np.deg2rad(normal_angle_deg)))
        self._points, self._normals, self._counts = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def points(self) -> Float64Array:
        """A view."""
        return self._points[: self._n]

    @property
    def normals(self) -> Float64Array:
        """Weighted means of unit normals, not normalised again; a view."""
        return self._normals[: self._n]

    @property
    def counts(self) -> Float64Array:
        """The sum of the alphas of each point's observations; a view."""
        return self._counts[: self._n]

    @property
    def n_bytes(self) -> int:
        """What the points in use take."""
        return self._n * 7 * 8

    def associate(self, view: View) -> Int64Array:
        """The map point (P,) of each pixel, ABSENT for none; no point has two pixels. Costs a pass over the map.

        A map point is projected and rounded to the nearest pixel; it matches where it lies nearer than the distance
        and its normal within the angle. Of several the highest count wins, then the smallest distance to the pixel's
        point (which gradslam calls the distance to the ray), then the older point.
        """
        from su3d_bench.baselines.conceptfusion.kernels import associate

        matched: Int64Array = associate(
            self.points, self.normals, self.counts, view, self._distance_m, self._least_cosine
        )
        return matched

    def fuse(self, view: View, matched: Int64Array) -> None:
        """Average the associated pixels into their points: p <- (c p + a q) / (c + a), c <- c + a; normals alike."""
        pixel = np.flatnonzero(matched != ABSENT)
        point, added = matched[pixel], view.alpha[pixel]
        held = self._counts[point]
        total = held + added
        for mean, seen in ((self._points, view.points), (self._normals, view.normals)):
            mean[point] = (held[:, None] * mean[point] + added[:, None] * seen[pixel]) / total[:, None]
        self._counts[point] = total

    def insert(self, view: View, matched: Int64Array) -> Int64Array:
        """Append the pixels with depth that found no point; those pixels, in the order of their new points."""
        pixel = np.flatnonzero(view.has_depth & (matched == ABSENT))
        start, end = self._n, self._n + len(pixel)
        self._points = with_room(self._points, start, end)
        self._normals = with_room(self._normals, start, end)
        self._counts = with_room(self._counts, start, end)
        self._points[start:end] = view.points[pixel]
        self._normals[start:end] = view.normals[pixel]
        self._counts[start:end] = view.alpha[pixel]
        self._n = end
        return pixel
