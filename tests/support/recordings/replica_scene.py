"""Small scenes in the exact layout of Replica: the render tree and the original release."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply
from su3d_bench.metrics.protocols.loading import load_protocol

WIDTH, HEIGHT, SCALE = 12, 8, 6553.5
CAMERA = {"w": WIDTH, "h": HEIGHT, "fx": 6.0, "fy": 6.5, "cx": 5.5, "cy": 3.5, "scale": SCALE}
CHAIR, TABLE, WALL = 20, 80, 93


def pose(index: int) -> np.ndarray:
    angle = 0.1 * index
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = index, 1 / 3, -index
    return matrix


def depth_values(index: int) -> np.ndarray:
    return np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 600 + index


def write_render(root: Path, scene: str = "room0", n_frames: int = 3, folder: str = "Replica") -> None:
    results = root / folder / scene / "results"
    results.mkdir(parents=True)
    (root / folder / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    lines = [" ".join(repr(float(value)) for value in pose(index).reshape(-1)) for index in range(n_frames)]
    (results.parent / "traj.txt").write_text("\n".join(lines) + "\n")
    for index in range(n_frames):
        colour = np.full((HEIGHT, WIDTH, 3), (30, 120, 200), np.uint8)  # blue, green, red
        cv2.imwrite(str(results / f"frame{index:06d}.jpg"), colour, [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(results / f"depth{index:06d}.png"), depth_values(index))


def info_table(objects: list[tuple[int, int]]) -> dict[str, Any]:
    labels = replica_label_set()
    classes = [{"id": i, "name": name} for i, name in zip(labels.ids, labels.names, strict=True)]
    return {"classes": classes, "objects": [{"id": one, "class_id": class_id} for one, class_id in objects]}


def write_original(
    root: Path,
    faces: list[list[int]],
    object_ids: list[int],
    objects: list[tuple[int, int]],
    folder: str = "replica_v1/room_0",
    n_vertices: int = 9,
) -> Path:
    """A mesh on a grid of points, three a row, and its table of objects."""
    habitat = root / folder / "habitat"
    habitat.mkdir(parents=True)
    grid = np.array([(i % 3, i // 3, 0) for i in range(n_vertices)], np.float32)
    corners = ListColumn(
        np.concatenate([[0], np.cumsum([len(face) for face in faces])]),
        np.array([corner for face in faces for corner in face], np.int32),
    )
    vertex = PlyElement("vertex", n_vertices, {axis: grid[:, i].copy() for i, axis in enumerate("xyz")})
    face = PlyElement("face", len(faces), {"vertex_indices": corners, "object_id": np.array(object_ids, np.uint16)})
    write_ply(habitat / "mesh_semantic.ply", [vertex, face])
    (habitat / "info_semantic.json").write_text(json.dumps(info_table(objects)))
    return habitat


# Four quads on nine vertices:   6 7 8    two of object 0, a chair, at the left,
#                                3 4 5    two of object 5, a table, at the right
#                                0 1 2
QUADS = [[0, 1, 4, 3], [3, 4, 7, 6], [1, 2, 5, 4], [4, 5, 8, 7]]
TWO_OBJECTS = [(0, CHAIR), (5, TABLE)]


def write_scene_graphs(root: Path, objects: list[tuple[int, str]], relations: list[tuple[int, int, str]]) -> Path:
    """ReplicaSSG's annotation of room_0, and of another scan, with the classes of its protocol."""
    rules = load_protocol("replica-relations")
    folder = root / "ReplicaSSG"
    folder.mkdir(parents=True)
    rows = [{"label": label, "id": str(number)} for number, label in objects]
    triples = [[subject, other, rules.predicates.index(name), name] for subject, other, name in relations]
    scans = {"objects": rows, "relationships": triples}
    for key, content in scans.items():
        of_scans = [{"scan": "apartment_0", key: []}, {"scan": "room_0", key: content}]
        (folder / f"{key}.json").write_text(json.dumps({"scans": of_scans}))
    meant = {"chair": "chair", "sofa": "chair", "table": "table", "wall": "unknown"}
    lists = {"VisualGenome_list": [entry.name for entry in rules.classes], "VisualGenome_rel": list(rules.predicates)}
    (folder / "replica_to_visual_genome.json").write_text(json.dumps({"Replica2VisualGenome": meant, **lists}))
    return folder
