"""Large tables a block of rows at a time, without those that lie in a file staying in memory."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
