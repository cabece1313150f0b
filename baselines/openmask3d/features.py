"""Features of 3D masks from their best views, as OpenMask3D computes them: prompted masks, crops at levels, a mean.

Source: openmask3d/mask_features_computation/utils.py and features_extractor.py at commit 3bc3fc5.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.interfaces import RegionPerception
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int64Array
from su3d_bench.perception.crops import mask_boxes


def prompted_mask(
    regions: RegionPerception, frame: Frame, pixels: Int64Array, n_rounds: int, n_points: int, rng: np.random.Generator
) -> BoolArray | None:
    """The mask (H, W) of which the segmenter is surest in ``n_rounds``, each of ``n_points`` random ones of ``pixels``.

    The first of equals; None where every round is empty or of certainty 0, where the original stops with an error.
    """
    best, best_score = None, 0.0
    for _ in range(n_rounds):
        mask, score = regions.mask_at(frame, pixels[rng.choice(len(pixels), min(n_points, len(pixels)), replace=False)])
        if score > best_score and mask.any():
            best, best_score = mask, score
    return best


def crop_boxes(mask: BoolArray, n_levels: int, growth: float) -> Int64Array:
    """Boxes (n_levels, 4), x0 y0 x1 y1, right and bottom exclusive, of a mask that is not empty.

    Level 0 is tight; level l is larger on every side by l times the floor of the growth times the side, clipped.

    >>> mask = np.zeros((40, 60), bool); mask[10:35, 5:24] = True
    >>> crop_boxes(mask, 3, 0.1).tolist()  # 19 x 25: steps of 1 and 2
    [[5, 10, 24, 35], [4, 8, 25, 37], [3, 6, 26, 39]]
    """
    x0, y0, x1, y1 = mask_boxes(mask[None])[0].astype(np.int64).tolist()
    step_x, step_y = int((x1 - x0) * growth), int((y1 - y0) * growth)
    steps = np.arange(n_levels)[:, None] * np.array([-step_x, -step_y, step_x, step_y])
    height, width = mask.shape
    return np.asarray(np.clip(np.array([x0, y0, x1, y1]) + steps, 0, [width, height, width, height]), np.int64)


class FeatureMeans:
    """Plain means of the unit features of all crops of each mask; not of unit length themselves.

    A mask without a crop has a feature of zeros.
    """

    def __init__(self, n_masks: int, dim: int) -> None:
        self._sums = np.zeros((n_masks, dim), np.float64)
        self._n = np.zeros(n_masks, np.int64)

    def add(self, mask: int, features: np.ndarray) -> None:
        """Enter the features (B, dim) of some crops."""
        self._sums[mask] += features.astype(np.float64).sum(axis=0)
        self._n[mask] += len(features)

    @property
    def means(self) -> Float64Array:
        """One feature (K, dim) a mask."""
        return self._sums / np.maximum(self._n, 1)[:, None]
