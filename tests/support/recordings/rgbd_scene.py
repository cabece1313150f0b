"""A described folder of a few small frames, in every supported form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from recording_files import HEIGHT, WIDTH, depth_values, text_of, turn, write_files

from su3d_bench.core.config import write_toml
from su3d_bench.datasets.rgbd.dataset import Rgbd

CAMERA = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [6.0, 0, 0, 0, 6.5, 0, 5.5, 3.5, 1]}
NUMBERED: dict[str, Any] = {
    "folder": "data",
    "colour": "colour/frame-{index}.png",
    "depth": "depth/frame-{index}.png",
    "pose": "frame-{index}.pose.txt",
    "intrinsics": [6.0, 6.5, 5.5, 3.5],
    "depth_unit_m": 0.001,
}


def log_of(indices: range) -> str:
    return "".join(f"{k} {k} {k + 1}\n{text_of(turn(k))}" for k in indices)


def write_scene(root: Path, n_frames: int = 3, **changes: Any) -> Path:
    """A scene 'desk' with images, pose files and every kind of trajectory and camera file; None removes a key."""
    folder = root / "rgbd" / "desk"
    files: dict[str, Any] = {"trajectory.log": log_of(range(n_frames)), "camera.json": CAMERA}
    for index in range(n_frames):
        files[f"colour/frame-{index}.png"] = np.full((HEIGHT, WIDTH, 3), (200, 120, 30), np.uint8)
        files[f"depth/frame-{index}.png"] = depth_values(index)
        files[f"frame-{index}.pose.txt"] = text_of(turn(index))
    write_files(folder / "data", files | {"intrinsics.txt": "6 0 5.5\n0 6.5 3.5\n0 0 1\n"})
    describe(folder, {**NUMBERED, "check_convention": False, **changes})
    return folder


def describe(folder: Path, keys: dict[str, Any]) -> None:
    leaves = [((key,), value, "") for key, value in keys.items() if value is not None]
    (folder / "rgbd.toml").write_text(write_toml(leaves))


def open_scene(root: Path) -> list[Any]:
    return list(Rgbd(root).frames("desk", 1))
