"""Pack a map for the HTML page: downsampled, quantised, sorted along a Z-order curve and deflated.

The content of a map is ``JSON length (uint32, little endian) | JSON | tree | planes``. The tree is an octree of the
points, stored level by level: one byte per cell, whose bit k is set if octant k (+1 for the upper half along x, +2
along y, +4 along z) contains points; ``depth`` levels down to cells of ``step`` metres with one point each; ``origin``
is the centre of the first cell. The JSON names the planes in order; a 16-bit plane stores its low bytes, then its high
bytes, which compresses far better.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.geometry import voxel_coordinates
from su3d_bench.core.maps import DenseFeatures, Prediction
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from su3d_bench.formats.images import jpeg_bytes
from su3d_bench.metrics.matching.nearest import Candidates
from su3d_bench.metrics.matching.rows import first_rows
from su3d_bench.reports.pictures.maps import map_cloud

MIN_SPACING_M = 0.015  # between drawn points; finer spacing is invisible on a screen
COARSER = 1.15  # ratio between consecutive candidate spacings
STEPS_PER_SPACING = 2  # points are at the centres of these finer cells, so that the grid is not visible
MAX_CELLS = 1 << 16  # per axis: positions are 16-bit integers
NO_GROUND_TRUTH_NEAR, NOT_SCORED = 0xFFFF, 0xFFFE
NEAR_M = 0.05  # maximum distance between a map point and its ground truth
COLOUR_NEAR_M = 0.06  # the points of frames are sampled every few centimetres
DEFLATE_LEVEL = 7  # level 9 takes five times as long and saves only 2 %
COLOUR_BITS = 5  # per channel; more is invisible on single points


@dataclass(frozen=True)
class Cloud:
    """The drawn points of a map: ``rows`` (n,) are indices into its points, ``spacing_m`` apart, in drawing order."""

    rows: Int64Array
    points: Float32Array
    spacing_m: float


def thinned(points: Float32Array, most: int) -> Cloud:
    """Downsample ``points`` to at most ``most``, one per voxel, at the smallest sufficient candidate spacing.

    Coarser grids are applied to the points kept by the finest one.
    """
    extent_m = max((float(np.ptp(column)) for column in points.T), default=0.0) if len(points) else 0.0
    finest_m = max(MIN_SPACING_M, STEPS_PER_SPACING * extent_m / (MAX_CELLS - 2))

    def spacing(n_steps: int) -> float:
        return finest_m * COARSER**n_steps

    finest = _first_of_cells(points, spacing(0))
    left = points[finest]
    n_steps, rows = 0, np.arange(len(finest))
    if len(rows) > most:
        # Points lie on surfaces: the number of cells falls with the square of the spacing.
        n_steps = max(1, round(math.log(len(rows) / most) / (2 * math.log(COARSER))))
        rows = _first_of_cells(left, spacing(n_steps))
        is_above = len(rows) > most  # then the loop below ends at the smallest sufficient spacing
        while len(rows) > most:
            n_steps += 1
            rows = _first_of_cells(left, spacing(n_steps))
        while not is_above and n_steps > 1 and len(finer := _first_of_cells(left, spacing(n_steps - 1))) <= most:
            n_steps, rows = n_steps - 1, finer
    rows = finest[rows]
    order = np.argsort(_curve(voxel_coordinates(points[rows], spacing(n_steps) / STEPS_PER_SPACING)), kind="stable")
    return Cloud(rows[order], points[rows[order]], spacing(n_steps))


def _first_of_cells(points: Float32Array, spacing_m: float) -> Int64Array:
    if not len(points):
        return np.zeros(0, np.int64)
    return np.sort(first_rows(voxel_coordinates(points, spacing_m)))


def _curve(cells: Int64Array) -> Int64Array:
    """Return the Z-order (Morton) index of each cell (n, 3)."""
    if not len(cells):
        return np.zeros(0, np.int64)
    cells = cells - cells.min(axis=0)
    key = np.zeros(len(cells), np.int64)
    for bit in range(int(cells.max()).bit_length()):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return key


def point_owners(prediction: Prediction, rows: Int64Array) -> Int32Array:
    """Return the instance of each of the points ``rows``, -1 for none; where masks overlap, the smaller one.

    Dense features have no instances.
    """
    if isinstance(prediction, DenseFeatures):
        return np.full(len(rows), -1, np.int32)
    return map_cloud(prediction).owner[rows]


def nearest_colours(points: Float32Array, seen: Candidates, seen_rgb: UInt8Array) -> UInt8Array | None:
    """Return the colour (n, 3) of the nearest point seen in frames, grey if none is near; None without frames."""
    if not len(seen) or not len(points):
        return None
    _, nearest_row = seen.nearest(points, COLOUR_NEAR_M)
    return np.where(nearest_row[:, None] >= 0, seen_rgb[nearest_row], np.uint8(128))


def nearest_classes(points: Float32Array, truth: Candidates, classes: Int64Array) -> Int64Array:
    """Return the ground-truth class (n,) near each point, ``NOT_SCORED`` without class or ``NO_GROUND_TRUTH_NEAR``."""
    _, nearest_row = truth.nearest(points, NEAR_M)
    if not len(truth):
        return np.full(len(points), NO_GROUND_TRUTH_NEAR)
    classes = np.where(classes >= 0, classes, NOT_SCORED)
    return np.where(nearest_row >= 0, classes[nearest_row], NO_GROUND_TRUTH_NEAR)


def jpeg_text(rgb: UInt8Array, quality: int) -> str:
    """Return an image as a base64 JPEG."""
    return base64.b64encode(jpeg_bytes(rgb, quality)).decode("ascii")


def pack_map(cloud: Cloud, planes: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> str:
    """Return a map in base64. ``planes``: attributes (n,) or (n, 3), uint8 or uint16; ``about``: plain values."""
    step = cloud.spacing_m / STEPS_PER_SPACING
    cells = voxel_coordinates(cloud.points, step)
    levels = _tree(_curve(cells))
    low = (cells.min(axis=0) + 0.5) * step if len(cells) else np.zeros(3)
    header = {
        "n": len(cloud.points),
        "origin": [round(float(value), 6) for value in low],
        "step": step,
        "spacing": cloud.spacing_m,
        "depth": len(levels),
        "planes": [
            {
                "name": name,
                "bytes": plane.dtype.itemsize,
                "width": plane.shape[1] if plane.ndim > 1 and len(plane) else 1,
            }
            for name, plane in planes.items()
        ],
        **about,
    }
    text = json.dumps(header, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    parts = [len(text).to_bytes(4, "little"), text, *levels, *(_plane_bytes(plane) for plane in planes.values())]
    return base64.b64encode(zlib.compress(b"".join(parts), DEFLATE_LEVEL)).decode("ascii")


def _tree(places: Int64Array) -> list[bytes]:
    """Return the octree levels, root first, of cells at these Morton indices ``places`` (unique, ascending)."""
    levels: list[bytes] = []
    while len(places) and places[-1] > 0:
        parents = places >> 3
        first = np.flatnonzero(np.diff(parents, prepend=-1))
        levels.append(np.bitwise_or.reduceat(1 << (places & 7), first).astype(np.uint8).tobytes())
        places = parents[first]
    return levels[::-1]


def _plane_bytes(plane: NDArray[Any]) -> bytes:
    """Return the bytes column by column; for 16 bits the low bytes of each column, then its high bytes."""
    columns = plane.reshape(len(plane), -1).T if len(plane) else plane.reshape(1, 0)
    if plane.dtype == np.uint16:
        halves = ((column & 255, column >> 8) for column in columns)
        return b"".join(half.astype(np.uint8).tobytes() for pair in halves for half in pair)
    return np.ascontiguousarray(columns, np.uint8).tobytes()


def colour_plane(colours: UInt8Array) -> UInt8Array:
    """Quantise colours (n, 3) to ``COLOUR_BITS`` per channel, rescaled to 0..255."""
    kept = colours >> (8 - COLOUR_BITS)
    return ((kept << (8 - COLOUR_BITS)) | (kept >> (2 * COLOUR_BITS - 8))).astype(np.uint8)


def index_plane(values: Int32Array | Int64Array) -> NDArray[np.uint16]:
    """Return indices as uint16; -1 and values that do not fit become 65535."""
    return np.where((values >= 0) & (values < 0xFFFF), values, 0xFFFF).astype(np.uint16)


def frame_cover(views: Sequence[Sequence[int]], most: int) -> list[int]:
    """Choose at most ``most`` frames that together show as many instances as possible (greedy set cover).

    ``views`` lists the frames of each instance; ties go to the earlier frame.

    >>> frame_cover([[0, 5], [5], [9], []], 2)
    [5, 9]
    """
    left = [set(frames) for frames in views if frames]
    chosen: list[int] = []
    while left and len(chosen) < most:
        counts: dict[int, int] = {}
        for frames in left:
            for frame in frames:
                counts[frame] = counts.get(frame, 0) + 1
        best = min(counts, key=lambda frame: (-counts[frame], frame))
        chosen.append(best)
        left = [frames for frames in left if best not in frames]
    return chosen


def extent_of(points: Float32Array) -> dict[str, list[float]]:
    """Return the centre and size in metres of the bounding box of ``points``; an empty dict without points."""
    if not len(points):
        return {}
    low, high = points.min(axis=0), points.max(axis=0)
    return {
        "centre": [round(float(value), 3) for value in (low + high) / 2],
        "size": [round(float(value), 3) for value in high - low],
    }


def box_in_view(
    points: Float32Array, camera_to_world: Float64Array, intrinsics: Float64Array, width: int, height: int
) -> list[float] | None:
    """Return the box of projected points as left, top, right, bottom in 0..1; None if no point is in the image."""
    relative = (points.astype(np.float64) - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
    relative = relative[relative[:, 2] > 0.05]  # m in front of the camera
    pixels = relative @ intrinsics.T
    place = pixels[:, :2] / pixels[:, 2:] / np.array([width, height])
    place = place[((place >= 0) & (place <= 1)).all(axis=1)]
    if not len(place):
        return None
    return [round(float(value), 3) for value in (*place.min(axis=0), *place.max(axis=0))]
