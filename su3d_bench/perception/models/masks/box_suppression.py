"""Boxes as detectors and segmenters hand them out: their overlaps, and which of them to keep."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import Float32Array, Int64Array


def corners_of(boxes: Float32Array, height: int, width: int) -> Float32Array:
    """Boxes (K, 4) x0 y0 x1 y1 in pixels from boxes centre x, centre y, width, height in shares of the image.

    Each product and sum is float32 and in the original's order: to pixels first, then from centres to corners
    (``Model.post_process_result`` of GroundingDINO's inference.py, with torchvision's ``box_convert``).
    """
    pixels = boxes * np.array([width, height, width, height], np.float32)
    centre, half = pixels[:, :2], np.float32(0.5) * pixels[:, 2:]
    return np.concatenate([centre - half, centre + half], axis=1).astype(np.float32)


def box_overlaps(box: Float32Array, others: Float32Array) -> Float32Array:
    """Intersection over union (K,) of one box with ``others`` (K, 4); NaN between two boxes without area.

    Each step is float32 and in torchvision's order (``torchvision::nms`` on the CPU, nms_kernel.cpp).
    """
    rest = others.reshape(-1, 4)
    low, high = np.maximum(box[:2], rest[:, :2]), np.minimum(box[2:], rest[:, 2:])
    sides = np.maximum(high - low, np.float32(0))
    shared = sides[:, 0] * sides[:, 1]
    area = (box[2] - box[0]) * (box[3] - box[1])
    areas = (rest[:, 2] - rest[:, 0]) * (rest[:, 3] - rest[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        overlaps: Float32Array = shared / (area + areas - shared)
    return overlaps


def suppress(boxes: Float32Array, scores: NDArray[np.floating[Any]], most_overlap: float) -> Int64Array:
    """Indices of the boxes that no better box overlaps by more than ``most_overlap``, the best first.

    Non-maximum suppression whatever the class; of equal scores the first counts as better. As torchvision has it, the
    float32 overlap is held against the threshold as it was written: an overlap of 0.4 is float32's 0.4, which is more
    than 0.4, and suppresses; one of 0.5 is 0.5 and does not.

    >>> square = np.array([[0, 0, 10, 10], [0, 0, 10, 5], [20, 0, 30, 10]], np.float32)
    >>> suppress(square, np.array([0.5, 0.9, 0.1], np.float32), 0.4).tolist()
    [1, 2]
    """
    order = np.argsort(-scores.astype(np.float64), kind="stable")
    is_open = np.ones(len(order), bool)
    kept = []
    for place, index in enumerate(order):
        if not is_open[place]:
            continue
        kept.append(index)
        rest = place + 1 + np.flatnonzero(is_open[place + 1 :])
        overlaps = box_overlaps(boxes[index], boxes[order[rest]]).astype(np.float64)
        # NaN, two boxes without area, is no overlap.
        is_open[rest[overlaps > most_overlap]] = False
    return np.array(kept, np.int64)
