"""SAM3D's groups: one integer a point of the scene, -1 where it is in no group."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.formats.numpy_files import npy_header_of, read_npy
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import MOST_POINTS, ScenePrediction
from su3d_bench.predictions.mask_archives import first_of_kind
from su3d_bench.predictions.mask_arrays import NO_SCORES, kind_of, scene_file, scene_files, vertex_masks

SUFFIXES = (".pth", ".npy")


class Sam3d:
    name = "sam3d"
    summary = "SAM3D's <scene>.pth or .npy: a group number for each point, -1 for none, without scores and classes"

    def recognise(self, path: Path) -> str | None:
        if first_of_kind(path, ".pth", ("array", "tensor")) is not None:
            return "its .pth files hold one array"
        if not path.is_dir() and path.suffix != ".npy":
            return None
        first = next(iter(scene_files(path, (".npy",)).values()), None)
        header = npy_header_of(first) if first is not None else None
        is_list = header is not None and len(header.shape) == 1 and header.code.lstrip("<>|=")[0] in "iu"
        return "its .npy files hold a list of integers" if is_list else None

    def scenes(self, path: Path) -> Mapping[str, Path]:
        return scene_files(path, SUFFIXES)

    def read(self, path: Path, scene: str) -> ScenePrediction:
        file = scene_file(scene_files(path, SUFFIXES), path, scene)
        where = shown(file)
        groups = read_npy(file) if file.suffix == ".npy" else read_torch(file)
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
        return ScenePrediction(scene, self.name, file, masks, (NO_SCORES, "groups without classes"))
