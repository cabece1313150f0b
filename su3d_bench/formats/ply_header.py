"""The header of a PLY file: what it promises, read strictly."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import DataError

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
        case ["element", name, count] if _COUNT.fullmatch(count) and all(name != one.name for one in elements):
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
    if any(new.name == one.name for one in elements[-1].properties):
        raise DataError(f"{where}: property '{clip(new.name)}' of '{clip(elements[-1].name)}' stands there twice")
    elements[-1].properties.append(new)


def clip(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
