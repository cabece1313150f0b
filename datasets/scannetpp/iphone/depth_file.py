"""Depth images in the iPhone's ``depth.bin``: 256x192, millimetres as the official toolkit unpacks them.

Three forms circulate: all images in one raw deflate stream of float32 metres; or one behind the other, each with its
length in four bytes, as an LZ4 block of uint16 millimetres or as a raw deflate stream of float32 metres. Metres become
millimetres by cutting off what is less than one.

Source: scannetpp/scannetpp at commit f3b4712, iphone/prepare_iphone_data.py.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float32Array
from su3d_bench.datasets.recordings.recorded_frames import N_DEPTH_VALUES, reading
from su3d_bench.datasets.scannetpp.iphone.forward import ForwardReader
from su3d_bench.datasets.scannetpp.iphone.lz4 import NotLz4, unpacked_block
from su3d_bench.formats.images import UInt16Array

DEPTH_NAME = "depth.bin"
WIDTH, HEIGHT = DEPTH_SIZE = (256, 192)
N_PIXELS = WIDTH * HEIGHT
UNITS_PER_METRE = 1000.0
RAW = -zlib.MAX_WBITS  # no header, no checksum
LENGTH_BYTES = 4
MOST_PACKED_BYTES = 1 << 20  # of one image, which unpacked has 196608
MOST_FRAMES = 1 << 20  # of five hours at 60 a second
PIECE_BYTES = 1 << 16


@dataclass(frozen=True)
class Packed:
    """Where an image lies in the file."""

    start: int
    n_bytes: int


class DepthFile:
    """The images of a file by their numbers; ``where`` begins each message, ``wanted`` are those that will be read."""

    def __init__(self, path: Path, where: str, wanted: frozenset[int]) -> None:
        self.path, self._where = path, f"{where}: {path.name}"
        with reading(where):
            self._index = _index(path)
        self._stream = ForwardReader(self._stream_images, wanted)

    def values(self, number: int) -> UInt16Array:
        """Millimetres (192, 256), 0 where there is none."""
        found = self._stream.at(number) if self._index is None else self._packed_values(self._index, number)
        if found is None:
            have = "fewer images" if self._index is None else f"{len(self._index)} images"
            raise DataError(f"{self._where}: has {have}, frame {number} is not among them; copy the file again")
        return found

    def _packed_values(self, index: list[Packed], number: int) -> UInt16Array | None:
        if number >= len(index):
            return None
        place = index[number]
        with reading(self._where), opened(self.path) as stream:
            stream.seek(place.start)
            content = stream.read(place.n_bytes)
        try:
            values = np.frombuffer(unpacked_block(content, 2 * N_PIXELS), "<u2")
        except NotLz4:
            values = millimetres(self._inflated(content, number))
        return values.astype(np.uint16).reshape(HEIGHT, WIDTH)

    def _inflated(self, content: bytes, number: int) -> Float32Array:
        try:
            unpacked = zlib.decompressobj(RAW).decompress(content, 4 * N_PIXELS + 1)
        except zlib.error:
            unpacked = b""
        if len(unpacked) != 4 * N_PIXELS:
            raise DataError(
                f"{self._where}: frame {number} is neither LZ4 nor deflate of {WIDTH}x{HEIGHT} depths; copy the file "
                "again"
            )
        return np.frombuffer(unpacked, "<f4")

    def _stream_images(self) -> Iterator[Callable[[], UInt16Array]]:
        unpack, waiting = zlib.decompressobj(RAW), bytearray()
        with reading(self._where), opened(self.path) as stream:
            while True:
                packed = unpack.unconsumed_tail or stream.read(PIECE_BYTES)
                try:
                    unpacked = unpack.decompress(packed, 4 * N_PIXELS)
                except zlib.error as error:
                    raise DataError(
                        f"{self._where}: is none of the forms of the release ({error}); copy the file again"
                    ) from error
                waiting += unpacked
                while len(waiting) >= 4 * N_PIXELS:
                    image = bytes(waiting[: 4 * N_PIXELS])
                    del waiting[: 4 * N_PIXELS]
                    yield partial(_image, image)
                if unpack.eof or not (packed or unpacked):
                    break
        if waiting or not unpack.eof:
            raise DataError(f"{self._where}: ends within an image; copy the file again")


def _image(content: bytes) -> UInt16Array:
    return millimetres(np.frombuffer(content, "<f4")).reshape(HEIGHT, WIDTH)


def millimetres(depth_m: Float32Array) -> UInt16Array:
    """Whole millimetres of metres, what is less cut off; 0 for what 16 bits do not hold."""
    with np.errstate(invalid="ignore", over="ignore"):
        values = depth_m * np.float32(UNITS_PER_METRE)
        return np.where((values >= 0) & (values < N_DEPTH_VALUES), values, 0).astype(np.uint16)


def packed_metres(values: UInt16Array) -> bytes:
    """An image with its length before it, as the toolkit unpacks it to these millimetres."""
    depth_m = values.astype(np.float32) / np.float32(UNITS_PER_METRE)
    for _ in range(2):  # a division may end just below the millimetre, which would be cut off
        is_short = millimetres(depth_m) < values
        depth_m = np.where(is_short, np.nextafter(depth_m, np.float32(np.inf)), depth_m)
    pack = zlib.compressobj(wbits=RAW)
    content = pack.compress(depth_m.astype("<f4").tobytes()) + pack.flush()
    return len(content).to_bytes(LENGTH_BYTES, "little") + content


def _index(path: Path) -> list[Packed] | None:
    """Where the images are in a file whose lengths lead from one to the next up to its end; None for one stream."""
    index: list[Packed] = []
    with opened(path) as stream:
        n_bytes = stream.seek(0, 2)
        at = 0
        while at < n_bytes:
            stream.seek(at)
            length = int.from_bytes(stream.read(LENGTH_BYTES), "little")
            at += LENGTH_BYTES
            if not 0 < length <= MOST_PACKED_BYTES or at + length > n_bytes or len(index) == MOST_FRAMES:
                return None
            index.append(Packed(at, length))
            at += length
    return index
