"""PLY files, read and written whole: every element and every property, lists of any length among them.

Libraries that show meshes keep vertices and faces and drop the rest in silence, a face's ``object_id`` first of all.
Formats ascii, binary_little_endian and binary_big_endian, version 1.0, with the eight scalar types under both their
names (``uchar``, ``uint8``). Source: Greg Turk, The PLY Polygon File Format, 1994.

Nothing is allocated on the word of the header: what it promises is held against the size of the file first.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.files.atomic import write_bytes
from su3d_bench.core.system.files import file_bytes, opened
from su3d_bench.core.types import Int64Array
from su3d_bench.formats.ply_parts import (
    NAMES_OF_TYPES,
    BinaryBody,
    Body,
    Promise,
    Property,
    TextBody,
    UnfitValueError,
    clip,
    read_header,
)

AnyArray = NDArray[Any]
FIRST_BYTES = 1 << 20


@dataclass(frozen=True)
class ListColumn:
    """A list property: row i is ``values[indptr[i]:indptr[i + 1]]``; ``count_type`` is the type of its lengths."""

    indptr: Int64Array
    values: AnyArray
    count_type: np.dtype[Any] = field(default_factory=lambda: np.dtype(np.uint8))

    def __len__(self) -> int:
        return len(self.indptr) - 1

    @property
    def lengths(self) -> Int64Array:
        return np.diff(self.indptr)


Column = NDArray[Any] | ListColumn


@dataclass(frozen=True)
class PlyElement:
    """One element: its name, its number of rows, and its properties in the order of the file."""

    name: str
    n_rows: int
    columns: Mapping[str, Column]


@dataclass(frozen=True)
class PlyFile:
    """A PLY file: ``format``, comments, and elements in the order of the file."""

    format: str
    comments: tuple[str, ...]
    elements: tuple[PlyElement, ...]

    def element(self, name: str) -> PlyElement | None:
        """The element of that name, None where there is none."""
        return next((element for element in self.elements if element.name == name), None)


def read_ply(path: Path, where: str | None = None) -> PlyFile:
    """Every element of a PLY file, in native byte order; ``where`` (default: the path) begins each message.

    Raises ``DataError`` for a file that is missing, damaged, cut short or longer than its header says.
    """
    where = where or str(path)
    with reading(where, DataError):
        content = file_bytes(path)
    header = read_header(content, where)
    body = TextBody(content, header, where) if header.format == "ascii" else BinaryBody(content, header)
    at, elements = body.start, []
    for promised in header.elements:
        element, at = _read_element(promised, body, at, where)
        elements.append(element)
    if left := body.n_left_over(at):
        raise DataError(
            f"{where}: {left} {body.unit} stand after the last element that the header names; it is damaged"
        )
    return PlyFile(header.format, header.comments, tuple(elements))


def first_rows(path: Path, name: str) -> dict[str, AnyArray]:
    """The columns of the first rows of the element ``name``, as many as the first megabyte of the file holds.

    Empty where the element is not the first of a binary file or has lists. Raises as ``read_ply`` does.
    """
    where = str(path)
    with reading(where, DataError), opened(path) as file:
        content = file.read(FIRST_BYTES)
    header = read_header(content, where)
    promise = header.elements[0] if header.elements else None
    is_plain = promise is not None and all(column.count_type is None for column in promise.properties)
    if promise is None or promise.name != name or not promise.properties or not is_plain or header.format == "ascii":
        return {}
    body = BinaryBody(content, header)
    stride = sum(body.size(column.type) for column in promise.properties)
    n_rows = min(promise.n_rows, (body.n_units - body.start) // stride)
    columns, _ = _equal_columns(Promise(name, n_rows, promise.properties), body, body.start) or ({}, 0)
    return {key: column for key, column in columns.items() if isinstance(column, np.ndarray)}


def _read_element(promise: Promise, body: Body, at: int, where: str) -> tuple[PlyElement, int]:
    """The element whose first row is at ``at``, and where the next element begins."""
    where = f"{where}: element '{clip(promise.name)}'"
    smallest = sum(body.size(column.count_type or column.type) for column in promise.properties)
    if promise.n_rows * smallest > body.n_units - at:
        raise DataError(
            f"{where}: the header promises {promise.n_rows} rows of {smallest} or more {body.unit}, but only "
            f"{body.n_units - at} are left; the file is cut short or damaged"
        )
    if not promise.properties:
        return PlyElement(promise.name, promise.n_rows, {}), at
    columns, end = _equal_columns(promise, body, at) or _walked_columns(promise, body, at, where)
    return PlyElement(promise.name, promise.n_rows, columns), end


def _equal_columns(promise: Promise, body: Body, at: int) -> tuple[dict[str, Column], int] | None:
    """The columns where each list is in all rows as long as in the first; None where one is not or a value is unfit."""
    columns: dict[str, Column] = {}
    n, lengths = promise.n_rows, _first_lengths(promise, body, at)
    stride = sum(_n_units(column, body, length) for column, length in zip(promise.properties, lengths, strict=False))
    if len(lengths) < len(promise.properties) or n * stride > body.n_units - at:
        return None
    offset = at
    try:
        for column, length in zip(promise.properties, lengths, strict=True):
            if column.count_type is None:
                columns[column.name] = body.strided(offset, stride, n, 1, column.type)[:, 0]
            elif (body.strided(offset, stride, n, 1, column.count_type) != length).any():
                return None
            else:
                values = body.strided(offset + body.size(column.count_type), stride, n, length, column.type)
                columns[column.name] = ListColumn(np.arange(n + 1) * length, values.reshape(-1), column.count_type)
            offset += _n_units(column, body, length)
    except UnfitValueError:
        return None
    return columns, at + n * stride


def _n_units(column: Property, body: Body, length: int) -> int:
    """Units that a property takes up in a row, a list of ``length`` items."""
    return (
        body.size(column.type)
        if column.count_type is None
        else body.size(column.count_type) + length * body.size(column.type)
    )


def _first_lengths(promise: Promise, body: Body, at: int) -> list[int]:
    """Items of each list (0 for scalars) in the row at ``at``; fewer entries where they cannot be read."""
    lengths: list[int] = []
    for column in promise.properties:
        length = 0
        if column.count_type is not None and promise.n_rows > 0:
            is_there = at + body.size(column.count_type) <= body.n_units
            length = body.count(at, column.count_type) if is_there else -1
        if length < 0:
            break
        lengths.append(length)
        at += _n_units(column, body, length)
    return lengths


def _walked_columns(promise: Promise, body: Body, at: int, where: str) -> tuple[dict[str, Column], int]:
    """The columns of rows that differ in size, found by going through them one by one."""
    starts, lengths, end = _walk(promise, body, at, where)
    columns: dict[str, Column] = {}
    for column, n_items in zip(promise.properties, lengths, strict=True):
        try:
            if column.count_type is None:
                indptr = np.arange(promise.n_rows + 1)
                columns[column.name] = body.gathered(starts, column.type)
                starts = starts + body.size(column.type)
                continue
            indptr = np.concatenate([[0], np.cumsum(n_items)])
            starts = starts + body.size(column.count_type)
            step = body.size(column.type)
            items = np.repeat(starts - indptr[:-1] * step, n_items) + np.arange(indptr[-1]) * step
            columns[column.name] = ListColumn(indptr, body.gathered(items, column.type), column.count_type)
            starts = starts + n_items * step
        except UnfitValueError as error:
            row = int(np.searchsorted(indptr, error.index, side="right")) - 1
            raise DataError(
                f"{where} row {row}: '{clip(column.name)}' is {error}, which {column.type} cannot hold"
            ) from error
    return columns, end


def _walk(promise: Promise, body: Body, at: int, where: str) -> tuple[Int64Array, list[Int64Array], int]:
    """Where each row begins, the list lengths of each property (none for scalars), and where the last row ends."""
    starts = array("q")
    lengths = [array("q") for _ in promise.properties]
    sizes = [body.size(column.type) for column in promise.properties]
    for row in range(promise.n_rows):
        starts.append(at)
        for column, size, known in zip(promise.properties, sizes, lengths, strict=True):
            if column.count_type is None:
                at += size
                continue
            behind = at + body.size(column.count_type)
            length = body.count(at, column.count_type) if behind <= body.n_units else 0
            if length < 0:
                raise DataError(
                    f"{where} row {row}: list '{clip(column.name)}' has no valid length; the file is damaged"
                )
            known.append(length)
            at = behind + length * size
        if at > body.n_units:
            raise DataError(
                f"{where} row {row} of {promise.n_rows}: the file ends in the middle of it; it is cut short or damaged"
            )
    return np.array(starts, np.int64), [np.array(known, np.int64) for known in lengths], at


def write_ply(path: Path, elements: Sequence[PlyElement]) -> None:
    """Write ``elements`` in little-endian bytes, whole or not at all; the types of the arrays are those of the file."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element in elements:
        lines.append(f"element {element.name} {element.n_rows}")
        lines += [_property_line(name, column) for name, column in element.columns.items()]
        assert all(len(column) == element.n_rows for column in element.columns.values()), element.name
    header = "\n".join([*lines, "end_header", ""]).encode()
    write_bytes(path, header + b"".join(map(_rows, elements)))


def _property_line(name: str, column: Column) -> str:
    if isinstance(column, ListColumn):
        return f"property list {_type_name(column.count_type)} {_type_name(column.values.dtype)} {name}"
    return f"property {_type_name(column.dtype)} {name}"


def _type_name(kind: np.dtype[Any]) -> str:
    return NAMES_OF_TYPES[kind.newbyteorder("=").str[1:]][0]


def _rows(element: PlyElement) -> bytes:
    """The rows of an element, each value scattered to its place."""
    sizes = np.zeros(element.n_rows, np.int64)
    for column in element.columns.values():
        if isinstance(column, ListColumn):
            sizes += column.count_type.itemsize + column.lengths * column.values.itemsize
        else:
            sizes += column.itemsize
    starts = np.cumsum(sizes) - sizes
    out = np.empty(int(sizes.sum()), np.uint8)
    for column in element.columns.values():
        if isinstance(column, ListColumn):
            lengths, step = column.lengths, column.values.itemsize
            assert lengths.max(initial=0) <= np.iinfo(column.count_type).max, "the count type cannot hold the lengths"
            _scatter(out, starts, lengths.astype(column.count_type))
            starts = starts + column.count_type.itemsize
            items = np.repeat(starts - column.indptr[:-1] * step, lengths) + np.arange(len(column.values)) * step
            _scatter(out, items, column.values)
            starts = starts + lengths * step
        else:
            _scatter(out, starts, column)
            starts = starts + column.itemsize
    return out.tobytes()


def _scatter(out: NDArray[np.uint8], starts: Int64Array, values: AnyArray) -> None:
    raw = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).view(np.uint8).reshape(-1, values.itemsize)
    for byte in range(values.itemsize):
        out[starts + byte] = raw[:, byte]
