"""Atomic file writes: files are written under a temporary name and then renamed, so they are complete or absent.

For files of a run, for caches that several processes fill at once, and for reading arrays from possibly damaged files,
within the limits of their real size. For the names and removal of unfinished files see ``core.files.locks``.
"""

from __future__ import annotations

import errno
import io
import json
import math
import mmap
import os
import shutil
import struct
import sys
import tempfile
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError, printable, reading
from su3d_bench.core.files.locks import clear_unfinished, locked_folder, new_file, remove_unheld
from su3d_bench.core.safe_output import escaped_json
from su3d_bench.core.system.files import file_text, opened

# Any file may unpack to this size: 600 masks of a scene's 120,000 points take 69 MiB, one byte per point.
FREE_BYTES = 128 << 20
# Above that, this many bytes per byte of the file; deflate alone reaches 1032. The masks above pack to 1/95.
MAX_RATIO = 100
PIECE = 1 << 20
# What readers raise for a damaged file, especially an .npz.
DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    SyntaxError,
    RuntimeError,  # from zipfile, for an unknown compression
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
)
ENCRYPTED = 0x1
MIN_ZIP = 22  # bytes of an archive without members
METHODS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # the others unpack without a limit


class UnpackingError(ValueError):
    """A file would unpack to far more than its size, or to an unknown size."""


class Allowance:
    """The number of bytes that may still be unpacked from a file of ``n_packed`` bytes, over all its parts."""

    def __init__(self, n_packed: int) -> None:
        self.n_bytes = max(FREE_BYTES, n_packed * MAX_RATIO)
        self._n_left = self.n_bytes

    def spend(self, n: int) -> None:
        """Count ``n`` bytes before they are unpacked; ``UnpackingError`` if there are too many."""
        if n > self._n_left:
            raise UnpackingError(
                f"unpacks to more than {self.n_bytes >> 20} MiB, over {MAX_RATIO} times its size; if it is valid, "
                "write it without compression"
            )
        self._n_left -= n


def allowance_of(archive: zipfile.ZipFile) -> Allowance:
    """The allowance of a zip archive by its real size; ``BadZipFile`` if it has bytes but no member."""
    assert archive.fp is not None
    n_bytes = archive.fp.seek(0, io.SEEK_END)
    if not archive.infolist() and n_bytes > MIN_ZIP + len(archive.comment):
        raise zipfile.BadZipFile("contains bytes but lists no member")
    return Allowance(n_bytes)


def check_member(info: zipfile.ZipInfo, allowance: Allowance) -> None:
    """Count the declared bytes of a member, beyond which ``zipfile`` does not read; reject members without a limit."""
    if info.flag_bits & ENCRYPTED or info.compress_type not in METHODS:
        name = printable(info.filename, 80)
        raise UnpackingError(f"'{name}' is encrypted or has an unsupported compression; write it plain or with deflate")
    allowance.spend(info.file_size)


def member_bytes(archive: zipfile.ZipFile, info: zipfile.ZipInfo, allowance: Allowance) -> bytes:
    """The content of a member, read in pieces: in one read ``zipfile`` unpacks more than the declared size."""
    check_member(info, allowance)
    content = io.BytesIO()
    with archive.open(info) as member:
        while piece := member.read(PIECE):
            content.write(piece)
    return content.getvalue()


REASONS = {
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.EDQUOT: "the disk quota is used up; free some space and run the same command again",
    errno.EACCES: "the folder is read-only; choose another with --out",
    errno.EPERM: "the folder is read-only; choose another with --out",
    errno.EROFS: "the folder is read-only; choose another with --out",
    errno.EFBIG: "the file exceeds the size limit of the disk or account; raise the limit or choose another with --out",
    errno.ENOLCK: "this disk has no locks available; choose a folder on another disk with --out",
    errno.ENOTDIR: "a file is in the place of a folder; choose another with --out",
    errno.EEXIST: "a file is in the place of a folder; choose another with --out",
}


def write_error(path: Path, error: OSError) -> StoreError:
    """The error to raise if the system refuses to write ``path``."""
    reason = REASONS.get(error.errno or 0, error.strerror or str(error))
    return StoreError(f"cannot write {path}: {reason}")


def make_folder(path: Path) -> None:
    """Create ``path`` and its parents, and remove unfinished files of killed processes from it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from error
    clear_unfinished(path)


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A stream whose bytes replace ``path`` at the end, atomically."""
    try:
        with filling(path, is_durable=True) as stream:
            yield stream
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def filling(path: Path, *, is_durable: bool = False) -> Iterator[IO[bytes]]:
    """As ``replacing``, for files that can be recreated: raises ``OSError`` and does not sync the disk."""
    if not is_durable:
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_unfinished(path.parent)
    place, handle = new_file(path)
    try:
        with open(place, "wb", opener=lambda *_: handle) as stream:  # for libraries that need a stream with a name
            yield stream
            stream.flush()
            if is_durable:
                os.fsync(handle)
            os.replace(place, path)
    except BaseException:
        with suppress(OSError):  # a read-only disk refuses even to remove a missing file
            place.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path`` atomically, even if the process or the machine stops meanwhile."""
    with replacing(path) as stream:
        stream.write(content)


def remove_file(path: Path) -> None:
    """Remove ``path`` if it exists."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def json_text(value: Any) -> str:
    """JSON in the form of all files of a run: two spaces, full precision, no NaN."""
    return escaped_json(value, indent=2, allow_nan=False) + "\n"


def write_json(path: Path, value: Any) -> None:
    write_text(path, json_text(value))


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An .npz archive without pickle whose bytes depend only on the arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)  # it dates every member 1980-01-01
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
    """Whether the file exists; False for a name that the system rejects, as in a hostile record."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_json(path: Path) -> Any:
    """The value of a JSON file; a missing or damaged file is a ``StoreError``."""
    try:
        with reading(str(path), StoreError):
            return json.loads(file_text(path), object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        what = str(error) if isinstance(error, _DuplicateKeyError) else "not readable as JSON"
        raise StoreError(f"{path}: {what}; run the same command again to repair it") from error


class _DuplicateKeyError(ValueError):
    """An object has a key twice: one program would read the first value, another the last."""


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of a JSON text, for ``json.loads``; a ``ValueError`` if it has a key twice."""
    value = dict(pairs)
    if len(value) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise _DuplicateKeyError(f"has the key '{printable(twice, 80)}' twice")
    return value


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file, without objects; raises one of ``DAMAGE`` for anything else.

    Three times as fast as ``numpy.load`` for the thirty small arrays of a scene's counts, of which a run has thousands;
    a header that declares more than its member contains is an error, not an allocation.
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
    # NumPy makes empty strings one character long.
    if dtype.hasobject or math.prod(shape) * (dtype.itemsize or 1) != len(content) - start:
        raise ValueError(f"{info.filename}: its size does not match its header ({dtype} {shape})")
    if start == len(content):
        return np.empty(shape, dtype)
    array = np.frombuffer(content, dtype, offset=start)
    if dtype.kind == "U" and array.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder)).max() > sys.maxunicode:
        raise ValueError(f"{info.filename}: contains invalid Unicode text")
    return array.reshape(shape, order="F" if is_fortran else "C").copy("K")


@lru_cache(maxsize=1024)
def _header(content: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(stream)
    return header


MAX_IN_MEMORY_BYTES = 1 << 26  # a hundredth of a small machine's memory; most scenes never reach it


def scratch_folder() -> Path:
    """The folder for large temporary files: TMPDIR, otherwise /var/tmp, otherwise Python's default.

    /tmp is memory on many systems; /var/tmp is not (Filesystem Hierarchy Standard 5.15).
    """
    if not os.environ.get("TMPDIR") and os.access("/var/tmp", os.W_OK):
        return Path("/var/tmp")
    return Path(tempfile.gettempdir())


class Scratch:
    """An unnamed temporary file of arrays, ``n_bytes`` in total; it disappears with the process."""

    def __init__(self, most_in_memory_bytes: int = MAX_IN_MEMORY_BYTES) -> None:
        self._file = tempfile.SpooledTemporaryFile(most_in_memory_bytes, dir=str(scratch_folder()))  # noqa: SIM115
        self._most_in_memory_bytes = most_in_memory_bytes
        self.n_bytes = 0

    def put(self, array: NDArray[Any]) -> StoredRows:
        """Store a copy of ``array`` until ``close``."""
        stored = StoredRows(self, self.n_bytes, array.dtype, array.shape)
        content = np.ascontiguousarray(array).tobytes()
        try:
            self._file.seek(self.n_bytes)
            self._file.write(content)
            self._file.flush()
        except OSError as error:
            raise StoreError(
                f"cannot write temporary data to {scratch_folder()}: {error.strerror or error}; set TMPDIR to a folder "
                "on a larger disk"
            ) from error
        self.n_bytes += len(content)
        return stored

    def read(self, offset: int, n_bytes: int) -> bytes:
        """The ``n_bytes`` bytes at ``offset``."""
        if self.n_bytes > self._most_in_memory_bytes > 0:  # on disk: a forked process shares the position in the file
            return os.pread(self._file.fileno(), n_bytes, offset)
        self._file.seek(offset)
        return self._file.read(n_bytes)

    def close(self) -> None:
        """Free memory and disk space."""
        self._file.close()


@dataclass(frozen=True, slots=True)
class StoredRows:
    """An array in a scratch file, read a few rows at a time."""

    scratch: Scratch
    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def rows(self, first: int, last: int) -> NDArray[Any]:
        """Rows ``first`` to ``last`` - 1, read-only."""
        if not 0 <= first <= last <= self.shape[0]:
            raise IndexError(f"rows {first} to {last} of {self.shape[0]}")
        row_bytes = self.dtype.itemsize * int(np.prod(self.shape[1:], dtype=np.int64))
        content = self.scratch.read(self.offset + first * row_bytes, (last - first) * row_bytes)
        return np.frombuffer(content, self.dtype).reshape(last - first, *self.shape[1:])


def row_blocks(table: NDArray[Any], n_rows: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """``table`` in blocks of ``n_rows``, each with its slice; a block is valid until the next is requested.

    >>> [(rows.start, rows.stop, block.tolist()) for rows, block in row_blocks(np.arange(3), 2)]
    [(0, 2, [0, 1]), (2, 3, [2])]
    """
    for start in range(0, len(table), n_rows):
        rows = slice(start, min(start + n_rows, len(table)))
        yield rows, table[rows]
        release_pages(table)


def release_pages(table: NDArray[Any]) -> None:
    """Release the pages of a memory-mapped table that were read or written; other arrays are unchanged.

    These pages count as memory of the process until they are released; they are loaded again when read, with what was
    written to the file. Private maps (mode ``c``) have changes that are in no file, and are not released.
    """
    if not isinstance(table, np.memmap) or table.mode == "c":
        return
    base: Any = table
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


SUFFIX = ".held"


class TemporaryFolder:
    """The folder ``path``, below the system's folder for temporary files, until ``close`` or the end of a block.

    ``prefix`` has the form ``su3d-<word>-``.
    """

    def __init__(self, prefix: str) -> None:
        remove_abandoned()
        try:
            self.path, self._lock = locked_folder(lambda: Path(tempfile.mkdtemp(SUFFIX, prefix)))
        except OSError as error:
            where = f" below {tempfile.tempdir}" if tempfile.tempdir else ""
            reason = error.strerror or str(error)
            raise StoreError(
                f"cannot create a temporary folder{where}: {reason}; set TMPDIR to a writable folder"
            ) from error

    def close(self) -> None:
        """Remove the folder; may be called twice."""
        shutil.rmtree(self.path, ignore_errors=True)
        lock, self._lock = self._lock, None  # first, so that an interrupt here does not close it twice
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()


def remove_abandoned() -> None:
    """Remove the temporary folders of killed processes."""
    for folder in Path(tempfile.gettempdir()).glob(f"su3d-*{SUFFIX}"):
        with suppress(OSError):  # in use, already removed, or of another user
            remove_unheld(folder)
