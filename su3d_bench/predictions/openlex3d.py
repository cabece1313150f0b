"""Predictions as OpenLex3D takes them: a cloud, the object of each point, the feature of each object.

Source: openlex3d at commit 3dbad2b. The format has no point without an object, no overlaps, scores or names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, printable, shown
from su3d_bench.core.types import Float32Array, Int32Array, Partition
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.predictions.base import ScenePrediction
from su3d_bench.predictions.clouds import checked_points, folders_with, named_once, without_nonfinite
from su3d_bench.predictions.hovsg import read_cloud
from su3d_bench.predictions.mask_arrays import kind_of

CLOUD = "point_cloud.pcd"
CLOUDS = (CLOUD, "point_cloud.ply", "input.ply")  # the order in which the original looks for them
INDEX, EMBEDDINGS = "index.npy", "embeddings.npy"


class OpenLex3d:
    name = "openlex3d"
    summary = "OpenLex3D's point_cloud.pcd (or .ply, or input.ply) with index.npy and embeddings.npy"

    def recognise(self, path: Path) -> str | None:
        return f"it holds {INDEX} and {EMBEDDINGS}" if path.is_dir() and _folders(path) else None

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return named_once([(_scene_of(folder, path), folder) for folder in _folders(path)], path)

    def read(self, path: Path, scene: str) -> ScenePrediction:
        folder = self.scenes(path).get(scene)
        if folder is None:
            raise PredictionError(f"{shown(path)}: has no prediction of scene '{printable(scene, 80)}'")
        clouds = [file for name in CLOUDS if (file := folder / name).is_file()]
        if not clouds:
            raise PredictionError(f"{shown(folder)}: has no cloud; expected {', '.join(CLOUDS[:-1])} or {CLOUDS[-1]}")
        points = checked_points(read_cloud(clouds[0]), shown(clouds[0]))
        features, remarks = _features(folder / EMBEDDINGS)
        if len(clouds) > 1:
            names = ", ".join(file.name for file in clouds[1:])
            remarks = (f"{clouds[0].name} is read, as the original does, and not {names}", *remarks)
        index = _index(folder / INDEX, len(points), clouds[0].name, len(features))
        return ScenePrediction(scene, self.name, folder, Partition(points, index, features), remarks)


def _folders(path: Path) -> list[Path]:
    """The folders of scenes at ``path`` or up to two levels below it."""
    found = folders_with(path, [f"{above}{INDEX}" for above in ("", "*/", "*/*/")])
    return [file.parent for file in found if (file.parent / EMBEDDINGS).is_file()]


def _scene_of(folder: Path, path: Path) -> str:
    """``scene``, or ``dataset/scene`` where ``path`` holds folders of datasets."""
    parts = folder.relative_to(path).parts
    return "/".join(parts) if parts else folder.absolute().name


def _features(file: Path) -> tuple[Float32Array, tuple[str, ...]]:
    table = read_npy(file)
    if table.ndim != 2 or table.dtype.kind != "f" or not table.shape[1]:
        raise PredictionError(f"{shown(file)}: holds {kind_of(table)}; expected a row of features an object")
    with np.errstate(over="ignore", invalid="ignore"):
        return without_nonfinite(table.astype(np.float32, copy=False), "objects")


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
