"""Where the phone was: lines of time, axis-angle and translation, and the pose nearest to an image's time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.datasets.recordings.recorded_frames import numbers
from su3d_bench.formats.text_files import read_text

N_COLUMNS = 7  # time, the axis of the rotation times its angle, translation: DATA.md of apple/ARKitScenes at 7283761
MOST_ROTATION = 1e3  # rad; half a turn is all that a writer needs
# FrameReaderDataLoaderLowRes of opensun3d_challenge_utils.py, OpenSun3D/cvpr24-challenge at 59db30f: an image whose
# nearest pose is so far away or farther is left out, and times of poses count in milliseconds.
MOST_DIFFERENCE_S = 0.3
MILLISECONDS = 3


@dataclass(frozen=True)
class Trajectory:
    """``times_s`` (n,) ascending, each once; ``poses`` (n, 4, 4) camera-to-world, metres."""

    times_s: Float64Array
    poses: Float64Array

    def nearest(self, times_s: Float64Array, most_s: float = MOST_DIFFERENCE_S) -> Int64Array:
        """The row of the pose nearest to each time, the later of equals; -1 where none is nearer than ``most_s``."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 0, len(self.times_s) - 1)
        before = np.maximum(after - 1, 0)
        is_before = np.abs(times_s - self.times_s[before]) < np.abs(times_s - self.times_s[after])
        row = np.where(is_before, before, after)
        return np.where(np.abs(self.times_s[row] - times_s) < most_s, row, -1)


def read_trajectory(path: Path, where: str) -> Trajectory:
    """The poses of a file ``lowres_wide.traj``, whose lines are world-to-camera; of equal times the last counts."""
    rows: dict[float, list[float]] = {}
    for number, line in enumerate(read_text(path, where).split("\n"), start=1):
        words = line.split()
        if not words:
            continue
        at = f"{where} line {number}"
        if len(words) != N_COLUMNS:
            raise DataError(f"{at}: has {len(words)} values; expected time, axis-angle and translation, {N_COLUMNS}")
        time_s, *rest = numbers(words, at)
        is_usual = 0 <= time_s < 1e12 and max(map(abs, rest[:3])) < MOST_ROTATION and max(map(abs, rest[3:])) < 1e6
        if not is_usual:  # of values that are not finite, too
            shown = " ".join(f"{value:g}" for value in (time_s, *rest))
            raise DataError(f"{at}: is {shown}; expected seconds, radians and metres; copy the file again")
        rows[round(time_s, MILLISECONDS)] = rest
    if not rows:
        raise DataError(f"{where}: has no pose; copy the file again")
    times_s = np.array(sorted(rows))
    return Trajectory(times_s, _camera_to_world(np.array([rows[time] for time in times_s.tolist()])))


def _camera_to_world(rows: Float64Array) -> Float64Array:
    """Poses (n, 4, 4) of rows (n, 6) of world-to-camera axis-angle and translation."""
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    turned = Rotation.from_rotvec(rows[:, :3]).inv().as_matrix()
    poses[:, :3, :3] = turned
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", turned, rows[:, 3:])
    return poses


def trajectory_line(time: str, camera_to_world: Float64Array) -> str:
    """The line of a pose (4, 4) as ``read_trajectory`` reads it, ``time`` in seconds."""
    from scipy.spatial.transform import Rotation

    to_camera = np.linalg.inv(camera_to_world)
    turn = Rotation.from_matrix(to_camera[:3, :3]).as_rotvec()
    return " ".join((time, *(repr(float(value)) for value in (*turn, *to_camera[:3, 3])))) + "\n"
