"""The rows of a PLY file behind its header: bytes of a binary file or values of a text file, addressed alike."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int64Array

ByteOrder = Literal["<", ">"]
BYTE_ORDERS: dict[str, ByteOrder] = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
NAMES_OF_TYPES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
TYPES = {name: np.dtype(code) for code, names in NAMES_OF_TYPES.items() for name in names}
MAX_HEADER_BYTES = 1 << 20  # headers have a few hundred
_COUNT = re.compile(r"\d{1,18}")


@dataclass(frozen=True)
class Property:
    """A property as the header promises it; ``count_type`` None for a scalar."""

    name: str
    type: np.dtype[Any]
    count_type: np.dtype[Any] | None


@dataclass(frozen=True)
class Promise:
    """An element as the header promises it."""

    name: str
    n_rows: int
    properties: list[Property]


@dataclass(frozen=True)
class Header:
    format: str
    comments: tuple[str, ...]
    elements: tuple[Promise, ...]
    n_bytes: int
    n_lines: int


def read_header(content: bytes, where: str) -> Header:
    if not re.match(rb"ply[ \t]*\r?\n", content):
        raise DataError(f"{where}: not a PLY file; its first line is not 'ply'")
    position, n_lines, format_name = content.index(b"\n") + 1, 1, ""
    comments: list[str] = []
    elements: list[Promise] = []
    while True:
        end = content.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise DataError(f"{where}: its header has no 'end_header'; the file is cut short or damaged")
        line = content[position:end].decode("utf-8", "replace").strip()
        position, n_lines = end + 1, n_lines + 1
        words = line.split()
        if words == ["end_header"]:
            break
        if words[:1] in (["comment"], ["obj_info"]):
            comments.append(line.partition(" ")[2])
        elif words[:1] == ["format"] and len(words) == 3 and not format_name:
            format_name = _known_format(words, f"{where}:{n_lines}")
        else:
            _read_promise(words, elements, f"{where}:{n_lines}", line)
    if not format_name:
        raise DataError(f"{where}: its header names no format; expected one of {', '.join(BYTE_ORDERS)}")
    return Header(format_name, tuple(comments), tuple(elements), position, n_lines)


def _known_format(words: Sequence[str], where: str) -> str:
    if words[1] not in BYTE_ORDERS or words[2] != "1.0":
        raise DataError(f"{where}: format '{clip(' '.join(words[1:]))}'; known: {', '.join(BYTE_ORDERS)}, all 1.0")
    return words[1]


def _read_promise(words: Sequence[str], elements: list[Promise], where: str, line: str) -> None:
    """Add what one ``element`` or ``property`` line promises to ``elements``."""
    match words:
        case ["element", name, count] if _COUNT.fullmatch(count) and all(name != known.name for known in elements):
            elements.append(Promise(name, int(count), []))
            return
        case ["property", kind, name] if kind in TYPES and elements:
            new = Property(name, TYPES[kind], None)
        case ["property", "list", counts, kind, name] if counts in TYPES and kind in TYPES and elements:
            new = Property(name, TYPES[kind], TYPES[counts])
        case _:
            raise DataError(f"{where}: header line '{clip(line)}' is not PLY; the file is damaged")
    if new.count_type is not None and new.count_type.kind == "f":
        raise DataError(f"{where}: list '{clip(new.name)}' counts its items in '{words[2]}'; expected an integer type")
    if any(new.name == known.name for known in elements[-1].properties):
        raise DataError(f"{where}: property '{clip(new.name)}' of '{clip(elements[-1].name)}' stands there twice")
    elements[-1].properties.append(new)


def clip(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."


AnyArray = NDArray[Any]


class UnfitValueError(ValueError):
    """A text value that its property's type cannot hold, at ``index`` among those asked for."""

    def __init__(self, index: int, value: float) -> None:
        super().__init__(f"{value:g}")
        self.index = index


class BinaryBody:
    """The rows of a binary file, addressed in bytes."""

    unit = "bytes"

    def __init__(self, content: bytes, header: Header) -> None:
        self._content = content
        self._bytes = np.frombuffer(content, np.uint8)
        self._order = BYTE_ORDERS[header.format]
        self.start, self.n_units = header.n_bytes, len(content)

    def size(self, kind: np.dtype[Any]) -> int:
        """Units of one value."""
        return kind.itemsize

    def count(self, at: int, kind: np.dtype[Any]) -> int:
        """The list length at ``at``; -1 where there is none."""
        order: Literal["little", "big"] = "little" if self._order == "<" else "big"
        return int.from_bytes(self._content[at : at + kind.itemsize], order, signed=kind.kind == "i")

    def strided(self, at: int, stride: int, n_rows: int, n_values: int, kind: np.dtype[Any]) -> AnyArray:
        """Values (n_rows, n_values) that begin at ``at`` and again every ``stride`` units."""
        stored = kind.newbyteorder(self._order)
        shape, strides = (n_rows, n_values), (stride, kind.itemsize)
        if n_rows * n_values == 0:
            return np.zeros(shape, kind)
        return np.ndarray(shape, stored, self._content, at, strides).astype(kind)

    def gathered(self, starts: Int64Array, kind: np.dtype[Any]) -> AnyArray:
        """One value at each of ``starts``."""
        raw = np.empty((len(starts), kind.itemsize), np.uint8)
        for byte in range(kind.itemsize):
            raw[:, byte] = self._bytes[starts + byte]
        return raw.view(kind.newbyteorder(self._order)).reshape(-1).astype(kind)

    def n_left_over(self, at: int) -> int:
        """Units from ``at`` on that are not mere white space."""
        return len(self._content[at:].strip())


class TextBody:
    """Values of a text file as float64, which holds every PLY type exactly."""

    unit = "values"

    def __init__(self, content: bytes, header: Header, where: str) -> None:
        text = content[header.n_bytes :].strip()
        try:
            # numpy answers -1 for a text without values
            self._values: Float64Array = np.fromstring(text, np.float64, sep=" ") if text else np.zeros(0)
        except ValueError as error:
            raise DataError(f"{where}{_place_of_stranger(content, header)}; the file is damaged") from error
        self.start, self.n_units = 0, len(self._values)

    def size(self, kind: np.dtype[Any]) -> int:
        return 1

    def count(self, at: int, kind: np.dtype[Any]) -> int:
        value = float(self._values[at])
        return int(value) if value.is_integer() and value <= np.iinfo(kind).max else -1

    def strided(self, at: int, stride: int, n_rows: int, n_values: int, kind: np.dtype[Any]) -> AnyArray:
        if n_rows * n_values == 0:
            return np.zeros((n_rows, n_values), kind)
        step = self._values.itemsize
        shape, strides = (n_rows, n_values), (stride * step, step)
        return self._typed(np.ndarray(shape, np.float64, self._values.data, at * step, strides), kind)

    def gathered(self, starts: Int64Array, kind: np.dtype[Any]) -> AnyArray:
        return self._typed(self._values[starts], kind)

    def n_left_over(self, at: int) -> int:
        return self.n_units - at

    def _typed(self, values: Float64Array, kind: np.dtype[Any]) -> AnyArray:
        with np.errstate(over="ignore", invalid="ignore"):
            typed: AnyArray = values.astype(kind)
            is_unfit = typed.astype(np.float64) != values if kind.kind != "f" else np.isinf(typed) & np.isfinite(values)
        if is_unfit.any():
            index = int(np.flatnonzero(is_unfit)[0])
            raise UnfitValueError(index, float(values.reshape(-1)[index]))
        return typed


def _place_of_stranger(content: bytes, header: Header) -> str:
    """A clause for the first word of the body that is no number, with its line."""
    for number, line in enumerate(content[header.n_bytes :].splitlines(), header.n_lines + 1):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return f":{number}: '{clip(word.decode('utf-8', 'replace'))}' is not a number"
    return ": it holds something that is not a number"


Body = BinaryBody | TextBody
