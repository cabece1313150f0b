"""SAM3D's groups: one integer a point of the scene, -1 where it is in no group, or one colour a group, black for none.

Source of both: util.py of Pointcept/SegmentAnything3D at 2aaa8c9, whose ``visualize_partition`` draws a random colour a
group and writes the cloud with Open3D, the points in the order of the scene's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, converted, reading, shown
from su3d_bench.core.types import Int64Array
from su3d_bench.formats.arrays import MOST_MASKS, MOST_POINTS, kind_of
from su3d_bench.formats.numpy_files import npy_header_of, read_npy
from su3d_bench.formats.ply import first_rows, read_ply
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import NO_SCORES, SceneFiles, ScenePrediction, VertexMasks, vertex_masks
from su3d_bench.predictions.mask_archives import TorchFiles
from su3d_bench.predictions.online.onlineanyseg import MASKS as ONLINE_MASKS

REMARKS = (NO_SCORES, "groups without classes")
CHANNELS = ("red", "green", "blue")
POINTS_OF_A_COLOUR = 20  # at least, on average over the first points, where colours are groups; photographs have 1 or 2


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
        return ScenePrediction(scene, self.name, place, masks_of_groups(groups, "group", where), REMARKS)


class Sam3dColours(SceneFiles):
    name = "sam3d-colours"
    summary = "SAM3D's coloured clouds <scene>.ply: one colour a group, black for none, the points those of the scene"
    suffixes = (".ply",)

    def recognise(self, path: Path) -> str | None:
        first = self.first(path, ".ply")
        if first is None or (first.parent / ONLINE_MASKS).is_file():  # the cloud that those masks are over
            return None
        try:
            with reading(shown(first)):
                colours = _colours(first_rows(first, "vertex"))
        except (DataError, PredictionError):
            return None
        is_group = colours is not None and len(np.unique(colours)) * POINTS_OF_A_COLOUR <= len(colours) > 0
        return "its .ply files hold clouds in which many points share a colour" if is_group else None

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        where = shown(place)
        with converted(DataError, PredictionError):
            vertices = read_ply(place, where).element("vertex")
        colours = None if vertices is None else _colours(vertices.columns)
        if colours is None:
            raise PredictionError(f"{where}: its points have no colours red, green, blue of one byte each")
        groups = np.where(colours == 0, -1, colours)
        if len(np.unique(groups)) > MOST_MASKS:
            raise PredictionError(
                f"{where}: {len(np.unique(groups))} colours; expected one a group: is it the cloud of a photograph?"
            )
        remark = "a colour is a group: two groups of one colour are one here"
        return ScenePrediction(scene, self.name, place, masks_of_groups(groups, "colour", where), (*REMARKS, remark))


def masks_of_groups(groups: NDArray[np.integer[Any]], noun: str, where: str) -> VertexMasks:
    """A mask for each value from 0 up, in ascending order."""
    order = np.argsort(groups, kind="stable").astype(np.int32)
    order = order[np.count_nonzero(groups < 0) :]
    sorted_groups = groups[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_groups[1:] != sorted_groups[:-1]])[: len(order)])
    members = np.split(order, starts[1:])[: len(starts)]
    values = sorted_groups[starts].tolist()
    keys = [f"#{value:06x}" if noun == "colour" else f"{noun} {value}" for value in values]
    return vertex_masks(where, members, len(groups), keys=keys)


def _colours(columns: Mapping[str, object]) -> Int64Array | None:
    """Red * 65536 + green * 256 + blue of each point; None where the file has no such bytes."""
    channels = [columns.get(name) for name in CHANNELS]
    if not all(isinstance(channel, np.ndarray) and channel.dtype == np.uint8 for channel in channels):
        return None
    red, green, blue = (np.asarray(channel, np.int64) for channel in channels)
    return (red << 16) | (green << 8) | blue
