"""Camera poses from text: one row-major matrix of 16 numbers per line, as in NICE-SLAM and gradslam trajectories."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.system.files import opened_text
from su3d_bench.core.types import Float32Array, Float64Array

MAX_LINE = 4096  # characters of a pose; 16 numbers have about 400


def poses_of_lines(lines: Sequence[str], where: str, first_line: int = 1) -> Float64Array:
    """Rigid camera-to-world poses (n, 4, 4), one per line; ``where`` names the file, ``first_line`` counts from 1."""
    poses = np.array([_values(line, f"{where} line {n}") for n, line in enumerate(lines, first_line)])
    poses = poses.reshape(-1, 4, 4)
    is_rigid = are_rigid(poses)
    if not is_rigid.all():
        raise DataError(
            f"{where} line {first_line + int(np.argmin(is_rigid))}: not a rigid transform; expected a row-major "
            "camera-to-world matrix with last row 0 0 0 1"
        )
    return poses


def _values(line: str, where: str) -> list[float]:
    words = line.split()
    if len(words) != 16:
        raise DataError(f"{where} has {len(words)} values; expected 16, a row-major 4x4 camera-to-world matrix")
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where}: {str(error)[:80]}; expected 16 numbers") from error
    for value, word in zip(values, words, strict=True):
        if not math.isfinite(value):
            raise DataError(f"{where}: the pose has '{word[:20]}'; fix the trajectory or exclude the scene")
    return values


def read_first_pose(path: Path, where: str) -> Float32Array:
    """The camera-to-world matrix (4, 4) in the first line, in single precision as in the original."""
    try:
        with opened_text(path) as file:
            line = file.readline(MAX_LINE)
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}; it belongs to the ground-truth cloud") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: is not a text file; copy it again") from error
    pose: Float32Array = poses_of_lines([line], where)[0].astype(np.float32)
    return pose


def moved(points: Float32Array, camera_to_world: Float32Array) -> Float32Array:
    """``points`` (N, 3) in the world, in single precision, bit-identical on every machine."""
    rotation, translation = camera_to_world[:3, :3], camera_to_world[:3, 3]
    world = [
        points[:, 0] * rotation[row, 0]
        + points[:, 1] * rotation[row, 1]
        + points[:, 2] * rotation[row, 2]
        + translation[row]
        for row in range(3)
    ]
    return np.stack(world, axis=1).astype(np.float32)
