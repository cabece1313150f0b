"""A walk of two frames with two objects in one room, and a scene graph of it, in HOV-SG's file formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from recording_files import write_files

SCENE, SHORT = "00824-Dd4bFSTQ8gi", "Dd4bFSTQ8gi"
WIDTH, HEIGHT = 8, 6
CHAIR = np.array([[x, y, -2.0 + x] for x in (0.0, 0.1, 0.2) for y in (0.3, 0.4)])
WALL = np.array([[x, y, -3.0] for x in (-1.0, 0.0, 1.0) for y in (0.0, 2.4)]) + [[0, 0, 0.01 * k] for k in range(6)]
ROOM = np.array([[x, 0.0, z] for x in (-1.0, 0.0, 1.0) for z in (-3.0, -2.0, -1.0)])
POSES = [np.eye(4), np.array([[0.0, 0, 1, 0.5], [0, 1, 0, 1.5], [-1, 0, 0, 0], [0, 0, 0, 1]])]
OBJECTS = ((3, "chair", "0A0B0C", CHAIR), (7, "wall", "FFEEDD", WALL))


def write_walk(root: Path) -> Path:
    """The walk, and the annotation of its scene in the release; the walk's folder."""
    folder = root / "hm3dsem_walks/val" / SCENE
    files: dict[str, Any] = {f"objects/{key}.ply": points for key, _, _, points in OBJECTS}
    for k, pose in enumerate(POSES):
        files[f"rgb/{SHORT}_{k:06d}.png"] = np.full((HEIGHT, WIDTH, 3), (10 * k, 20, 30), np.uint8)
        files[f"depth/{SHORT}_{k:06d}.png"] = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 50
        files[f"pose/{SHORT}_{k:06d}.txt"] = "\t".join(str(value) for value in pose.reshape(-1).tolist()) + "\n"
    write_files(folder, files | {"scene_info.json": info()})
    lines = ["HM3D Semantic Annotations", *(f'{key},{colour},"{name}",5' for key, name, colour, _ in OBJECTS)]
    write_files(root / "hm3d/val" / SCENE, {f"{SHORT}.semantic.txt": "\n".join(lines) + "\n"})
    return folder


def info() -> dict[str, list[dict[str, object]]]:
    """The content of ``scene_info.json``."""
    room = {"id": 5, "floor_id": 0, "voted_category": "office", "category": None, "min_height": 0.0, "max_height": 2.4}
    objects = [
        {
            "id": key, "category": name, "hex": colour, "region_id": 5, "floor_id": 0,
            "obb_center": ((points.min(0) + points.max(0)) / 2).tolist(),
            "obb_dims": (np.ptp(points, axis=0) + 0.02).tolist(),
        }
        for key, name, colour, points in OBJECTS
    ]  # fmt: skip
    return {
        "levels": [{"id": 0, "lower": 0.0, "upper": 2.4}],
        "regions": [room | {"mean_height": 1.0, "bev_region_points": ROOM.tolist()}],
        "objects": objects,
    }


def write_graph(folder: Path, n_dimensions: int = 4) -> Path:
    """A valid scene graph: one floor, one room, both objects; its folder."""
    corners = [[x, y, z] for x in (-1.0, 1.0) for y in (0.0, 2.4) for z in (-3.0, -1.0)]
    floor = {"floor_id": "0", "rooms": ["0_0"], "vertices": corners, "floor_height": 2.4, "floor_zero_level": 0.0}
    room = {"room_id": "0_0", "name": "office", "floor_id": "0", "room_height": 2.4, "room_zero_level": 0.0}
    files: dict[str, Any] = {"floors/0.json": floor, "floors/0.ply": ROOM, "rooms/0_0.ply": ROOM}
    files["rooms/0_0.json"] = room | {"embeddings": []}
    for k, (_, name, _, points) in enumerate(OBJECTS):
        feature = np.eye(n_dimensions)[k].tolist()
        table = {"object_id": f"0_0_{k}", "room_id": "0_0", "name": name, "embedding": feature}
        files |= {f"objects/0_0_{k}.ply": points, f"objects/0_0_{k}.json": table}
    write_files(folder, files)
    return folder
