"""Results of OnlineAnySeg: masks over the points that it rebuilt itself, with a feature a mask.

Source: yjtang249/OnlineAnySeg at commit 152466e, ``export_instance_mask`` of tool/post_process.py and ``save_pc`` of
Scene_rep.py, as main.py calls them. What its eval/semantic_helpers.py makes of them is MaskClustering's form.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.arrays import (
    checked_points,
    column_members,
    kind_of,
    matrix_of,
    scores_of,
    without_nonfinite,
)
from su3d_bench.formats.numpy_files import read_npz
from su3d_bench.predictions.base import NO_SCORES, SceneFolders, ScenePrediction, vertex_masks
from su3d_bench.predictions.hovsg import read_cloud

MASKS, CLOUD = "ckpt_final.npz", "final.ply"


class OnlineAnySeg(SceneFolders):
    name = "onlineanyseg"
    summary = f"OnlineAnySeg's <scene>/{MASKS}, masks (points, masks) and their features, with the points {CLOUD}"
    first, second = MASKS, CLOUD

    def scene_of(self, folder: Path, path: Path) -> str:
        return folder.absolute().name

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        file = place / MASKS
        where = shown(file)
        points = checked_points(read_cloud(place / CLOUD), shown(place / CLOUD))
        arrays = read_npz(file, ("pred_masks", "pred_score", "pred_sem_features"))
        matrix = matrix_of(arrays.get("pred_masks"), where)
        n_points, n_masks = matrix.shape
        if n_points != len(points):
            raise PredictionError(
                f"{where}: the masks are of {n_points} points, {CLOUD} has {len(points)}; both must be of one run"
            )
        scores = scores_of(arrays["pred_score"], n_masks, where) if "pred_score" in arrays else None
        masks = vertex_masks(where, column_members(matrix, where), n_points, scores=scores)
        features, remarks = _features(arrays.get("pred_sem_features"), n_masks, where)
        instances = Instances.of(points, masks, masks.scores, features, names=masks.keys)
        remarks += () if scores is not None else (NO_SCORES,)
        return ScenePrediction(scene, self.name, place, instances, remarks)


def _features(value: object, n_masks: int, where: str) -> tuple[Float32Array | None, tuple[str, ...]]:
    """The features (masks, D) of the file's (D, masks)."""
    if value is None:
        return None, ("the file has no features: the masks are class-agnostic",)
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind != "f" or value.shape[1] != n_masks:
        raise PredictionError(
            f"{where}: {n_masks} masks, but the features are {kind_of(value)}; expected a column a mask"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return without_nonfinite(np.ascontiguousarray(value.T).astype(np.float32), "masks")
