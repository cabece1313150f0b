"""Maps of ConceptFusion as gradslam stores them: ``pc_points.h5`` and the features of its points.

Source: gradslam branch conceptfusion at commit 59ca872. Its loader makes poses relative to the first frame, so that
the points are in the frame of the first camera; the first pose of the recording brings them to the world.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, StoreError, converted, shown
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.arrays import checked_points, half_rows
from su3d_bench.formats.hdf5 import n_columns_of, read_rows, row_blocks
from su3d_bench.formats.poses import moved, read_first_pose
from su3d_bench.predictions.base import SceneFolders, ScenePrediction

POINTS, EMBEDDINGS = "pc_points.h5", "pc_embeddings.h5"
POSE_FILES = ("first_pose.txt", "traj.txt", "traj_w_c.txt")
FOLDERS_OF_A_MAP = ("pointclouds", "saved-map", "saved-maps", "Sequence_1")
HELD_IN_MEMORY = 64 << 20  # bytes of features; larger tables are mapped from a temporary file


class Gradslam(SceneFolders):
    name = "gradslam"
    summary = "ConceptFusion's saved-map/pointclouds of gradslam: pc_points.h5 with pc_embeddings.h5"
    noun, first, second, n_above = "map", POINTS, EMBEDDINGS, 3

    def scene_of(self, folder: Path, path: Path) -> str:
        """The first name upwards that is no folder of the map's own."""
        absolute = folder.absolute()
        names = [above.name for above in (absolute, *absolute.parents) if above.name not in FOLDERS_OF_A_MAP]
        return names[0] or "scene"

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place / POINTS)
        with converted(DataError, PredictionError):
            points = checked_points(read_rows(place / POINTS, 3, where), where)
            points, pose_remark = _in_world(points, place)
            features, n_without = _features(place / EMBEDDINGS, len(points))
        if not np.isfinite(points).all():
            raise PredictionError(f"{where}: the first pose moves points out of what float32 metres can hold")
        remarks = [pose_remark]
        if n_without:
            remarks.append(f"{n_without} of {len(points)} points have no feature (a row of zeros or NaN)")
        return ScenePrediction(scene, self.name, place, DenseFeatures(points, features), tuple(remarks))


def _in_world(points: Float32Array, folder: Path) -> tuple[Float32Array, str]:
    """``points`` moved by the first pose beside them, or as they are; and the remark that says so."""
    file = next((candidate for name in POSE_FILES if (candidate := folder / name).is_file()), None)
    if file is None:
        return points, (
            "points are taken as they are; gradslam leaves them in the frame of the first camera: to bring them to the "
            f"world, put its camera-to-world pose, 16 numbers in a line, into {POSE_FILES[0]} beside {POINTS}"
        )
    pose = read_first_pose(file, shown(file))
    with np.errstate(over="ignore", invalid="ignore"):
        return moved(points, pose), f"points were brought to the world with the first pose of {file.name}"


def _features(file: Path, n_points: int) -> tuple[NDArray[np.float16], int]:
    """The features (N, D) and how many rows have none: rows with what float16 cannot hold become zeros."""
    where = shown(file)
    n_columns = n_columns_of(file, where)
    n_rows = n_without = n_held = 0
    stored: list[NDArray[np.float16]] = []
    # Sparse writes would crash the process on a full disk when the map is touched; plain ones fail here.
    with tempfile.TemporaryFile() as spill:
        for block in row_blocks(file, n_columns, where):
            n_rows += len(block)
            if n_rows > n_points:
                break
            rows = half_rows(block)
            n_without += int((~rows.any(axis=1)).sum())
            stored.append(rows)
            n_held += rows.nbytes
            if n_held > HELD_IN_MEMORY:
                _spill(spill, stored)
                n_held = 0
        if n_rows != n_points:
            raise PredictionError(f"{where}: has other rows than {POINTS}, which has {n_points}; copy both again")
        if not spill.tell():
            return np.concatenate([np.zeros((0, n_columns), np.float16), *stored]), n_without
        _spill(spill, stored)
        return np.memmap(spill, np.float16, "r", shape=(n_points, n_columns)), n_without


def _spill(file: Any, stored: list[NDArray[np.float16]]) -> None:
    """Move what is held in memory to the end of a temporary file."""
    try:
        for rows in stored:
            file.write(rows.tobytes())
        file.flush()
    except OSError as error:
        raise StoreError(
            f"cannot write features to {tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to a larger disk"
        ) from error
    stored.clear()
