"""Posed RGB-D frames of NICE-SLAM's render: cam_params.json, traj.txt, results/.

Depth is uint16, metres are value / scale, 0 is invalid; a pose is a row-major 4x4 camera-to-world matrix with OpenCV
axes in the z-up world of the original mesh, used unchanged. Any faulty file fails the scene: the release is
complete, so a gap or a NaN means a damaged copy, and a metric would not be that of the scene.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings import recorded_frames
from su3d_bench.datasets.recordings.source import check_complete, list_folder
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.images import UInt16Array
from su3d_bench.formats.json_models import FileModel, Metres, WholeNumber, read_json
from su3d_bench.formats.poses import poses_of_lines

FRAMES_PER_SECOND = 30.0  # the release has no timestamps


Pixels = Annotated[float, Field(gt=0, lt=1e9)]


class Camera(FileModel):
    """Image size and intrinsics in pixels, and depth units per metre."""

    w: WholeNumber
    h: WholeNumber
    fx: Pixels
    fy: Pixels
    cx: Metres
    cy: Metres
    scale: Pixels

    @model_validator(mode="after")
    def _check_principal_point(self) -> Camera:
        if not (0 <= self.cx <= self.w and 0 <= self.cy <= self.h):
            raise ValueError(f"the principal point ({self.cx:g}, {self.cy:g}) lies outside the image")
        return self

    @property
    def intrinsics(self) -> Float64Array:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class CameraFile(FileModel):
    camera: Camera


def read_camera(path: Path, where: str) -> Camera:
    """The camera of ``cam_params.json``; ``where`` begins each message."""
    return read_json(path, f"{where}: {path.name}", CameraFile, f"it belongs into {path.parent}").camera


def read_trajectory(path: Path, where: str) -> Float64Array:
    """Camera-to-world poses (n, 4, 4), one per line; ``where`` begins each message."""
    return poses_of_lines(trajectory_lines(path, where), f"{where}: traj.txt")


def trajectory_lines(path: Path, where: str) -> list[str]:
    """The lines of ``traj.txt``, at least one."""
    lines = read_text(path, f"{where}: traj.txt").rstrip().splitlines()
    if not lines:
        raise DataError(f"{where}: traj.txt is empty; expected one pose per line")
    return lines


def check_frames_complete(scene_folder: Path, n_poses: int, where: str) -> None:
    """Raise ``DataError`` unless results/ has exactly the colour and depth of frames 0 to ``n_poses`` - 1."""
    names = list_folder(scene_folder, "results", where)
    matches = {
        "results/frame{:06d}.jpg": [re.fullmatch(r"frame(\d{6,9})\.jpg", name) for name in names],
        "results/depth{:06d}.png": [re.fullmatch(r"depth(\d{6,9})\.png", name) for name in names],
    }
    kinds = {kind: {int(match[1]): match[0] for match in found if match} for kind, found in matches.items()}
    n_frames = max(set().union(*kinds.values()), default=-1) + 1
    if n_frames == 0:
        raise DataError(f"{where}: results/ has no frames; expected frame000000.jpg and depth000000.png and so on")
    check_complete(kinds, range(n_frames), where, "copy results/ again")
    if n_frames != n_poses:
        raise DataError(f"{where}: traj.txt has {n_poses} poses but results/ has {n_frames} frames; copy it again")


def colour_name(index: int) -> str:
    return f"results/frame{index:06d}.jpg"


def depth_name(index: int) -> str:
    return f"results/depth{index:06d}.png"


class ReplicaFrames(recorded_frames.RecordedFrames):
    """The frames at ``indices``, each read on access; a file that cannot be used is a ``DataError``."""

    advice = "copy results/ again"

    def __init__(self, folder: Path, where: str, camera: Camera, poses: Float64Array, indices: range) -> None:
        frames = tuple(
            recorded_frames.RecordedFrame(i, i / FRAMES_PER_SECOND, colour_name(i), depth_name(i), poses[i])
            for i in indices
        )
        metres, size = recorded_frames.depth_m_of_values(camera.scale), (camera.w, camera.h)
        super().__init__(
            recorded_frames.Recording(
                where, recorded_frames.Folder(folder), frames, camera.intrinsics, metres, (), size
            )
        )

    def check_depth(self, values: UInt16Array, where: str) -> None:
        if not values.any():
            raise DataError(f"{where}: empty depth, no pixel is above 0; copy the file again or exclude the scene")
