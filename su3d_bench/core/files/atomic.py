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
import sys
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError, reading
from su3d_bench.core.files.locks import clear_unfinished, new_file
from su3d_bench.core.files.unpacking import DAMAGE, Allowance, allowance_of, check_member
from su3d_bench.core.printing import escaped_json
from su3d_bench.core.system.files import file_text, opened

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
    try:
        with filling(path, is_durable=True) as stream:
            yield stream
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def filling(path: Path, *, is_durable: bool = False) -> Iterator[IO[bytes]]:
    """As ``replacing``, for what can be made again: an ``OSError`` where the disk refuses, and no wait for the disk."""
    if not is_durable:
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_unfinished(path.parent)
    place, handle = new_file(path)
    try:
        with open(place, "wb", opener=lambda *_: handle) as stream:  # whoever writes files by name finds one
            yield stream
            stream.flush()
            if is_durable:
                os.fsync(handle)
            os.replace(place, path)
    except BaseException:
        with suppress(OSError):  # a read-only disk refuses even to remove what is not there
            place.unlink(missing_ok=True)
        raise


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
    np.savez(buffer, allow_pickle=False, **arrays)  # which dates every member 1980-01-01
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

    Three times as fast as ``numpy.load`` for the thirty small arrays of a scene's counts, of which a run has thousands;
    and a header that promises more than its member holds is damage, no terabyte to allocate.
    """
    whole = opened(source) if isinstance(source, Path) else nullcontext(source)
    with whole as stream, zipfile.ZipFile(stream) as archive:
        allowance = allowance_of(archive)
        return {info.filename.removesuffix(".npy"): _array(archive, info, allowance) for info in archive.infolist()}


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, allowance: Allowance) -> NDArray[Any]:
    check_member(info, allowance)
    with archive.open(info) as member:
        content = member.read(info.file_size)
    n_length = {b"\x01\x00": 2, b"\x02\x00": 4}[content[6:8]]
    start = 8 + n_length + int.from_bytes(content[8 : 8 + n_length], "little")
    shape, is_fortran, dtype = _header(content[:start])
    # NumPy makes texts of no length one character long.
    if dtype.hasobject or math.prod(shape) * (dtype.itemsize or 1) != len(content) - start:
        raise ValueError(f"{info.filename}: holds other than the {shape} of {dtype} that it promises")
    if start == len(content):
        return np.empty(shape, dtype)
    array = np.frombuffer(content, dtype, offset=start)
    if dtype.kind == "U" and array.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder)).max() > sys.maxunicode:
        raise ValueError(f"{info.filename}: holds what is no text")
    return array.reshape(shape, order="F" if is_fortran else "C").copy("K")


@lru_cache(maxsize=1024)
def _header(content: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(stream)
    return header
