"""The per-pixel ID image M': which detection each pixel belongs to, with a ring of no instance around each mask."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import Literal

import numpy as np

from su3d_bench.core.types import BoolArray, Int32Array, Int64Array

NO_DETECTION = -1


@dataclass(frozen=True)
class IdImage:
    """``ids`` (H, W) int32: the detection of each pixel, NO_DETECTION in a ring and in no mask; this is M'.

    ``owner`` (H, W) int32 is the same before the rings were cut: it differs from ``ids`` in the rings alone.
    """

    ids: Int32Array
    owner: Int32Array


def paint(masks: BoolArray, border_px: int, shape: Literal["disc", "square"]) -> IdImage:
    """The ID image of ``masks`` (K, H, W).

    Larger masks are painted first, equal ones in order, so that where masks overlap the smaller one shows. Each mask
    takes the ring of ``border_px`` around it from what was painted before.
    """
    from su3d_bench.opensu3d.kernels import image as kernels

    ids = np.full(masks.shape[1:], NO_DETECTION, np.int32)
    owner = ids.copy()
    pixels = np.require(masks, np.bool_, ["C", "W"]).view(np.uint8)
    areas, bounds = np.empty(len(masks), np.int64), np.empty((len(masks), 4), np.int64)
    kernels.extents(pixels, areas, bounds)
    reach = _reach(border_px, shape)
    for k in np.argsort(-areas, kind="stable"):
        if areas[k]:
            kernels.paint(pixels[k], k, bounds[k], reach, ids, owner)
    return IdImage(ids, owner)


def _reach(radius: int, shape: Literal["disc", "square"]) -> Int64Array:
    """How far the ring of one pixel goes along the rows 0, 1, ... ``radius`` off."""
    rows = np.arange(radius + 1)
    furthest = np.array([isqrt(radius * radius - int(row) ** 2) for row in rows], np.int64)
    return np.full(radius + 1, radius, np.int64) if shape == "square" else furthest
