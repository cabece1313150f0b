"""A small scene in the files of ScanNet++: a floor of two halves, a mat across both, seen from above by an iPhone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scannet_scan import floor_image, grid, write_mesh

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.datasets.scannetpp.images import DEPTH_SIZE, packed_metres
from su3d_bench.formats.images import jpeg_bytes, png_bytes

SCENE = "036bce3393"
WHERE = f"scannetpp/{SCENE}"
COLOUR_SIZE = (64, 48)
HEIGHT_M, N_FRAMES, EVERY = 2.0, 3, 10
NUMBERS = tuple(range(0, N_FRAMES * EVERY, EVERY))
NAMES, INSTANCES = ("wall", "floor", "chair", "sofa", "mat"), ("chair", "sofa", "mat")
MAP = "class,count,semantic_map_to,instance_map_to\nchair,3,,\ncouch,2,sofa,sofa\nrug,1,mat,\nfloor,9,,\nodd,1,None,\n"


def pose(x_m: float) -> Float64Array:
    """Above the floor at ``x_m``, 1 m from its edge, looking down."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = x_m, 1.0, HEIGHT_M
    return matrix


def poses() -> list[Float64Array]:
    return [pose(float(x_m)) for x_m in np.linspace(1.5, 2.5, N_FRAMES)]


def write_colmap(folder: Path, distortion: Sequence[float] = (0, 0, 0, 0), model: str = "OPENCV") -> None:
    """Cameras and images as COLMAP writes them; the camera sees 2 m of the floor."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = COLOUR_SIZE
    camera = f"1 {model} {width} {height} {width} {width} {width / 2} {height / 2} {' '.join(map(str, distortion))}"
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    lines = ["# Image list with two lines of data per image:", "# Number of images: 3, mean observations per image: 1"]
    for k, (number, matrix) in enumerate(zip(NUMBERS, poses(), strict=True), 1):
        shift = " ".join(repr(float(value)) for value in np.linalg.inv(matrix)[:3, 3])
        lines += [f"{k} 0.0 1.0 0.0 0.0 {shift} 1 frame_{number:06d}.jpg", "1.5 2.5 -1" if k == 1 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def tracking(**changes: Any) -> dict[str, Any]:
    """``pose_intrinsic_imu.json``; ``changes`` of the first frame."""
    width, height = COLOUR_SIZE
    camera = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
    entries: dict[str, Any] = {
        f"frame_{number:06d}": {"timestamp": number / 60, "aligned_pose": matrix.tolist(), "intrinsic": camera}
        for number, matrix in zip(NUMBERS, poses(), strict=True)
    }
    entries["frame_000000"] |= changes
    return entries


def write_extracted(folder: Path) -> None:
    """``rgb/`` and ``depth/`` as the official toolkit extracts them."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number, matrix in zip(NUMBERS, poses(), strict=True):
        image = floor_image(COLOUR_SIZE, float(matrix[0, 3]))
        (folder / f"rgb/frame_{number:06d}.jpg").write_bytes(jpeg_bytes(image))
        (folder / f"depth/frame_{number:06d}.png").write_bytes(png_bytes(depth_values(number)))


def depth_values(number: int) -> np.ndarray:
    """Millimetres (192, 256): the floor, and a mark of the frame in the first pixels."""
    values = np.full(DEPTH_SIZE[::-1], round(HEIGHT_M * 1000), np.uint16)
    values[:8, :8] = number + 1
    return values


def write_depth_file(path: Path) -> None:
    """``depth.bin`` with an image for every frame of the video."""
    path.write_bytes(b"".join(packed_metres(depth_values(number)) for number in range(NUMBERS[-1] + 1)))


def write_video(path: Path) -> None:
    """A Matroska video of every frame; the grey of each tells its number."""
    import cv2

    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 60.0, COLOUR_SIZE)
    assert video.isOpened()
    for number in range(NUMBERS[-1] + 1):
        video.write(grey(number))
    video.release()


def grey(number: int) -> UInt8Array:
    return np.full((COLOUR_SIZE[1], COLOUR_SIZE[0], 3), 60 + 6 * number, np.uint8)


def write_lists(root: Path) -> None:
    folder = root / "metadata" / "semantic_benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("top100.txt", "\n".join(NAMES)),
        ("top100_instance.txt", "\n".join(INSTANCES) + "\n"),
        ("map_benchmark.csv", MAP),
    ):
        (folder / name).write_text(text)


def write_scans(
    folder: Path,
    segments: Sequence[int],
    groups: Sequence[tuple[str, Sequence[int]]],
    masked: Sequence[int] = (),
    mesh: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """The four files of a scan's truth."""
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / "mesh_aligned_0.05.ply", *(mesh or grid()))
    (folder / "mesh_aligned_0.05_mask.txt").write_text("".join(f"{vertex}\n" for vertex in masked))
    write_json(folder / "segments.json", {"sceneId": SCENE, "segIndices": list(segments)})
    entries = [
        {"id": k, "objectId": k + 1, "label": word, "segments": list(parts)} for k, (word, parts) in enumerate(groups)
    ]
    write_json(folder / "segments_anno.json", {"sceneId": SCENE, "segGroups": entries})


def write_floor(folder: Path, spacing_m: float = 0.1) -> None:
    """A floor of 4 x 2 m: left half a chair, right half a couch, a rug across the middle; the last row is masked."""
    columns, rows = round(4 / spacing_m) + 1, round(2 / spacing_m) + 1
    points, triangles = grid(columns, rows, spacing_m)
    segments = np.where(points[:, 0] < 2, 17, 40) + (np.abs(points[:, 0] - 2) < 0.3)
    groups = [("floor", (17, 18, 40, 41)), ("chair", (17, 18)), ("couch", (40, 41)), ("rug", (18, 41))]
    masked = range(columns * (rows - 1), columns * rows)
    write_scans(folder, segments.tolist(), groups, masked, (points, triangles))


def write_scene(root: Path, *, packed: bool = False, spacing_m: float = 0.1) -> Path:
    """A whole scene below ``root``, its images extracted or ``packed``; its folder."""
    folder = root / "data" / SCENE
    write_colmap(folder / "iphone" / "colmap")
    write_json(folder / "iphone" / "pose_intrinsic_imu.json", tracking())
    if packed:
        write_depth_file(folder / "iphone" / "depth.bin")
        write_video(folder / "iphone" / "rgb.mkv")
    else:
        write_extracted(folder / "iphone")
    write_floor(folder / "scans", spacing_m)
    write_lists(root)
    (root / "splits").mkdir(exist_ok=True)
    (root / "splits" / "nvs_sem_val.txt").write_text(f"{SCENE}\n")
    return folder


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content), encoding="utf-8")
