"""Regions and features of a frame through the cache, and perception on demand for methods that choose where to look."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import package_digest
from su3d_bench.core.interfaces import Encoder, Segmenter, StageTimer
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Int64Array, Regions
from su3d_bench.perception.cache import (
    CODE,
    FrameCache,
    array_digest,
    content_key,
    pack_masks,
    unpack_masks,
)
from su3d_bench.perception.crops import crop_images

Computed = TypeVar("Computed")


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


class OfLastFrame(Generic[Computed]):
    """What ``compute`` makes of a frame, kept while it is asked for that one frame."""

    def __init__(self, compute: Callable[[Frame], Computed]) -> None:
        self._compute = compute
        self._last: tuple[Frame, Computed] | None = None

    def __call__(self, frame: Frame) -> Computed:
        last = self._last
        if last is None or last[0] is not frame:
            last = self._last = frame, self._compute(frame)
        return last[1]


class CropsOnDemand:
    """The half of a ``RegionPerception`` that encodes."""

    def __init__(self, encoder: Encoder) -> None:
        self.dim = encoder.dim
        self._encoder = encoder

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """Features (B, dim) of the crops ``boxes`` (B, 4), none of them empty, whatever the mask.

        What surrounds a region tells of it too.
        """
        if not len(boxes):
            return np.zeros((0, self.dim), np.float32)
        return self._encoder.encode_images([np.ascontiguousarray(frame.rgb[y0:y1, x0:x1]) for x0, y0, x1, y1 in boxes])


class RegionsOnDemand(CropsOnDemand):
    """``RegionPerception`` over the regions of a frame: the one that lies under the points."""

    def __init__(self, regions_of: Callable[[Frame], Regions], encoder: Encoder) -> None:
        super().__init__(encoder)
        self._regions = OfLastFrame(regions_of)

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The mask of the region that holds most of ``points``; empty and 0 where none does.

        How sure it is: the region's score times the share of the points that lie in it.
        """
        regions = self._regions(frame)
        best, share = region_under(regions.masks, points)
        if best < 0:
            return np.zeros(frame.depth_m.shape, np.bool_), 0.0
        return regions.masks[best], share * float(regions.scores[best])


class CropEncoder:
    """Crop and whole-image features of frames, kept in the cache one table a ratio."""

    def __init__(self, encoder: Encoder, cache: FrameCache) -> None:
        self._encoder = encoder
        self._cache = cache
        self._source = package_digest(*CODE)

    def crops(
        self,
        frame: Frame,
        boxes: Float32Array,
        wanted: NDArray[np.intp],
        ratios: tuple[float, ...],
        timer: StageTimer,
        known: Mapping[float, Float32Array],
    ) -> Float32Array:
        """Features (W, R, D) of the crops around boxes ``wanted``, one for each of ``ratios``.

        Ratios whose features (K, D) of all K boxes are ``known`` are taken from there.
        """
        image = ""
        if self._cache.is_on and not set(ratios) <= set(known):
            with timer.stage("cache"):
                image = self._cache.image_digest(frame.rgb) + array_digest(boxes)
        features = np.zeros((len(wanted), len(ratios), self._encoder.dim), np.float32)
        for column, ratio in enumerate(ratios):
            if ratio in known:
                features[:, column] = known[ratio][wanted]
                continue

            def compute(missing: NDArray[np.intp], ratio: float = ratio) -> Float32Array:
                with timer.stage("encode"):
                    return self._encoder.encode_images(crop_images(frame.rgb, boxes[missing], ratio))

            key = content_key("crops", image, self._source, self._encoder.digest, repr(float(ratio)))
            features[:, column] = self._rows(key, len(boxes), wanted, compute, timer)
        return features

    def whole(self, frame: Frame, timer: StageTimer) -> Float32Array:
        """The feature (D,) of the whole image."""

        def compute(_: NDArray[np.intp]) -> Float32Array:
            with timer.stage("encode"):
                return self._encoder.encode_images([frame.rgb])

        with timer.stage("cache"):
            image = self._cache.image_digest(frame.rgb) if self._cache.is_on else ""
            key = content_key("image", image, self._encoder.digest)
        row: Float32Array = self._rows(key, 1, np.zeros(1, np.intp), compute, timer)[0]
        return row

    def _rows(
        self,
        key: str,
        n: int,
        wanted: NDArray[np.intp],
        compute: Callable[[NDArray[np.intp]], Float32Array],
        timer: StageTimer,
    ) -> Float32Array:
        """Rows ``wanted`` of the table of ``n`` features under ``key``; ``compute`` makes the missing ones."""
        with timer.stage("cache"):
            entry = self._cache.load(key)
        if entry is None or entry["rows"].shape != (n, self._encoder.dim):
            table, known = np.zeros((n, self._encoder.dim), np.float32), np.zeros(n, bool)
        else:
            table, known = entry["rows"], entry["known"]
        missing = wanted[~known[wanted]]
        if len(missing):
            table[missing] = compute(missing)
            known[missing] = True
            with timer.stage("cache"):
                self._cache.save(key, {"rows": table, "known": known})
        return table[wanted]
