"""A small scene in ScanNet++'s file formats: a floor of two halves and a mat across both, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recording_files import HEIGHT_M, floor_image, grid, pose, write_files, write_mesh

from su3d_bench.datasets.scannetpp.images import DEPTH_SIZE

SCENE = "036bce3393"
WHERE = f"scannetpp/{SCENE}"
COLOUR_SIZE = WIDTH, HEIGHT = (64, 48)
NUMBERS = (0, 10, 20)
POSES = [pose(x_m) for x_m in (1.5, 2.0, 2.5)]
LISTS = "metadata/semantic_benchmark"
NAMES, INSTANCES = ("wall", "floor", "chair", "sofa", "mat"), ("chair", "sofa", "mat")
MAP = "class,count,semantic_map_to,instance_map_to\nchair,3,,\ncouch,2,sofa,sofa\nrug,1,mat,\nfloor,9,,\nodd,1,None,\n"


def write_colmap(folder: Path, distortion: Sequence[float] = (0, 0, 0, 0), model: str = "OPENCV") -> None:
    """Cameras and images as written by COLMAP; the camera sees 2 m of the floor."""
    bent = " ".join(map(str, distortion))
    camera = f"# Camera list\n1 {model} {WIDTH} {HEIGHT} {WIDTH} {WIDTH} {WIDTH / 2} {HEIGHT / 2} {bent}\n"
    lines = ["# Image list with two lines of data per image:", "# Number of images: 3, mean observations per image: 1"]
    for k, (number, matrix) in enumerate(zip(NUMBERS, POSES, strict=True), 1):
        shift = " ".join(repr(float(value)) for value in np.linalg.inv(matrix)[:3, 3])
        lines += [f"{k} 0.0 1.0 0.0 0.0 {shift} 1 frame_{number:06d}.jpg", "1.5 2.5 -1" if k == 1 else ""]
    write_files(folder, {"cameras.txt": camera, "images.txt": "\n".join(lines) + "\n"})


def tracking(**changes: Any) -> dict[str, Any]:
    """``pose_intrinsic_imu.json`` with ``changes`` to the first frame."""
    camera = [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]]
    entries: dict[str, Any] = {
        f"frame_{number:06d}": {"timestamp": number / 60, "aligned_pose": matrix.tolist(), "intrinsic": camera}
        for number, matrix in zip(NUMBERS, POSES, strict=True)
    }
    entries["frame_000000"] |= changes
    return entries


def depth_values(number: int) -> np.ndarray:
    """Millimetres (192, 256): the floor, and the frame number encoded in the first pixels."""
    values = np.full(DEPTH_SIZE[::-1], round(HEIGHT_M * 1000), np.uint16)
    values[:8, :8] = number + 1
    return values


def write_lists(root: Path) -> None:
    instances = "\n".join(INSTANCES) + "\n"
    files = {"top100.txt": "\n".join(NAMES), "top100_instance.txt": instances, "map_benchmark.csv": MAP}
    write_files(root / LISTS, files)


def write_scans(folder: Path, segments: Any, groups: Any, masked: Any = (), mesh: Any = None) -> None:
    """The four files of a scan's ground truth; ``groups`` are (word, segments)."""
    write_mesh(folder / "mesh_aligned_0.05.ply", *(mesh or grid()))
    rows = enumerate(groups)
    entries = [{"id": k, "objectId": k + 1, "label": word, "segments": list(parts)} for k, (word, parts) in rows]
    files = {"segments.json": {"segIndices": list(segments)}, "segments_anno.json": {"segGroups": entries}}
    write_files(folder, files | {"mesh_aligned_0.05_mask.txt": "".join(f"{vertex}\n" for vertex in masked)})


def write_scene(root: Path, *, spacing_m: float = 0.1) -> Path:
    """A complete scene below ``root``; its folder.

    A floor of 4 x 2 m: left half a chair, right half a couch, a rug across the middle; the last row is masked.
    """
    folder = root / "data" / SCENE
    write_colmap(folder / "iphone/colmap")
    write_files(folder, {"iphone/pose_intrinsic_imu.json": tracking()})
    for number, matrix in zip(NUMBERS, POSES, strict=True):
        rgb = {f"iphone/rgb/frame_{number:06d}.jpg": floor_image(COLOUR_SIZE, float(matrix[0, 3]))}
        write_files(folder, rgb | {f"iphone/depth/frame_{number:06d}.png": depth_values(number)})
    columns, rows = round(4 / spacing_m) + 1, round(2 / spacing_m) + 1
    mesh = grid(columns, rows, spacing_m)
    segments = np.where(mesh[0][:, 0] < 2, 17, 40) + (np.abs(mesh[0][:, 0] - 2) < 0.3)
    groups = [("floor", (17, 18, 40, 41)), ("chair", (17, 18)), ("couch", (40, 41)), ("rug", (18, 41))]
    write_scans(folder / "scans", segments.tolist(), groups, range(columns * (rows - 1), columns * rows), mesh)
    write_lists(root)
    write_files(root, {"splits/nvs_sem_val.txt": f"{SCENE}\n"})
    return folder
