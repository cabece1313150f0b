"""Maps of OVO: the points of its SLAM, the object of each, and a feature an object, in one checkpoint a scene.

Source: tberriel/OVO at commit cf3b68e, ``save_representation`` of ovo/entities/ovomapping.py, ``capture_dict`` of
ovo/entities/ovo.py and ``export`` of ovo/entities/instance3d.py. What its ``--segment`` writes beside them, a class a
vertex and lists of run lengths, are texts in ScanNet's forms, their classes positions in OVO's own list.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.files.unpacking import Allowance, UnpackingError
from su3d_bench.core.maps import Partition
from su3d_bench.core.types import Float32Array, Int32Array, Int64Array
from su3d_bench.formats.arrays import MOST_MASKS, checked_points, kind_of, without_nonfinite
from su3d_bench.formats.torch_stream import read_torch_of_either_form
from su3d_bench.predictions.base import SceneFolders, ScenePrediction

MAP = "ovo_map.ckpt"
POINTS = ("map_params", "gaussian_params")  # the second in maps of before; its own loader takes both
OBJECTS = "ovo_map_params"


class Ovo(SceneFolders):
    name = "ovo"
    summary = f"OVO's <scene>/{MAP}: points with the object of each, and a feature an object"
    noun, first, second = "map", MAP, MAP

    def recognise(self, path: Path) -> str | None:
        return f"it holds {MAP}" if super().recognise(path) else None

    def scene_of(self, folder: Path, path: Path) -> str:
        return folder.absolute().name

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        file = place / MAP
        where, value = shown(file), read_torch_of_either_form(file)
        parts = value if isinstance(value, dict) else {}
        cloud = next((parts[key] for key in POINTS if isinstance(parts.get(key), dict)), None)
        objects = parts.get(OBJECTS)
        if not isinstance(cloud, dict) or not isinstance(objects, dict):
            raise PredictionError(
                f"{where}: holds {kind_of(value)} without '{POINTS[0]}' and '{OBJECTS}'; is it of OVO?"
            )
        points = checked_points(cloud.get("xyz"), where)
        ids = _ids(objects.get("ins_3d_ids"), where)
        features, remarks = without_nonfinite(_features(objects, ids, Allowance(file.stat().st_size), where), "objects")
        instance = _rows(cloud.get("obj_ids"), len(points), ids, where)
        n_lost = len(ids) - len(np.unique(instance[instance >= 0]))
        if n_lost:
            remarks += (f"{n_lost} of {len(ids)} objects have no point left",)
        return ScenePrediction(scene, self.name, file, Partition(points, instance, features), remarks)


def _ids(value: object, where: str) -> Int64Array:
    """The number of each object, in the order of the map's."""
    is_list = isinstance(value, np.ndarray) and value.ndim == 1 and (value.dtype.kind in "iu" or not value.size)
    if not isinstance(value, np.ndarray) or not is_list or len(value) > MOST_MASKS:
        raise PredictionError(f"{where}: 'ins_3d_ids' is {kind_of(value)}; expected the number of each object")
    ids = value.astype(np.int64)
    if len(np.unique(ids)) != len(ids) or (len(ids) and int(ids.min()) < 0):
        raise PredictionError(f"{where}: 'ins_3d_ids' has a number twice or below 0; is it damaged?")
    return ids


def _features(objects: Mapping[object, object], ids: Int64Array, allowance: Allowance, where: str) -> Float32Array:
    """A row (K, D) for each object, of zeros for those that were never described."""
    features: Float32Array | None = None
    for row, number in enumerate(ids.tolist()):
        value = objects.get(f"ins3d_{number}_clip_feature")
        if value is None:
            continue
        n = None if features is None else features.shape[1]
        is_row = isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.shape in _row_shapes(value.size)
        if not isinstance(value, np.ndarray) or not is_row or n not in (None, value.size):
            beside = "" if n is None else f" of {n}"
            raise PredictionError(
                f"{where}: the feature of object {number} is {kind_of(value)}; expected a row{beside}"
            )
        if features is None:
            try:
                allowance.spend(4 * len(ids) * value.size)  # objects may share one row
            except UnpackingError as error:
                raise PredictionError(f"{where}: {error}") from error
            features = np.zeros((len(ids), value.size), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            features[row] = value.reshape(-1)
    return np.zeros((len(ids), 1), np.float32) if features is None else features


def _row_shapes(n: int) -> tuple[tuple[int, ...], ...]:
    """As OVO has them: alone where one view was kept, as a table of one row where several were merged."""
    return ((n,), (1, n)) if n else ()


def _rows(value: object, n_points: int, ids: Int64Array, where: str) -> Int32Array:
    """The row of the object of each point, -1 for none."""
    if (
        not isinstance(value, np.ndarray)
        or value.dtype.kind not in "iu"
        or value.shape not in {(n_points,), (n_points, 1)}
    ):
        raise PredictionError(
            f"{where}: 'obj_ids' is {kind_of(value)}; expected an object for each of {n_points} points"
        )
    numbers = value.reshape(-1).astype(np.int64)
    order = np.argsort(ids)
    known = np.array([*ids[order], np.iinfo(np.int64).max], np.int64)
    place = np.searchsorted(known, numbers)
    is_known = known[place] == numbers
    is_wrong = ~is_known & (numbers >= 0)
    if is_wrong.any():
        worst = int(np.argmax(is_wrong))
        raise PredictionError(f"{where}: point {worst} is of object {int(numbers[worst])}, which the map does not have")
    rows = np.array([*order, -1], np.int32)
    return np.where(is_known, rows[place], -1).astype(np.int32)
