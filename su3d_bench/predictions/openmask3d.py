"""OpenMask3D's masks with a feature each: a matrix saved by torch and a NumPy file beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.types import Float32Array
from su3d_bench.formats.arrays import column_members, kind_of, matrix_of, without_nonfinite
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import NO_SCORES, ScenePrediction, vertex_masks
from su3d_bench.predictions.mask_archives import TorchFiles

FEATURES_SUFFIXES = ("_openmask3d_features.npy", "_features.npy", ".npy")


class OpenMask3d(TorchFiles):
    name = "openmask3d"
    summary = (
        "OpenMask3D's <scene>_masks.pt (points, masks) with <scene>_openmask3d_features.npy, or <scene>.pt and .npy"
    )
    suffixes = ("_masks.pt", ".pt")
    kinds = ("array", "tensor")
    content = "one matrix"

    def recognise(self, path: Path) -> str | None:
        is_hovsg = (path / "mask_feats.pt").is_file()  # a matrix, too: of features
        return None if is_hovsg else super().recognise(path)

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        matrix = matrix_of(read_torch(place), where)
        features, remarks = _features(place.parent, scene, matrix.shape[1])
        masks = vertex_masks(where, column_members(matrix, where), len(matrix), features=features)
        return ScenePrediction(scene, self.name, place, masks, (NO_SCORES, *remarks))


def _features(folder: Path, scene: str, n_masks: int) -> tuple[Float32Array | None, tuple[str, ...]]:
    """The features (masks, D) that lie beside the masks, as they are; a row with NaN is one without a feature."""
    file = next((candidate for end in FEATURES_SUFFIXES if (candidate := folder / f"{scene}{end}").is_file()), None)
    if file is None:
        return None, (f"no '{scene}{FEATURES_SUFFIXES[0]}' lies beside the masks: they have no features",)
    values = read_npy(file)
    if values.ndim != 2 or values.dtype.kind not in "fiu" or len(values) != n_masks:
        raise PredictionError(f"{shown(file)}: {n_masks} masks, but the features are {kind_of(values)}")
    # OpenMask3D normalises and puts 0 for what is NaN then, which makes a row with a NaN or infinity one of zeros.
    with np.errstate(over="ignore", invalid="ignore"):
        return without_nonfinite(values.astype(np.float32), "masks")
