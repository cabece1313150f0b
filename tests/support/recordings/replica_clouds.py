"""ConceptGraphs' clouds of a scene of Replica, as files."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from su3d_bench.core.types import Float32Array
from su3d_bench.datasets.replica.truth import N_EMBEDDING

SEQUENCE = "Replica-semantic/room_0/Sequence_1"
CLOUDS = f"{SEQUENCE}/saved-maps-gt/pointclouds"
REFERENCE = "Replica/room0/rgb_cloud/pointclouds/pc_points.h5"


def write_table(path: Path, table: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(path.stem, data=table)


def one_hot(labels: np.ndarray) -> Float32Array:
    rows: Float32Array = np.eye(N_EMBEDDING, dtype=np.float32)[labels]
    return rows


def first_pose() -> np.ndarray:
    """A turn about x, then z, and a shift."""
    a, b = 0.7, -1.9
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z @ about_x
    matrix[:3, 3] = 0.3, -1.25, 1.5
    return matrix


def write_clouds(
    root: Path, points: np.ndarray, labels: np.ndarray, reference: np.ndarray, scene: str = "room0"
) -> None:
    """The labelled cloud, whose ``points`` are in the first camera's frame, and the reference cloud in the world."""
    native = f"{scene[:-1]}_{scene[-1]}"
    sequence = root / SEQUENCE.replace("room_0", native)
    clouds = sequence / "saved-maps-gt/pointclouds"
    write_table(clouds / "pc_points.h5", points.astype(np.float32))
    write_table(clouds / "pc_embeddings.h5", one_hot(labels))
    poses = np.stack([first_pose(), np.eye(4)])
    lines = [" ".join(repr(float(value)) for value in one.reshape(-1)) for one in poses]
    (sequence / "traj_w_c.txt").write_text("\n".join(lines) + "\n")
    write_table(root / REFERENCE.replace("room0", scene), reference.astype(np.float32))
