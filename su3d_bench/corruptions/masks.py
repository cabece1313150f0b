"""Corruptions of the regions that perception found in a frame: masks, boxes and scores.

Names, captions and features stay with their region, so that the error is the mask's alone. A changed mask has the box
around its pixels; a region without a pixel left is dropped. Pixels are those of an image 640 wide.

The kinds of error are those with which Cheng et al. compare measures of masks ("Boundary IoU", CVPR 2021: errors of
scale and of location), and those of a segmenter about which pixels belong together.

A share is each region's chance, so that frames with few regions change as often as those with many.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import BoolArray, Detections, Float32Array, Int64Array
from su3d_bench.corruptions.model import Corruption

WIDTH_PX = 640


def _distance(mask: BoolArray) -> Float32Array:
    """The distance (H, W) of each pixel from the nearest one of a mask, which must have a pixel; 0 inside."""
    import cv2

    outside = np.asarray(~mask, np.uint8)
    return np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _boxes(masks: BoolArray) -> Float32Array:
    """Boxes (K, 4) around the pixels, right and bottom exclusive."""
    ends = []
    for axis in (1, 2):
        has: BoolArray = np.any(masks, axis=axis)
        ends.append((has.argmax(axis=1), has.shape[1] - has[:, ::-1].argmax(axis=1)))
    (left, right), (top, bottom) = ends
    return np.stack([left, top, right, bottom], axis=1).astype(np.float32)


def _regions(found: Detections, of: Int64Array, masks: BoolArray) -> Detections:
    """Regions with ``masks``, of which the k-th has everything else of region ``of[k]``; without the empty ones."""
    has_pixels = masks.any(axis=(1, 2))
    of, masks = of[has_pixels], masks[has_pixels]
    is_changed = (masks != found.masks[of]).any(axis=(1, 2))
    boxes = found.boxes[of]
    boxes[is_changed] = _boxes(masks[is_changed])
    return replace(
        found,
        masks=masks,
        boxes=boxes,
        scores=found.scores[of],
        names=tuple(found.names[k] for k in of),
        captions=tuple(found.captions[k] for k in of),
        crop_features=found.crop_features[of],
        name_features=None if found.name_features is None else found.name_features[of],
        rows=np.array([found.row_of(k) for k in of], np.int64),
    )


def _pixels(found: Detections, px: float) -> float:
    return float(px * found.masks.shape[2] / WIDTH_PX)


def eroded(found: Detections, px: float, rng: Generator) -> Detections:
    """Masks without pixels within ``px`` of a pixel outside; beyond the image's border is no outside."""
    radius = _pixels(found, px)
    masks = [mask if mask.all() else _distance(~mask) > radius for mask in found.masks]
    return _regions(found, np.arange(len(found)), np.array(masks, bool).reshape(found.masks.shape))


def dilated(found: Detections, px: float, rng: Generator) -> Detections:
    """Masks with all pixels within ``px`` of them."""
    radius = _pixels(found, px)
    masks = [_distance(mask) <= radius if mask.any() else mask for mask in found.masks]
    return _regions(found, np.arange(len(found)), np.array(masks, bool).reshape(found.masks.shape))


def shifted(found: Detections, px: float, rng: Generator) -> Detections:
    """Masks moved by ``px``, each in a direction of its own; what leaves the image is lost."""
    angles = rng.uniform(0, 2 * np.pi, len(found))
    steps = np.rint(_pixels(found, px) * np.stack([np.sin(angles), np.cos(angles)], axis=1)).astype(np.int64)
    moved = np.zeros_like(found.masks)
    for k, (down, right) in enumerate(steps):
        rows, columns = (slice(max(step, 0), min(step, 0) or None) for step in (down, right))
        from_rows, from_columns = (slice(max(-step, 0), min(-step, 0) or None) for step in (down, right))
        moved[k, rows, columns] = found.masks[k, from_rows, from_columns]
    return _regions(found, np.arange(len(found)), moved)


def dropped(found: Detections, share: float, rng: Generator) -> Detections:
    kept = np.flatnonzero(rng.random(len(found)) >= share)
    return _regions(found, kept, found.masks[kept])


def merged(found: Detections, share: float, rng: Generator) -> Detections:
    """Regions joined to the nearest one, touching or not; the largest of a joined region gives all but the mask."""
    areas = found.masks.sum(axis=(1, 2))
    chosen = np.flatnonzero((rng.random(len(found)) < share) & (areas > 0))
    if np.count_nonzero(areas) < 2:
        return found
    region, pixel = np.nonzero(found.masks.reshape(len(found), -1))
    there, starts = np.unique(region, return_index=True)
    group = np.arange(len(found))
    for k in chosen:
        distance = np.minimum.reduceat(_distance(found.masks[k]).ravel()[pixel], starts)
        nearest = there[np.where(there == k, np.inf, distance).argmin()]
        group[group == group[k]] = group[nearest]
    masks = np.stack([found.masks[group == one].any(axis=0) for one in np.unique(group)])
    largest = [np.flatnonzero(group == one)[areas[group == one].argmax()] for one in np.unique(group)]
    return _regions(found, np.array(largest), masks)


def split(found: Detections, share: float, rng: Generator) -> Detections:
    """Regions cut in two by a line through their centre of area; both parts have the region's name and features."""
    is_cut, angles = rng.random(len(found)) < share, rng.uniform(0, np.pi, len(found))
    of, masks = [], []
    for k, mask in enumerate(found.masks):
        of.append(k)
        masks.append(mask)
        if is_cut[k] and mask.any():
            v, u = np.nonzero(mask)
            side = (u - u.mean()) * np.cos(angles[k]) + (v - v.mean()) * np.sin(angles[k]) >= 0
            masks[-1], other = np.zeros_like(mask), np.zeros_like(mask)
            masks[-1][v[side], u[side]], other[v[~side], u[~side]] = True, True
            of.append(k)
            masks.append(other)
    return _regions(found, np.array(of), np.array(masks)) if of else found


def scores_shuffled(found: Detections, share: float, rng: Generator) -> Detections:
    """Scores of a share of the regions, each given to the next of these in a random order."""
    order = rng.permutation(len(found))
    chosen = order[rng.random(len(found)) < share]
    scores = found.scores.copy()
    scores[chosen] = scores[np.roll(chosen, 1)]
    return replace(found, scores=scores)


PX = "px at 640 px width"
ROWS: tuple[Corruption, ...] = (
    Corruption(
        "masks", "eroded", "detections", eroded, PX, (1, 2, 4, 8, 16),
        "ours: doubled up to 2 % of the diagonal, the width of a boundary in Boundary IoU (Cheng et al. 2021)",
    ),
    Corruption(
        "masks", "dilated", "detections", dilated, PX, (1, 2, 4, 8, 16),
        "ours: doubled up to 2 % of the diagonal, the width of a boundary in Boundary IoU (Cheng et al. 2021)",
    ),
    Corruption(
        "masks", "shifted", "detections", shifted, PX, (2, 4, 8, 16, 32),
        "ours: doubled up to twice 2 % of the diagonal; an exposure 33 ms late at 30 degrees/s is about 10 px",
    ),
    Corruption(
        "masks", "dropped", "detections", dropped, "share of regions", (0.1, 0.2, 0.4, 0.6, 0.8),
        "ours: from few misses to one region in five found",
    ),
    Corruption(
        "masks", "merged", "detections", merged, "share of regions", (0.1, 0.2, 0.4, 0.6, 0.8),
        "ours: as dropped",
    ),
    Corruption("masks", "split", "detections", split, "share of regions", (0.1, 0.2, 0.4, 0.7, 1.0), "ours: up to all"),
    Corruption(
        "masks", "scores-shuffled", "detections", scores_shuffled, "share of regions", (0.2, 0.4, 0.6, 0.8, 1.0),
        "ours: up to scores that say nothing",
    ),
)  # fmt: skip
