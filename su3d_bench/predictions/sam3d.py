"""SAM3D's groups: one integer a point of the scene, -1 where it is in no group."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.formats.arrays import MOST_POINTS, kind_of
from su3d_bench.formats.numpy_files import npy_header_of, read_npy
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import NO_SCORES, ScenePrediction, vertex_masks
from su3d_bench.predictions.mask_archives import TorchFiles


class Sam3d(TorchFiles):
    name = "sam3d"
    summary = "SAM3D's <scene>.pth or .npy: a group number for each point, -1 for none, without scores and classes"
    suffixes = (".npy", ".pth")
    kinds = ("array", "tensor")
    content = "one array"

    def recognise(self, path: Path) -> str | None:
        if (reason := super().recognise(path)) is not None:
            return reason
        first = self.first(path, ".npy")
        header = npy_header_of(first) if first is not None else None
        is_list = header is not None and len(header.shape) == 1 and header.code.lstrip("<>|=")[0] in "iu"
        return "its .npy files hold a list of integers" if is_list else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        groups = read_npy(place) if place.suffix == ".npy" else read_torch(place)
        if not isinstance(groups, np.ndarray) or groups.ndim != 1 or groups.dtype.kind not in "iu":
            raise PredictionError(f"{where}: holds {kind_of(groups)}; expected one group number a point")
        if len(groups) > MOST_POINTS:
            raise PredictionError(f"{where}: holds {kind_of(groups)}; is it damaged?")
        order = np.argsort(groups, kind="stable").astype(np.int32)
        order = order[np.count_nonzero(groups < 0) :]
        sorted_groups = groups[order]
        starts = np.flatnonzero(np.concatenate([[True], sorted_groups[1:] != sorted_groups[:-1]])[: len(order)])
        members = np.split(order, starts[1:])[: len(starts)]
        keys = [f"group {int(sorted_groups[start])}" for start in starts]
        masks = vertex_masks(where, members, len(groups), keys=keys)
        return ScenePrediction(scene, self.name, place, masks, (NO_SCORES, "groups without classes"))
