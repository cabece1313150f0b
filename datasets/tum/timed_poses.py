"""Trajectories as lines of time, position and quaternion, and the pose at a time between two of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import rotations_of
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings.recorded_frames import numbers
from su3d_bench.formats.arrays import read_text


def rows_of(path: Path, where: str, n_words: int, form: str) -> list[tuple[int, list[str]]]:
    """(line number, words) of every line that is no comment; commas and tabs part words, as in associate.py."""
    rows = []
    for number, line in enumerate(read_text(path, where).replace(",", " ").split("\n"), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            if len(words) != n_words:
                raise DataError(f"{where} line {number}: has {len(words)} values; expected {form}")
            rows.append((number, words))
    if not rows:
        raise DataError(f"{where}: has no lines; expected {form}")
    return rows


def seconds(word: str, where: str) -> float:
    (time_s,) = numbers([word], where)
    if not abs(time_s) < 1e12:
        raise DataError(f"{where}: the time is {time_s:g}; expected seconds")
    return time_s


def read_trajectory(path: Path, where: str) -> tuple[Float64Array, Float64Array]:
    """Times (n,) s ascending and rows (n, 7) tx ty tz qx qy qz qw with unit quaternions."""
    rows = {}
    for number, words in rows_of(path, where, 8, "'time tx ty tz qx qy qz qw'"):
        place = f"{where} line {number}"
        tx, ty, tz, *quaternion = numbers(words[1:], place)
        if not max(abs(tx), abs(ty), abs(tz)) < 1e6:
            raise DataError(f"{place}: the camera is at {tx:g} {ty:g} {tz:g}; expected metres")
        rows[seconds(words[0], place)] = [tx, ty, tz, *unit_quaternion(quaternion, place)]
    times_s = sorted(rows)
    return np.array(times_s), np.array([rows[time] for time in times_s])


def pose_at(
    time_s: float, times_s: Float64Array, rows: Float64Array, max_difference_s: float, *, interpolate: bool
) -> Float64Array | None:
    """Camera-to-world pose (4, 4) at ``time_s``; None where no row is within ``max_difference_s``."""
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
    # Below 1e-6 rad the sines are too small to divide by, and the straight line is as good.
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
    """The quaternion at length 1; one without a direction is a ``DataError``."""
    length = float(np.linalg.norm(values))
    if not (np.isfinite(length) and length > 1e-6):
        raise DataError(f"{where}: the quaternion has the length {length:g}; expected 1")
    return [value / length for value in values]
