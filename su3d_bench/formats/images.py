"""Colour and depth images from the bytes of a file: JPEG, PNG, PPM and PGM.

The header is checked before anything is decoded: a decoder would allocate the declared size and report damage on
stderr. Every problem is a ``DataError`` that begins with ``where``.
"""

from __future__ import annotations

import re
import stat
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, Int32Array, UInt8Array
from su3d_bench.formats.ply import ListColumn

UInt16Array = NDArray[np.uint16]
Image = TypeVar("Image", UInt8Array, UInt16Array)
Size = tuple[int, int]  # width, height in pixels
MAX_PIXELS = 50_000_000  # no RGB-D camera has more; a damaged header may declare 4 billion
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_BYTES = 1 << 30  # of one file; 50 million pixels of 16-bit RGB take 300 MB
JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
JPEG_END_WITHIN = 1024  # some writers add data after the end of the image
JPEG_SCAN, MAX_SCANS = b"\xff\xda", 100  # a progressive JPEG has about ten; each covers the whole image
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # the markers that contain the size
PORTABLE_MAP = re.compile(rb"(P[56])\s+(?:#[^\n]*\s+)*(\d{1,6})\s+(\d{1,6})\s+(\d{1,5})\s")


def read_bytes(path: Path, where: str, advice: str = "copy the file again", most: int = MAX_BYTES) -> bytes:
    """The content of a file of at most ``most`` bytes; ``advice``: what to do if it is missing."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{where} is not a file and cannot be read; {advice}")
        if status.st_size > most:
            raise DataError(f"{where} has {status.st_size} bytes; expected at most {most >> 20} MiB")
        return file_bytes(path)
    except FileNotFoundError as error:
        raise DataError(f"{where} is missing; {advice}") from error
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}") from error


def image_size(content: bytes) -> tuple[int, int] | None:
    """Width and height from the header of a JPEG, PNG, PPM or PGM; None if there is no such header."""
    if content.startswith(PNG_SIGNATURE) and content[12:16] == b"IHDR" and len(content) >= 33:
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    if match := PORTABLE_MAP.match(content[:4096]):
        return int(match[2]), int(match[3])
    return _jpeg_size(content)


def decode_colour(content: bytes, where: str) -> UInt8Array:
    """Pixels (H, W, 3) RGB of a JPEG, an 8-bit PNG or a PPM."""
    import cv2

    if content.startswith(b"P6"):
        return _portable_map(content, b"P6", where)
    is_png = content.startswith(PNG_SIGNATURE)
    # Some decoders fill the missing part of a truncated JPEG with grey.
    is_whole_jpeg = JPEG_END in content[-JPEG_END_WITHIN:] and content.count(JPEG_SCAN) <= MAX_SCANS
    is_whole = whole_png_header(content) is not None if is_png else is_whole_jpeg
    size, image = image_size(content), None
    if is_whole and size is not None and 0 < size[0] * size[1] <= MAX_PIXELS:
        image = decoded(content, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.dtype != np.uint8:
        raise DataError(f"{where}: not a readable {'PNG' if is_png else 'JPEG'} image; copy the file again")
    return np.asarray(image)


def decode_depth(content: bytes, where: str) -> UInt16Array:
    """Values (H, W) uint16 of a PNG with one 16-bit channel, or of a 16-bit PGM (big-endian by definition)."""
    import cv2

    if content.startswith(b"P5"):
        return _portable_map(content, b"P5", where)
    header = whole_png_header(content)
    if header is None or not 0 < header[0] * header[1] <= MAX_PIXELS:
        raise DataError(f"{where}: not a readable PNG image; copy the file again")
    values = decoded(content, cv2.IMREAD_UNCHANGED) if header[2:] == (16, 0) else None
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise DataError(f"{where}: not a depth image; expected one channel of 16 bits")
    return np.asarray(values)


def sized(decode: Callable[[bytes, str], Image], content: bytes, size: Size, where: str, reason: str) -> Image:
    """The result of ``decode``, which must have the width and height ``size``; ``reason`` explains why in messages."""
    _check_size(image_size(content), size, where, reason)
    image = decode(content, where)
    _check_size((image.shape[1], image.shape[0]), size, where, reason)
    return image


def _check_size(actual: Size | None, size: Size, where: str, reason: str) -> None:
    """No error if no size was found: then the decoder reports what is wrong."""
    if actual is not None and actual != size:
        raise DataError(f"{where} is {actual[0]}x{actual[1]}; expected {size[0]}x{size[1]}, {reason}")


def _portable_map(content: bytes, magic: bytes, where: str) -> NDArray[Any]:
    match = PORTABLE_MAP.match(content[:4096])
    name, top, n_channels = ("PGM", 65535, 1) if magic == b"P5" else ("PPM", 255, 3)
    if match is None or match[1] != magic:
        raise DataError(f"{where}: not a readable {name} image; copy the file again")
    width, height, maximum = (int(match[k]) for k in (2, 3, 4))
    dtype = np.dtype(">u2") if magic == b"P5" else np.dtype(np.uint8)
    if (maximum > 255) != (top > 255) or not 0 < width * height <= MAX_PIXELS:
        raise DataError(f"{where}: {name} of {width}x{height} with values to {maximum}; expected values to {top}")
    n = width * height * n_channels
    if len(content) - match.end() != n * dtype.itemsize:
        raise DataError(
            f"{where}: {name} of {width}x{height} needs {n * dtype.itemsize} bytes of pixels, "
            f"but has {len(content) - match.end()}; copy the file again"
        )
    pixels = np.frombuffer(content, dtype, n, match.end()).astype(dtype.newbyteorder("="))
    return pixels.reshape((height, width, 3) if n_channels == 3 else (height, width))


def decoded(content: bytes, flags: int) -> Any:
    """The image, or None if it cannot be decoded."""
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


def whole_png_header(content: bytes) -> tuple[int, int, int, int] | None:
    """Width, height, bits and colour type of a PNG; None unless all chunks are present with correct checksums."""
    if not content.startswith(PNG_SIGNATURE) or len(content) < 33 or content[12:16] != b"IHDR":
        return None
    at, kind = len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(content) or zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return None
        at = end + 4
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big"), content[24], content[25]


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    if not content.startswith(JPEG_START):
        return None
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
        if marker in JPEG_FRAMES:
            return int.from_bytes(content[at + 7 : at + 9], "big"), int.from_bytes(content[at + 5 : at + 7], "big")
        at += 1 if marker == 0xFF else 2 + length
    return None


JPEG_QUALITY = 95
PNG_COMPRESSION = 3


def jpeg_bytes(rgb: UInt8Array, quality: int = JPEG_QUALITY) -> bytes:
    import cv2

    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def png_bytes(image: UInt8Array | UInt16Array) -> bytes:
    """A PNG of an image (H, W, 3) 8-bit RGB, or (H, W) 16-bit grey."""
    import cv2

    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return bytes(cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1])


def depth_in_units(depth_m: Float32Array, units_per_metre: float) -> UInt16Array:
    """Depth in integer units, rounded; values beyond 16 bits become 0, which means no reading."""
    values = np.rint(depth_m.astype(np.float64) * units_per_metre)
    return np.where(values > np.iinfo(np.uint16).max, 0, values).astype(np.uint16)


def list_column(rows: Int32Array) -> ListColumn:
    """Rows (N, k) as list properties of length k for a PLY file."""
    return ListColumn(np.arange(len(rows) + 1) * rows.shape[1], rows.reshape(-1).astype(np.int32))


def triangles_of(quads: Int32Array) -> Int32Array:
    """Quads (F, 4) as triangles (2F, 3), split from the first corner to the third, as in habitat."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
