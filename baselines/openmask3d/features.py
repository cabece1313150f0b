"""Features of 3D masks from their best views, as OpenMask3D computes them: prompted masks, crops at levels, a mean.

Source: openmask3d/mask_features_computation/utils.py and features_extractor.py at commit 3bc3fc5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.interfaces import RegionPerception
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int64Array


@dataclass(frozen=True)
class Looking:
    """How a view is looked at: ``n_rounds`` times ``n_points`` prompts, ``n_levels`` crops that grow by ``growth``."""

    n_rounds: int
    n_points: int
    n_levels: int
    growth: float


def prompted_mask(
    regions: RegionPerception, frame: Frame, pixels: Int64Array, looking: Looking, rng: np.random.Generator
) -> BoolArray | None:
    """The mask (H, W) of which the segmenter is surest among some rounds, each of a few random ones of ``pixels``.

    The first of equals; None where every round is empty or of certainty 0, where the original stops with an error.
    """
    best, best_score = None, 0.0
    n_points = min(looking.n_points, len(pixels))
    for _ in range(looking.n_rounds):
        mask, score = regions.mask_at(frame, pixels[rng.choice(len(pixels), n_points, replace=False)])
        if score > best_score and mask.any():
            best, best_score = mask, score
    return best


def crop_boxes(mask: BoolArray, looking: Looking) -> Int64Array:
    """Boxes (levels, 4), x0 y0 x1 y1, right and bottom exclusive, of a mask that is not empty.

    Level 0 is tight; level l is larger on every side by l times the floor of the growth times the side, clipped.

    >>> mask = np.zeros((40, 60), bool); mask[10:35, 5:24] = True
    >>> crop_boxes(mask, Looking(10, 5, 3, 0.1)).tolist()  # 19 x 25: steps of 1 and 2
    [[5, 10, 24, 35], [4, 8, 25, 37], [3, 6, 26, 39]]
    """
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    x0, x1, y0, y1 = int(columns[0]), int(columns[-1]) + 1, int(rows[0]), int(rows[-1]) + 1
    step_x, step_y = int((x1 - x0) * looking.growth), int((y1 - y0) * looking.growth)
    height, width = mask.shape
    boxes = []
    for level in range(looking.n_levels):
        dx, dy = level * step_x, level * step_y
        boxes.append((max(0, x0 - dx), max(0, y0 - dy), min(width, x1 + dx), min(height, y1 + dy)))
    return np.array(boxes, np.int64).reshape(looking.n_levels, 4)


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
        result: Float64Array = self._sums / np.maximum(self._n, 1)[:, None]
        return result
