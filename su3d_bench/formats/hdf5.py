"""One table of floats from an HDF5 file that anyone may have made: checked first, then read in blocks of rows.

The files are those of gradslam (``pc_points.h5``, ``pc_embeddings.h5``): one dataset at the root, named like the file.
Links out of the file, external and virtual storage are refused, and what the header promises is compared with the size
of the file before h5py allocates anything. So are tables in chunks: HDF5 trusts what a compressed chunk unpacks to, and
shows foreign memory where one is too short.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.system.files import regular
from su3d_bench.core.types import Float32Array, Int32Array

FloatArray = NDArray[np.floating[Any]]
BLOCK_BYTES = 16 << 20
MAX_COLUMNS = 1 << 16  # of a table whose width is not known; features have some thousand
# What h5py raises on damaged files; it has no base class of its own.
LIBRARY_ERRORS = (OSError, KeyError, ValueError, RuntimeError, TypeError, AttributeError, MemoryError)


def read_rows(path: Path, n_columns: int, where: str) -> Float32Array:
    """The whole table (N, ``n_columns``) as float32; ``where`` begins each message."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite
        blocks = [block.astype(np.float32) for block in row_blocks(path, n_columns, where)]
    return np.concatenate([np.zeros((0, n_columns), np.float32), *blocks])


def largest_column(path: Path, n_columns: int, where: str) -> Int32Array:
    """The column (N,) of the first maximum of each row; a row of zeros gives 0, a NaN is a ``DataError``."""
    columns: list[Int32Array] = [np.zeros(0, np.int32)]
    n_rows = 0
    for block in row_blocks(path, n_columns, where):
        is_nan = np.isnan(block).any(axis=1)
        if is_nan.any():
            raise DataError(f"{where}: row {n_rows + int(np.argmax(is_nan))} holds NaN; copy the file again")
        columns.append(block.argmax(axis=1).astype(np.int32))
        n_rows += len(block)
    return np.concatenate(columns)


def row_blocks(path: Path, n_columns: int | None, where: str) -> Iterator[FloatArray]:
    """The rows of the dataset that is named like the file, in order, some at a time, in the file's precision.

    ``n_columns`` is None where any number of them will do.

    Raises ``DataError`` for a file that is missing, damaged, too short for what it promises, or of another form.
    """
    with _open_table(path, where) as table:
        _check_form(table, n_columns, path.stat().st_size, where)
        n_rows = max(1, BLOCK_BYTES // (table.shape[1] * table.dtype.itemsize))
        for start in range(0, len(table), n_rows):
            yield table[start : start + n_rows]


@contextmanager
def _open_table(path: Path, where: str) -> Iterator[Any]:
    """The h5py dataset; every error of the library inside the block comes out as a ``DataError``."""
    import h5py

    name = path.stem
    with reading(where, DataError):
        regular_path = regular(path)
    try:
        with h5py.File(regular_path, "r", locking="best-effort") as file:
            link = file.get(name, getlink=True) if name in file else None
            if link is not None and not isinstance(link, h5py.HardLink):
                raise DataError(f"{where}: '{name}' is a link; expected the data itself in this file")
            table = file[name] if link is not None else None
            if not isinstance(table, h5py.Dataset):
                raise DataError(f"{where}: has no dataset '{name}'; expected one named like the file")
            yield table
    except LIBRARY_ERRORS as error:
        raise DataError(f"{where}: not a readable HDF5 file ({type(error).__name__}); copy the file again") from error


def _check_form(table: Any, n_columns: int | None, file_bytes: int, where: str) -> None:
    dtype, shape = table.dtype, table.shape
    if table.external is not None or table.is_virtual:
        raise DataError(f"{where}: the values are in other files; expected them in this one")
    if table.chunks is not None:
        raise DataError(f"{where}: is stored in chunks or compressed; save it as one piece, as gradslam does")
    if dtype.kind != "f" or dtype.itemsize > 8:
        raise DataError(f"{where}: holds values of type {str(dtype)[:40]}; expected float16, float32 or float64")
    if shape is None or len(shape) != 2 or not 0 < shape[1] <= MAX_COLUMNS or n_columns not in (None, shape[1]):
        raise DataError(f"{where}: has the shape {str(shape)[:60]}; expected (N, {n_columns or 'D'})")
    n_bytes = shape[0] * shape[1] * dtype.itemsize
    if n_bytes > file_bytes or table.id.get_storage_size() != n_bytes:
        raise DataError(
            f"{where}: promises {shape[0]} rows of {shape[1]} values, {n_bytes} bytes, but the file has {file_bytes}; "
            "it is cut short or damaged"
        )
