"""Scratch space for arrays that come with every image and are seldom read again: in memory while few, then on disk."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError

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
