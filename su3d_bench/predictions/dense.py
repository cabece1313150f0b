"""Maps over points of their own with a feature for each point, voxel or object of a partition.

- ConceptFusion as gradslam stores it, ``pc_points.h5`` and the features of its points. Source: gradslam branch
  conceptfusion at commit 59ca872. Its loader makes poses relative to the first frame, so that the points are in the
  frame of the first camera; the first pose of the recording brings them to the world.
- RayFronts, a feature a voxel or point. Source: RayFronts/RayFronts at commit cfa0e6a: ``save`` of
  rayfronts/mapping/semantic_voxel_map.py and semantic_point_cloud.py, and the cache that scripts/semseg_eval.py keeps
  of any of its maps, ``map.pt`` in the folder of a scene. Its rays, beyond the reach of the depth, are in no file.
- OVO, the points of its SLAM, the object of each, and a feature an object, in one checkpoint a scene. Source:
  tberriel/OVO at commit cf3b68e, ``save_representation`` of ovo/entities/ovomapping.py, ``capture_dict`` of
  ovo/entities/ovo.py and ``export`` of ovo/entities/instance3d.py. What its ``--segment`` writes beside them are texts
  in ScanNet's forms, their classes positions in OVO's own list.
- OpenLex3D, a cloud, the object of each point, the feature of each object. Source: openlex3d at commit 3dbad2b. The
  format has no point without an object, no overlaps, scores or names.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, StoreError, converted, shown
from su3d_bench.core.files.atomic import Allowance, UnpackingError
from su3d_bench.core.maps import DenseFeatures, Partition
from su3d_bench.core.types import Float32Array, Int32Array, Int64Array
from su3d_bench.formats.arrays import MOST_MASKS, checked_points, feature_table, half_rows, kind_of, without_nonfinite
from su3d_bench.formats.hdf5 import n_columns_of, read_rows, row_blocks
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.formats.poses import moved, read_first_pose
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.predictions.base import Parsed, SceneFiles, ScenePrediction, first_found, named_once
from su3d_bench.predictions.hovsg import read_cloud
from su3d_bench.predictions.masks import holds

POINTS, EMBEDDINGS = "pc_points.h5", "pc_embeddings.h5"  # gradslam's
POSE_FILES = ("first_pose.txt", "traj.txt", "traj_w_c.txt")
FOLDERS_OF_A_MAP = ("pointclouds", "saved-map", "saved-maps", "Sequence_1")
HELD_IN_MEMORY = 64 << 20  # bytes of features; larger tables are mapped from a temporary file
CLOUD = "point_cloud.pcd"  # OpenLex3D's
CLOUDS = (CLOUD, "point_cloud.ply", "input.ply")  # the order in which the original looks for them
LEX_INDEX, LEX_EMBEDDINGS = "index.npy", "embeddings.npy"
OVO_MAP = "ovo_map.ckpt"
OVO_POINTS = ("map_params", "gaussian_params")  # the second in maps of before; its own loader takes both
OVO_OBJECTS = "ovo_map_params"
RAY_MAP = "map.pt"
N_COLOURS, N_COUNTS = 3, 1  # columns before and behind the features of a voxel of RayFronts


def scene_of_gradslam(folder: Path, path: Path) -> str:
    """The first name upwards that is no folder of the map's own."""
    absolute = folder.absolute()
    names = [above.name for above in (absolute, *absolute.parents) if above.name not in FOLDERS_OF_A_MAP]
    return names[0] or "scene"


def gradslam(place: Path, scene: str) -> Parsed:
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
    return DenseFeatures(points, features), remarks


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


# ---- OpenLex3D


def scene_of_openlex3d(folder: Path, path: Path) -> str:
    """``scene``, or ``dataset/scene`` where ``path`` holds folders of datasets."""
    parts = folder.relative_to(path).parts
    return "/".join(parts) if parts else folder.absolute().name


def openlex3d(place: Path, scene: str) -> Parsed:
    clouds = [file for name in CLOUDS if (file := place / name).is_file()]
    if not clouds:
        raise PredictionError(f"{shown(place)}: has no cloud; expected {', '.join(CLOUDS[:-1])} or {CLOUDS[-1]}")
    points = checked_points(read_cloud(clouds[0]), shown(clouds[0]))
    embeddings = place / LEX_EMBEDDINGS
    features, remarks = without_nonfinite(feature_table(read_npy(embeddings), embeddings), "objects")
    if len(clouds) > 1:
        names = ", ".join(file.name for file in clouds[1:])
        remarks = (f"{clouds[0].name} is read, as the original does, and not {names}", *remarks)
    index = _index(place / LEX_INDEX, len(points), clouds[0].name, len(features))
    return Partition(points, index, features), remarks


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
            f"{shown(file)}: point {point} is of object {int(index[point])}, {LEX_EMBEDDINGS} has {n_objects} rows; "
            "every point needs one of them, leave out points without an object"
        )
    return index.astype(np.int32)


# ---- OVO


def ovo(place: Path, scene: str) -> Parsed:
    file = place / OVO_MAP
    where, value = shown(file), read_torch(file)
    parts = value if isinstance(value, dict) else {}
    cloud = next((parts[key] for key in OVO_POINTS if isinstance(parts.get(key), dict)), None)
    objects = parts.get(OVO_OBJECTS)
    if not isinstance(cloud, dict) or not isinstance(objects, dict):
        raise PredictionError(
            f"{where}: holds {kind_of(value)} without '{OVO_POINTS[0]}' and '{OVO_OBJECTS}'; is it of OVO?"
        )
    points = checked_points(cloud.get("xyz"), where)
    ids = _ids(objects.get("ins_3d_ids"), where)
    features, remarks = without_nonfinite(_rows_of(objects, ids, Allowance(file.stat().st_size), where), "objects")
    instance = _rows(cloud.get("obj_ids"), len(points), ids, where)
    n_lost = len(ids) - len(np.unique(instance[instance >= 0]))
    if n_lost:
        remarks += (f"{n_lost} of {len(ids)} objects have no point left",)
    return Partition(points, instance, features), remarks


def _ids(value: object, where: str) -> Int64Array:
    """The number of each object, in the order of the map's."""
    is_list = isinstance(value, np.ndarray) and value.ndim == 1 and (value.dtype.kind in "iu" or not value.size)
    if not isinstance(value, np.ndarray) or not is_list or len(value) > MOST_MASKS:
        raise PredictionError(f"{where}: 'ins_3d_ids' is {kind_of(value)}; expected the number of each object")
    ids = value.astype(np.int64)
    if len(np.unique(ids)) != len(ids) or (len(ids) and int(ids.min()) < 0):
        raise PredictionError(f"{where}: 'ins_3d_ids' has a number twice or below 0; is it damaged?")
    return ids


def _rows_of(objects: Mapping[object, object], ids: Int64Array, allowance: Allowance, where: str) -> Float32Array:
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


# ---- RayFronts


class RayFronts(SceneFiles):
    name = "rayfronts"
    summary = (
        f"RayFronts' <scene>/{RAY_MAP} of its evaluation, or <scene>.pt of a map's save: a feature a voxel or point"
    )
    noun = "map"
    suffixes = (".pt",)

    def recognise(self, path: Path) -> str | None:
        if _kept(path):
            return f"it holds {RAY_MAP}"
        first = next(iter(super().scenes(path).values()), None) if path.exists() else None
        return None if first is None else holds(dict, "a dict")(first)

    def scenes(self, path: Path) -> Mapping[str, Path]:
        if not path.exists():
            return {}
        kept = _kept(path)
        return dict(named_once([(file.absolute().parent.name, file) for file in kept], path)) or super().scenes(path)

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where, value = shown(place), read_torch(place)
        if not isinstance(value, dict):
            raise PredictionError(f"{where}: holds {kind_of(value)}; expected a dict of RayFronts")
        try:
            points, table = _columns(value, Allowance(place.stat().st_size), where)
        except UnpackingError as error:
            raise PredictionError(f"{where}: {error}") from error
        places = checked_points(points, where)
        if not isinstance(table, np.ndarray) or table.ndim != 2 or table.dtype.kind != "f" or not table.shape[1]:
            raise PredictionError(f"{where}: the features are {kind_of(table)}; expected a row a voxel or point")
        if len(table) != len(places):
            raise PredictionError(f"{where}: {len(places)} places, but the features are {kind_of(table)}")
        features = half_rows(table)
        n_without = int((~features.any(axis=1)).sum())
        remarks = ["what lay beyond the reach of the depth is in no file of RayFronts: its rays are not scored"]
        if n_without:
            remarks.append(f"{n_without} of {len(places)} voxels or points have no feature (a row of zeros or NaN)")
        return ScenePrediction(scene, self.name, place, DenseFeatures(places, features), tuple(remarks))


def _kept(path: Path) -> list[Path]:
    """The caches of an evaluation at or below ``path``."""
    if not path.is_dir():
        return []
    return [file for file in first_found(path, [RAY_MAP, f"*/{RAY_MAP}", f"*/*/{RAY_MAP}"]) if file.is_file()]


def _columns(value: Mapping[object, object], allowance: Allowance, where: str) -> tuple[object, object]:
    """Places and features of a map in any of the three forms."""
    if "feats_feats" in value:
        return value.get("feats_xyz"), value["feats_feats"]
    if "global_vox_rgb_feat_conf" in value:
        table = value["global_vox_rgb_feat_conf"]
        has_columns = isinstance(table, np.ndarray) and table.ndim == 2
        return value.get("global_vox_xyz"), table[:, N_COLOURS:-N_COUNTS] if has_columns else table  # type: ignore[index]
    if "global_feat_pc" in value:
        places, features = value.get("global_xyz_pc"), value["global_feat_pc"]
        return _joined(places, allowance, where), _joined(features, allowance, where)
    if "global_vox_occ" in value:
        raise PredictionError(f"{where}: holds which voxels are occupied and no features; save a semantic map")
    names = sorted(name for name in value if isinstance(name, str))
    raise PredictionError(
        f"{where}: holds {', '.join(names[:4]) or 'nothing'}; expected a map of RayFronts, such as {RAY_MAP}"
    )


def _joined(value: object, allowance: Allowance, where: str) -> NDArray[np.generic]:
    """The clouds of a list as one."""
    clouds = value if isinstance(value, list | tuple) else []
    first = clouds[0] if clouds else None
    for cloud in clouds:
        is_table = isinstance(cloud, np.ndarray) and cloud.ndim == 2 and cloud.dtype.kind in "fiu"
        if not is_table or not isinstance(first, np.ndarray) or cloud.shape[1:] != first.shape[1:]:
            raise PredictionError(f"{where}: a cloud of the list is {kind_of(cloud)}; expected tables of one width")
    if not clouds:
        raise PredictionError(f"{where}: holds no cloud; expected a list of them")
    allowance.spend(sum(cloud.nbytes for cloud in clouds))  # clouds may share what they hold
    return np.concatenate(clouds)
