"""The per-pixel ID image M': which detection each pixel belongs to, with a ring of no instance around each mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.types import BoolArray, Int32Array, UInt8Array

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
    ids = np.full(masks.shape[1:], NO_DETECTION, np.int32)
    owner = ids.copy()
    areas = np.count_nonzero(masks, axis=(1, 2))
    element = _structuring_element(border_px, shape)
    for k in np.argsort(-areas, kind="stable"):
        if areas[k] == 0:
            continue
        window = _window(masks[k], border_px)
        mask = masks[k][window]
        ids[window][_dilate(mask, element)] = NO_DETECTION
        ids[window][mask] = k
        owner[window][mask] = k
    return IdImage(ids, owner)


def _window(mask: BoolArray, margin: int) -> tuple[slice, slice]:
    """The mask's bounding box grown by ``margin``, clipped to the image."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )


def _structuring_element(radius: int, shape: Literal["disc", "square"]) -> UInt8Array:
    offsets = np.arange(-radius, radius + 1)
    inside = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= radius * radius
    return np.where(inside | (shape == "square"), 1, 0).astype(np.uint8)


def _dilate(mask: BoolArray, element: UInt8Array) -> BoolArray:
    import cv2

    grown = cv2.dilate(mask.astype(np.uint8), element, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(grown, np.uint8) > 0
