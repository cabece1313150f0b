"""Arrays of numbers and texts out of .npy and .npz files: sizes are compared with the file, nothing is unpickled."""

from __future__ import annotations

import io
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable, reading, shown
from su3d_bench.core.files.atomic import Allowance, UnpackingError, allowance_of, member_bytes
from su3d_bench.core.system.files import file_bytes, opened, regular

# What zipfile raises on a damaged archive; RuntimeError is its answer to a compression that it does not know.
ZIP_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError, struct.error)
# What NumPy raises on a damaged header, which it parses as a Python literal.
NPY_DAMAGE = (
    ValueError, TypeError, LookupError, SyntaxError, RecursionError, MemoryError, OverflowError, tokenize.TokenError,
)  # fmt: skip
NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
PLAIN_TYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|U\d{1,6}|S\d{1,6})")
MAX_DIMENSIONS = 8
MAX_CHARACTER = 0x10FFFF  # the end of Unicode


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
    """The content of a member, stored or deflated, whose checksum is right."""
    try:
        info = archive.getinfo(name)
        content = member_bytes(archive, info, allowance)
    except KeyError as error:
        raise PredictionError(f"{where}: '{printable(name, 80)}' is not in the archive") from error
    except UnpackingError as error:
        raise PredictionError(f"{where}: {error}") from error
    if len(content) != info.file_size:
        raise PredictionError(f"{where}: '{printable(name, 80)}' is cut short; copy the file again")
    return content


def plain_type(code: object) -> np.dtype[Any]:
    """The dtype of a code such as ``<f2``; ``ValueError`` for everything but numbers and texts."""
    if not isinstance(code, str) or PLAIN_TYPE.fullmatch(code) is None:
        raise ValueError(f"an array of type {printable(str(code), 40)}")
    return np.dtype(code)


def checked_shape(shape: object) -> tuple[int, ...]:
    """``shape`` as a tuple of sizes; ``ValueError`` where it is none."""
    sizes = tuple(shape) if isinstance(shape, tuple | list) and len(shape) <= MAX_DIMENSIONS else (-1,)
    if not all(type(size) is int and 0 <= size < 1 << 62 for size in sizes):
        raise ValueError("an array without a valid shape")
    return sizes


def plain_array(content: bytes, kind: np.dtype[Any], shape: object, is_fortran: bool, start: int = 0) -> NDArray[Any]:
    """The array over ``content`` from ``start`` to its end, read-only; ``ValueError`` where it has another size."""
    sizes, n_bytes = checked_shape(shape), len(content) - start
    n = math.prod(sizes)
    if n * kind.itemsize != n_bytes or kind.itemsize == 0:
        raise ValueError(f"an array of shape {sizes} {kind.name} needs {n * kind.itemsize} bytes, {n_bytes} are there")
    array: NDArray[Any] = np.frombuffer(content, kind, n, start)
    if kind.kind == "U" and n and int(array.view(f"{kind.str[0]}u4").max()) > MAX_CHARACTER:
        raise ValueError("a text with a character that does not exist")
    return array.reshape(sizes, order="F" if is_fortran else "C")


def read_npy(path: Path) -> NDArray[Any]:
    """The array of a .npy file of numbers or texts."""
    with reading(shown(path)):
        content = file_bytes(path)
    return npy_array(content, shown(path))


def map_npy(path: Path) -> NDArray[Any]:
    """The array of a .npy file, mapped and not read."""
    try:
        array: NDArray[Any] = np.load(regular(path), mmap_mode="r", allow_pickle=False)
        plain_type(array.dtype.str)
        return array
    except OSError as error:
        raise PredictionError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error
    except (*NPY_DAMAGE, EOFError) as error:
        raise PredictionError(
            f"{shown(path)}: not a whole .npy array of plain numbers ({printable(str(error), 80)}); copy the file again"
        ) from error


def npy_array(content: bytes, where: str) -> NDArray[Any]:
    """The array in the bytes of a .npy file, read-only over them."""
    stream = io.BytesIO(content)
    try:
        shape, is_fortran, kind = NPY_HEADERS[np.lib.format.read_magic(stream)](stream)
        return plain_array(content, plain_type(kind.str), shape, is_fortran, stream.tell())
    except NPY_DAMAGE as error:
        raise PredictionError(
            f"{where}: not a whole .npy array of plain numbers ({printable(str(error), 120)}); copy the file again"
        ) from error


def npz_names(path: Path) -> tuple[str, ...]:
    """The names of the arrays in a .npz file; none where it is not a readable archive."""
    try:
        with opened_zip(path) as archive:
            return _names(archive)
    except PredictionError:
        return ()


def _names(archive: zipfile.ZipFile) -> tuple[str, ...]:
    return tuple(name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy"))


def read_npz(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file, those in ``names`` that are there, or all."""
    where = shown(path)
    with opened_zip(path) as archive:
        allowance = allowance_of(archive)
        chosen = [name for name in _names(archive) if names is None or name in names]
        members = {name: read_member(archive, f"{name}.npy", where, allowance) for name in chosen}
    return {name: npy_array(content, f"{where}: '{printable(name, 80)}'") for name, content in members.items()}
