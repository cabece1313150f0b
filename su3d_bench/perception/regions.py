"""Regions of a frame through the cache, and perception on demand for methods that choose where to look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import package_digest
from su3d_bench.core.interfaces import Encoder, Segmenter, StageTimer
from su3d_bench.core.timing import Timer
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Int64Array, PerceptionNeeds, Regions
from su3d_bench.perception.cache import CachedRows, FrameCache, array_digest, content_key, pack_masks, unpack_masks
from su3d_bench.perception.crops import crop_images


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


def regions_to_keep(
    names: Sequence[str], boxes: Float32Array, image_shape: tuple[int, ...], needs: PerceptionNeeds
) -> NDArray[np.intp]:
    """Indices of the regions whose name is no background name and whose box is not too large a part of the image."""
    background = {name.lower() for name in needs.background_names}
    is_named = np.array([name.lower() not in background for name in names], bool)
    areas = (boxes[:, 2] - boxes[:, 0]).astype(np.float64) * (boxes[:, 3] - boxes[:, 1])
    is_small = areas <= needs.max_box_fraction * image_shape[0] * image_shape[1]
    return np.flatnonzero(is_named & is_small)


def grown_boxes(boxes: Float32Array, padding_px: int) -> Float32Array:
    """``boxes`` (K, 4) with every side moved outwards by ``padding_px``; crops are clipped to the image later."""
    return boxes + np.array([-padding_px, -padding_px, padding_px, padding_px], np.float32)


class NameEncoder:
    """Text features of region names as they are, each name encoded once."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._known: dict[str, Float32Array] = {}

    def features(self, names: Sequence[str], needs: PerceptionNeeds) -> Float32Array | None:
        """Features (K, D) of ``names``; None where the method does not ask for them."""
        if not needs.name_features:
            return None
        new = [name for name in dict.fromkeys(names) if name not in self._known]
        if new:
            self._known |= dict(zip(new, self._encoder.encode_texts(new), strict=True))
        return np.array([self._known[name] for name in names], np.float32).reshape(len(names), self._encoder.dim)


class CropEncoder:
    """Crop and whole-image features of frames, kept in the cache one table a ratio."""

    def __init__(self, encoder: Encoder, cache: FrameCache) -> None:
        self._encoder = encoder
        self._cache = cache
        self._source = package_digest("perception/crops.py", "perception/regions.py")
        self._rows = CachedRows(cache, encoder.dim)

    def crops(
        self,
        frame: Frame,
        boxes: Float32Array,
        wanted: NDArray[np.intp],
        ratios: tuple[float, ...],
        timer: StageTimer,
        known: Mapping[float, Float32Array] | None = None,
    ) -> Float32Array:
        """Features (W, R, D) of the crops around boxes ``wanted``, one for each of ``ratios``.

        Ratios whose features (K, D) of all K boxes are ``known`` are taken from there.
        """
        with timer.stage("cache"):
            image = self._cache.image_digest(frame.rgb) + array_digest(boxes) if self._cache.is_on else ""
        features = np.zeros((len(wanted), len(ratios), self._encoder.dim), np.float32)
        for column, ratio in enumerate(ratios):
            if known is not None and ratio in known:
                features[:, column] = known[ratio][wanted]
                continue

            def compute(missing: NDArray[np.intp], ratio: float = ratio) -> Float32Array:
                with timer.stage("encode"):
                    return self._encoder.encode_images(crop_images(frame.rgb, boxes[missing], ratio))

            key = content_key("crops", image, self._source, self._encoder.digest, repr(float(ratio)))
            features[:, column] = self._rows.rows(key, len(boxes), wanted, compute, timer)
        return features

    def whole(self, frame: Frame, timer: StageTimer) -> Float32Array:
        """The feature (D,) of the whole image."""

        def compute(_: NDArray[np.intp]) -> Float32Array:
            with timer.stage("encode"):
                return self._encoder.encode_images([frame.rgb])

        with timer.stage("cache"):
            image = self._cache.image_digest(frame.rgb) if self._cache.is_on else ""
            key = content_key("image", image, self._encoder.digest)
        row: Float32Array = self._rows.rows(key, 1, np.zeros(1, np.intp), compute, timer)[0]
        return row
