"""The layout of the TUM RGB-D benchmark: time stamps, images and a trajectory that were recorded together.

A sequence is a folder below the data root, ``tum/`` or ``TUM/`` with

- ``rgb.txt``, ``depth.txt``: lines ``time file``, files relative to the folder; lines that begin with # are comments
- ``associate.txt`` (optional): lines ``time colour-file time depth-file``; without it, images pair up by time
- ``groundtruth.txt``: lines ``time tx ty tz qx qy qz qw``, camera-to-world, seconds and metres
- ``camera.txt`` (optional, ours): one line ``fx fy cx cy``, pixels; without it, the benchmark's values for the camera
  in the sequence's name (``fr1``, ``freiburg2``, ...), otherwise the ROS default
- the images: 8-bit colour; 16-bit depth registered to it, 5000 units per metre, 0 if there is none

There is no ground truth of objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import rotations_of
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings import recorded_frames
from su3d_bench.datasets.recordings.file_dataset import RecordedDataset, keeps_last
from su3d_bench.formats.arrays import read_text

UNITS_PER_METRE = 5000.0  # the benchmark's page "file formats"
DEPTH_M_OF_VALUE = recorded_frames.depth_m_of_values(UNITS_PER_METRE)
MAX_CANDIDATES = 2_000_000  # pairs of images near in time; a recording has about two an image
# fx fy cx cy of the colour cameras: the benchmark's page "file formats", section "intrinsic camera calibration".
CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
    "": (525.0, 525.0, 319.5, 239.5),  # "ROS default"
}
Stamped = tuple[float, str]  # time in seconds, file name


class TumOptions(BaseModel):
    """How images and poses are matched.

    ``max_difference_s``: images further apart in time are not paired, nor are images and poses.
    ``pose``: interpolated at the colour image's time (linear, spherical; only the nearest if
    the other is further away than ``max_difference_s``), or the ``nearest``. ``intrinsics``: fx fy cx cy, replacing
    ``camera.txt`` and the benchmark's values.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_difference_s: float = Field(default=0.02, gt=0, le=1)  # the benchmark's associate.py
    pose: Literal["interpolate", "nearest"] = "interpolate"
    intrinsics: tuple[float, float, float, float] | None = None


class Tum(RecordedDataset[TumOptions]):
    """Sequences in the layout of the TUM RGB-D benchmark; unscored, because they have no ground truth of objects."""

    name = "tum"
    reader_version = 3
    places_of_scenes = (".", "tum", "TUM")
    how_to_get = (
        " or in its folder tum (a sequence is a folder with rgb.txt and depth.txt); unpack one there or set SU3D_DATA "
        "to their folder"
    )
    label_space = "none"
    no_mesh = "the benchmark has none"
    Options = TumOptions

    def is_scene(self, folder: Path) -> bool:
        n = sum((folder / name).is_file() for name in ("rgb.txt", "depth.txt", "groundtruth.txt"))
        return not folder.name.startswith(".") and n > 1  # if one is missing, the reader names it

    @keeps_last
    def recording(self, scene: str) -> recorded_frames.Recording:
        return self._open(self.folder(scene), self.where(scene))

    def _open(self, path: Path, where: str) -> recorded_frames.Recording:
        """The frames with images and a pose; missing ones are reported once, as a warning."""
        folder, limit_s = recorded_frames.Folder(path), self.options.max_difference_s
        has_pairs = (path / "associate.txt").exists()
        pairs = read_pairs(path, where) if has_pairs else associate(path, where, limit_s)
        lists = ("associate.txt",) if has_pairs else ("rgb.txt", "depth.txt")
        named = f"{where}: {' and '.join(lists)}"
        times_s, poses = read_trajectory(path / "groundtruth.txt", f"{where}: groundtruth.txt")
        frames, missing, unposed = [], [], []
        for index, ((colour_s, colour), (_, depth)) in enumerate(pairs):
            absent = [name for name in (colour, depth) if not folder.file(name, named).is_file()]
            missing += absent
            if absent:
                continue
            # The colour image's time, as in the benchmark's generate_registered_pointcloud.py: depth stamps are late,
            # and in fr1/desk depth images agree better with each other this way (88 % of the pixels against 80 %).
            pose = pose_at(colour_s, times_s, poses, limit_s, interpolate=self.options.pose == "interpolate")
            if pose is None:
                unposed.append(colour)
            else:
                frames.append(recorded_frames.RecordedFrame(index, colour_s, colour, depth, pose))
        no_pose = f"colour images have no pose within {limit_s:g} s in groundtruth.txt"
        remarks = recorded_frames.left_out(named, missing, "listed images are missing", len(frames))
        remarks += recorded_frames.left_out(where, unposed, no_pose, len(frames))
        if not frames:
            raise DataError(remarks[0] if remarks else f"{named}: no two images within {limit_s:g} s")
        camera = ("camera.txt",) if (path / "camera.txt").exists() else ()
        files = tuple(path / name for name in (*lists, *camera, "groundtruth.txt"))
        intrinsics = self._intrinsics(path, where)
        return recorded_frames.Recording(
            where, folder, tuple(frames), intrinsics, DEPTH_M_OF_VALUE, files, missing=tuple(remarks)
        )

    def _intrinsics(self, path: Path, where: str) -> Float64Array:
        if self.options.intrinsics is not None:
            return recorded_frames.pinhole(*self.options.intrinsics, where=f"{where}: option intrinsics")
        if (path / "camera.txt").exists():
            where = f"{where}: camera.txt"
            words = read_text(path / "camera.txt", where).split()
            if len(words) != 4:
                raise DataError(f"{where}: has {len(words)} values; expected one line fx fy cx cy")
            fx, fy, cx, cy = recorded_frames.numbers(words, where)
            return recorded_frames.pinhole(fx, fy, cx, cy, where)
        camera = re.search(r"(?:freiburg|fr)([123])", path.name)
        return recorded_frames.pinhole(*CAMERAS[camera[1] if camera else ""], where=where)


def read_pairs(folder: Path, where: str) -> list[tuple[Stamped, Stamped]]:
    """The rows of ``associate.txt``."""
    where = f"{where}: associate.txt"
    rows = rows_of(folder / "associate.txt", where, 4, "'time colour-file time depth-file'")
    place = f"{where} line"
    return [((seconds(a, f"{place} {n}"), b), (seconds(c, f"{place} {n}"), d)) for n, (a, b, c, d) in rows]


def associate(folder: Path, where: str, max_difference_s: float) -> list[tuple[Stamped, Stamped]]:
    """Pairs of colour and depth images, nearest in time first, each image once, as in associate.py."""
    lists = []
    for name in ("rgb.txt", "depth.txt"):
        rows = rows_of(folder / name, f"{where}: {name}", 2, "'time file'")
        stamped = {seconds(time, f"{where}: {name} line {number}"): file for number, (time, file) in rows}
        lists.append(sorted(stamped.items()))
    colours, depths = lists
    colour_s, depth_s = (np.array([time for time, _ in stamped]) for stamped in lists)
    first = np.searchsorted(depth_s, colour_s - max_difference_s)
    n_near = np.searchsorted(depth_s, colour_s + max_difference_s, side="right") - first
    if (n := int(n_near.sum())) > MAX_CANDIDATES:
        raise DataError(f"{where}: rgb.txt and depth.txt: {n} pairs within {max_difference_s:g} s; lower the limit")
    left = np.repeat(np.arange(len(colours)), n_near)
    right = np.arange(len(left)) - np.repeat(np.cumsum(n_near) - n_near - first, n_near)
    difference_s = np.abs(colour_s[left] - depth_s[right])
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for k in np.lexsort((right, left, difference_s)):
        i, j = int(left[k]), int(right[k])
        if difference_s[k] < max_difference_s and i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    return [(colours[i], depths[j]) for i, j in sorted(partner.items())]


def rows_of(path: Path, where: str, n_words: int, form: str, n_fewer: int = 0) -> list[tuple[int, list[str]]]:
    """(line number, words) of every non-comment line; commas and tabs separate words, as in associate.py.

    Each line has ``n_words``, or, if the first line does, ``n_fewer`` less.
    """
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(path, where).replace(",", " ").split("\n"), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            if not rows and len(words) == n_words - n_fewer:
                n_words = len(words)
            if len(words) != n_words:
                raise DataError(f"{where} line {number}: has {len(words)} values; expected {form}")
            rows.append((number, words))
    if not rows:
        raise DataError(f"{where}: has no lines; expected {form}")
    return rows


def seconds(word: str, where: str) -> float:
    (time_s,) = recorded_frames.numbers([word], where)
    if not abs(time_s) < 1e12:
        raise DataError(f"{where}: the time is {time_s:g}; expected seconds")
    return time_s


def read_trajectory(path: Path, where: str) -> tuple[Float64Array, Float64Array]:
    """Times (n,) s ascending and rows (n, 7) tx ty tz qx qy qz qw with unit quaternions."""
    rows = {}
    for number, words in rows_of(path, where, 8, "'time tx ty tz qx qy qz qw'"):
        place = f"{where} line {number}"
        tx, ty, tz, *quaternion = recorded_frames.numbers(words[1:], place)
        if not max(abs(tx), abs(ty), abs(tz)) < 1e6:
            raise DataError(f"{place}: the camera is at {tx:g} {ty:g} {tz:g}; expected metres")
        rows[seconds(words[0], place)] = [tx, ty, tz, *unit_quaternion(quaternion, place)]
    times_s = sorted(rows)
    return np.array(times_s), np.array([rows[time] for time in times_s])


def pose_at(
    time_s: float, times_s: Float64Array, rows: Float64Array, max_difference_s: float, *, interpolate: bool
) -> Float64Array | None:
    """Camera-to-world pose (4, 4) at ``time_s``; None if no row is within ``max_difference_s``."""
    after = int(np.searchsorted(times_s, time_s))
    near = [k for k in (after - 1, after) if 0 <= k < len(times_s) and abs(times_s[k] - time_s) <= max_difference_s]
    if not near:
        return None
    if len(near) == 1 or not interpolate:
        row = rows[min(near, key=lambda k: abs(times_s[k] - time_s))]
        return np.asarray(quaternion_poses(row[None, :3], row[None, 3:])[0])
    before, behind = rows[near[0]], rows[near[1]]
    part = (time_s - times_s[near[0]]) / (times_s[near[1]] - times_s[near[0]])
    sign = 1.0 if before[3:] @ behind[3:] >= 0 else -1.0  # a quaternion and its negative are one rotation
    angle = np.arccos(min(1.0, abs(float(before[3:] @ behind[3:]))))
    # Below 1e-6 rad the sines are too small to divide by, and linear interpolation is as good.
    weights = (1 - part, part) if angle < 1e-6 else np.sin([(1 - part) * angle, part * angle]) / np.sin(angle)
    quaternion = weights[0] * before[3:] + sign * weights[1] * behind[3:]
    translation = (1 - part) * before[:3] + part * behind[:3]
    return np.asarray(quaternion_poses(translation[None], quaternion[None] / np.linalg.norm(quaternion))[0])


def quaternion_poses(translations: Float64Array, quaternions: Float64Array) -> Float64Array:
    """Poses (n, 4, 4) of translations (n, 3) and unit quaternions (n, 4) in the order x y z w."""
    poses = np.tile(np.eye(4), (len(quaternions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations_of(quaternions), translations
    return poses


def unit_quaternion(values: Sequence[float], where: str) -> list[float]:
    """The normalized quaternion; one of length 0 is a ``DataError``."""
    length = float(np.linalg.norm(values))
    if not (np.isfinite(length) and length > 1e-6):
        raise DataError(f"{where}: the quaternion has the length {length:g}; expected 1")
    return [value / length for value in values]
