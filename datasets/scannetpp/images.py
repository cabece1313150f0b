"""Images of the iPhone: depth out of ``depth.bin``, colour out of ``rgb.mkv``, read forward.

Depth is 256x192, millimetres as unpacked by the official toolkit.

Three formats exist: all images in one raw deflate stream of float32 metres; or one after the other, each preceded by
its length in four bytes, as an LZ4 block of uint16 millimetres or a raw deflate stream of float32 metres. Metres are
truncated to whole millimetres.

Source: scannetpp/scannetpp at commit f3b4712, iphone/prepare_iphone_data.py.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.datasets.recordings.recorded_frames import N_DEPTH_VALUES, reading
from su3d_bench.formats.images import MAX_PIXELS, Size, UInt16Array

MIN_MATCH = 4


class NotLz4(Exception):
    """The content is not a block of the requested length."""


def unpacked_block(content: bytes, n_bytes: int) -> bytes:
    """The ``n_bytes`` stored in a block."""
    out, at = bytearray(), 0
    try:
        while True:
            token = content[at]
            n_literals, at = _length(content, token >> 4, at + 1)
            if len(out) + n_literals > n_bytes or at + n_literals > len(content):
                raise NotLz4
            out += content[at : at + n_literals]
            at += n_literals
            if at == len(content):
                break
            offset = content[at] | content[at + 1] << 8
            n_match, at = _length(content, token & 15, at + 2)
            n_match += MIN_MATCH
            if not 0 < offset <= len(out) or len(out) + n_match > n_bytes:
                raise NotLz4
            start = len(out) - offset
            if offset >= n_match:
                out += out[start : start + n_match]
            else:  # the match overlaps its own output: the pattern repeats
                pattern = bytes(out[start:])
                out += (pattern * (n_match // offset + 1))[:n_match]
    except IndexError:
        raise NotLz4 from None
    if len(out) != n_bytes:
        raise NotLz4
    return bytes(out)


def _length(content: bytes, first: int, at: int) -> tuple[int, int]:
    """A length (``first`` has its four bits; 15 means more bytes follow), and the position after it."""
    length = first
    if first == 15:
        while True:
            length += content[at]
            at += 1
            if content[at - 1] != 255:
                break
    return length, at


Item = TypeVar("Item")
N_KEPT = 12  # passed items kept, so that this many threads can ask out of order without a restart


class ForwardReader(Generic[Item]):
    """Reads items forward: ``begin`` opens the input; each step returns a function that unpacks the item, if wanted."""

    def __init__(self, begin: Callable[[], Iterator[Callable[[], Item]]], wanted: frozenset[int]) -> None:
        self._begin, self._wanted = begin, wanted
        self._steps: Iterator[Callable[[], Item]] | None = None
        self._next = 0
        self._kept: dict[int, Item] = {}
        self._lock = Lock()

    def at(self, number: int) -> Item | None:
        """The item with that number; None if there are fewer."""
        with self._lock:
            if number in self._kept:
                return self._kept[number]
            if self._steps is None or number < self._next:
                self._steps, self._next = self._begin(), 0
            try:
                return self._passed(self._steps, number)
            except BaseException:
                self._steps = None
                raise

    def _passed(self, steps: Iterator[Callable[[], Item]], number: int) -> Item | None:
        while self._next <= number:
            unpack = next(steps, None)
            if unpack is None:
                self._steps = None
                return None
            if self._next in self._wanted or self._next == number:
                self._kept[self._next] = unpack()
                if len(self._kept) > N_KEPT:
                    del self._kept[next(iter(self._kept))]
            self._next += 1
        return self._kept[number]


DEPTH_NAME = "depth.bin"
WIDTH, HEIGHT = DEPTH_SIZE = (256, 192)
N_PIXELS = WIDTH * HEIGHT
UNITS_PER_METRE = 1000.0
RAW = -zlib.MAX_WBITS  # no header, no checksum
LENGTH_BYTES = 4
MAX_PACKED_BYTES = 1 << 20  # of one image, which unpacked has 196608
MAX_FRAMES = 1 << 20  # of five hours at 60 a second
PIECE_BYTES = 1 << 16


class DepthFile:
    """The images of a file by number; ``where`` begins each message, ``wanted`` are those to be read."""

    def __init__(self, path: Path, where: str, wanted: frozenset[int]) -> None:
        self.path, self._where = path, f"{where}: {path.name}"
        with reading(where):
            self._index = _index(path)
        self._stream = ForwardReader(self._stream_images, wanted)

    def values(self, number: int) -> UInt16Array:
        """Millimetres (192, 256), 0 for no depth."""
        found = self._stream.at(number) if self._index is None else self._packed_values(self._index, number)
        if found is None:
            have = "fewer images" if self._index is None else f"{len(self._index)} images"
            raise DataError(f"{self._where}: has {have}, but not frame {number}; copy the file again")
        return found

    def _packed_values(self, index: list[tuple[int, int]], number: int) -> UInt16Array | None:
        if number >= len(index):
            return None
        start, n_bytes = index[number]
        with reading(self._where), opened(self.path) as stream:
            stream.seek(start)
            content = stream.read(n_bytes)
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
                        f"{self._where}: is not in any format of the release ({error}); copy the file again"
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
    """Whole millimetres of metres, truncated; 0 if they exceed 16 bits."""
    with np.errstate(invalid="ignore", over="ignore"):
        values = depth_m * np.float32(UNITS_PER_METRE)
        return np.where((values >= 0) & (values < N_DEPTH_VALUES), values, 0).astype(np.uint16)


def _index(path: Path) -> list[tuple[int, int]] | None:
    """Start and length of each image if the lengths chain up to the end of the file; None for a single stream."""
    index: list[tuple[int, int]] = []
    with opened(path) as stream:
        n_bytes = stream.seek(0, 2)
        at = 0
        while at < n_bytes:
            stream.seek(at)
            length = int.from_bytes(stream.read(LENGTH_BYTES), "little")
            at += LENGTH_BYTES
            if not 0 < length <= MAX_PACKED_BYTES or at + length > n_bytes or len(index) == MAX_FRAMES:
                return None
            index.append((at, length))
            at += length
    return index


VIDEO_NAME = "rgb.mkv"
MATROSKA = b"\x1a\x45\xdf\xa3"  # other formats that ffmpeg opens may refer to other files and addresses
QUIET = {"OPENCV_FFMPEG_LOGLEVEL": "-8"}  # keeps the decoder's messages off the terminal
ADVICE = "copy the file again, or extract it with the official toolkit into rgb/"


def video_size(path: Path, where: str) -> Size:
    """Width and height of the images in a video."""
    with _opened_video(path, f"{where}: {path.name}") as (_, size):
        return size


class VideoFile:
    """The images of a video by number; each of ``wanted`` is stored as returned by ``prepared``."""

    def __init__(
        self, path: Path, where: str, size: Size, wanted: frozenset[int], prepared: Callable[[UInt8Array], UInt8Array]
    ) -> None:
        self.path, self._where, self._size, self._prepared = path, f"{where}: {path.name}", size, prepared
        self._images = ForwardReader(self._decoded, wanted)

    def image(self, number: int) -> UInt8Array:
        """The prepared image with that number."""
        image = self._images.at(number)
        if image is None:
            raise DataError(f"{self._where}: frame {number} is missing or cannot be decoded; {ADVICE}")
        return image

    def _decoded(self) -> Iterator[Callable[[], UInt8Array]]:
        with _opened_video(self.path, self._where) as (video, size):
            if size != self._size:
                raise DataError(
                    f"{self._where}: images of {size[0]}x{size[1]}; the camera has {self._size[0]}x{self._size[1]}"
                )
            while video.grab():
                yield partial(self._unpacked, video)

    def _unpacked(self, video: Any) -> UInt8Array:
        import cv2

        is_there, image = video.retrieve()
        if not is_there or image is None or image.shape != (self._size[1], self._size[0], 3):
            raise DataError(f"{self._where}: an image in it cannot be decoded; {ADVICE}")
        return self._prepared(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8))


@contextmanager
def _opened_video(path: Path, where: str) -> Iterator[tuple[Any, Size]]:
    """The decoder of a video, and the size of its images."""
    import cv2

    with reading(where), opened(path) as stream:
        if stream.read(len(MATROSKA)) != MATROSKA:
            raise DataError(f"{where}: is not a Matroska video; {ADVICE}")
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if not video.isOpened() or width < 1 or height < 1 or width * height > MAX_PIXELS:
            raise DataError(f"{where}: cannot be decoded; {ADVICE}")
        yield video, (width, height)
    except cv2.error as error:
        raise DataError(f"{where}: cannot be decoded ({error.code}); {ADVICE}") from error
    finally:
        video.release()
