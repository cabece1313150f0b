"""Rendered frames in files of Replica's layout, and the reader of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from su3d_bench.core.types import Frame
from su3d_bench.datasets.replica.frames import Camera, ReplicaFrames, colour_name, depth_name

SCALE = 6553.5  # depth units per metre of Replica's render


def write_replica(folder: Path, frames: Sequence[Frame], n: int) -> ReplicaFrames:
    """``n`` frames, repeating ``frames``, as JPEG and 16-bit PNG below ``folder``."""
    (folder / "results").mkdir()
    for i in range(n):
        frame = frames[i % len(frames)]
        cv2.imwrite(str(folder / colour_name(i)), frame.rgb[:, :, ::-1])
        cv2.imwrite(str(folder / depth_name(i)), np.round(frame.depth_m * SCALE).astype(np.uint16))
    height, width = frames[0].depth_m.shape
    (fx, _, cx), (_, fy, cy) = frames[0].intrinsics[:2].tolist()
    camera = Camera(w=width, h=height, fx=fx, fy=fy, cx=cx, cy=cy, scale=SCALE)
    poses = np.array([frames[i % len(frames)].camera_to_world for i in range(n)])
    return ReplicaFrames(folder, "replica/bench", camera, poses, range(n))
