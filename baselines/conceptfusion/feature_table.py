"""A table of one feature a point in half precision that grows and is averaged in place, in memory or on disk."""

from __future__ import annotations

import tempfile
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.scratch import release_pages, scratch_folder
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array

Place = Literal["memory", "disk"]
HalfArray = NDArray[np.float16]
MOST_LENGTH = 1e30  # at its floor a confidence is rounded up by a fifth, at every image: kept from overflow
BLOCK_ROWS = 4096  # 16 MB of float32 at 1024 dimensions


class FeatureTable:
    """Features (N, D) float16 and the confidence of each.

    On disk they lie in a file without a name, which is gone with the process, however that ends. Both places do the
    same arithmetic: a block in float32, rounded to half precision once an update. ``average_in_half`` leaves the length
    of features apart, so that it does not leave half precision.
    """

    def __init__(self, n_dimensions: int, place: Place) -> None:
        self.n_dimensions = n_dimensions
        self._file: IO[bytes] | None = _nameless_file() if place == "disk" else None
        self._held = np.empty((0, n_dimensions), np.float16)
        self._confidences = np.empty(0)
        self._lengths: Float64Array | None = None  # (N,) by what each row is to be multiplied
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def n_bytes(self) -> int:
        """What the features take."""
        return self._n * self.n_dimensions * 2

    @property
    def confidences(self) -> Float64Array:
        """Confidence (N,) of each feature; a view."""
        return self._confidences[: self._n]

    def append(self, features: HalfArray, row: Int32Array, confidences: Float64Array) -> None:
        """Add ``features[row]`` with their ``confidences``, zero rows included."""
        end = self._n + len(row)
        self._confidences = with_room(self._confidences, self._n, end)
        self._confidences[self._n : end] = confidences
        if self._lengths is not None:
            self._lengths = with_room(self._lengths, self._n, end)
            self._lengths[self._n : end] = 1.0
        if self._file is None:
            self._held = with_room(self._held, self._n, end)
        for start in range(0, len(row), BLOCK_ROWS):
            block = features[row[start : start + BLOCK_ROWS]]
            if self._file is None:
                self._held[self._n + start : self._n + start + len(block)] = block
            else:
                self._write(block, self._n + start)
        self._n = end

    def _write(self, block: HalfArray, first_row: int) -> None:
        # A plain write fails where the disk is full; writing through a map of a sparse file would end the process.
        assert self._file is not None
        try:
            self._file.seek(first_row * self.n_dimensions * 2)
            self._file.write(block.tobytes())
            self._file.flush()
        except OSError as error:
            raise _disk_error(error) from error

    def average(self, point: Int64Array, features: HalfArray, row: Int32Array, weights: Float64Array) -> None:
        """Running mean of ``features[row]`` with ``weights`` into the features of ``point``, each named once.

        f <- (c f + w e) / (c + w), c <- c + w; the mean is not normalised.
        """
        if not len(point):
            return
        order = np.argsort(point, kind="stable")  # neighbours in the file are read together
        table = self._mapped("r+") if self._file is not None else self._held
        for start in range(0, len(order), BLOCK_ROWS):
            chosen = order[start : start + BLOCK_ROWS]
            of_point = point[chosen]
            held, added = self._confidences[of_point], weights[chosen]
            share: Float32Array = (added / (held + added)).astype(np.float32)[:, None]
            before: Float32Array = table[of_point].astype(np.float32)
            table[of_point] = (np.float32(1) - share) * before + share * features[row[chosen]].astype(np.float32)
            self._confidences[of_point] = held + added
            release_pages(table)

    def average_in_half(self, point: Int64Array, features: HalfArray, row: Int32Array, weights: Float64Array) -> None:
        """As ``average``, to be called at every image that met a point, with gradslam's products of half precision.

        Confidences are rounded to half precision before they are multiplied; that of the image times its feature stays
        half precision, and so does, the first time, that of the map: what then falls below 3e-8 is gone. From then on
        its features are of single precision, and a row that nothing is averaged into is multiplied by its rounded
        confidence and divided by the one that is not. Source: fuse_with_map of gradslam at 59ca872.
        """
        table = self._mapped("r+") if self._file is not None else self._held[: self._n]
        held = self._confidences[: self._n].copy()
        rounded = held.astype(np.float16)
        is_first = self._lengths is None
        lengths = np.ones(self._n) if self._lengths is None else self._lengths[: self._n]
        added = np.zeros(self._n)
        added[point] = weights
        source = np.full(self._n, -1, np.int64)
        source[point] = row
        if not is_first:
            lengths = np.minimum(lengths * np.where(source < 0, rounded / held, 1.0), MOST_LENGTH)
        changed = np.arange(self._n) if is_first else np.sort(point)
        for start in range(0, len(changed), BLOCK_ROWS):
            chosen = changed[start : start + BLOCK_ROWS]
            seen = features[source[chosen]] * (added[chosen].astype(np.float16) * (source[chosen] >= 0))[:, None]
            if is_first:
                total = (table[chosen] * rounded[chosen, None] + seen).astype(np.float32)
            else:
                before = table[chosen] * lengths[chosen, None].astype(np.float32)
                total = before * rounded[chosen, None].astype(np.float32) + seen
            mean = total / (held + added)[chosen, None].astype(np.float32)
            lengths[chosen] = np.maximum(np.abs(mean).max(axis=1), 1.0)
            table[chosen] = mean / lengths[chosen, None].astype(np.float32)
            release_pages(table)
        self._confidences[: self._n] = held + added
        self._lengths = lengths

    def _mapped(self, mode: Literal["r", "r+"]) -> HalfArray:
        # mapped anew at each use, for the file grows between them
        assert self._file is not None
        return np.memmap(self._file, np.float16, mode, shape=(self._n, self.n_dimensions))

    def features(self) -> HalfArray:
        """The features (N, D), read-only: a view of the table, whose rows move with the next ``average``."""
        if self._file is not None and self.n_bytes:
            return self._mapped("r")
        view = self._held[: self._n].view()
        view.flags.writeable = False
        return view

    def close(self) -> None:
        """Give the disk space back; a view that is still held keeps it until it goes."""
        if self._file is not None:
            self._file.close()


def _nameless_file() -> IO[bytes]:
    try:
        file: IO[bytes] = tempfile.TemporaryFile(dir=scratch_folder())  # noqa: SIM115  (closed by the table)
    except OSError as error:
        raise _disk_error(error) from error
    return file


def _disk_error(error: OSError) -> StoreError:
    return StoreError(
        f"cannot write features to {scratch_folder()}: {error.strerror or error}; set TMPDIR to a larger disk, or "
        "features_in = 'memory'"
    )


def with_room(array: NDArray[Any], used: int, needed: int) -> NDArray[Any]:
    """``array`` with room for ``needed`` rows, growing by a half so that appending stays cheap."""
    if needed <= len(array):
        return array
    larger = np.empty((max(needed, len(array) * 3 // 2), *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger
