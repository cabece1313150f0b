"""The per-pixel ID image M': which detection each pixel belongs to, with a ring of no instance around each mask."""

from __future__ import annotations

from typing import Literal

import numpy as np

from su3d_bench.types import BoolArray, Int32Array, UInt8Array

BACKGROUND = -1
BORDER = -2


def paint(masks: BoolArray, border_px: int, shape: Literal["disc", "square"]) -> Int32Array:
    """ID image (H, W) int32 of ``masks`` (K, H, W): a detection's index, BACKGROUND in no mask, BORDER in a ring.

    Larger masks are painted first, equal ones in order, so that where masks overlap the smaller one shows. Each mask
    takes the ring of ``border_px`` around it from what was painted before; a ring over no mask stays BACKGROUND.
    """
    image = np.full(masks.shape[1:], BACKGROUND, np.int32)
    areas = np.count_nonzero(masks, axis=(1, 2))
    element = _structuring_element(border_px, shape)
    for k in np.argsort(-areas, kind="stable"):
        if areas[k] == 0:
            continue
        rows, columns = _window(masks[k], border_px)
        mask, window = masks[k, rows, columns], image[rows, columns]
        ring = _dilate(mask, element) & ~mask
        window[ring & (window != BACKGROUND)] = BORDER
        window[mask] = k
    return image


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
