"""Results of EmbodiedSAM (ESAM): the points of all frames and the colour of the mask of each, grey for none.

Source: xuxw98/ESAM at commit 188fc6d, ``run`` and ``mask_to_color`` of vis_demo/stream_demo.py, the only program of it
that writes masks: one of 256 random colours a mask. Its tools/test.py prints numbers and leaves nothing behind.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.errors import PredictionError, shown
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Int64Array
from su3d_bench.formats.arrays import checked_points, kind_of
from su3d_bench.formats.numpy_files import read_npy
from su3d_bench.predictions.base import SceneFolders, ScenePrediction
from su3d_bench.predictions.sam3d import REMARKS, masks_of_groups

POINTS, COLOURS = "points.npy", "points_color.npy"
GREY = 200  # of every channel: a point in no mask
MOST_COLOURS = 256  # in its palette


class Esam(SceneFolders):
    name = "esam"
    summary = f"ESAM's <scene>/{POINTS} and {COLOURS} of its stream demo: one colour a mask, grey for none"
    first, second = COLOURS, POINTS

    def scene_of(self, folder: Path, path: Path) -> str:
        return folder.absolute().name

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        points, where = read_npy(place / POINTS), shown(place / COLOURS)
        places = checked_points(
            points.reshape(-1, points.shape[-1]) if points.ndim == 3 else points, shown(place / POINTS)
        )
        groups = _groups(place / COLOURS, points.shape)
        masks = masks_of_groups(groups, "colour", where)
        if len(masks) > MOST_COLOURS:
            raise PredictionError(
                f"{where}: has {len(masks)} colours, ESAM's palette {MOST_COLOURS}; are they those of photographs?"
            )
        instances = Instances.of(places, masks, names=masks.keys)
        remark = "a colour is a mask: of masks that share points one has them"
        return ScenePrediction(scene, self.name, place, instances, (*REMARKS, remark))


def _groups(file: Path, shape: tuple[int, ...]) -> Int64Array:
    """The colour of each point as one number, -1 where it is in no mask."""
    colours = read_npy(file)
    if colours.shape != shape or colours.dtype.kind not in "iu":
        raise PredictionError(
            f"{shown(file)}: holds {kind_of(colours)}; expected a colour for each of {POINTS}, {shape}"
        )
    if colours.size and not 0 <= int(colours.min()) <= int(colours.max()) <= 255:
        raise PredictionError(
            f"{shown(file)}: a channel is {int(colours.min())} or {int(colours.max())}; expected 0 to 255"
        )
    red, green, blue = colours.reshape(-1, 3).astype(np.int64).T
    is_none = (red == GREY) & (green == GREY) & (blue == GREY)
    return np.where(is_none, -1, (red << 16) | (green << 8) | blue)
