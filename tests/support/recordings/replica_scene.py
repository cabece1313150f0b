"""Small scenes in the exact layout of Replica: the render tree, the original release, and ConceptGraphs' clouds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recording_files import HEIGHT, WIDTH, depth_values, text_of, turn, write_files
from scipy.spatial.transform import Rotation

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.datasets.replica.truth import N_EMBEDDING
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply

SCALE = 6553.5
CAMERA = {"w": WIDTH, "h": HEIGHT, "fx": 6.0, "fy": 6.5, "cx": 5.5, "cy": 3.5, "scale": SCALE}
CHAIR, TABLE, WALL = 20, 80, 93
SEQUENCE = "Replica-semantic/room_0/Sequence_1"
CLOUDS = f"{SEQUENCE}/saved-maps-gt/pointclouds"
REFERENCE = "Replica/room0/rgb_cloud/pointclouds/pc_points.h5"
# Four quads on nine vertices:   6 7 8    two of object 0, a chair, at the left,
#                                3 4 5    two of object 5, a table, at the right
#                                0 1 2
QUADS = [[0, 1, 4, 3], [3, 4, 7, 6], [1, 2, 5, 4], [4, 5, 8, 7]]
TWO_OBJECTS = [(0, CHAIR), (5, TABLE)]


def write_render(root: Path, scene: str = "room0", n_frames: int = 3) -> None:
    poses = np.array([turn(index).reshape(-1) for index in range(n_frames)])
    files: dict[str, Any] = {"cam_params.json": {"camera": CAMERA}, f"{scene}/traj.txt": text_of(poses)}
    for index in range(n_frames):
        files[f"{scene}/results/frame{index:06d}.jpg"] = np.full((HEIGHT, WIDTH, 3), (200, 120, 30), np.uint8)
        files[f"{scene}/results/depth{index:06d}.png"] = depth_values(index)
    write_files(root / "Replica", files)


def info_table(objects: list[tuple[int, int]]) -> dict[str, Any]:
    labels = replica_label_set()
    classes = [{"id": i, "name": name} for i, name in zip(labels.ids, labels.names, strict=True)]
    return {"classes": classes, "objects": [{"id": one, "class_id": class_id} for one, class_id in objects]}


def box(
    centre: Any = (1, 1, 0), sizes: Any = (2, 2, 0.1), rotation: Any = (0, 0, 0, 1), translation: Any = (0, 0, 0)
) -> dict[str, Any]:
    """An entry ``oriented_bbox`` of a table of objects."""
    turned = {"rotation": list(rotation), "translation": list(translation)}
    return {"abb": {"center": list(centre), "sizes": list(sizes)}, "orientation": turned}


def write_original(
    root: Path,
    faces: Sequence[list[int]],
    object_ids: list[int],
    objects: list[tuple[int, int]],
    folder: str = "replica_v1/room_0",
) -> Path:
    """A mesh on a grid of nine points, three per row, and its table of objects."""
    habitat = root / folder / "habitat"
    write_files(habitat, {"info_semantic.json": info_table(objects)})
    grid = np.array([(i % 3, i // 3, 0) for i in range(9)], np.float32)
    corners = ListColumn(np.cumsum([0, *map(len, faces)]), np.concatenate(faces).astype(np.int32))
    vertex = PlyElement("vertex", 9, {axis: grid[:, i].copy() for i, axis in enumerate("xyz")})
    face = PlyElement("face", len(faces), {"vertex_indices": corners, "object_id": np.array(object_ids, np.uint16)})
    write_ply(habitat / "mesh_semantic.ply", [vertex, face])
    return habitat


def first_pose() -> Float64Array:
    """A rotation about x, then z, and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xz", (0.7, -1.9)).as_matrix()
    matrix[:3, 3] = 0.3, -1.25, 1.5
    return matrix


def write_clouds(
    root: Path, points: np.ndarray, labels: np.ndarray, reference: np.ndarray, scene: str = "room0"
) -> None:
    """The labelled cloud, whose ``points`` are in the first camera's frame, and the reference cloud in the world."""
    sequence, clouds = (name.replace("room_0", f"{scene[:-1]}_{scene[-1]}") for name in (SEQUENCE, CLOUDS))
    files = {
        f"{clouds}/pc_points.h5": points.astype(np.float32),
        f"{clouds}/pc_embeddings.h5": np.eye(N_EMBEDDING, dtype=np.float32)[labels],
        f"{sequence}/traj_w_c.txt": text_of(np.stack([first_pose().reshape(-1), np.eye(4).reshape(-1)])),
        REFERENCE.replace("room0", scene): reference.astype(np.float32),
    }
    write_files(root, files)
