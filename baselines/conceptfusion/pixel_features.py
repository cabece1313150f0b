"""ConceptFusion's pixel field: for each pixel a mix of the image's feature and those of the regions over it.

Source: extract_conceptfusion_features.py of concept-fusion at 4457c1f and of its branch fastsam at 668c26c; the
uniqueness term is the paper's (Eq. 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array

Weights = Literal["softmax", "uniqueness"]
Overlaps = Literal["sum", "small-over-large"]
SMALLEST_LENGTH = 1e-12  # torch's normalize divides by no less


@dataclass(frozen=True)
class PixelFeatures:
    """Which row of ``features`` (C, D) float16 each pixel has: ``row`` (height, width) int32.

    Pixels under the same masks share a row; that of pixels under no mask is all zero.
    """

    row: Int32Array
    features: NDArray[np.float16]


def picked(n_pixels: int, n_picked: int) -> Int64Array:
    """Which of ``n_pixels`` a nearest-neighbour resize to ``n_picked`` takes: floor(i n / m), as torch and OpenCV do.

    >>> picked(6, 4).tolist(), picked(2, 4).tolist()
    ([0, 1, 3, 4], [0, 0, 1, 1])
    """
    return np.arange(n_picked, dtype=np.int64) * n_pixels // n_picked


def mixing_weights(whole: Float32Array, regions: Float32Array, rule: Weights, temperature: float = 1.0) -> Float64Array:
    """How much of the image's feature each region's pixels get (K,): a softmax over the regions of one image.

    ``softmax`` is over the cosines of regions (K, D) with the image's feature (D,); ``uniqueness`` adds to each the
    mean cosine with the other regions. One region alone gets weight 1, and none of its own feature.

    >>> mixing_weights(np.ones(2, np.float32), np.eye(2, dtype=np.float32), "softmax").tolist()
    [0.5, 0.5]
    """
    directions = _normalised(np.asarray(regions, np.float64))
    score = directions @ _normalised(np.asarray(whole, np.float64)[None])[0]
    if rule == "uniqueness" and len(regions) > 1:
        between = directions @ directions.T
        score = score + (between.sum(axis=1) - np.diag(between)) / (len(regions) - 1)
    share = np.exp((score - score.max(initial=-np.inf)) / temperature)
    weights: Float64Array = share / share.sum()
    return weights


def mixed_features(whole: Float32Array, regions: Float32Array, weights: Float64Array) -> Float64Array:
    """The feature (K, D) of the pixels of each region: normalise(w f_G + (1 - w) f_i)."""
    share = weights[:, None]
    return _normalised(share * np.asarray(whole, np.float64) + (1 - share) * np.asarray(regions, np.float64))


def paint(
    masks: BoolArray, boxes: Float32Array, features: Float64Array, overlaps: Overlaps, height: int, width: int
) -> PixelFeatures:
    """The field of ``height`` x ``width`` pixels, from masks (K, H, W) of any size.

    ``sum``: masks in their order, F <- normalise(F + f_i), so that the last counts as much as all before it together.
    ``small-over-large``: the mask of the largest box first, each overwriting those before.
    The originals paint at full size and resize then, or the reverse; a nearest-neighbour resize makes them the same.
    """
    k, n_dimensions = features.shape
    if k == 0:
        return PixelFeatures(np.zeros((height, width), np.int32), np.zeros((1, n_dimensions), np.float16))
    rows, columns = picked(masks.shape[1], height), picked(masks.shape[2], width)
    is_inside = masks[:, rows[:, None], columns].reshape(k, -1)
    # a feature for each set of masks that some pixel lies under, rather than one a pixel
    packed = np.ascontiguousarray(np.packbits(is_inside, axis=0).T)
    _, example, row = np.unique(
        packed.view(np.dtype((np.void, packed.shape[1]))).ravel(), return_index=True, return_inverse=True
    )
    is_under = is_inside[:, example]
    field = np.zeros((len(example), n_dimensions))
    for i in _painting_order(boxes, overlaps):
        hit = is_under[i]
        field[hit] = _normalised(field[hit] + features[i]) if overlaps == "sum" else features[i]
    return PixelFeatures(row.reshape(height, width).astype(np.int32), field.astype(np.float16))


def _painting_order(boxes: Float32Array, overlaps: Overlaps) -> Int64Array:
    if overlaps == "sum":
        return np.arange(len(boxes))
    areas = (boxes[:, 2] - boxes[:, 0]).astype(np.float64) * (boxes[:, 3] - boxes[:, 1])
    return np.argsort(areas, kind="stable")[::-1]  # of equal boxes the first of the list is painted last, and seen


def _normalised(rows: Float64Array) -> Float64Array:
    length = np.sqrt((rows * rows).sum(axis=-1, keepdims=True))
    normalised: Float64Array = rows / np.maximum(length, SMALLEST_LENGTH)
    return normalised
