"""Posed RGB-D frames of the render that NICE-SLAM distributes: cam_params.json, traj.txt, results/.

Depth is uint16, metres are value / scale, 0 is invalid; a pose is a row-major 4x4 camera-to-world matrix with OpenCV
axes in the z-up world of the original mesh, taken as it is. A fault in any file fails the scene: the release is
complete, so a gap or a NaN means a damaged copy, and a number computed around it would not be the scene's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_bytes, file_text
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings.recorded_frames import (
    Folder,
    RecordedFrame,
    RecordedFrames,
    Recording,
    depth_m_of_values,
)
from su3d_bench.datasets.replica.truth import shown
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import UInt16Array
from su3d_bench.formats.poses import poses_of_lines

CAMERA_KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")
FRAMES_PER_SECOND = 30.0  # the release has no timestamps
MOST_OF_CAMERA = 1e9  # pixels, focal lengths and depth units stay far below


@dataclass(frozen=True)
class Camera:
    """Image size in pixels, intrinsics (3, 3), and how many depth units make a metre."""

    width: int
    height: int
    intrinsics: Float64Array
    scale: float


def read_camera(path: Path, where: str) -> Camera:
    """The camera of ``cam_params.json``; ``where`` begins each message."""
    where = f"{where}: {path.name}"
    try:
        content = parsed_json(file_bytes(path), where)
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}; it belongs into {path.parent}") from error
    table = content.get("camera") if isinstance(content, dict) else None
    if not isinstance(table, dict):
        raise DataError(f"{where}: has no table 'camera'; expected {{'camera': {{{', '.join(CAMERA_KEYS)}}}}}")
    w, h, fx, fy, cx, cy, scale = (_number(table, key, where) for key in CAMERA_KEYS)
    for key, value in (("w", w), ("h", h), ("fx", fx), ("fy", fy), ("scale", scale)):
        if value <= 0:
            raise DataError(f"{where}: '{key}' is {value:g}; it must be above 0")
    if not (w.is_integer() and h.is_integer()):
        raise DataError(f"{where}: the image size {w:g}x{h:g} is not in whole pixels")
    if not (0 <= cx <= w and 0 <= cy <= h):
        raise DataError(f"{where}: the principal point ({cx:g}, {cy:g}) lies outside the image of {w:g}x{h:g}")
    return Camera(int(w), int(h), np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), scale)


def _number(table: dict[str, Any], key: str, where: str) -> float:
    if key not in table:
        raise DataError(f"{where}: 'camera' has no '{key}'; expected {', '.join(CAMERA_KEYS)}")
    value = table[key]
    # NaN is not below any bound, and an integer of any length can be compared where it cannot become a float
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MOST_OF_CAMERA:
        raise DataError(f"{where}: '{key}' is {shown(value)}; expected a number")
    return float(value)


def read_trajectory(path: Path, where: str) -> Float64Array:
    """Camera-to-world poses (n, 4, 4), one a line; ``where`` begins each message."""
    return poses_of_lines(trajectory_lines(path, where), f"{where}: traj.txt")


def trajectory_lines(path: Path, where: str) -> list[str]:
    """The lines of ``traj.txt``, at least one."""
    try:
        lines = file_text(path).rstrip().splitlines()
    except OSError as error:
        raise DataError(f"{where}: traj.txt cannot be read: {error.strerror}; expected it in {path.parent}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: traj.txt is not a text file; copy it again") from error
    if not lines:
        raise DataError(f"{where}: traj.txt is empty; expected one pose a line")
    return lines


def check_frames_complete(scene_folder: Path, n_poses: int, where: str) -> None:
    """Raise ``DataError`` unless results/ holds exactly colour and depth of frames 0 to ``n_poses`` - 1."""
    folder = scene_folder / "results"
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise DataError(f"{where}: results/ cannot be read: {error.strerror}; expected it in {scene_folder}") from error
    colours = {int(match[1]) for name in names if (match := re.fullmatch(r"frame(\d{6,9})\.jpg", name))}
    depths = {int(match[1]) for name in names if (match := re.fullmatch(r"depth(\d{6,9})\.png", name))}
    n_frames = max(colours | depths, default=-1) + 1
    if n_frames == 0:
        raise DataError(f"{where}: results/ holds no frames; expected frame000000.jpg and depth000000.png and so on")
    for indices, file_name in ((colours, colour_name), (depths, depth_name)):
        if len(indices) < n_frames:
            first = next(index for index in range(n_frames) if index not in indices)
            n_missing = n_frames - len(indices)
            others = "" if n_missing == 1 else f", and {n_missing - 1} more"
            raise DataError(f"{where}: {file_name(first)} is missing{others}; copy results/ again")
    if n_frames != n_poses:
        raise DataError(
            f"{where}: traj.txt has {n_poses} poses but results/ has {n_frames} frames; copy the scene again"
        )


def colour_name(index: int) -> str:
    return f"results/frame{index:06d}.jpg"


def depth_name(index: int) -> str:
    return f"results/depth{index:06d}.png"


class ReplicaFrames(RecordedFrames):
    """The frames at ``indices``, each read when it is asked for; a file that cannot be used is a ``DataError``."""

    advice = "copy results/ again"

    def __init__(self, folder: Path, where: str, camera: Camera, poses: Float64Array, indices: range) -> None:
        frames = tuple(
            RecordedFrame(i, i / FRAMES_PER_SECOND, colour_name(i), depth_name(i), poses[i]) for i in indices
        )
        self._size = camera.width, camera.height
        metres = depth_m_of_values(camera.scale)
        super().__init__(Recording(where, Folder(folder), frames, camera.intrinsics, metres, ()))

    def check_size(self, width: int, height: int, where: str) -> None:
        if (width, height) != self._size:
            raise DataError(
                f"{where} is {width}x{height} but cam_params.json says {self._size[0]}x{self._size[1]}; it belongs to "
                "another render"
            )

    def check_depth(self, values: UInt16Array, where: str) -> None:
        if not values.any():
            raise DataError(f"{where}: empty depth, no pixel is above 0; copy the file again or leave the scene out")
