"""OpenMask3D's masks with a feature each: a matrix saved by torch and a NumPy file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import ScenePrediction
from su3d_bench.predictions.mask_archives import first_of_kind
from su3d_bench.predictions.mask_arrays import (
    NO_SCORES,
    column_members,
    kind_of,
    matrix_of,
    scene_file,
    scene_files,
    vertex_masks,
)

MASKS_SUFFIXES = ("_masks.pt", ".pt")
FEATURES_SUFFIXES = ("_openmask3d_features.npy", "_features.npy", ".npy")


class OpenMask3d:
    name = "openmask3d"
    summary = (
        "OpenMask3D's <scene>_masks.pt (points, masks) with <scene>_openmask3d_features.npy, or <scene>.pt and .npy"
    )

    def recognise(self, path: Path) -> str | None:
        first = first_of_kind(path, ".pt", ("array", "tensor"))
        is_hovsg = (path / "mask_feats.pt").is_file()  # a matrix, too: of features
        return None if first is None or is_hovsg else "its .pt files hold one matrix"

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return scene_files(path, MASKS_SUFFIXES)

    def read(self, path: Path, scene: str) -> ScenePrediction:
        file = scene_file(scene_files(path, MASKS_SUFFIXES), path, scene)
        where = shown(file)
        matrix = matrix_of(read_torch(file), where)
        features, remarks = _features(file.parent, scene, matrix.shape[1])
        masks = vertex_masks(where, column_members(matrix, where), len(matrix), features=features)
        return ScenePrediction(scene, self.name, file, masks, (NO_SCORES, *remarks))


def _features(folder: Path, scene: str, n_masks: int) -> tuple[Float32Array | None, tuple[str, ...]]:
    """The features (masks, D) that lie beside the masks, as they are; a row with NaN is one without a feature."""
    file = next((one for end in FEATURES_SUFFIXES if (one := folder / f"{scene}{end}").is_file()), None)
    if file is None:
        return None, (f"no '{scene}{FEATURES_SUFFIXES[0]}' lies beside the masks: they have no features",)
    values = read_npy(file)
    if values.ndim != 2 or values.dtype.kind not in "fiu" or len(values) != n_masks:
        raise PredictionError(f"{shown(file)}: {n_masks} masks, but the features are {kind_of(values)}")
    # OpenMask3D normalises and puts 0 for what is NaN then, which makes a row with a NaN or infinity one of zeros.
    with np.errstate(over="ignore", invalid="ignore"):
        features = values.astype(np.float32)
    features[~np.isfinite(features).all(axis=1)] = 0
    n_without = int((~features.any(axis=1)).sum())
    remarks = (f"{n_without} masks have no feature (a row of zeros or NaN)",) if n_without else ()
    return features, remarks
