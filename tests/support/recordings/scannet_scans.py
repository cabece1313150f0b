"""Whole scans of the small recording: with truth, and as the Python reader exports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scannet_scan import (
    COLOUR_SIZE,
    DEPTH_SIZE,
    LOST,
    SCAN,
    floor_image,
    header,
    pose,
    positions,
    table_text,
    write_floor_truth,
    write_recording,
)

from su3d_bench.datasets.scannet.dataset import ScanNet, ScannetOptions
from su3d_bench.datasets.scannet.truth import TABLE_NAME

WHERE = f"scannet/{SCAN}"


def write_scan(root: Path, scan: str = SCAN, place: str = "scans", n_frames: int = 5, lost: Sequence[int] = ()) -> Path:
    """A scan with recording and truth; the folder that it lies in."""
    folder = root / place / scan
    write_recording(folder / f"{scan}.sens", n_frames, lost)
    write_floor_truth(folder, scan)
    (folder / f"{scan}.txt").write_text("axisAlignment = 0 -1 0 5 1 0 0 6 0 0 1 7 0 0 0 1\ncolorHeight = 48\n")
    (root / TABLE_NAME).write_text(table_text())
    return folder


def dataset(root: Path, **options: Any) -> ScanNet:
    return ScanNet(root, ScannetOptions(**options))


def export(folder: Path, n_frames: int = 5) -> None:
    """The same walk as the Python reader exports it, in millimetres of 1.5 m to tell it from the recording."""
    import cv2

    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    head = header()
    for name, matrix in (("intrinsic_color", head.intrinsic_colour), ("intrinsic_depth", head.intrinsic_depth)):
        np.savetxt(folder / "intrinsic" / f"{name}.txt", matrix, "%f")
    for i, x_m in enumerate(positions(n_frames)):
        cv2.imwrite(str(folder / "color" / f"{i}.jpg"), floor_image(COLOUR_SIZE, x_m)[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.full(DEPTH_SIZE[::-1], 1500, np.uint16))
        np.savetxt(folder / "pose" / f"{i}.txt", LOST if i == 1 else pose(x_m), "%f")
