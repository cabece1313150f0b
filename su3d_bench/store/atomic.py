"""Files of caches that several processes fill at once: whole or absent, and nothing piles up beside them.

And arrays out of files that may be damaged, of which no more is believed than they hold.
"""

from __future__ import annotations

import fcntl
import io
import math
import os
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

MAGIC_1_0 = b"\x93NUMPY\x01\x00"
SMALL_BYTES = 1 << 16  # of an array that is read whole before its header is looked at


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """The plain arrays of an .npz file; raises one of ``DAMAGE`` for anything else.

    As ``numpy.load``, but a header that promises more than its member holds is damage, and no terabyte to allocate.
    """
    held = source.getvalue() if isinstance(source, io.BytesIO) else None
    with zipfile.ZipFile(source) as archive:
        arrays = {info.filename.removesuffix(".npy"): _array(archive, info, held) for info in archive.infolist()}
    for name, array in arrays.items():
        if (
            array.dtype.kind == "U"
            and array.size
            and array.reshape(-1).view(_codes(array.dtype)).max() > sys.maxunicode
        ):
            raise ValueError(f"{name}: holds what is no text")
    return arrays


def _codes(texts: np.dtype[Any]) -> np.dtype[Any]:
    """The type of the characters in an array of ``texts``."""
    return np.dtype(np.uint32).newbyteorder(texts.byteorder)


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, held: bytes | None) -> NDArray[Any]:
    """``held``: the bytes of the archive where they are in memory."""
    if info.file_size <= SMALL_BYTES:
        content = archive.read(info) if held is None else _small_member(held, info)
        if content.startswith(MAGIC_1_0):
            return _small_array(content, info.filename)
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{info.filename}: .npy of version {version}")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(member)
        if math.prod(shape) * _item_bytes(dtype) != info.file_size - member.tell():
            raise ValueError(f"{info.filename}: holds other than the {shape} that it promises")
        member.seek(0)
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        return array


def _small_member(held: bytes, info: zipfile.ZipInfo) -> bytes:
    """What ``ZipFile.read`` gives, without the five objects that it makes for each member."""
    start = info.header_offset
    signature, flags, method, n_name, n_extra = struct.unpack_from("<4s2xHH16xHH", held, start)
    if signature != b"PK\x03\x04" or flags & 1 or method != info.compress_type:
        raise zipfile.BadZipFile(f"{info.filename}: its two headers differ, or it is encrypted")
    start += 30 + n_name + n_extra
    packed = held[start : start + info.compress_size]
    if method == zipfile.ZIP_DEFLATED:
        packed = zlib.decompressobj(-15).decompress(packed, SMALL_BYTES + 1)
    elif method != zipfile.ZIP_STORED:
        raise zipfile.BadZipFile(f"{info.filename}: packed by the method {method}")
    if len(packed) != info.file_size or zlib.crc32(packed) != info.CRC:
        raise zipfile.BadZipFile(f"{info.filename}: is not whole")
    return packed


def _item_bytes(dtype: np.dtype[Any]) -> int:
    """How long one item is; NumPy makes texts of no length one character long."""
    return dtype.itemsize or 1


def _small_array(content: bytes, name: str) -> NDArray[Any]:
    """The array of a .npy file in memory; a run has thousands of files with few and equal headers."""
    start = 10 + int.from_bytes(content[8:10], "little")
    shape, is_fortran, dtype = _header_1_0(content[:start])
    if dtype.hasobject or math.prod(shape) * _item_bytes(dtype) != len(content) - start:
        raise ValueError(f"{name}: holds other than the {shape} of {dtype} that it promises")
    if start == len(content):
        return np.empty(shape, dtype)
    return np.frombuffer(content, dtype, offset=start).reshape(shape, order="F" if is_fortran else "C").copy("K")


@lru_cache(maxsize=1024)
def _header_1_0(content: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    stream = io.BytesIO(content)
    np.lib.format.read_magic(stream)
    found: tuple[tuple[int, ...], bool, np.dtype[Any]] = np.lib.format.read_array_header_1_0(stream)
    return found


@contextmanager
def filling(path: Path) -> Iterator[IO[bytes] | None]:
    """A stream whose bytes become ``path`` at the end; None where another process is writing that file just now.

    The unfinished file has one name, and its writer holds a lock that dies with it: what a killed process leaves is
    taken over by the next that writes the same file. Raises ``OSError`` where the disk refuses.
    """
    unfinished = path.with_name(f".{path.name}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    with os.fdopen(os.open(unfinished, os.O_RDWR | os.O_CREAT, 0o666), "r+b") as stream:
        if not _is_ours(stream, unfinished):
            yield None
            return
        try:
            stream.truncate(0)
            yield stream
            stream.flush()
            os.replace(unfinished, path)
        except BaseException:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
            raise


def _is_ours(stream: IO[bytes], unfinished: Path) -> bool:
    """Whether the lock is ours and the file is still unfinished: its last writer may have renamed it meanwhile."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(stream.fileno()), unfinished.stat())
    except (BlockingIOError, FileNotFoundError):
        return False
