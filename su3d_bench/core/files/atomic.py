"""Files that are whole or absent, however a process ends: written under a temporary name, then renamed.

Those of a run, those of caches that several processes fill at once, and arrays out of files that may be damaged, of
which no more is believed than they hold. How unfinished files are named and cleared: ``store.unfinished``.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError, reading
from su3d_bench.core.files.locks import SHARED, beside, clear_unfinished, new_file, own_file
from su3d_bench.core.files.unpacking import Allowance, allowance_of, check_member, member_bytes
from su3d_bench.core.printing import escaped_json
from su3d_bench.core.system.damage import DAMAGE
from su3d_bench.core.system.files import file_text, opened

MAGIC_1_0 = b"\x93NUMPY\x01\x00"
SMALL_BYTES = 1 << 16  # of an array that is read whole before its header is looked at
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
REASONS = {
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.EDQUOT: "the disk quota is used up; free some space and run the same command again",
    errno.EACCES: "the folder is read-only; choose another with --out",
    errno.EPERM: "the folder is read-only; choose another with --out",
    errno.EROFS: "the folder is read-only; choose another with --out",
    errno.EFBIG: "the file grows beyond what this disk or account allows; raise the limit or choose another with --out",
    errno.ENOLCK: "this disk has no locks to give; choose a folder on another disk with --out",
    errno.ENOTDIR: "a file stands where a folder should be; choose another with --out",
    errno.EEXIST: "a file stands where a folder should be; choose another with --out",
}


def write_error(path: Path, error: OSError) -> StoreError:
    """What is said where the system refuses to write ``path``."""
    reason = REASONS.get(error.errno or 0, error.strerror or str(error))
    return StoreError(f"cannot write {path}: {reason}")


def make_folder(path: Path) -> None:
    """Make ``path`` and its parents, and clear from it what killed processes left unfinished."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from error
    clear_unfinished(path)


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A stream whose bytes take the place of ``path`` at the end, whole or not at all."""
    unfinished = None
    try:
        unfinished, handle = new_file(path)
        with _stream(unfinished, handle) as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            os.replace(unfinished, path)
    except BaseException as error:
        if unfinished is not None:
            with suppress(OSError):  # a read-only disk refuses even to remove what is not there
                unfinished.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise write_error(path, error) from error
        raise


def _stream(place: Path, handle: int) -> IO[bytes]:
    """The open file ``handle`` as a stream that knows its name, for whoever writes files by name."""
    return open(place, "wb", opener=lambda *_: handle)


def write_bytes(path: Path, content: bytes) -> None:
    """Put ``content`` at ``path``, whole or not at all, even when the process or the machine dies meanwhile."""
    with replacing(path) as stream:
        stream.write(content)


def remove_file(path: Path) -> None:
    """Remove ``path`` where it exists."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def json_text(value: Any) -> str:
    """JSON as every file of a run has it: two spaces, full precision, no NaN."""
    return escaped_json(value, indent=2, allow_nan=False) + "\n"


def write_json(path: Path, value: Any) -> None:
    write_text(path, json_text(value))


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An .npz archive without pickle whose bytes depend on the arrays alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array), version=(1, 0), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=ZIP_EPOCH)
            archive.writestr(entry, member.getvalue())
    return buffer.getvalue()


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    write_bytes(path, npz_bytes(arrays))


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file; a damaged file is a ``StoreError``."""
    try:
        return read_arrays(path)
    except DAMAGE as error:
        raise StoreError(f"{path}: not a readable .npz file ({error}); delete it and run again") from error


def is_file(path: Path) -> bool:
    """Whether there is such a file; none has a name that no system could give, as a hostile record may say."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_json(path: Path) -> Any:
    """The value of a JSON file; a missing or damaged file is a ``StoreError``."""
    try:
        with reading(str(path), StoreError):
            return json.loads(file_text(path))
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not readable as JSON; run the same command again to mend it") from error


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """The plain arrays of an .npz file; raises one of ``DAMAGE`` for anything else.

    As ``numpy.load``, but a header that promises more than its member holds is damage, and no terabyte to allocate,
    and so is an archive that unpacks to far more than it is.
    """
    held = source.getvalue() if isinstance(source, io.BytesIO) else None
    whole = opened(source) if isinstance(source, Path) else nullcontext(source)
    with whole as stream, zipfile.ZipFile(stream) as archive:
        allowance, members = allowance_of(archive), archive.infolist()
        arrays = {info.filename.removesuffix(".npy"): _array(archive, info, held, allowance) for info in members}
    for name, array in arrays.items():
        if array.dtype.kind == "U" and array.size:
            codes = array.reshape(-1).view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
            if codes.max() > sys.maxunicode:
                raise ValueError(f"{name}: holds what is no text")
    return arrays


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, held: bytes | None, allowance: Allowance) -> NDArray[Any]:
    """``held``: the bytes of the archive where they are in memory."""
    if info.file_size <= SMALL_BYTES:
        content = member_bytes(archive, info, allowance) if held is None else _small_member(held, info, allowance)
        if content.startswith(MAGIC_1_0):
            return _small_array(content, info.filename)
    check_member(info, allowance)
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


def _small_member(held: bytes, info: zipfile.ZipInfo, allowance: Allowance) -> bytes:
    """What ``member_bytes`` gives, without the five objects that ``zipfile`` makes for each member."""
    check_member(info, allowance)
    start = info.header_offset
    signature, flags, method, n_name, n_extra = struct.unpack_from("<4s2xHH16xHH", held, start)
    if signature != b"PK\x03\x04" or flags & 1 or method != info.compress_type:
        raise zipfile.BadZipFile(f"{info.filename}: its two headers differ, or it is encrypted")
    start += 30 + n_name + n_extra
    packed = held[start : start + info.compress_size]
    if method == zipfile.ZIP_DEFLATED:
        packed = zlib.decompressobj(-15).decompress(packed, SMALL_BYTES + 1)
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
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = np.lib.format.read_array_header_1_0(stream)
    return header


@contextmanager
def filling(path: Path) -> Iterator[IO[bytes] | None]:
    """A stream whose bytes become ``path`` at the end; None where another process is writing that file just now.

    All processes write it under one name, so that they meet. Raises ``OSError`` where the disk refuses.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    clear_unfinished(path.parent)
    unfinished = beside(path, SHARED)
    handle = own_file(unfinished, os.O_RDWR | os.O_CREAT)
    if handle is None:
        yield None
        return
    with _stream(unfinished, handle) as stream:
        try:
            stream.truncate(0)
            yield stream
            stream.flush()
            os.replace(unfinished, path)
        except BaseException:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
            raise
