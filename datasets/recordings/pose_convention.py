"""Check of pose and depth conventions: depth of one frame, seen from another, must agree.

It also finds which axis of the world points up, from the cameras and level surfaces.

Wrong poses that are rigid motions pass every other check and only make the map bad. The points of
one frame are projected into another under the current reading and under common mistakes: the inverse motion, the
other camera axes, both, and another unit of depth. If a mistake agrees clearly better, the reading is wrong; if
the current reading is not clearly better than the inverse, the frames cannot decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Dataset, HasReadingCorrections
from su3d_bench.core.types import Float64Array, Frame, UpAxis, WorldUp

N_ANCHORS = 4
GAPS = (1, 3, 9, 27)  # frame distances of pairs: suits fast and slow cameras, and strides
N_COLUMNS = 80  # of the pixel grid: 4,800 pixels of a 640x480 image
TOLERANCE = 0.02  # of the depth; a Kinect's noise is 1.4 % of it at 5 m (Khoshelham and Elberink 2012)
MIN_LANDED = 0.3  # a reading is trusted if this share of the points lands on pixels with depth
MIN_SHARE = 0.6  # ... and agrees with this share of those
MIN_GAIN = 0.2  # ... by this much more than the current reading
MIN_WON = 0.75  # of the pairs that distinguish two readings
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's camera axes to OpenGL's, and back
# Between the units m, mm, 0.1 mm and TUM's 0.2 mm; 8: values with bits rotated by three, as in SUN RGB-D.
ROTATED = 0.125
DEPTH_FACTORS = (0.001, 0.1, ROTATED, 0.2, 5.0, 8.0, 10.0, 1000.0)
Motion = Literal["as read", "inverse", "other axes", "inverse and other axes"]
READINGS: tuple[tuple[Motion, float], ...] = (
    ("as read", 1.0),
    ("inverse", 1.0),
    ("other axes", 1.0),
    ("inverse and other axes", 1.0),
    *(("as read", factor) for factor in DEPTH_FACTORS),
)


@dataclass(frozen=True)
class Finding:
    """Another reading that agrees better: how it differs, and mean shares of both on the deciding pairs."""

    motion: Motion
    depth_factor: float
    share_as_read: float
    share_otherwise: float

    @property
    def shares(self) -> str:
        return (
            f"poses and depth contradict each other: {self.share_as_read:.0%} of the pixels agree between frames, "
            f"{self.share_otherwise:.0%}"
        )

    def changes(self, camera_axes: str = "opencv") -> tuple[str, ...]:
        """Which of ``pose_direction`` and ``camera_axes`` to change in a description with these ``camera_axes``.

        A reading is identified by the motion between two frames. The inverse of a pose with changed axes moves like
        the pose with changed direction and axes.
        """
        direction, axes = "pose_direction", "camera_axes"
        of_motion: Mapping[Motion, tuple[str, ...]] = {
            "as read": (),
            "inverse": (direction,) if camera_axes == "opencv" else (direction, axes),
            "other axes": (axes,),
            "inverse and other axes": (direction, axes) if camera_axes == "opencv" else (direction,),
        }
        return of_motion[self.motion]


@dataclass(frozen=True)
class Verdict:
    """A finding on the reading of poses and depth: ``is_wrong`` if another reading agrees clearly better,
    otherwise the reading is only unconfirmed."""

    is_wrong: bool
    line: str


def judge_scene(dataset: Dataset, scene: str, frames: Sequence[Frame] | None = None) -> Verdict | None:
    """The verdict on a scene, worded for its dataset; None if the reading is right or not to be checked.

    ``frames`` are at full rate if available; about twenty of them are read.
    """
    if isinstance(dataset, HasReadingCorrections) and not dataset.is_reading_checked(scene):
        return None
    where = f"{dataset.name}/{scene}"
    shares = _shares(dataset.frames(scene, 1) if frames is None else frames)
    finding = _best_other(shares)
    if finding is None:
        doubt = _uncertainty(shares)
        return None if doubt is None else Verdict(False, f"{where}: {doubt}")
    if isinstance(dataset, HasReadingCorrections):
        return Verdict(True, f"{where}: {finding.shares} {dataset.correction_of_reading(scene, finding)}")
    return Verdict(True, f"{where}: {finding.shares} {_in_words(finding)}")


def _in_words(finding: Finding) -> str:
    if finding.depth_factor != 1:
        return f"with depth times {finding.depth_factor:g}; check the unit of the depth"
    words: Mapping[Motion, str] = {
        "inverse": "the inverse poses; check whether they are camera-to-world or world-to-camera",
        "other axes": "OpenGL's camera axes for OpenCV's, or the reverse; check the axes of the poses",
        "inverse and other axes": "the inverse poses and OpenGL's camera axes for OpenCV's, or the reverse; check both",
    }
    return f"with {words[finding.motion]}"


def _uncertainty(shares: Float64Array) -> str | None:
    """Why the frames cannot rule out inverted poses (the usual mistake); None if they can."""
    as_read, inverse = shares[:, 0], shares[:, READINGS.index(("inverse", 1.0))]
    if not len(shares) or max(as_read.max(), inverse.max()) < MIN_SHARE:
        best = f", at most {as_read.max():.0%} of what one frame shows" if len(shares) else ""
        return f"poses and depth could not be checked: no two of the examined frames overlap{best}"
    tells = np.abs(as_read - inverse) >= MIN_GAIN
    n_confirm = int((tells & (as_read > inverse) & (as_read >= MIN_SHARE)).sum())
    if n_confirm and n_confirm >= MIN_WON * tells.sum():
        return None
    if not tells.any():
        return "the frames cannot distinguish the poses from their inverses: the camera hardly moves between them"
    return (
        f"poses and depth may contradict each other: only {n_confirm} of {int(tells.sum())} pairs of frames agree "
        f"better with the poses than with their inverses; check with: su3d-bench datasets show"
    )


def _shares(frames: Sequence[Frame]) -> Float64Array:
    """The share of points that agree, for each pair of frames (rows) and reading (columns)."""
    cache: dict[int, Frame] = {}
    table = []
    for first, second in _pairs(len(frames)):
        for position in (first, second):
            if position not in cache:
                cache[position] = frames[position]
        points = _Points(cache[first])
        table.append([points.share_in(cache[second], motion, factor) for motion, factor in READINGS])
    return np.array(table, np.float64).reshape(-1, len(READINGS))


def _best_other(shares: Float64Array) -> Finding | None:
    """The best other reading, if it wins nearly every pair that distinguishes it from the current one.

    Frames without motion between them, or a single frame, decide nothing.
    """
    best: Finding | None = None
    for column, (motion, factor) in enumerate(READINGS[1:], start=1):
        gains = shares[:, column] - shares[:, 0]
        tells = np.abs(gains) >= MIN_GAIN
        wins = (gains >= MIN_GAIN) & (shares[:, column] >= MIN_SHARE)
        if not wins.any() or wins.sum() < MIN_WON * tells.sum():
            continue
        finding = Finding(motion, factor, float(shares[tells, 0].mean()), float(shares[tells, column].mean()))
        if best is None or finding.share_otherwise > best.share_otherwise:
            best = finding
    return best


def _pairs(n: int) -> list[tuple[int, int]]:
    """Pairs of positions in ``n`` frames, spread over the recording, in both directions of time."""
    anchors = sorted({round(part * (n - 1) / (N_ANCHORS - 1)) for part in range(N_ANCHORS)}) if n else []
    pairs = {
        (anchor, other)
        for anchor in anchors
        for gap in GAPS
        if 0 <= (other := anchor + (gap if anchor + gap < n else -gap)) < n
    }
    return sorted(pairs)


class _Points:
    """Points of one frame on a pixel grid, in camera coordinates."""

    def __init__(self, frame: Frame) -> None:
        step = max(1, frame.depth_m.shape[1] // N_COLUMNS)
        offset = step // 2
        depth_m = frame.depth_m[offset::step, offset::step].astype(np.float64)
        rows, columns = np.nonzero(depth_m > 0)
        fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        z = depth_m[rows, columns]
        x = (columns * step + offset - cx) / fx * z
        y = (rows * step + offset - cy) / fy * z
        self._points: Float64Array = np.stack([x, y, z])
        self._pose = frame.camera_to_world

    def share_in(self, other: Frame, motion: Motion, depth_factor: float) -> float:
        """The share of points that land on a pixel with depth in ``other`` and agree; 0 if few land."""
        to_other = _motion(self._pose, other.camera_to_world, motion)
        x, y, z = to_other[:3, :3] @ (self._points * depth_factor) + to_other[:3, 3:]
        fx, fy, cx, cy = other.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        in_front = z > 1e-9
        x, y, z = x[in_front], y[in_front], z[in_front]
        u, v = x / z * fx + cx, y / z * fy + cy
        height, width = other.depth_m.shape
        in_view = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        seen_m = other.depth_m[v[in_view].round().astype(int), u[in_view].round().astype(int)] * depth_factor
        has_depth = seen_m > 0
        n_landed = int(has_depth.sum())
        if n_landed < MIN_LANDED * self._points.shape[1] or n_landed == 0:
            return 0.0
        agrees = np.abs(z[in_view] - seen_m)[has_depth] <= TOLERANCE * seen_m[has_depth]
        return float(agrees.mean())


def _motion(first: Float64Array, second: Float64Array, motion: Motion) -> Float64Array:
    """The transform (4, 4) from the first pose's camera to the second's, under a reading of both."""
    if motion.startswith("inverse"):
        first, second = (np.asarray(np.linalg.inv(pose), np.float64) for pose in (first, second))
    if motion.endswith("other axes"):
        first, second = first @ FLIP, second @ FLIP
    return np.asarray(np.linalg.inv(second) @ first)


AXES: tuple[UpAxis, ...] = ("x", "y", "z", "-x", "-y", "-z")
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
MAYBE, UPRIGHT = 0.5, 0.8  # mean component of the image's up direction along an axis: 60 and 37 degrees off
LEVEL = np.cos(np.radians(15))  # cosine of surface normal and up: allows for depth noise over a few centimetres
MIN_LEVEL, MORE_LEVEL = 0.05, 2.0  # minimum share of level surfaces, and minimum ratio to the next axis
N_FRAMES = 6
N_DRAWN_COLUMNS, REACH = 80, 2  # of the pixel grid; normals use neighbours this many columns away
SMOOTH = 0.1  # of the depth; neighbours farther apart belong to different surfaces


def guess_up(poses: Float64Array, frames: Sequence[Frame]) -> WorldUp:
    """The axis that points up according to ``poses`` (n, 4, 4) and, if these are ambiguous, to some ``frames``."""
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    if not len(poses):
        return WorldUp(None, False, "no frame has a pose")
    along = DIRECTIONS @ -poses[:, :3, 1].mean(axis=0)
    candidates = np.flatnonzero(along >= MAYBE)
    if not len(candidates):
        return WorldUp(None, False, "the camera orientation varies too much")
    if len(candidates) > 1 or along[candidates[0]] < UPRIGHT:
        level = _shares_level(frames)[candidates]
        best, *others = np.sort(level)[::-1]
        if best < MIN_LEVEL or any(best < MORE_LEVEL * other for other in others):
            return WorldUp(None, False, "the cameras were tilted and no axis has clearly more level surfaces")
        return WorldUp(AXES[candidates[int(level.argmax())]], False, f"{best:.0%} of the surfaces are normal to it")
    return WorldUp(AXES[candidates[0]], False, "by camera orientation")


def _shares_level(frames: Sequence[Frame]) -> Float64Array:
    """For each of ``AXES`` the share of visible surfaces whose outward normal is along it."""
    counts, n = np.zeros(len(AXES)), 0
    for position in sorted({int(place) for place in np.linspace(0, len(frames) - 1, min(len(frames), N_FRAMES))}):
        try:
            normals = _normals(frames[position])
        except DataError:  # reported by the code that needs the frame
            continue
        counts += (normals @ DIRECTIONS.T >= LEVEL).sum(axis=0)
        n += len(normals)
    return counts / max(n, 1)


def _normals(frame: Frame) -> Float64Array:
    """Unit normals (n, 3) in the world, towards the camera, at smooth places of a pixel grid."""
    step = max(1, frame.depth_m.shape[1] // N_DRAWN_COLUMNS)
    z = frame.depth_m[::step, ::step].astype(np.float64)
    fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    v, u = np.mgrid[: z.shape[0], : z.shape[1]] * step
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    if min(z.shape) <= 2 * REACH:
        return np.zeros((0, 3))
    middle = points[REACH:-REACH, REACH:-REACH]
    around = (
        points[REACH:-REACH, 2 * REACH :],
        points[REACH:-REACH, : -2 * REACH],
        points[2 * REACH :, REACH:-REACH],
        points[: -2 * REACH, REACH:-REACH],
    )
    depth = middle[..., 2]
    is_smooth = depth > 0
    for side in around:
        is_smooth &= (side[..., 2] > 0) & (np.abs(side[..., 2] - depth) < SMOOTH * depth)
    right, left, below, above = (side[is_smooth] for side in around)
    normals = np.cross(right - left, above - below)
    length = np.linalg.norm(normals, axis=1)
    normals, seen = normals[length > 0] / length[length > 0, None], middle[is_smooth][length > 0]
    towards = np.where((normals * seen).sum(axis=1) > 0, -1.0, 1.0)
    in_world: Float64Array = (normals * towards[:, None]) @ frame.camera_to_world[:3, :3].T
    return in_world
