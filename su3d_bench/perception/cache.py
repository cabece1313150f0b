"""What perception computed for a frame, kept on disk under a key of everything that moves it.

An entry is an npz file without pickled objects that carries a checksum of its arrays. Entries are written under a
temporary name and renamed, so that concurrent processes see whole entries only; a damaged entry counts as absent
and is made anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import DAMAGE, filling, read_arrays
from su3d_bench.core.types import BoolArray, Float64Array, Frame, UInt8Array
from su3d_bench.perception.crops import mask_boxes

Arrays = dict[str, NDArray[Any]]

# The code that can move what is kept: keys follow it.
CODE = ("core", "numerics", "perception")
# Moves every key: raise it when the format of an entry changes.
CACHE_VERSION = "1"
_CHECKSUM = "checksum"


def content_key(*parts: str) -> str:
    """A hex key of texts; the order counts, and no two lists of parts share a key."""
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
    """Entries of named arrays below ``root``; with ``root`` None nothing is read or written."""

    def __init__(self, root: Path | None) -> None:
        self._root = None if root is None else root / "perception"
        self._last_image: tuple[UInt8Array, str] | None = None

    @property
    def is_on(self) -> bool:
        """Whether entries are kept at all; where not, keys need not be made."""
        return self._root is not None

    def image_digest(self, rgb: UInt8Array) -> str:
        """A digest of an image, taken once while it is asked for that one image: it is in the key of many entries."""
        last = self._last_image
        if last is None or last[0] is not rgb:
            last = self._last_image = rgb, array_digest(rgb)
        return last[1]

    def frame_digest(self, frame: Frame, with_pose: bool) -> str:
        """A digest of colour, depth and intrinsics, and of the pose where the answer depends on it."""
        pose: tuple[Float64Array, ...] = (frame.camera_to_world,) if with_pose else ()
        return self.image_digest(frame.rgb) + array_digest(frame.depth_m, frame.intrinsics, *pose)

    def path(self, key: str) -> Path | None:
        """Where the entry of ``key`` lies, whether or not it is there."""
        return None if self._root is None else self._root / key[:2] / f"{key}.npz"

    def load(self, key: str) -> Arrays | None:
        """The arrays stored under ``key``, or None where there is no whole entry."""
        path = self.path(key)
        if path is None or not path.is_file():
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
        """Store ``arrays`` under ``key`` in one step; raises ``StoreError`` where the disk refuses."""
        path = self.path(key)
        if path is None:
            return
        try:
            with filling(path) as file:
                np.savez(file, allow_pickle=False, **{**arrays, _CHECKSUM: _checksum(arrays)})
        except OSError as error:
            raise StoreError(
                f"{path.parent}: the perception cache cannot be written ({error.strerror or error}); "
                "free space, choose another cache folder, or set perception.cache = false"
            ) from error


def _checksum(arrays: Mapping[str, NDArray[Any]]) -> UInt8Array:
    hasher = hashlib.sha256()
    for name in sorted(arrays):
        hasher.update(name.encode() + b"\0" + array_digest(arrays[name]).encode())
    return np.frombuffer(hasher.digest(), np.uint8)


def pack_masks(masks: BoolArray) -> Arrays:
    """``masks`` (K, H, W) as arrays that take little room: the bits of each mask inside its own box, end to end."""
    windows = mask_boxes(masks).astype(np.int32)
    bits = [np.packbits(mask[y0:y1, x0:x1]) for mask, (x0, y0, x1, y1) in zip(masks, windows.tolist(), strict=True)]
    return {
        "mask_windows": windows,
        "mask_bits": np.concatenate(bits) if bits else np.zeros(0, np.uint8),
        "mask_shape": np.array(masks.shape[1:], np.int32),
    }


def unpack_masks(arrays: Mapping[str, NDArray[Any]]) -> BoolArray:
    """The masks (K, H, W) that ``pack_masks`` took."""
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
