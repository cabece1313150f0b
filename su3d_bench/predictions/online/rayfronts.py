"""Maps of RayFronts: a feature a voxel or point.

Source: RayFronts/RayFronts at commit cfa0e6a: ``save`` of rayfronts/mapping/semantic_voxel_map.py and
semantic_point_cloud.py, and the cache that scripts/semseg_eval.py keeps of any of its maps, ``map.pt`` in the folder of
a scene. Its rays, beyond the reach of the depth, are in no file: the maps that have them cannot be saved.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.files.unpacking import Allowance, UnpackingError
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.formats.arrays import checked_points, half_rows, kind_of
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import ScenePrediction, first_found, named_once
from su3d_bench.predictions.mask_archives import TorchFiles

MAP = "map.pt"
N_COLOURS, N_COUNTS = 3, 1  # columns before and behind the features of a voxel


class RayFronts(TorchFiles):
    name = "rayfronts"
    summary = f"RayFronts' <scene>/{MAP} of its evaluation, or <scene>.pt of a map's save: a feature a voxel or point"
    noun = "map"
    suffixes = (".pt",)
    kinds = ("dict",)
    content = "a dict"

    def recognise(self, path: Path) -> str | None:
        return f"it holds {MAP}" if _kept(path) else super().recognise(path)

    def scenes(self, path: Path) -> dict[str, Path]:
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
    return [file for file in first_found(path, [MAP, f"*/{MAP}", f"*/*/{MAP}"]) if file.is_file()]


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
        f"{where}: holds {', '.join(names[:4]) or 'nothing'}; expected a map of RayFronts, such as {MAP}"
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
