"""Regions of a frame through the cache, and perception on demand for methods that choose where to look."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.interfaces import Encoder, Segmenter, StageTimer
from su3d_bench.core.timing import Timer
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Int64Array, Regions
from su3d_bench.perception.cache import FrameCache, content_key, pack_masks, unpack_masks


def cached_regions(
    segmenter: Segmenter, frame: Frame, cache: FrameCache, with_pose: bool, timer: StageTimer
) -> Regions:
    """The regions that ``segmenter`` finds in ``frame``, from the cache where they are known.

    ``with_pose``: they depend on the camera's pose, and on the index of the frame, which seeds the oracle's noise.
    """
    if not cache.is_on:
        with timer.stage("segment"):
            return segmenter.segment(frame)
    with timer.stage("cache"):
        index = str(frame.index) if with_pose else ""
        key = content_key("regions", segmenter.digest, cache.frame_digest(frame, with_pose), index)
        entry = cache.load(key)
        if entry is not None:
            names = tuple(str(name) for name in entry["names"]) if "names" in entry else None
            return Regions(unpack_masks(entry), entry["boxes"], entry["scores"], names)
    with timer.stage("segment"):
        regions = segmenter.segment(frame)
    with timer.stage("cache"):
        arrays = {**pack_masks(regions.masks), "boxes": regions.boxes, "scores": regions.scores}
        if regions.names is not None:
            arrays["names"] = np.array(regions.names, np.str_)
        cache.save(key, arrays)
    return regions


def region_under(masks: BoolArray, points: Int64Array) -> tuple[int, float]:
    """Which of ``masks`` (K, H, W) holds most of the pixels ``points`` (P, 2), x y, and the share of them in it.

    The first on ties; -1 and 0 where no mask holds any.
    """
    if not len(masks) or not len(points):
        return -1, 0.0
    n_inside = masks[:, points[:, 1], points[:, 0]].sum(axis=1)
    best = int(np.argmax(n_inside))
    return (best, float(n_inside[best] / len(points))) if n_inside[best] else (-1, 0.0)


class SegmentedRegions:
    """``RegionPerception`` over a segmenter that takes no prompt: the region of its own that lies under the points.

    How sure it is: the region's score times the share of the points that lie in it.
    """

    def __init__(self, segmenter: Segmenter, encoder: Encoder, cache: FrameCache) -> None:
        self.dim = encoder.dim
        self._segmenter = segmenter
        self._encoder = encoder
        self._cache = cache
        self._last: tuple[Frame, Regions] | None = None

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The mask of the region that holds most of ``points``; empty and 0 where none does."""
        if self._last is None or self._last[0] is not frame:
            self._last = frame, cached_regions(self._segmenter, frame, self._cache, False, Timer())
        regions = self._last[1]
        best, share = region_under(regions.masks, points)
        if best < 0:
            return np.zeros(frame.depth_m.shape, np.bool_), 0.0
        return regions.masks[best], share * float(regions.scores[best])

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """Features of the crops, whatever the mask: what surrounds a region tells of it too."""
        return encode_boxes(self._encoder, frame, boxes)


def encode_boxes(encoder: Encoder, frame: Frame, boxes: Int64Array) -> Float32Array:
    """Features (B, dim) of the crops ``boxes`` (B, 4) of ``frame``, none of them empty."""
    if not len(boxes):
        return np.zeros((0, encoder.dim), np.float32)
    crops = [np.ascontiguousarray(frame.rgb[y0:y1, x0:x1]) for x0, y0, x1, y1 in boxes]
    return encoder.encode_images(crops)
