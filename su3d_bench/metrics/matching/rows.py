"""Distinct rows of arrays: their numbers, and the first of each."""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array, IntArray


def row_ids(rows: Int64Array | Float64Array) -> Int64Array:
    """One number, from 0, per distinct row, without the slow comparison of whole rows in numpy's unique.

    >>> row_ids(np.array([[1, 5], [0, 5], [1, 5], [0, 6]])).tolist()
    [1, 0, 1, 2]
    """
    if (keys := _packed(rows)) is not None:
        return np.unique(keys, return_inverse=True)[1]
    order = np.lexsort(rows.T)
    is_new = np.any(np.diff(rows[order], axis=0) != 0, axis=1)
    ids = np.zeros(len(rows), np.int64)
    ids[order[1:]] = np.cumsum(is_new)
    return ids


def rows_of(ids: IntArray, values: IntArray) -> Int64Array:
    """The row in ascending ``ids`` of each of ``values`` (N,), -1 if it is not among them.

    >>> rows_of(np.array([3, 7]), np.array([7, 0, 3, 9])).tolist()
    [1, -1, 0, -1]
    """
    known = np.append(ids, np.iinfo(np.int64).max).astype(np.int64)
    row = np.searchsorted(known, values)
    return np.where((known[row] == values) & (row < len(ids)), row, -1)


def _packed(rows: Int64Array | Float64Array) -> Int64Array | None:
    """One number per row of integers, in the order of the rows from the last column; None if 63 bits are too few."""
    if not len(rows) or rows.dtype.kind not in "iu":
        return None
    lows = [int(column.min()) for column in rows.T]  # column by column: numpy is slow along short rows
    spans = [int(column.max()) - low + 1 for column, low in zip(rows.T, lows, strict=True)]
    if math.prod(spans) >= 1 << 63:
        return None
    keys = np.zeros(len(rows), np.int64)
    for column, low, span in reversed(list(zip(rows.T, lows, spans, strict=True))):
        keys *= span
        keys += column - low
    return keys


def first_rows(rows: Int64Array) -> Int64Array:
    """The first of each distinct row, in the order of ``row_ids``.

    >>> first_rows(np.array([[1, 5], [0, 5], [1, 5], [0, 6]])).tolist()
    [1, 0, 3]
    """
    keys = _packed(rows)
    keys = row_ids(rows) if keys is None else keys
    n_bits = len(keys).bit_length()
    if int(keys.max(initial=0)).bit_length() + n_bits > 63:
        return np.unique(keys, return_index=True)[1]
    # a key and its index in one number: sorting plain numbers takes half the time of an argsort
    ordered = np.sort((keys << n_bits) | np.arange(len(keys)))
    is_first = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:] >> n_bits, ordered[:-1] >> n_bits, out=is_first[1:])
    return ordered[is_first] & ((1 << n_bits) - 1)
