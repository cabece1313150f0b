"""Crops of an image around detections, by one rounding rule for every encoder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Int64Array, UInt8Array


def mask_boxes(masks: BoolArray) -> Float32Array:
    """Tight boxes (K, 4) x0 y0 x1 y1 of ``masks`` (K, H, W), right and bottom exclusive; zeros for an empty mask."""
    boxes = np.zeros((len(masks), 4), np.float32)
    for k, mask in enumerate(masks):
        columns = np.flatnonzero(mask.any(axis=0))
        rows = np.flatnonzero(mask.any(axis=1))
        if len(columns):
            boxes[k] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def crop_window(box: Sequence[float] | Float32Array, ratio: float, width: int, height: int) -> Int64Array:
    """Integer window (4,) x0 y0 x1 y1 of ``box`` scaled by ``ratio`` about its centre and clipped to the image.

    Each border is rounded to the nearest pixel border, halves towards the right and the bottom, after clipping; a
    window that would be empty is one pixel wide. So a whole-pixel box at ratio 1.0 is returned as it is.
    """
    x0, y0, x1, y1 = (float(value) for value in box)
    left, right = _scaled((x0, x1), ratio, width)
    top, bottom = _scaled((y0, y1), ratio, height)
    return np.array([left, top, right, bottom], np.int64)


def _scaled(span: tuple[float, float], ratio: float, size: int) -> tuple[int, int]:
    centre = 0.5 * (span[0] + span[1])
    half = 0.5 * (span[1] - span[0]) * ratio
    low = int(np.floor(min(max(centre - half, 0.0), size) + 0.5))
    high = int(np.floor(min(max(centre + half, 0.0), size) + 0.5))
    if high > low:
        return low, high
    low = min(low, size - 1)
    return low, low + 1


def crop_images(rgb: UInt8Array, boxes: Float32Array, ratio: float) -> list[UInt8Array]:
    """One contiguous crop (h, w, 3) of ``rgb`` for each box (K, 4), at its native size."""
    height, width = rgb.shape[:2]
    crops = []
    for box in boxes:
        x0, y0, x1, y1 = crop_window(box, ratio, width, height)
        crops.append(np.ascontiguousarray(rgb[y0:y1, x0:x1]))
    return crops
