"""A described folder of a few small frames, in every form that one may have."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from su3d_bench.core.config import write_toml
from su3d_bench.datasets.rgbd.dataset import Rgbd

WIDTH, HEIGHT = 12, 8


CAMERA = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [6.0, 0, 0, 0, 6.5, 0, 5.5, 3.5, 1]}


NUMBERED: dict[str, Any] = {
    "folder": "data",
    "colour": "colour/frame-{index}.png",
    "depth": "depth/frame-{index}.png",
    "pose": "frame-{index}.pose.txt",
    "intrinsics": [6.0, 6.5, 5.5, 3.5],
    "depth_unit_m": 0.001,
}


Change = Callable[[Path], object]


def pose(index: int) -> np.ndarray:
    matrix = np.eye(4)
    angle = 0.1 * index
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = index, 1 / 3, -index
    return matrix


def depth_values(index: int) -> np.ndarray:
    return np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 600 + index


def text_of(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in matrix) + "\n"


def log_of(indices: range) -> str:
    return "".join(f"{k} {k} {k + 1}\n{text_of(pose(k))}" for k in indices)


def write_scene(root: Path, n_frames: int = 3, description: dict[str, Any] | None = None, **changes: Any) -> Path:
    """A scene 'desk' with images, pose files and every kind of trajectory and camera file; None drops a key."""
    folder = root / "rgbd" / "desk"
    for name in ("colour", "depth"):
        (folder / "data" / name).mkdir(parents=True, exist_ok=True)
    for index in range(n_frames):
        colour = np.full((HEIGHT, WIDTH, 3), (30, 120, 200), np.uint8)
        cv2.imwrite(str(folder / f"data/colour/frame-{index}.png"), colour)
        cv2.imwrite(str(folder / f"data/depth/frame-{index}.png"), depth_values(index))
        (folder / f"data/frame-{index}.pose.txt").write_text(text_of(pose(index)))
    (folder / "data/trajectory.log").write_text(log_of(range(n_frames)))
    (folder / "data/camera.json").write_text(json.dumps(CAMERA) + "\n")
    (folder / "data/intrinsics.txt").write_text("6 0 5.5\n0 6.5 3.5\n0 0 1\n")
    describe(folder, {**(description or NUMBERED), "check_convention": False, **changes})
    return folder


def describe(folder: Path, keys: dict[str, Any]) -> None:
    leaves = [((key,), value, "") for key, value in keys.items() if value is not None]
    (folder / "rgbd.toml").write_text(write_toml(leaves))


def open_scene(root: Path) -> list[Any]:
    return list(Rgbd(root).frames("desk", 1))
