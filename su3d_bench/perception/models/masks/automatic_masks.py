"""SAM's automatic masks: a grid of points over the image and over crops of it, with filtering and deduplication.

The order of steps, the filters and their tie-breaking are those of the original's ``SamAutomaticMaskGenerator``, whose
setting names are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.system.devices import Batches
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array, Regions, UInt8Array
from su3d_bench.perception.cache import mask_boxes
from su3d_bench.perception.models.masks.grounding_dino import suppress
from su3d_bench.perception.models.masks.sam import (
    FULL_SIZE_AT_ONCE,
    MASK_THRESHOLD,
    OBJECT_POINT,
    Prompts,
    Sam,
    SeenImage,
)

CROP_EDGE_PX = 20.0  # a box within this of a crop's edge counts as cut by it
Share = float


class AutomaticMaskConfig(BaseModel):
    """Settings of automatic masks; the defaults are the original's. Thresholds of 0 filter nothing."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    points_per_side: int = Field(default=32, ge=1, le=256)
    points_per_batch: int = Field(default=64, ge=1, le=4096)
    pred_iou_thresh: Share = Field(default=0.88, ge=0, le=1)
    stability_score_thresh: Share = Field(default=0.95, ge=0, le=1)
    stability_score_offset: float = Field(default=1.0, ge=0)
    box_nms_thresh: Share = Field(default=0.7, ge=0, le=1)
    crop_n_layers: int = Field(default=0, ge=0, le=4)
    crop_nms_thresh: Share = Field(default=0.7, ge=0, le=1)
    crop_overlap_ratio: Share = Field(default=512 / 1500, ge=0, lt=1)
    crop_n_points_downscale_factor: int = Field(default=1, ge=1)
    min_mask_region_area: int = Field(default=0, ge=0)


# The SAM settings of each method's own program; "sam" is SAM3D's, the defaults.
AUTOMATIC_MASKS: Mapping[str, AutomaticMaskConfig] = MappingProxyType(
    {
        "sam": AutomaticMaskConfig(),
        # ConceptGraphs, generate_gsa_results.py, class set "none"
        "conceptgraphs": AutomaticMaskConfig(points_per_side=12, points_per_batch=144, min_mask_region_area=100),
        # ConceptFusion, extract_conceptfusion_features.py, which ignores its command line's points and area
        "conceptfusion": AutomaticMaskConfig(
            points_per_side=8, pred_iou_thresh=0.92, crop_n_layers=1, crop_n_points_downscale_factor=2
        ),
    }
)


@dataclass(frozen=True)
class Crop:
    """A part of the image, x0 y0 x1 y1, of one ``layer``: 0 is the whole image."""

    box: tuple[int, int, int, int]
    layer: int


def point_grid(n_per_side: int) -> Float64Array:
    """Points (n * n, 2), x y as fractions of a crop, row by row, half a step from its edges."""
    offset = 1 / (2 * n_per_side)
    steps = np.linspace(offset, 1 - offset, n_per_side)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def crops_of(height: int, width: int, n_layers: int, overlap_ratio: float) -> list[Crop]:
    """The whole image, then 4, 16, ... crops per layer, column by column; neighbours overlap by ``overlap_ratio`` of
    the shorter side, halved from layer to layer."""
    crops = [Crop((0, 0, width, height), 0)]
    for layer in range(1, n_layers + 1):
        n_side = 2**layer
        overlap = int(overlap_ratio * min(height, width) * (2 / n_side))
        crop_width = int(np.ceil((overlap * (n_side - 1) + width) / n_side))
        crop_height = int(np.ceil((overlap * (n_side - 1) + height) / n_side))
        lefts = [(crop_width - overlap) * i for i in range(n_side)]
        tops = [(crop_height - overlap) * i for i in range(n_side)]
        crops += [
            Crop((left, top, min(left + crop_width, width), min(top + crop_height, height)), layer)
            for left, top in product(lefts, tops)
        ]
    return crops


def stability(logits: Any, offset: float) -> Any:
    """Stability of masks (N, H, W) under the threshold: IoU (N,) of the masks at threshold + and - ``offset``.

    NaN if both are empty.
    """
    inner, outer = (_area(logits > MASK_THRESHOLD + step) for step in (offset, -offset))
    return inner / outer


def _area(masks: Any) -> Any:
    import torch

    return masks.flatten(-2).sum(-1, dtype=torch.int32)  # two axes at once, or int64, take three times as long


def is_cut_by_crop(boxes: Float32Array, crop: Crop, height: int, width: int) -> BoolArray:
    """Which boxes (K, 4), in image pixels, touch an edge of ``crop`` that is not an edge of the image."""
    near_crop = np.abs(boxes - np.array(crop.box, np.float32)) <= CROP_EDGE_PX
    near_image = np.abs(boxes - np.array([0, 0, width, height], np.float32)) <= CROP_EDGE_PX
    return np.asarray((near_crop & ~near_image).any(axis=1), np.bool_)


def without_small_parts(mask: BoolArray, min_area_px: int, part: Literal["holes", "islands"]) -> tuple[BoolArray, bool]:
    """``mask`` with its small holes filled, or without its small islands, except the largest if all are small.

    Parts are 8-connected; small is below ``min_area_px``. Also returns whether there was any small part.
    """
    import cv2

    searched = ~mask if part == "holes" else mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(searched.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    is_small = areas < min_area_px
    if not is_small.any():
        return mask, False
    if part == "islands" and is_small.all():
        is_small[np.argmax(areas)] = False
    changed = np.isin(labels, 1 + np.flatnonzero(is_small))
    return (mask | changed if part == "holes" else mask & ~changed), True


def to_last_pixel(boxes: Float32Array | Int64Array) -> Float32Array:
    """Tight ``boxes`` (K, 4), right and bottom exclusive, converted to the original's, which end at the last pixel.

    ``batched_mask_to_box`` of segment-anything; a mask without pixels has zeros in both.
    """
    ends = np.maximum(boxes[:, 2:] - 1, boxes[:, :2])
    return np.concatenate([boxes[:, :2], ends], axis=1).astype(np.float32)


@dataclass(frozen=True)
class _Candidates:
    """Masks cropped to their windows (K, 4) in the image, right and bottom exclusive, with predicted IoU (K,)."""

    cuts: list[BoolArray]
    windows: Int64Array
    scores: Float32Array
    crop_areas: Float64Array

    @property
    def boxes(self) -> Float32Array:
        return to_last_pixel(self.windows)

    def at(self, kept: Int64Array) -> _Candidates:
        return _Candidates([self.cuts[k] for k in kept], self.windows[kept], self.scores[kept], self.crop_areas[kept])

    @staticmethod
    def joined(parts: list[_Candidates]) -> _Candidates:
        return _Candidates(
            [cut for part in parts for cut in part.cuts],
            np.concatenate([part.windows for part in parts]),
            np.concatenate([part.scores for part in parts]),
            np.concatenate([part.crop_areas for part in parts]),
        )


class AutomaticMasks:
    """Every region that SAM finds in an image without prompts."""

    def __init__(self, sam: Sam, config: AutomaticMaskConfig) -> None:
        self._sam = sam
        self._config = config
        self._batches = Batches(config.points_per_batch)

    def regions(self, rgb: UInt8Array) -> Regions:
        """The masks of ``rgb`` in the original's order: best predicted IoU first, masks of smaller crops before others.

        Boxes are the original's, from the first to the last pixel: a mask one pixel wide has a box of zero width.
        Scores are the predicted IoU, clipped to 1, because the network may return slightly more.
        """
        config = self._config
        height, width = rgb.shape[:2]
        crops = crops_of(height, width, config.crop_n_layers, config.crop_overlap_ratio)
        candidates = _Candidates.joined([self._in_crop(rgb, crop) for crop in crops])
        if len(crops) > 1:
            candidates = candidates.at(suppress(candidates.boxes, 1 / candidates.crop_areas, config.crop_nms_thresh))
        masks = np.zeros((len(candidates.cuts), height, width), bool)
        for mask, cut, (x0, y0, x1, y1) in zip(masks, candidates.cuts, candidates.windows.tolist(), strict=True):
            mask[y0:y1, x0:x1] = cut
        scores = candidates.scores
        if config.min_mask_region_area:
            masks, kept = self._cleaned(masks)
            scores = scores[kept]
        # A mask without pixels passes if the filters are off, but a region must have some.
        is_something = masks.any(axis=(1, 2))
        masks = masks[is_something]
        return Regions(masks, to_last_pixel(mask_boxes(masks)), np.clip(scores[is_something], 0, 1).astype(np.float32))

    def _in_crop(self, rgb: UInt8Array, crop: Crop) -> _Candidates:
        x0, y0, x1, y1 = crop.box
        image = self._sam.look(np.ascontiguousarray(rgb[y0:y1, x0:x1]))
        n_side = int(self._config.points_per_side / self._config.crop_n_points_downscale_factor**crop.layer)
        points = point_grid(max(n_side, 1)) * np.array([x1 - x0, y1 - y0])
        batches = self._batches.run(range(len(points)), lambda part: self._from_points(image, points[part], crop, rgb))
        candidates = _Candidates.joined(batches)
        return candidates.at(suppress(candidates.boxes, candidates.scores, self._config.box_nms_thresh))

    def _from_points(self, image: SeenImage, points: Float64Array, crop: Crop, rgb: UInt8Array) -> _Candidates:
        """Those of the three masks per point that pass the filters, which treat each mask independently."""
        labels = np.full((len(points), 1), OBJECT_POINT, np.int64)
        logits, predicted = self._sam.decode(image, Prompts(points[:, None], labels), is_single=False)
        logits, predicted = logits.flatten(0, 1), predicted.flatten(0, 1)
        if self._config.pred_iou_thresh > 0:
            # Filtering before resizing masks to full size changes nothing and saves most of the work.
            is_good = predicted > self._config.pred_iou_thresh
            logits, predicted = logits[is_good], predicted[is_good]
        parts = [
            self._large(image, logits[at : at + FULL_SIZE_AT_ONCE], predicted[at : at + FULL_SIZE_AT_ONCE], crop, rgb)
            for at in range(0, max(len(logits), 1), FULL_SIZE_AT_ONCE)
        ]
        return _Candidates.joined(parts)

    def _large(self, image: SeenImage, logits: Any, predicted: Any, crop: Crop, rgb: UInt8Array) -> _Candidates:
        """Those of the masks that are stable and not cut by the crop."""
        if len(logits):
            logits = self._sam.full_size(image, logits)
            if self._config.stability_score_thresh > 0:
                is_stable = stability(logits, self._config.stability_score_offset)
                is_stable = is_stable >= self._config.stability_score_thresh
                logits, predicted = logits[is_stable], predicted[is_stable]
        x0, y0, x1, y1 = crop.box
        masks = (logits > MASK_THRESHOLD).cpu().numpy() if len(logits) else np.zeros((0, y1 - y0, x1 - x0), bool)
        inside = mask_boxes(masks).astype(np.int64)
        cuts = [mask[b:d, a:c].copy() for mask, (a, b, c, d) in zip(masks, inside.tolist(), strict=True)]
        windows = inside + np.array([x0, y0, x0, y0])
        area = np.full(len(masks), float((x1 - x0) * (y1 - y0)))
        candidates = _Candidates(cuts, windows, predicted.cpu().numpy().astype(np.float32), area)
        return candidates.at(np.flatnonzero(~is_cut_by_crop(candidates.boxes, crop, *rgb.shape[:2])))

    def _cleaned(self, masks: BoolArray) -> tuple[BoolArray, Int64Array]:
        """``masks`` without small holes and islands and without resulting duplicates, and the indices of those left.

        Masks that needed no cleaning take precedence over those that did.
        """
        smallest = self._config.min_mask_region_area
        cleaned, is_unchanged = masks.copy(), np.zeros(len(masks), np.float32)
        for k, mask in enumerate(masks):
            filled, had_holes = without_small_parts(mask, smallest, "holes")
            cleaned[k], had_islands = without_small_parts(filled, smallest, "islands")
            is_unchanged[k] = not (had_holes or had_islands)
        boxes = to_last_pixel(mask_boxes(cleaned))
        most = max(self._config.box_nms_thresh, self._config.crop_nms_thresh)
        kept = suppress(boxes, is_unchanged, most)
        return cleaned[kept], kept
