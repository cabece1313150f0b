"""One table of floats from an HDF5 file that anyone may have made: checked first, then read in blocks of rows.

The files are those of gradslam (``pc_points.h5``, ``pc_embeddings.h5``): one dataset at the root, named like the file.
Links out of the file, external and virtual storage, and filters other than gzip and shuffle are refused. What the
header promises is held against the size of the file before anything is allocated, and chunks are decompressed here
with a bound, because the library's own filters allocate whatever a stream expands to.
"""

from __future__ import annotations

import zlib
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
MOST_CHUNK_BYTES = 64 << 20  # chunks that h5py chooses itself stay below 1 MB
MOST_COLUMNS = 1 << 16  # of a table whose width is not known; features have some thousand
DEFLATE, SHUFFLE = 1, 2  # H5Z_FILTER_DEFLATE and H5Z_FILTER_SHUFFLE
# What h5py raises on damaged files; it has no base class of its own.
LIBRARY_ERRORS = (OSError, KeyError, ValueError, RuntimeError, TypeError, AttributeError)


def read_rows(path: Path, n_columns: int, where: str) -> Float32Array:
    """The whole table (N, ``n_columns``) as float32; ``where`` begins each message."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite
        blocks = [block.astype(np.float32) for block in row_blocks(path, n_columns, where)]
    table = np.empty((sum(map(len, blocks)), n_columns), np.float32)
    start = 0
    while blocks:  # each is let go as soon as it is copied
        block = blocks.pop(0)
        table[start : start + len(block)] = block
        start += len(block)
    return table


def largest_column(path: Path, n_columns: int, where: str) -> Int32Array:
    """The column (N,) of the first maximum of each row; a row of zeros gives 0, a NaN is a ``DataError``."""
    columns: list[Int32Array] = []
    n_rows = 0
    for block in row_blocks(path, n_columns, where):
        best = block.argmax(axis=1)
        # argmax takes the first NaN for the maximum
        is_nan = np.isnan(block[np.arange(len(block)), best])
        if is_nan.any():
            row = n_rows + int(np.flatnonzero(is_nan)[0])
            raise DataError(f"{where}: row {row} holds NaN; copy the file again")
        columns.append(best.astype(np.int32))
        n_rows += len(block)
    return np.concatenate([np.zeros(0, np.int32), *columns])


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
        if table.chunks is None:
            n_rows = max(1, BLOCK_BYTES // (n_columns * table.dtype.itemsize))
            for start in range(0, len(table), n_rows):
                yield table[start : start + n_rows]
        else:
            yield from _chunked_blocks(table, where)


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
    except (*LIBRARY_ERRORS, MemoryError) as error:
        raise DataError(f"{where}: not a readable HDF5 file ({type(error).__name__}); copy the file again") from error


def _check_form(table: Any, n_columns: int, file_bytes: int, where: str) -> None:
    dtype, shape, chunks = table.dtype, table.shape, table.chunks
    if table.external is not None or table.is_virtual:
        raise DataError(f"{where}: the values are in other files; expected them in this one")
    if dtype.kind != "f" or dtype.itemsize > 8:
        raise DataError(f"{where}: holds values of type {str(dtype)[:40]}; expected float16, float32 or float64")
    if shape is None or len(shape) != 2 or shape[1] != n_columns:
        raise DataError(f"{where}: has the shape {str(shape)[:60]}; expected (N, {n_columns})")
    unpacked = shape[0] * n_columns * dtype.itemsize
    at_most = file_bytes if chunks is None else Allowance(file_bytes).n_bytes
    if chunks is not None and unpacked <= at_most:
        chunk_bytes = int(np.prod([int(side) for side in chunks], dtype=object)) * dtype.itemsize
        if not 0 < chunk_bytes <= MOST_CHUNK_BYTES:
            raise DataError(
                f"{where}: is stored in chunks of {str(chunks)[:60]}; expected at most {MOST_CHUNK_BYTES} bytes each"
            )
        unpacked = -(-shape[0] // chunks[0]) * -(-n_columns // chunks[1]) * chunk_bytes
    if unpacked > at_most or (chunks is None and table.id.get_storage_size() != unpacked):
        raise DataError(
            f"{where}: promises {shape[0]} rows of {n_columns} values, {unpacked} bytes, but the file has "
            f"{file_bytes}; it is cut short or damaged, or unpacks to far more than it is: save it without compression"
        )
    if chunks is not None:
        for code, values in _filters(table):
            if code not in (DEFLATE, SHUFFLE) or (code == SHUFFLE and values[:1] != (dtype.itemsize,)):
                raise DataError(
                    f"{where}: is compressed with the filter {code} of HDF5; expected gzip, shuffle or none: save it "
                    "again with one of these"
                )


def _filters(table: Any) -> list[tuple[int, tuple[int, ...]]]:
    """Code and parameters of each filter, in the order in which they were applied."""
    pipeline = table.id.get_create_plist()
    filters = [pipeline.get_filter(index) for index in range(pipeline.get_nfilters())]
    return [(int(code), tuple(values)) for code, _, values, _ in filters]


def _chunked_blocks(table: Any, where: str) -> Iterator[FloatArray]:
    """One block for each row of chunks."""
    (n_rows, n_columns), (height, width) = table.shape, table.chunks
    codes = [code for code, _ in _filters(table)]
    stored: dict[tuple[int, ...], Any] = {}  # found in one pass: asked one by one, each takes as long as all
    table.id.chunk_iter(lambda one: stored.setdefault(tuple(one.chunk_offset), one) and None)
    for top in range(0, n_rows, height):
        block = np.empty((min(height, n_rows - top), n_columns), table.dtype)
        for left in range(0, n_columns, width):
            chunk = _chunk(table, (top, left), stored.get((top, left)), codes, where)
            part = block[:, left : left + width]
            part[:] = chunk[: part.shape[0], : part.shape[1]]
        yield block


def _chunk(table: Any, corner: tuple[int, int], stored: Any, codes: list[int], where: str) -> FloatArray:
    """The values of the chunk whose first value is at ``corner`` and whose bytes are where ``stored`` says."""
    n_bytes = table.chunks[0] * table.chunks[1] * table.dtype.itemsize
    # compression that gains nothing adds a little: zlib's bound is below a thousandth and 64 bytes
    if stored is None or stored.byte_offset is None or not 0 < stored.size <= n_bytes + n_bytes // 1000 + 64:
        raise DataError(f"{where}: the values from row {corner[0]} on are missing or damaged; copy the file again")
    skipped, content = table.id.read_direct_chunk(corner)
    for index, code in reversed(list(enumerate(codes))):
        if skipped >> index & 1:
            continue
        if code == DEFLATE:
            stream = zlib.decompressobj()
            try:
                content = stream.decompress(content, n_bytes + 1)
            except zlib.error:
                content = b""
        elif len(content) == n_bytes:
            planes = np.frombuffer(content, np.uint8).reshape(table.dtype.itemsize, -1)
            content = np.ascontiguousarray(planes.T).tobytes()
    if len(content) != n_bytes:
        raise DataError(f"{where}: the values from row {corner[0]} on are damaged; copy the file again")
    return np.frombuffer(content, table.dtype).reshape(table.chunks)
