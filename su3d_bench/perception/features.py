"""From regions to detections: which regions stay, and the features of their crops, each computed once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import package_digest
from su3d_bench.core.interfaces import Encoder, StageTimer
from su3d_bench.core.types import Float32Array, Frame, PerceptionNeeds
from su3d_bench.perception.cache import CachedRows, FrameCache, array_digest, content_key
from su3d_bench.perception.crops import crop_images


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
        self._source = package_digest("perception/crops.py", "perception/features.py")
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
