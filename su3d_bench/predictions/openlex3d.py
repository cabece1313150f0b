"""Predictions as OpenLex3D takes them: a cloud, the object of each point, the feature of each object.

Source: openlex3d at commit 3dbad2b. The format has no point without an object, no overlaps, scores or names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.maps import Partition
from su3d_bench.core.types import Int32Array
from su3d_bench.formats.arrays import checked_points, feature_table, kind_of, without_nonfinite
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.predictions.base import SceneFolders, ScenePrediction
from su3d_bench.predictions.hovsg import read_cloud

CLOUD = "point_cloud.pcd"
CLOUDS = (CLOUD, "point_cloud.ply", "input.ply")  # the order in which the original looks for them
INDEX, EMBEDDINGS = "index.npy", "embeddings.npy"


class OpenLex3d(SceneFolders):
    name = "openlex3d"
    summary = "OpenLex3D's point_cloud.pcd (or .ply, or input.ply) with index.npy and embeddings.npy"
    first, second = INDEX, EMBEDDINGS

    def scene_of(self, folder: Path, path: Path) -> str:
        """``scene``, or ``dataset/scene`` where ``path`` holds folders of datasets."""
        parts = folder.relative_to(path).parts
        return "/".join(parts) if parts else folder.absolute().name

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        clouds = [file for name in CLOUDS if (file := place / name).is_file()]
        if not clouds:
            raise PredictionError(f"{shown(place)}: has no cloud; expected {', '.join(CLOUDS[:-1])} or {CLOUDS[-1]}")
        points = checked_points(read_cloud(clouds[0]), shown(clouds[0]))
        features, remarks = without_nonfinite(
            feature_table(read_npy(place / EMBEDDINGS), place / EMBEDDINGS), "objects"
        )
        if len(clouds) > 1:
            names = ", ".join(file.name for file in clouds[1:])
            remarks = (f"{clouds[0].name} is read, as the original does, and not {names}", *remarks)
        index = _index(place / INDEX, len(points), clouds[0].name, len(features))
        return ScenePrediction(scene, self.name, place, Partition(points, index, features), remarks)


def _index(file: Path, n_points: int, cloud: str, n_objects: int) -> Int32Array:
    """The object of each point; every point has one."""
    index = read_npy(file)
    if index.shape != (n_points,) or index.dtype.kind not in "iu":
        raise PredictionError(
            f"{shown(file)}: holds {kind_of(index)}; expected an integer for each of the {n_points} points of {cloud}"
        )
    is_wrong = (index < 0) | (index >= n_objects)
    if is_wrong.any():
        point = int(np.argmax(is_wrong))
        raise PredictionError(
            f"{shown(file)}: point {point} is of object {int(index[point])}, {EMBEDDINGS} has {n_objects} rows; every "
            "point needs one of them, leave out points without an object"
        )
    return index.astype(np.int32)
