"""Scratch space for arrays that come with every image and are seldom read again: in memory while few, then on disk."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.locks import held_folder, remove_unheld

MOST_IN_MEMORY_BYTES = 1 << 26  # a hundredth of a small machine's memory; most scenes never reach it


def scratch_folder() -> Path:
    """Where large temporary files go: TMPDIR, else /var/tmp, else what Python finds.

    /tmp is memory on many systems; /var/tmp is not (Filesystem Hierarchy Standard 5.15).
    """
    if not os.environ.get("TMPDIR") and os.access("/var/tmp", os.W_OK):
        return Path("/var/tmp")
    return Path(tempfile.gettempdir())


class Scratch:
    """A file without a name that takes arrays, ``n_bytes`` in all; it is gone with the process, however that ends."""

    def __init__(self, most_in_memory_bytes: int = MOST_IN_MEMORY_BYTES) -> None:
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
            self.path, self._lock = held_folder(lambda: Path(tempfile.mkdtemp(SUFFIX, prefix)))
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
