"""Files that are whole or absent, however a process ends: written under a temporary name, then renamed.

Those of a run, those of caches that several processes fill at once, and arrays out of files that may be damaged, of
which no more is believed than they hold. How unfinished files are named and cleared: ``store.unfinished``.
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

# What any file may unpack to: 600 masks of a scene's 120,000 points take 69 MiB, a byte a point.
FREE_BYTES = 128 << 20
# Beyond that so many bytes for one of the file; deflate alone reaches 1032. The masks above pack to a 95th.
MAX_RATIO = 100
PIECE = 1 << 20
# What readers raise on a damaged file, an .npz above all.
DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    SyntaxError,
    RuntimeError,  # zipfile's, of a compression unknown to it
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
)
ENCRYPTED = 0x1
MIN_ZIP = 22  # bytes of an archive without members
METHODS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # the others unpack without a bound


class UnpackingError(ValueError):
    """A file would unpack to far more than it is, or nobody can bound to how much."""


class Allowance:
    """How many bytes may still be unpacked from a file of ``n_packed`` bytes, all its parts together."""

    def __init__(self, n_packed: int) -> None:
        self.n_bytes = max(FREE_BYTES, n_packed * MAX_RATIO)
        self._n_left = self.n_bytes

    def spend(self, n: int) -> None:
        """Count ``n`` bytes before they are made; ``UnpackingError`` where there are too many."""
        if n > self._n_left:
            raise UnpackingError(
                f"unpacks to more than {self.n_bytes >> 20} MiB, over {MAX_RATIO} times its size; write it without "
                "compression if it is sound"
            )
        self._n_left -= n


def allowance_of(archive: zipfile.ZipFile) -> Allowance:
    """What may be unpacked from a zip archive by its real bytes; damage where none of them is a member."""
    assert archive.fp is not None
    n_bytes = archive.fp.seek(0, io.SEEK_END)
    if not archive.infolist() and n_bytes > MIN_ZIP + len(archive.comment):
        raise zipfile.BadZipFile("holds bytes and names no member")
    return Allowance(n_bytes)


def check_member(info: zipfile.ZipInfo, allowance: Allowance) -> None:
    """Count the bytes that a member promises, beyond which ``zipfile`` reads none; refuse what it cannot bound."""
    if info.flag_bits & ENCRYPTED or info.compress_type not in METHODS:
        name = printable(info.filename, 80)
        raise UnpackingError(f"'{name}' is encrypted or compressed in an unusual way; write it plainly")
    allowance.spend(info.file_size)


def member_bytes(archive: zipfile.ZipFile, info: zipfile.ZipInfo, allowance: Allowance) -> bytes:
    """The content of a member, in pieces: asked for all at once, ``zipfile`` unpacks beyond what was promised."""
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


MAX_IN_MEMORY_BYTES = 1 << 26  # a hundredth of a small machine's memory; most scenes never reach it


def scratch_folder() -> Path:
    """Where large temporary files go: TMPDIR, else /var/tmp, else what Python finds.

    /tmp is memory on many systems; /var/tmp is not (Filesystem Hierarchy Standard 5.15).
    """
    if not os.environ.get("TMPDIR") and os.access("/var/tmp", os.W_OK):
        return Path("/var/tmp")
    return Path(tempfile.gettempdir())


class Scratch:
    """A file without a name that takes arrays, ``n_bytes`` in all; it is gone with the process, however that ends."""

    def __init__(self, most_in_memory_bytes: int = MAX_IN_MEMORY_BYTES) -> None:
        self._file = tempfile.SpooledTemporaryFile(most_in_memory_bytes, dir=str(scratch_folder()))  # noqa: SIM115
        self.n_bytes = 0

    def put(self, array: NDArray[Any]) -> StoredRows:
        """Keeps a copy of ``array`` until ``close``."""
        stored = StoredRows(self, self.n_bytes, array.dtype, array.shape)
        content = np.ascontiguousarray(array).tobytes()
        try:
            self._file.seek(self.n_bytes)
            self._file.write(content)
            self._file.flush()
        except OSError as error:
            raise StoreError(
                f"cannot write temporary data to {scratch_folder()}: {error.strerror or error}; set TMPDIR to a larger "
                "disk"
            ) from error
        self.n_bytes += len(content)
        return stored

    def read(self, offset: int, n_bytes: int) -> bytes:
        """What lies at ``offset``."""
        self._file.seek(offset)
        return self._file.read(n_bytes)

    def close(self) -> None:
        """Gives memory and disk space back."""
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
    """``table`` in blocks of ``n_rows``, each with the slice that it is; a block is good until the next is asked for.

    >>> [(rows.start, rows.stop, block.tolist()) for rows, block in row_blocks(np.arange(3), 2)]
    [(0, 2, [0, 1]), (2, 3, [2])]
    """
    for start in range(0, len(table), n_rows):
        rows = slice(start, min(start + n_rows, len(table)))
        yield rows, table[rows]
        release_pages(table)


def release_pages(table: NDArray[Any]) -> None:
    """Let go of what has been touched of a memory-mapped table; other arrays stay as they are.

    What was touched counts as memory of the process until someone says so; it comes back when it is read, what was
    written into the file included. Private maps (mode ``c``) hold changes that no file has, and are left alone.
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

    ``prefix`` is ``su3d-``, a word and a hyphen.
    """

    def __init__(self, prefix: str) -> None:
        remove_abandoned()
        try:
            self.path, self._lock = locked_folder(lambda: Path(tempfile.mkdtemp(SUFFIX, prefix)))
        except OSError as error:
            where = f" below {tempfile.tempdir}" if tempfile.tempdir else ""
            reason = error.strerror or str(error)
            raise StoreError(
                f"cannot make a temporary folder{where}: {reason}; set TMPDIR to a folder that can be written"
            ) from error

    def close(self) -> None:
        """Remove the folder; once is enough, twice is no fault."""
        shutil.rmtree(self.path, ignore_errors=True)
        lock, self._lock = self._lock, None  # first, so that an interrupt here closes nothing twice
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()


def remove_abandoned() -> None:
    """Remove the temporary folders of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"su3d-*{SUFFIX}"):
        with suppress(OSError):  # in use, gone meanwhile, or somebody else's
            remove_unheld(folder)
