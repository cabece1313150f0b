"""One table of floats from an HDF5 file that anyone may have made: checked first, then read in blocks of rows.

The files are those of gradslam (``pc_points.h5``, ``pc_embeddings.h5``): one dataset at the root, named like the file.
Links out of the file, external and virtual storage, and filters other than gzip and shuffle are refused, and what the
header promises is compared with the size of the file before h5py allocates anything.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.files.unpacking import Allowance
from su3d_bench.core.system.files import regular
from su3d_bench.core.types import Float32Array, Int32Array

FloatArray = NDArray[np.floating[Any]]
BLOCK_BYTES = 16 << 20
MOST_CHUNK_BYTES = 1 << 20  # of a packed chunk, as h5py chooses them: HDF5 unpacks one to 1032 times its bytes
MOST_COLUMNS = 1 << 16  # of a table whose width is not known; features have some thousand
FILTERS = {1, 2}  # H5Z_FILTER_DEFLATE and H5Z_FILTER_SHUFFLE
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


def n_columns_of(path: Path, where: str) -> int:
    """How many values a row of the table has, at least one."""
    with _open_table(path, where) as table:
        shape = table.shape
        if shape is None or len(shape) != 2 or not 0 < shape[1] <= MOST_COLUMNS:
            raise DataError(f"{where}: has the shape {str(shape)[:60]}; expected (N, D), D at most {MOST_COLUMNS}")
        return int(shape[1])


def row_blocks(path: Path, n_columns: int, where: str) -> Iterator[FloatArray]:
    """The rows of the dataset that is named like the file, in order, some at a time, in the file's precision.

    Raises ``DataError`` for a file that is missing, damaged, too short for what it promises, or of another form.
    """
    with _open_table(path, where) as table:
        _check_form(table, n_columns, path.stat().st_size, where)
        height = 1 if table.chunks is None else table.chunks[0]
        n_rows = max(1, BLOCK_BYTES // (n_columns * table.dtype.itemsize) // height) * height
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


def _check_form(table: Any, n_columns: int, file_bytes: int, where: str) -> None:
    dtype, shape, chunks = table.dtype, table.shape, table.chunks
    if table.external is not None or table.is_virtual:
        raise DataError(f"{where}: the values are in other files; expected them in this one")
    if dtype.kind != "f" or dtype.itemsize > 8:
        raise DataError(f"{where}: holds values of type {str(dtype)[:40]}; expected float16, float32 or float64")
    if shape is None or len(shape) != 2 or shape[1] != n_columns:
        raise DataError(f"{where}: has the shape {str(shape)[:60]}; expected (N, {n_columns})")
    n_bytes = shape[0] * n_columns * dtype.itemsize
    if chunks is None:
        is_whole = n_bytes <= file_bytes and table.id.get_storage_size() == n_bytes
    else:
        chunk_bytes = int(np.prod([int(side) for side in chunks], dtype=object)) * dtype.itemsize
        _check_filters(table, chunk_bytes, where)
        n_chunks = -(-shape[0] // chunks[0]) * -(-n_columns // chunks[1])
        stored: list[int] = []
        if is_whole := n_chunks * chunk_bytes <= Allowance(file_bytes).n_bytes:
            table.id.chunk_iter(lambda one: stored.append(one.size))
            # compression that gains nothing adds a little: zlib's bound is below a thousandth and 64 bytes
            is_whole = len(stored) == n_chunks and max(stored, default=0) <= chunk_bytes + chunk_bytes // 1000 + 64
    if not is_whole:
        raise DataError(
            f"{where}: promises {shape[0]} rows of {n_columns} values, {n_bytes} bytes, but the file has "
            f"{file_bytes}; it is cut short or damaged, or unpacks to far more than it is: save it without compression"
        )


def _check_filters(table: Any, chunk_bytes: int, where: str) -> None:
    pipeline = table.id.get_create_plist()
    codes = {int(pipeline.get_filter(index)[0]) for index in range(pipeline.get_nfilters())}
    if not codes <= FILTERS or (codes and not 0 < chunk_bytes <= MOST_CHUNK_BYTES):
        raise DataError(
            f"{where}: is compressed with filters {sorted(codes)} of HDF5 in chunks of {chunk_bytes} bytes; expected "
            f"gzip, shuffle or none in chunks of at most {MOST_CHUNK_BYTES >> 10} KiB: save it without compression"
        )
