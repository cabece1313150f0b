"""On-disk cache of the perception results of a frame, keyed by everything that affects them.

An entry is an npz file without pickled objects, with a checksum of its arrays. Entries are written under a temporary
name and renamed, so that concurrent processes only see complete entries; a damaged entry is treated as missing and
recomputed.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import package_digest
from su3d_bench.core.files.atomic import DAMAGE, filling, read_arrays
from su3d_bench.core.interfaces import Encoder, Segmenter, StageTimer
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, Int64Array, Regions, UInt8Array

logger = logging.getLogger(__name__)


def mask_boxes(masks: BoolArray) -> Float32Array:
    """Tight boxes (K, 4) x0 y0 x1 y1 of ``masks`` (K, H, W), right and bottom exclusive; zeros for an empty mask."""
    boxes = np.zeros((len(masks), 4), np.float32)
    for k, mask in enumerate(masks):
        columns = np.flatnonzero(mask.any(axis=0))
        rows = np.flatnonzero(mask.any(axis=1))
        if len(columns):
            boxes[k] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def crop_window(box: Sequence[float] | Float32Array, ratio: float, width: int, height: int) -> Int64Array:
    """Integer window (4,) x0 y0 x1 y1 of ``box`` scaled by ``ratio`` about its centre and clipped to the image.

    Each border is rounded to the nearest pixel border, halves towards the right and the bottom, after clipping; a
    window that would be empty is one pixel wide. So a whole-pixel box at ratio 1.0 is returned unchanged.
    """
    x0, y0, x1, y1 = (float(value) for value in box)
    left, right = _scaled((x0, x1), ratio, width)
    top, bottom = _scaled((y0, y1), ratio, height)
    return np.array([left, top, right, bottom], np.int64)


def _scaled(span: tuple[float, float], ratio: float, size: int) -> tuple[int, int]:
    centre = 0.5 * (span[0] + span[1])
    half = 0.5 * (span[1] - span[0]) * ratio
    low = int(np.floor(min(max(centre - half, 0.0), size) + 0.5))
    high = int(np.floor(min(max(centre + half, 0.0), size) + 0.5))
    if high > low:
        return low, high
    low = min(low, size - 1)
    return low, low + 1


def crop_images(rgb: UInt8Array, boxes: Float32Array, ratio: float) -> list[UInt8Array]:
    """One contiguous crop (h, w, 3) of ``rgb`` for each box (K, 4), at its native size."""
    height, width = rgb.shape[:2]
    crops = []
    for box in boxes:
        x0, y0, x1, y1 = crop_window(box, ratio, width, height)
        crops.append(np.ascontiguousarray(rgb[y0:y1, x0:x1]))
    return crops


Computed = TypeVar("Computed")


def cached_regions(
    segmenter: Segmenter, frame: Frame, cache: FrameCache, with_pose: bool, timer: StageTimer
) -> Regions:
    """The regions that ``segmenter`` finds in ``frame``, cached.

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
    """The index of the mask (K, H, W) with most of the pixels ``points`` (P, 2), x y, and the share of points in it.

    The first on ties; -1 and 0 if no mask contains any.
    """
    if not len(masks) or not len(points):
        return -1, 0.0
    n_inside = masks[:, points[:, 1], points[:, 0]].sum(axis=1)
    best = int(np.argmax(n_inside))
    return (best, float(n_inside[best] / len(points))) if n_inside[best] else (-1, 0.0)


class LastFrameCache(Generic[Computed]):
    """The result of ``compute`` for a frame, stored for the most recent frame."""

    def __init__(self, compute: Callable[[Frame], Computed]) -> None:
        self._compute = compute
        self._last: tuple[Frame, Computed] | None = None

    def __call__(self, frame: Frame) -> Computed:
        last = self._last
        if last is None or last[0] is not frame:
            last = self._last = frame, self._compute(frame)
        return last[1]


class CropsOnDemand:
    """The encoding part of a ``RegionPerception``."""

    def __init__(self, encoder: Encoder) -> None:
        self.dim = encoder.dim
        self._encoder = encoder

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """Features (B, dim) of the crops ``boxes`` (B, 4), none of them empty; the mask is ignored.

        The context of a region is informative too.
        """
        if not len(boxes):
            return np.zeros((0, self.dim), np.float32)
        return self._encoder.encode_images([np.ascontiguousarray(frame.rgb[y0:y1, x0:x1]) for x0, y0, x1, y1 in boxes])


class RegionsOnDemand(CropsOnDemand):
    """``RegionPerception`` that selects the region of a frame under the points."""

    def __init__(self, regions_of: Callable[[Frame], Regions], encoder: Encoder) -> None:
        super().__init__(encoder)
        self._regions = LastFrameCache(regions_of)

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The mask and score of the region with most of ``points``; otherwise an empty mask and 0.

        The score is the region's score times the share of points inside it.
        """
        regions = self._regions(frame)
        best, share = region_under(regions.masks, points)
        if best < 0:
            return np.zeros(frame.depth_m.shape, np.bool_), 0.0
        return regions.masks[best], share * float(regions.scores[best])


class CropEncoder:
    """Crop and image features of frames, cached as one table per ratio."""

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
        """The feature (D,) of the complete image."""

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
        """Rows ``wanted`` of the table of ``n`` features under ``key``; ``compute`` returns the missing ones."""
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


Arrays = dict[str, NDArray[Any]]

# The code that affects cached values: keys depend on it.
CODE = ("core", "numerics", "perception")
# Part of every key: increment it when the format of an entry changes.
CACHE_VERSION = "1"
_CHECKSUM = "checksum"


def content_key(*parts: str) -> str:
    """A hex key of texts; the order matters, and no two lists of parts share a key."""
    hasher = hashlib.sha256(CACHE_VERSION.encode())
    for part in parts:
        encoded = part.encode()
        hasher.update(len(encoded).to_bytes(8, "little"))
        hasher.update(encoded)
    return hasher.hexdigest()


def array_digest(*arrays: NDArray[Any]) -> str:
    """A hex digest of the values, shapes and types of ``arrays``."""
    hasher = hashlib.blake2b(digest_size=20)
    for array in arrays:
        hasher.update(f"{array.dtype.str}{array.shape}".encode())
        hasher.update(np.ascontiguousarray(array).data)
    return hasher.hexdigest()


class FrameCache:
    """Entries of named arrays below ``root``; if ``root`` is None, nothing is read or written."""

    def __init__(self, root: Path | None) -> None:
        self._root = None if root is None else root / "perception"
        self._last_image: tuple[UInt8Array, str] | None = None

    @property
    def is_on(self) -> bool:
        """Whether the cache is enabled; if not, no keys are needed."""
        return self._root is not None

    def image_digest(self, rgb: UInt8Array) -> str:
        """A digest of an image, remembered for the last image because it is part of many keys."""
        last = self._last_image
        if last is None or last[0] is not rgb:
            last = self._last_image = rgb, array_digest(rgb)
        return last[1]

    def frame_digest(self, frame: Frame, with_pose: bool) -> str:
        """A digest of colour, depth and intrinsics, and of the pose if the result depends on it."""
        pose: tuple[Float64Array, ...] = (frame.camera_to_world,) if with_pose else ()
        return self.image_digest(frame.rgb) + array_digest(frame.depth_m, frame.intrinsics, *pose)

    def path(self, key: str) -> Path | None:
        """The path of the entry of ``key``, whether or not it exists."""
        return None if self._root is None else self._root / key[:2] / f"{key}.npz"

    def load(self, key: str) -> Arrays | None:
        """The arrays stored under ``key``, or None if there is no valid entry."""
        path = self.path(key)
        if path is None:
            return None
        try:
            arrays = read_arrays(path)
        except DAMAGE:
            return None
        checksum = arrays.pop(_CHECKSUM, None)
        if checksum is None or not np.array_equal(checksum, _checksum(arrays)):
            return None
        return arrays

    def save(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store ``arrays`` under ``key`` atomically; if writing fails, warn and use the cache no more."""
        path = self.path(key)
        if path is None:
            return
        try:
            with filling(path) as file:
                np.savez(file, allow_pickle=False, **{**arrays, _CHECKSUM: _checksum(arrays)})
        except OSError as error:
            logger.warning(
                "%s: cannot be written (%s): the run continues without this cache; set SU3D_CACHE to another folder",
                self._root,
                error.strerror or error,
            )
            self._root = None


def _checksum(arrays: Mapping[str, NDArray[Any]]) -> UInt8Array:
    hasher = hashlib.sha256()
    for name in sorted(arrays):
        hasher.update(name.encode() + b"\0" + array_digest(arrays[name]).encode())
    return np.frombuffer(hasher.digest(), np.uint8)


def pack_masks(masks: BoolArray) -> Arrays:
    """``masks`` (K, H, W) as compact arrays: the concatenated bits of each mask inside its own box."""
    windows = mask_boxes(masks).astype(np.int32)
    bits = [np.packbits(mask[y0:y1, x0:x1]) for mask, (x0, y0, x1, y1) in zip(masks, windows.tolist(), strict=True)]
    return {
        "mask_windows": windows,
        "mask_bits": np.concatenate(bits) if bits else np.zeros(0, np.uint8),
        "mask_shape": np.array(masks.shape[1:], np.int32),
    }


def unpack_masks(arrays: Mapping[str, NDArray[Any]]) -> BoolArray:
    """The masks (K, H, W) packed by ``pack_masks``."""
    windows = arrays["mask_windows"]
    height, width = (int(size) for size in arrays["mask_shape"])
    masks = np.zeros((len(windows), height, width), bool)
    start = 0
    for mask, (x0, y0, x1, y1) in zip(masks, windows.tolist(), strict=True):
        n_bits = (y1 - y0) * (x1 - x0)
        n_bytes = -(-n_bits // 8)
        bits = np.unpackbits(arrays["mask_bits"][start : start + n_bytes], count=n_bits)
        mask[y0:y1, x0:x1] = bits.reshape(y1 - y0, x1 - x0)
        start += n_bytes
    return masks
