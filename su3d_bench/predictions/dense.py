"""Maps over their own points with a feature for each point, voxel or object of a partition.

- ConceptFusion as stored by gradslam, ``pc_points.h5`` and the features of its points. Source: gradslam branch
  conceptfusion at commit 59ca872. Its loader makes poses relative to the first frame, so that the points are in the
  frame of the first camera; the first pose of the recording transforms them to the world.
  - RayFronts, one feature per voxel or point. Source: RayFronts/RayFronts at commit cfa0e6a: ``save`` of
  rayfronts/mapping/semantic_voxel_map.py and semantic_point_cloud.py, and the cache that scripts/semseg_eval.py
  writes for any of its maps, ``map.pt`` in the folder of a scene. Its rays, beyond the depth range, are in no file.
  - OVO, the points of its SLAM, the object of each, and one feature per object, in one checkpoint per scene. Source:
  tberriel/OVO at commit cf3b68e, ``save_representation`` of ovo/entities/ovomapping.py, ``capture_dict`` of
  ovo/entities/ovo.py and ``export`` of ovo/entities/instance3d.py. Its ``--segment`` also writes text files in
  ScanNet's formats, whose classes are indices into OVO's own list.
- OpenLex3D, a cloud, the object of each point, the feature of each object. Source: openlex3d at commit 3dbad2b. The
  format has no points without an object, no overlaps, scores or names.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, StoreError, converted, shown
from su3d_bench.core.maps import DenseFeatures, Partition
from su3d_bench.core.types import Float32Array, Int32Array, Int64Array
from su3d_bench.formats import arrays
from su3d_bench.formats.hdf5 import read_rows, row_blocks
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.formats.poses import moved, read_first_pose
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.predictions.base import Parsed, file_format, first_found, named_once
from su3d_bench.predictions.hovsg import read_points
from su3d_bench.predictions.masks import holds

POINTS, EMBEDDINGS = "pc_points.h5", "pc_embeddings.h5"  # gradslam's
POSE_FILES = ("first_pose.txt", "traj.txt", "traj_w_c.txt")
MAP_FOLDERS = ("pointclouds", "saved-map", "saved-maps", "Sequence_1")
CLOUD = "point_cloud.pcd"  # OpenLex3D's
CLOUDS = (CLOUD, "point_cloud.ply", "input.ply")  # the search order of the original
LEX_INDEX, LEX_EMBEDDINGS = "index.npy", "embeddings.npy"
OVO_MAP = "ovo_map.ckpt"
OVO_POINTS = ("map_params", "gaussian_params")  # the second in older maps; its own loader accepts both
OVO_OBJECTS = "ovo_map_params"
RAY_MAP = "map.pt"
N_COLOURS, N_COUNTS = 3, 1  # columns before and after the features of a voxel of RayFronts


def scene_of_gradslam(folder: Path, path: Path) -> str:
    """The first name upwards that is not one of the map's own folders."""
    absolute = folder.absolute()
    names = [above.name for above in (absolute, *absolute.parents) if above.name not in MAP_FOLDERS]
    return names[0] or "scene"


def gradslam(place: Path, scene: str) -> Parsed:
    where = shown(place / POINTS)
    with converted(DataError, PredictionError):
        points = arrays.checked_points(read_rows(place / POINTS, 3, where), where)
        points, pose_remark = _in_world(points, place)
        features, n_without = _features(place / EMBEDDINGS, len(points))
    if not np.isfinite(points).all():
        raise PredictionError(f"{where}: the first pose moves points outside the range of float32 metres")
    remarks = [pose_remark]
    if n_without:
        remarks.append(f"{n_without} of {len(points)} points have no feature (a row of zeros or NaN)")
    return DenseFeatures(points, features), remarks


def _in_world(points: Float32Array, folder: Path) -> tuple[Float32Array, str]:
    """``points``, transformed with the first pose next to them if there is one, and a remark on it."""
    file = next((candidate for name in POSE_FILES if (candidate := folder / name).is_file()), None)
    if file is None:
        return points, (
            "points are used unchanged; gradslam stores them in the frame of the first camera: to transform them to "
            f"the world, put its camera-to-world pose, 16 numbers on one line, into {POSE_FILES[0]} next to {POINTS}"
        )
    pose = read_first_pose(file, shown(file))
    with np.errstate(over="ignore", invalid="ignore"):
        return moved(points, pose), f"points were transformed to the world with the first pose of {file.name}"


def _features(file: Path, n_points: int) -> tuple[NDArray[np.float16], int]:
    """The features (N, D), memory-mapped from an unnamed file, and the number of rows without any.

    Rows with values outside the range of float16 become zeros.
    """
    where, n_rows, n_without, n_columns = shown(file), 0, 0, 0
    try:
        # Sparse writes would crash the process on a full disk at the first access of the map; plain ones fail here.
        with tempfile.TemporaryFile() as stored:
            for block in row_blocks(file, None, where):
                rows = arrays.half_rows(block)
                n_rows, n_columns = n_rows + len(rows), rows.shape[1]
                n_without += int((~rows.any(axis=1)).sum())
                if n_rows <= n_points:
                    stored.write(rows.tobytes())
            stored.flush()
            if n_rows != n_points:
                raise PredictionError(f"{where}: has other rows than {POINTS} ({n_points}); copy both again")
            empty = np.zeros((0, n_columns), np.float16)
            return (np.memmap(stored, np.float16, "r", shape=(n_rows, n_columns)) if n_rows else empty), n_without
    except OSError as error:
        raise StoreError(
            f"cannot write features to {tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to a larger disk"
        ) from error


# ---- OpenLex3D


def scene_of_openlex3d(folder: Path, path: Path) -> str:
    """``scene``, or ``dataset/scene`` if ``path`` contains folders of datasets."""
    parts = folder.relative_to(path).parts
    return "/".join(parts) if parts else folder.absolute().name


def openlex3d(place: Path, scene: str) -> Parsed:
    clouds = [file for name in CLOUDS if (file := place / name).is_file()]
    if not clouds:
        raise PredictionError(f"{shown(place)}: has no cloud; expected {', '.join(CLOUDS[:-1])} or {CLOUDS[-1]}")
    points = read_points(clouds[0])
    embeddings = place / LEX_EMBEDDINGS
    features, remarks = arrays.without_nonfinite(arrays.feature_table(read_npy(embeddings), embeddings), "objects")
    if len(clouds) > 1:
        names = ", ".join(file.name for file in clouds[1:])
        remarks = (f"{clouds[0].name} is read, as in the original, and not {names}", *remarks)
    index = _index(place / LEX_INDEX, len(points), clouds[0].name, len(features))
    return Partition(points, index, features), remarks


def _index(file: Path, n_points: int, cloud: str, n_objects: int) -> Int32Array:
    """The object of each point; every point has one."""
    expected = f"one integer for each of the {n_points} points of {cloud}"
    index = arrays.array_of(read_npy(file), f"{shown(file)}: holds", expected, "iu", n_points)
    is_wrong = (index < 0) | (index >= n_objects)
    if is_wrong.any():
        point = int(np.argmax(is_wrong))
        raise PredictionError(
            f"{shown(file)}: point {point} is of object {int(index[point])}, {LEX_EMBEDDINGS} has {n_objects} rows; "
            "every point needs one of them, omit points without an object"
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
            f"{where}: holds {arrays.kind_of(value)} without '{OVO_POINTS[0]}' and '{OVO_OBJECTS}'; is it of OVO?"
        )
    points = arrays.checked_points(cloud.get("xyz"), where)
    ids = _ids(objects.get("ins_3d_ids"), where)
    features, remarks = arrays.without_nonfinite(_rows_of(objects, ids, file), "objects")
    instance = _rows(cloud.get("obj_ids"), len(points), ids, where)
    n_lost = len(ids) - len(np.unique(instance[instance >= 0]))
    if n_lost:
        remarks += (f"{n_lost} of {len(ids)} objects have no points",)
    return Partition(points, instance, features), remarks


def _ids(value: object, where: str) -> Int64Array:
    """The number of each object, ascending, because the smallest wins a tie of votes in OVO's evaluation."""
    is_empty = isinstance(value, np.ndarray) and not value.size
    value = arrays.array_of(
        value, f"{where}: 'ins_3d_ids' is", "the number of each object", "iuf" if is_empty else "iu", None
    )
    arrays.check_sizes(0, len(value), where)
    ids = value.astype(np.int64)
    if len(np.unique(ids)) != len(ids) or (len(ids) and int(ids.min()) < 0):
        raise PredictionError(f"{where}: 'ins_3d_ids' has a repeated or negative number; is it damaged?")
    return np.sort(ids)


def _rows_of(objects: Mapping[object, object], ids: Int64Array, file: Path) -> Float32Array:
    """One row (K, D) per object, zeros for those without a descriptor."""
    where, features = shown(file), np.zeros((len(ids), 0), np.float32)
    for row, number in enumerate(ids.tolist()):
        value = objects.get(f"ins3d_{number}_clip_feature")
        if value is None:
            continue
        if isinstance(value, np.ndarray) and value.ndim == 2 and len(value) == 1:  # if several views were merged
            value = value[0]
        n = features.shape[1]
        found = f"{where}: the feature of object {number} is"
        feature = arrays.array_of(value, found, f"a row of {n}" if n else "a row", "f", n or arrays.NOT_EMPTY)
        if not n:
            arrays.check_memory(4 * len(ids) * len(feature), file)  # objects can share one row
            features = np.zeros((len(ids), len(feature)), np.float32)
        features[row] = arrays.as_float32(feature)
    return features if features.shape[1] else np.zeros((len(ids), 1), np.float32)


def _rows(value: object, n_points: int, ids: Int64Array, where: str) -> Int32Array:
    """The row of the object of each point, -1 for none."""
    flat = value[:, 0] if isinstance(value, np.ndarray) and value.shape == (n_points, 1) else value
    expected = f"an object for each of {n_points} points"
    numbers = arrays.array_of(flat, f"{where}: 'obj_ids' is", expected, "iu", n_points).astype(np.int64)
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


def looks_like_rayfronts(path: Path) -> str | None:
    if _kept(path):
        return f"it contains {RAY_MAP}"
    return SAVED_MAPS.recognise(path)


def rayfronts_scenes(path: Path) -> Mapping[str, Path]:
    if kept := _kept(path):
        return named_once([(file.absolute().parent.name, file) for file in kept], path)
    return SAVED_MAPS.scenes(path) if path.exists() else {}


def rayfronts(place: Path, scene: str) -> Parsed:
    where, value = shown(place), read_torch(place)
    if not isinstance(value, dict):
        raise PredictionError(f"{where}: holds {arrays.kind_of(value)}; expected a dict of RayFronts")
    points, table = _columns(value, place)
    places = arrays.checked_points(points, where)
    found = f"{where}: {len(places)} positions, but the features are"
    features = arrays.half_rows(
        arrays.array_of(table, found, "one row per voxel or point", "f", len(places), arrays.NOT_EMPTY)
    )
    n_without = int((~features.any(axis=1)).sum())
    remarks = ["RayFronts' files do not contain its rays, beyond the depth range: they are not scored"]
    if n_without:
        remarks.append(f"{n_without} of {len(places)} voxels or points have no feature (a row of zeros or NaN)")
    return DenseFeatures(places, features), remarks


SAVED_MAPS = file_format("rayfronts", (".pt",), holds(dict, "a dict"), rayfronts)


def _kept(path: Path) -> list[Path]:
    """The caches of an evaluation at or in ``path``."""
    if not path.is_dir():
        return []
    return [file for file in first_found(path, [RAY_MAP, f"*/{RAY_MAP}", f"*/*/{RAY_MAP}"]) if file.is_file()]


def _columns(value: Mapping[object, object], file: Path) -> tuple[object, object]:
    """Positions and features of a map in any of the three forms."""
    where = shown(file)
    if "feats_feats" in value:
        return value.get("feats_xyz"), value["feats_feats"]
    if "global_vox_rgb_feat_conf" in value:
        table = value["global_vox_rgb_feat_conf"]
        has_columns = isinstance(table, np.ndarray) and table.ndim == 2
        return value.get("global_vox_xyz"), table[:, N_COLOURS:-N_COUNTS] if has_columns else table  # type: ignore[index]
    if "global_feat_pc" in value:
        places, features = value.get("global_xyz_pc"), value["global_feat_pc"]
        return _joined(places, file), _joined(features, file)
    if "global_vox_occ" in value:
        raise PredictionError(f"{where}: is an occupancy map without features; save a semantic map")
    names = sorted(name for name in value if isinstance(name, str))
    raise PredictionError(
        f"{where}: holds {', '.join(names[:4]) or 'nothing'}; expected a map of RayFronts, such as {RAY_MAP}"
    )


def _joined(value: object, file: Path) -> NDArray[np.generic]:
    """The clouds of a list, concatenated."""
    clouds, where = value if isinstance(value, list | tuple) else [], shown(file)
    if not clouds:
        raise PredictionError(f"{where}: holds no cloud; expected a list of them")
    width = next(iter(np.shape(clouds[0])[1:]), None)
    found = f"{where}: a cloud of the list is"
    tables = [arrays.array_of(cloud, found, "tables of one width", "fiu", None, width) for cloud in clouds]
    arrays.check_memory(sum(table.nbytes for table in tables), file)  # clouds may share their arrays
    return np.concatenate(tables)
