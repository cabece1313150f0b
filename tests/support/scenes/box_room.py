"""A tiny empty room in the layout of Replica whose frames match its ground truth: walls, floor, ceiling as a box."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply

WIDTH, HEIGHT, FOCAL, SCALE = 48, 36, 24.0, 6553.5
SIZE = np.array([4.0, 3.0, 2.5])
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
CELL_M = 0.1
CLASSES = {1: "wall", 2: "wall", 3: "wall", 4: "wall", 5: "floor", 6: "ceiling"}  # of the objects 1 to 6
COLOURS = np.array([[200, 80, 60], [80, 200, 60], [60, 80, 200], [200, 200, 60], [120, 120, 120], [230, 230, 230]])


def pose(index: int) -> np.ndarray:
    """Camera-to-world of a moving, rotating camera, looking slightly down."""
    yaw = 0.3 * index
    forward = np.array([np.cos(yaw), np.sin(yaw), -0.25])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = 1.5 + 0.1 * index, 1.2 + 0.04 * index, 1.4
    return matrix


def images(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) uint8 RGB and depth (H, W) in metres of the box from camera ``index``."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(INTRINSICS).T
    camera = pose(index)
    directions = rays @ camera[:3, :3].T
    with np.errstate(divide="ignore"):
        to_low, to_high = (-camera[:3, 3] / directions, (SIZE - camera[:3, 3]) / directions)
    ahead = np.where(directions > 0, to_high, to_low)
    axis = ahead.argmin(axis=-1)
    is_high = np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0
    face = np.array([[0, 1], [2, 3], [4, 5]])[axis, is_high.astype(int)]
    return COLOURS[face].astype(np.uint8), ahead.min(axis=-1)


def write_frame(folder: Path, index: int) -> None:
    rgb, depth_m = images(index)
    name = folder / "results" / f"frame{index:06d}.jpg"
    cv2.imwrite(str(name), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    cv2.imwrite(str(folder / "results" / f"depth{index:06d}.png"), np.rint(depth_m * SCALE).astype(np.uint16))


def write_poses(folder: Path, poses: list[np.ndarray]) -> None:
    lines = [" ".join(repr(float(value)) for value in matrix.reshape(-1)) for matrix in poses]
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")


def write_box_room(root: Path, n_frames: int = 8, scene: str = "room0", *, with_truth: bool = True) -> Path:
    """The scene's folder in the render tree."""
    folder = root / "Replica" / scene
    (folder / "results").mkdir(parents=True)
    camera = {"w": WIDTH, "h": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera | {"scale": SCALE}}))
    write_poses(folder, [pose(index) for index in range(n_frames)])
    for index in range(n_frames):
        write_frame(folder, index)
    if with_truth:
        write_truth(root / "replica_v1" / f"{scene[:-1]}_{scene[-1]}" / "habitat")
    return folder


def write_truth(habitat: Path, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    """The box as a mesh of quads, each side one object; ``offset`` shifts it away from what the cameras see."""
    corners, objects = [], []
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        for side in range(2):
            for a in np.arange(0, SIZE[u] - 1e-9, CELL_M):
                for b in np.arange(0, SIZE[v] - 1e-9, CELL_M):
                    quad = np.zeros((4, 3))
                    quad[:, axis] = side * SIZE[axis]
                    quad[:, u] = [a, a + CELL_M, a + CELL_M, a]
                    quad[:, v] = [b, b, b + CELL_M, b + CELL_M]
                    corners.append(quad + offset)
                    objects.append(2 * axis + side + 1)
    vertices = np.concatenate(corners).astype(np.float32)
    faces = ListColumn(np.arange(len(objects) + 1) * 4, np.arange(len(vertices), dtype=np.int32))
    labels = replica_label_set()
    ids = dict(zip(labels.names, labels.ids, strict=True))
    table = {
        "classes": [{"id": i, "name": name} for name, i in ids.items()],
        "objects": [{"id": one, "class_id": ids[name]} for one, name in CLASSES.items()],
    }
    habitat.mkdir(parents=True, exist_ok=True)
    vertex = PlyElement("vertex", len(vertices), {axis: vertices[:, i].copy() for i, axis in enumerate("xyz")})
    face = PlyElement("face", len(objects), {"vertex_indices": faces, "object_id": np.array(objects, np.uint16)})
    write_ply(habitat / "mesh_semantic.ply", [vertex, face])
    (habitat / "info_semantic.json").write_text(json.dumps(table))
