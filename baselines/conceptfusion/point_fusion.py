"""PointFusion as in gradslam: a map of points; images are associated by projection and averaged into it.

Source: gradslam, branch conceptfusion at 59ca872 (slam/fusionutils.py, structures/rgbdimages.py). Colours are omitted:
no metric uses them. The table has one half-precision feature per point, in memory or on disk.
"""

from __future__ import annotations

import tempfile
from typing import IO, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.atomic import release_pages, row_blocks, scratch_folder
from su3d_bench.core.geometry import valid_depth
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, Int32Array, Int64Array

Place = Literal["memory", "disk"]
HalfArray = NDArray[np.float16]
MAX_LENGTH = 1e30  # minimal confidences are rounded up by a fifth at every image: prevents overflow
BLOCK_ROWS = 4096  # 16 MB of float32 at 1024 dimensions


class FeatureTable:
    """Features (N, D) float16 and the confidence of each.

    They are in memory, or in an anonymous file on disk, which disappears with the process. Arithmetic
    uses blocks in float32, rounded to half precision once per update. ``average_in_half`` stores the
    length of features separately, so that they stay within half precision.
    """

    def __init__(self, n_dimensions: int, place: Place) -> None:
        self.n_dimensions = n_dimensions
        self._file = _nameless_file() if place == "disk" else None
        self._rows = np.empty((0, n_dimensions), np.float16)  # in memory
        self._confidences = np.empty(0)
        self._lengths: Float64Array | None = None  # (N,) factor of each row
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def n_bytes(self) -> int:
        """Bytes of the features."""
        return self._n * self.n_dimensions * 2

    @property
    def confidences(self) -> Float64Array:
        """Confidence (N,) of each feature; a view."""
        return self._confidences[: self._n]

    def append(self, features: HalfArray, row: Int32Array, confidences: Float64Array) -> None:
        """Add ``features[row]`` with their ``confidences``, zero rows included."""
        end = self._n + len(row)
        self._confidences = with_room(self._confidences, self._n, end)
        self._confidences[self._n : end] = confidences
        if self._lengths is not None:
            self._lengths = with_room(self._lengths, self._n, end)
            self._lengths[self._n : end] = 1.0
        for start in range(0, len(row), BLOCK_ROWS):
            block = features[row[start : start + BLOCK_ROWS]]
            self._write(block, self._n + start)
        self._n = end

    def _write(self, block: HalfArray, first_row: int) -> None:
        if self._file is None:
            end = first_row + len(block)
            self._rows = with_room(self._rows, first_row, end)
            self._rows[first_row:end] = block
            return
        # A plain write fails if the disk is full; writing through a memory map of a sparse file would kill the process.
        try:
            self._file.seek(first_row * self.n_dimensions * 2)
            self._file.write(block.tobytes())
            self._file.flush()
        except OSError as error:
            raise _disk_error(error) from error

    def average(self, point: Int64Array, features: HalfArray, row: Int32Array, weights: Float64Array) -> None:
        """Running mean of ``features[row]`` with ``weights`` into the features of ``point`` (no duplicates).

        f <- (c f + w e) / (c + w), c <- c + w; the mean is not normalised.
        """
        if not len(point):
            return
        order = np.argsort(point, kind="stable")  # read neighbouring rows together
        table = self._mapped("r+")
        for start in range(0, len(order), BLOCK_ROWS):
            chosen = order[start : start + BLOCK_ROWS]
            of_point = point[chosen]
            stored, added = self._confidences[of_point], weights[chosen]
            share: Float32Array = (added / (stored + added)).astype(np.float32)[:, None]
            before: Float32Array = table[of_point].astype(np.float32)
            table[of_point] = (np.float32(1) - share) * before + share * features[row[chosen]].astype(np.float32)
            self._confidences[of_point] = stored + added
            release_pages(table)

    def average_in_half(self, point: Int64Array, features: HalfArray, row: Int32Array, weights: Float64Array) -> None:
        """Like ``average``, for every image that matched a point, with gradslam's half-precision products.

        Confidences are rounded to half precision first; the product of the image's confidence and feature
        stays half precision, and so does the map's the first time: what falls below 3e-8 is lost. After that,
        its features are in single precision, and a row without a match is multiplied by its rounded
        confidence and divided by the unrounded one. Source: fuse_with_map of gradslam at 59ca872.
        """
        table = self._mapped("r+")
        stored = self._confidences[: self._n].copy()
        rounded = stored.astype(np.float16)
        is_first = self._lengths is None
        lengths = np.ones(self._n) if self._lengths is None else self._lengths[: self._n]
        added = np.zeros(self._n)
        added[point] = weights
        source = np.full(self._n, -1, np.int64)
        source[point] = row
        if not is_first:
            lengths = np.minimum(lengths * np.where(source < 0, rounded / stored, 1.0), MAX_LENGTH)
        changed = np.arange(self._n) if is_first else np.sort(point)
        for start in range(0, len(changed), BLOCK_ROWS):
            chosen = changed[start : start + BLOCK_ROWS]
            seen = features[source[chosen]] * (added[chosen].astype(np.float16) * (source[chosen] >= 0))[:, None]
            if is_first:
                total = (table[chosen] * rounded[chosen, None] + seen).astype(np.float32)
            else:
                before = table[chosen] * lengths[chosen, None].astype(np.float32)
                total = before * rounded[chosen, None].astype(np.float32) + seen
            mean = total / (stored + added)[chosen, None].astype(np.float32)
            lengths[chosen] = np.maximum(np.abs(mean).max(axis=1), 1.0)
            table[chosen] = mean / lengths[chosen, None].astype(np.float32)
            release_pages(table)
        self._confidences[: self._n] = stored + added
        self._lengths = lengths

    def _mapped(self, mode: Literal["r", "r+"]) -> HalfArray:
        if self._file is None:
            return self._rows[: self._n]
        # mapped again at each use, because the file grows in between
        return np.memmap(self._file, np.float16, mode, shape=(self._n, self.n_dimensions))

    def features(self) -> HalfArray:
        """The features (N, D), read-only: a view of the table, whose rows change with the next ``average``."""
        table = self._mapped("r") if self.n_bytes else np.zeros((self._n, self.n_dimensions), np.float16)
        table.flags.writeable = False
        return table

    def state(self) -> dict[str, Float64Array | None]:
        """What ``restore`` needs besides the features."""
        return {"confidences": self.confidences, "lengths": None if self._lengths is None else self._lengths[: self._n]}

    def restore(self, features: HalfArray, confidences: Float64Array, lengths: Float64Array | None) -> None:
        """Fill this empty table."""
        for rows, block in row_blocks(features, BLOCK_ROWS):
            self._write(block, rows.start)
        self._confidences, self._lengths, self._n = confidences, lengths, len(features)

    def close(self) -> None:
        """Release the disk space; a remaining view keeps it until it is deleted."""
        if self._file is not None:
            self._file.close()


def _nameless_file() -> IO[bytes]:
    try:
        file: IO[bytes] = tempfile.TemporaryFile(dir=scratch_folder())  # noqa: SIM115  (closed by the table)
    except OSError as error:
        raise _disk_error(error) from error
    return file


def _disk_error(error: OSError) -> StoreError:
    return StoreError(
        f"cannot write features to {scratch_folder()}: {error.strerror or error}; set TMPDIR to a larger disk, or "
        "feature_storage = 'memory'"
    )


def with_room(array: NDArray[Any], used: int, needed: int) -> NDArray[Any]:
    """``array`` with space for ``needed`` rows, growing by half so that appending stays cheap."""
    if needed <= len(array):
        return array
    larger = np.empty((max(needed, len(array) * 3 // 2), *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger


MIN_ALPHA, MAX_ALPHA = 1e-7, 1.01  # get_alpha
ABSENT = -1


class View(NamedTuple):
    """One image at fusion size, one row per pixel in row-major order, P = height * width; used directly by kernels.

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

    At gradslam's sigma of 0.6 it is minimal beyond 3.4 m.

    >>> alpha(np.array([[0.0, 0, 0], [0, 0, 0.6], [0, 0, 4]]), 0.6).round(7).tolist()
    [1.0, 0.6065307, 1e-07]
    """
    squared = (points_camera**2).sum(axis=-1)
    clamped: Float64Array = np.clip(np.exp(-squared / (2 * sigma**2)), MIN_ALPHA, MAX_ALPHA)
    return clamped


def normals_of(vertices: Float64Array) -> Float64Array:
    """Unit normals (h, w, 3) of an image of points: the cross product of the steps right and down.

    The last column and row repeat the previous step; a normal is zero if the steps are parallel.
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

    The intrinsics are scaled as in gradslam: by the ratio of sizes, ignoring which pixel of
    a cell was used. gradslam moves all poses into the first camera's frame; the map here is in the world from the
    start, which changes no distances or angles.
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
    # einsum, not a matrix product: a threaded one waits for busy cores
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
        """Weighted means of unit normals, not renormalised; a view."""
        return self._normals[: self._n]

    @property
    def counts(self) -> Float64Array:
        """The sum of the alphas of each point's observations; a view."""
        return self._counts[: self._n]

    @property
    def n_bytes(self) -> int:
        """Bytes of the points in use."""
        return self._n * 7 * 8

    def restore(self, points: Float64Array, normals: Float64Array, counts: Float64Array) -> None:
        """Replace the map by these points."""
        self._points, self._normals, self._counts, self._n = points, normals, counts, len(counts)

    def associate(self, view: View) -> Int64Array:
        """The map point (P,) of each pixel, ABSENT for none; each point has at most one pixel. One pass over the map.

        A map point is projected and rounded to the nearest pixel; it matches if it is nearer than the distance
        and its normal within the angle. Of several candidates the highest count wins, then the smallest distance to the
        pixel's point (called the distance to the ray in gradslam), then the older point.
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
        stored = self._counts[point]
        total = stored + added
        for mean, seen in ((self._points, view.points), (self._normals, view.normals)):
            mean[point] = (stored[:, None] * mean[point] + added[:, None] * seen[pixel]) / total[:, None]
        self._counts[point] = total

    def insert(self, view: View, matched: Int64Array) -> Int64Array:
        """Append the pixels with depth but no match; returns those pixels, in the order of their new points."""
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
