"""Arrays out of .npy and .npz files, without NumPy's pickle, sizes held against what is there."""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, reading, shown
from su3d_bench.core.files.unpacking import Allowance, UnpackingError, allowance_of, member_bytes
from su3d_bench.core.system.files import file_bytes, opened
from su3d_bench.formats.pickles.pickle_constructors import MOST_DIMENSIONS, SIMPLE_TYPE, RefusedError, check_texts
from su3d_bench.formats.pickles.pickles import read_pickle

# What zipfile raises on a damaged archive; RuntimeError is its answer to a compression that it does not know.
ZIP_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError, struct.error)


@contextmanager
def opened_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive at ``path``; damage, inside the block too, is a ``PredictionError`` that names the file."""
    try:
        with opened(path) as stream, zipfile.ZipFile(stream) as archive:
            yield archive
    except OSError as error:
        raise PredictionError(f"{shown(path)}: cannot be read: {error.strerror or 'wrong offsets'}") from error
    except ZIP_DAMAGE as error:
        raise PredictionError(f"{shown(path)}: not a whole zip archive; copy the file again") from error


def read_member(archive: zipfile.ZipFile, name: str, where: str, allowance: Allowance) -> bytes:
    """The content of a member, stored or deflated, with its checksum held against it."""
    try:
        info = archive.getinfo(name)
    except KeyError as error:
        raise PredictionError(f"{where}: '{name}' is not in the archive") from error
    name = printable(name, 80)
    try:
        content = member_bytes(archive, info, allowance)
    except UnpackingError as error:
        raise PredictionError(f"{where}: {error}") from error
    if len(content) != info.file_size:
        raise PredictionError(f"{where}: '{name}' has {len(content)} of {info.file_size} bytes; copy the file again")
    return content


MAGIC = b"\x93NUMPY"
MOST_HEADER = 10_000  # NumPy's own limit
DESCR = re.compile(rb"'descr':\s*'([^']{1,16})'")
ORDER = re.compile(rb"'fortran_order':\s*(True|False)")
SHAPE = re.compile(rb"'shape':\s*\(([0-9L,\s]{0,250})\)")
SIZE = re.compile(rb"\d+")
MOST_DIGITS = 18  # of a size


@dataclass(frozen=True)
class NpyHeader:
    """What stands before the values: type code, order, shape, and where the values begin."""

    code: str
    is_fortran: bool
    shape: tuple[int, ...]
    start: int

    @property
    def is_object(self) -> bool:
        return self.code.lstrip("<>|=").startswith("O")


def npy_header(content: bytes) -> NpyHeader | None:
    """The header of a .npy file out of its first bytes; None where it is none of plain numbers, texts or objects."""
    if content[:6] != MAGIC or len(content) < 12:
        return None
    width = 2 if content[6] == 1 else 4
    start = 8 + width + int.from_bytes(content[8 : 8 + width], "little")
    text = content[8 + width : start]
    matches = DESCR.search(text), ORDER.search(text), SHAPE.search(text)
    if start > min(len(content), MOST_HEADER) or matches[0] is None or matches[1] is None or matches[2] is None:
        return None
    code = matches[0][1].decode("latin1")
    sizes = SIZE.findall(matches[2][1])
    is_odd = len(sizes) > MOST_DIMENSIONS or any(len(size) > MOST_DIGITS for size in sizes)
    if SIMPLE_TYPE.fullmatch(code) is None or is_odd:
        return None
    return NpyHeader(code, matches[1][1] == b"True", tuple(map(int, sizes)), start)


def npy_header_of(path: Path) -> NpyHeader | None:
    """``npy_header`` of a file; None where it cannot be read."""
    try:
        with opened(path) as stream:
            return npy_header(stream.read(MOST_HEADER))
    except OSError:
        return None


def read_npy(path: Path) -> NDArray[Any]:
    """The array of a .npy file of numbers or texts."""
    return npy_array(_content(path), shown(path))


def read_npy_value(path: Path) -> object:
    """The value that ``numpy.save`` pickled into a .npy file of objects, such as a dict; see ``read_pickle``."""
    content = _content(path)
    header = _header(content, shown(path))
    if not header.is_object:
        raise PredictionError(f"{shown(path)}: holds an array of {header.code}; expected a pickled value")
    stream = io.BytesIO(content)
    stream.seek(header.start)
    return read_pickle(stream, len(content) - header.start, shown(path))


def npz_names(path: Path) -> tuple[str, ...]:
    """The names of the arrays in a .npz file; none where it is not a readable archive."""
    try:
        with opened_zip(path) as archive:
            return tuple(name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy"))
    except PredictionError:
        return ()


def read_npz(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file, those in ``names`` that are there, or all."""
    with opened_zip(path) as archive:
        there = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        chosen = [name for name in there if names is None or name in names]
        where, allowance = shown(path), allowance_of(archive)
        members = {name: read_member(archive, f"{name}.npy", where, allowance) for name in chosen}
    return {name: npy_array(content, f"{where}: '{printable(name, 80)}'") for name, content in members.items()}


def npy_array(content: bytes, where: str) -> NDArray[Any]:
    """The array in the bytes of a .npy file, read-only over them."""
    header = _header(content, where)
    if header.is_object:
        raise PredictionError(f"{where}: holds pickled Python objects, which are not read; write numbers")
    dtype, n = np.dtype(header.code), math.prod(header.shape)
    n_bytes = len(content) - header.start
    if n * dtype.itemsize != n_bytes or dtype.itemsize == 0:
        raise PredictionError(
            f"{where}: an array of shape {header.shape} {dtype.name} needs {n * dtype.itemsize} bytes, "
            f"{n_bytes} are there; copy the file again"
        )
    try:
        flat = np.frombuffer(content, dtype, n, header.start)
        check_texts(flat)
        return flat.reshape(header.shape, order="F" if header.is_fortran else "C")
    except RefusedError as error:
        raise PredictionError(f"{where}: {error}; the file is damaged") from error
    except ValueError as error:  # an empty array with sizes beyond what NumPy can multiply
        raise PredictionError(f"{where}: an array of shape {header.shape}; the file is damaged") from error


def _header(content: bytes, where: str) -> NpyHeader:
    header = npy_header(content)
    if header is None:
        raise PredictionError(f"{where}: not a .npy array of plain numbers; copy the file again")
    return header


def _content(path: Path) -> bytes:
    with reading(shown(path)):
        return file_bytes(path)
