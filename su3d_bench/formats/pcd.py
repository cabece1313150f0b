"""The points of a PCD file, whatever its form (ascii, binary or binary_compressed), and such a file of points.

Source: The PCD file format, version 0.7, of the Point Cloud Library. Nothing is allocated on the word of the header:
what it promises is held against the size of the file first.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, printable, reading
from su3d_bench.core.files.atomic import write_bytes
from su3d_bench.core.files.unpacking import Allowance, UnpackingError
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array

MOST_HEADER_BYTES = 1 << 16  # headers have some hundred
MOST_FIELDS, MOST_VALUES = 256, 1 << 16  # of a point; histograms of features have some hundred values
MOST_EXPANSION = 88  # of LZF: three bytes stand for at most 264
FORMS = ("ascii", "binary", "binary_compressed")
AXES = ("x", "y", "z")
TYPES = {f"{kind} {size}": f"<{code}{size}" for kind, code in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)}
TYPES |= {"F 4": "<f4", "F 8": "<f8"}
_NUMBER = re.compile(r"\d{1,12}")


@dataclass(frozen=True)
class Field:
    """A field of a point: its type and number of values; ``offset`` in bytes, ``first`` in values of the point."""

    name: str
    type: np.dtype[np.generic]
    count: int
    offset: int
    first: int


@dataclass(frozen=True)
class Header:
    fields: tuple[Field, ...]
    n_points: int
    form: str
    n_bytes: int

    @property
    def row_bytes(self) -> int:
        return sum(field.type.itemsize * field.count for field in self.fields)

    @property
    def row_values(self) -> int:
        return sum(field.count for field in self.fields)


def read_pcd_points(path: Path, where: str | None = None) -> Float64Array:
    """Coordinates (N, 3) of every point, NaN where an organised cloud has none; ``where`` begins each message.

    Raises ``DataError`` for a file that is missing, damaged, cut short or longer than its header says.
    """
    where = where or str(path)
    with reading(where, DataError):
        content = file_bytes(path)
    header = read_header(content, where)
    axes = [next((field for field in header.fields if field.name == axis), None) for axis in AXES]
    coordinates = [field for field in axes if field is not None and field.count == 1]
    if len(coordinates) != len(AXES):
        names = printable(", ".join(field.name for field in header.fields), 120)
        raise DataError(f"{where}: has the fields {names}; expected x, y and z, one value each")
    if header.form == "ascii":
        return _text_points(content, header, coordinates, where)
    if header.form == "binary":
        return _binary_points(content, header, coordinates, where)
    return _compressed_points(content, header, coordinates, where)


def read_header(content: bytes, where: str) -> Header:
    """What the lines up to ``DATA`` promise."""
    lines: dict[str, list[str]] = {}
    at, number = 0, 0
    while "DATA" not in lines:
        end = content.find(b"\n", at, MOST_HEADER_BYTES)
        if end < 0:
            raise DataError(f"{where}: not a PCD file, or cut short: its header has no line 'DATA'")
        words = content[at:end].decode("ascii", "replace").split()
        at, number = end + 1, number + 1
        if not words or words[0].startswith("#"):
            continue
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]  # the name before version 0.7
        if key not in {"VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}:
            raise DataError(f"{where}:{number}: '{printable(' '.join(words), 60)}' belongs in no PCD header")
        if lines.setdefault(key, words[1:]) is not words[1:] and lines[key] != words[1:]:
            raise DataError(f"{where}:{number}: '{key}' stands there twice; the file is damaged")
    form = " ".join(lines["DATA"])
    if form not in FORMS:
        raise DataError(f"{where}:{number}: DATA is '{printable(form, 60)}'; expected {', '.join(FORMS)}")
    return Header(_fields(lines, where), _n_points(lines, where), form, at)


def _fields(lines: dict[str, list[str]], where: str) -> tuple[Field, ...]:
    names = lines.get("FIELDS", [])
    sizes, kinds = lines.get("SIZE", []), lines.get("TYPE", [])
    counts = lines.get("COUNT", ["1"] * len(names))
    if not 0 < len(names) <= MOST_FIELDS or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise DataError(
            f"{where}: FIELDS, SIZE, TYPE and COUNT have {len(names)}, {len(sizes)}, {len(kinds)} and {len(counts)} "
            "entries; the file is damaged"
        )
    fields: list[Field] = []
    offset = first = 0
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        n = int(count) if _NUMBER.fullmatch(count) else 0
        if f"{kind} {size}" not in TYPES or not 0 < n <= MOST_VALUES:
            raise DataError(
                f"{where}: field '{printable(name, 60)}' has TYPE {printable(kind, 60)}, SIZE "
                f"{printable(size, 60)}, COUNT {printable(count, 60)}; the file is damaged"
            )
        if name in AXES and any(name == field.name for field in fields):
            raise DataError(f"{where}: field '{name}' stands there twice; the file is damaged")
        field = Field(name, np.dtype(TYPES[f"{kind} {size}"]), n, offset, first)
        fields.append(field)
        offset, first = offset + n * field.type.itemsize, first + n
    return tuple(fields)


def _n_points(lines: dict[str, list[str]], where: str) -> int:
    numbers = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        words = lines.get(key, [])
        if len(words) == 1 and _NUMBER.fullmatch(words[0]):
            numbers[key] = int(words[0])
        elif words or key != "POINTS":
            raise DataError(f"{where}: {key} is '{printable(' '.join(words), 60)}'; expected a number")
    n = numbers["WIDTH"] * numbers["HEIGHT"]
    if numbers.get("POINTS", n) != n:
        raise DataError(f"{where}: POINTS is {numbers['POINTS']}, WIDTH times HEIGHT is {n}; the file is damaged")
    return n


def _text_points(content: bytes, header: Header, axes: list[Field], where: str) -> Float64Array:
    promised, body = header.n_points * header.row_values, content[header.n_bytes :].strip()
    if promised > len(body):
        raise _too_short(promised, len(body), "values", "characters", where)
    try:
        values: Float64Array = np.fromstring(body, np.float64, sep=" ") if body else np.zeros(0)
    except ValueError as error:
        raise DataError(f"{where}: holds something that is no number among its points; the file is damaged") from error
    if len(values) != promised:
        raise _too_short(promised, len(values), "values", "values", where)
    table = values.reshape(header.n_points, header.row_values)
    return np.ascontiguousarray(table[:, [field.first for field in axes]])


def _binary_points(content: bytes, header: Header, axes: list[Field], where: str) -> Float64Array:
    promised, there = header.n_points * header.row_bytes, len(content) - header.n_bytes
    if promised > there or content[header.n_bytes + promised :].strip(b"\0\r\n\t "):
        raise _too_short(promised, there, "bytes", "bytes", where)
    columns = []
    for field in axes if header.n_points else []:
        start = header.n_bytes + field.offset
        columns.append(np.ndarray(header.n_points, field.type, content, start, (header.row_bytes,)))
    return _table(columns)


def _compressed_points(content: bytes, header: Header, axes: list[Field], where: str) -> Float64Array:
    """From a body of LZF, in which the values stand field by field."""
    promised, at = header.n_points * header.row_bytes, header.n_bytes + 8
    n_packed = int.from_bytes(content[header.n_bytes : at - 4], "little")
    n_plain = int.from_bytes(content[at - 4 : at], "little")
    if len(content) < at or n_packed > len(content) - at or content[at + n_packed :].strip(b"\0\r\n\t "):
        raise _too_short(n_packed, len(content) - at, "packed bytes", "bytes", where)
    if n_plain != promised or n_plain > n_packed * MOST_EXPANSION:
        raise _too_short(promised, n_plain, "bytes", f"bytes out of {n_packed} packed ones", where)
    try:
        Allowance(len(content)).spend(n_plain + header.n_points * len(AXES) * np.dtype(np.float64).itemsize)
    except UnpackingError as error:
        raise DataError(f"{where}: {error}") from error
    plain = _inflated(np.frombuffer(content, np.uint8, n_packed, at), n_plain)
    if plain is None:
        raise DataError(f"{where}: its compressed points are damaged; copy the file again")
    n = header.n_points
    return _table([np.frombuffer(plain, field.type, n, field.offset * n) for field in (axes if n else [])])


def _table(columns: list[NDArray[Any]]) -> Float64Array:
    """The columns side by side; none of them, no point."""
    with np.errstate(invalid="ignore"):  # NaN of any kind is NaN
        return np.stack([column.astype(np.float64) for column in columns], axis=1) if columns else np.zeros((0, 3))


def _inflated(packed: UInt8Array, n_plain: int) -> UInt8Array | None:
    """The ``n_plain`` bytes that LZF packed; None where it packed anything else."""
    from su3d_bench.formats.pcd_kernels import inflate

    plain = np.zeros(n_plain, np.uint8)
    return plain if inflate(packed, plain) == n_plain else None


def _too_short(promised: int, there: int, unit: str, unit_there: str, where: str) -> DataError:
    return DataError(
        f"{where}: the header promises {promised} {unit}, the file has {there} {unit_there}; it is cut short or damaged"
    )


def write_pcd_points(path: Path, points: Float32Array) -> None:
    """Write points (N, 3) as a binary PCD file, whole or not at all."""
    n = len(points)
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F"]
    lines += ["COUNT 1 1 1", f"WIDTH {n}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {n}", "DATA binary", ""]
    write_bytes(path, "\n".join(lines).encode() + np.ascontiguousarray(points, "<f4").tobytes())
