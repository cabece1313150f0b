"""Files of ``torch.save`` read without torch: a pickle, and beside it the bytes of the storages behind its tensors.

They are a zip archive of both, or, as torch wrote before 1.6 and some programs still ask for, a stream of pickles with
the bytes behind. Source: ``_save`` and ``_legacy_save`` of pytorch's serialization.py.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, reading, shown
from su3d_bench.core.files.atomic import PIECE, allowance_of
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import UInt8Array
from su3d_bench.formats.numpy_files import checked_shape, opened_zip, read_member
from su3d_bench.formats.pickles import NAMES, GlobalRef, Names, unpickled

ZIP_START = b"PK\x03\x04"
PICKLE_NAME = "data.pkl"
MAGIC, VERSION = 0x1950A86A20F9469CFC6C, 1001  # what the first two pickles of the older form hold
MAGIC_WITHIN = 64  # bytes
SPARSE = "torch.sparse_coo"
BFLOAT16 = "BFloat16"  # the upper halves of float32, which is what they become
UNTYPED = "torch.storage.UntypedStorage"
# NumPy codes of torch's storages and dtypes; those that NumPy lacks (quantised ones) are refused by name.
CODES = {
    "Bool": "b1", "Byte": "u1", "Char": "i1", "Short": "i2", "Int": "i4", "Long": "i8",
    "Half": "f2", "Float": "f4", "Double": "f8", BFLOAT16: "f4",
}  # fmt: skip
DTYPES = {"bool": "b1"} | {
    f"{kind}{n}": f"{kind[0]}{n // 8}"
    for kind in ("uint", "int", "float")
    for n in (8, 16, 32, 64)
    if f"{kind}{n}" != "float8"
}


@dataclass(frozen=True)
class SparseTensor:
    """Values (nnz, ...) at ``indices`` (dimensions, nnz) of an array of ``shape``; equal places add up."""

    indices: NDArray[Any]
    values: NDArray[Any]
    shape: tuple[int, ...]


@dataclass(eq=False)
class Storage:
    """Bytes that tensors are views of, filled once the pickle is read; ``code`` None: the tensor says the type."""

    kind: str
    n: int
    n_bytes: int
    code: str | None
    content: UInt8Array

    def fill(self, stream: Any, where: str) -> None:
        """Read the bytes out of ``stream``."""
        place = self.content.data[: self.n_bytes]
        n_read = 0
        while n_read < self.n_bytes and (n := stream.readinto(place[n_read : n_read + PIECE])):
            n_read += n
        if n_read < self.n_bytes:
            raise PredictionError(f"{where}: the file is cut short or damaged; copy it again")
        if self.kind == BFLOAT16:
            upper = self.content[: self.n_bytes].view("<u2").astype("<u4")
            self.content.view("<u4")[:] = upper << 16


@dataclass
class Storages:
    """The storages that a pickle refers to, by their names, of which a file can hold ``n_left`` bytes."""

    n_left: int
    found: dict[str, Storage] = field(default_factory=dict)

    def find(self, key: Any) -> Storage:
        """That of ("storage", type, name, place, number of values)."""
        word, kind, name, _, n, *views = key
        if word != "storage" or not isinstance(kind, GlobalRef) or not isinstance(name, str) or type(n) is not int:
            raise ValueError("a reference that is no storage")
        if not re.fullmatch(r"\d{1,20}", name) or any(view is not None for view in views):
            raise ValueError("a reference to a storage of a form that is not known")
        known = self.found.get(name)
        short = kind.name.removeprefix("torch.").removesuffix("Storage")
        if known is None:
            code = None if kind.name == UNTYPED else CODES[short]
            n_bytes = n * (1 if code is None else 2 if short == BFLOAT16 else int(code[-1]))
            if n < 0 or n_bytes > self.n_left:
                raise ValueError(f"its storages are larger than the file: {n} values in storage {name}")
            self.n_left -= n_bytes
            content = np.empty(2 * n_bytes if short == BFLOAT16 else n_bytes, np.uint8)
            known = self.found[name] = Storage(short, n, n_bytes, code, content)
        if (known.kind, known.n) != (short, n):
            raise ValueError(f"two types or sizes of storage {name}")
        return known


def _tensor(storage: object, offset: object, size: object, stride: object, *_: object) -> NDArray[Any]:
    """``_rebuild_tensor[_v2](storage, offset, size, stride, ...)``."""
    return _view(storage, storage.code if isinstance(storage, Storage) else None, offset, size, stride)


def _tensor_with_type(*parts: Any) -> NDArray[Any]:
    """``_rebuild_tensor_v3(storage, offset, size, stride, grad, hooks, type, ...)``."""
    storage, offset, size, stride, _, _, kind = parts[:7]
    code = DTYPES.get(kind.name.removeprefix("torch.")) if isinstance(kind, GlobalRef) else None
    return _view(storage, code, offset, size, stride)


def _view(storage: object, code: str | None, offset: Any, size: object, stride: object) -> NDArray[Any]:
    sizes, strides = checked_shape(size), checked_shape(stride)
    if not isinstance(storage, Storage) or code is None or type(offset) is not int or offset < 0:
        raise ValueError("a tensor without a valid place in a storage")
    n, width = math.prod(sizes), int(code[-1])
    n_stored = len(storage.content) // width
    if not n:
        return np.zeros(sizes, code)
    end = offset + sum((n_items - 1) * step for n_items, step in zip(sizes, strides, strict=True)) + 1
    if end > n_stored or n > n_stored:
        raise ValueError(f"a tensor of shape {sizes} lies beyond the {n_stored} values of its storage")
    values = storage.content[: n_stored * width].view(f"<{code}")
    return np.lib.stride_tricks.as_strided(values[offset:], sizes, [step * width for step in strides], writeable=False)


def _sparse(layout: object, parts: Any) -> SparseTensor:
    """``_rebuild_sparse_tensor("torch.sparse_coo", (indices, values, size, ...))``."""
    indices, values, shape = parts[0], parts[1], checked_shape(parts[2])
    are_arrays = isinstance(indices, np.ndarray) and isinstance(values, np.ndarray) and indices.dtype.kind in "iu"
    if layout != SPARSE or not are_arrays or values.ndim != 1 or indices.shape != (len(shape), len(values)):
        raise ValueError("a sparse tensor without indices and values")
    return SparseTensor(indices, values, shape)


TORCH_NAMES: Names = {
    **NAMES,
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_tensor_v3": _tensor_with_type,
    "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
    "torch._utils._rebuild_sparse_tensor": _sparse,
    "torch.serialization._get_layout": lambda name: name,
    "torch.Size": checked_shape,
    **{
        name: GlobalRef(name)
        for name in (UNTYPED, *(f"torch.{kind}Storage" for kind in CODES), *(f"torch.{kind}" for kind in DTYPES))
    },
}


def read_torch(path: Path, *, is_outline: bool = False) -> object:
    """The value that ``torch.save`` wrote: tensors as read-only arrays or ``SparseTensor``, containers, plain values.

    In an outline the values of tensors are arbitrary. ``PredictionError`` for whatever is damaged or not plain data.
    """
    where = shown(path)
    with reading(where), opened(path) as stream:
        start = stream.read(MAGIC_WITHIN)
        n_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        if not start.startswith(ZIP_START) and MAGIC.to_bytes(10, "little") in start:
            return _read_stream(stream, n_bytes, where, is_outline)
    if not start.startswith(ZIP_START):
        raise PredictionError(f"{where}: no file of torch.save; copy it again")
    with opened_zip(path) as archive:
        names = [name for name in archive.namelist() if name.split("/")[1:] == [PICKLE_NAME]]
        if len(names) != 1:
            raise PredictionError(f"{where}: a zip archive, but not one of torch.save: {len(names)} '*/{PICKLE_NAME}'")
        folder, allowance, storages = names[0].removesuffix(PICKLE_NAME), allowance_of(archive), Storages(n_bytes)
        order = f"{folder}byteorder"
        if order in archive.namelist() and read_member(archive, order, where, allowance) != b"little":
            raise PredictionError(f"{where}: is of another byte order; save it on a little-endian machine")
        content = read_member(archive, names[0], where, allowance)
        value = unpickled(io.BytesIO(content), len(content), n_bytes, where, TORCH_NAMES, storages.find)
        for name, storage in {} if is_outline else storages.found.items():
            info = archive.NameToInfo.get(f"{folder}data/{name}")
            if info is None or info.file_size != storage.n_bytes or info.compress_type != zipfile.ZIP_STORED:
                raise PredictionError(
                    f"{where}: storage {name} is missing, packed or of another size; copy the file again"
                )
            with archive.open(info) as member:
                storage.fill(member, where)
                member.read(1)  # which checks the checksum
        return value


def _read_stream(stream: BinaryIO, n_bytes: int, where: str, is_outline: bool) -> object:
    """The value of the older form: magic number, version, system, value, names of storages, and these."""
    storages = Storages(n_bytes)

    def part(names: Names = NAMES) -> Any:
        return unpickled(stream, n_bytes - stream.tell(), n_bytes, where, names, storages.find)

    magic, version, system = part(), part(), part()
    if magic != MAGIC or version != VERSION or not isinstance(system, dict) or not system.get("little_endian", True):
        raise PredictionError(f"{where}: is of a form of torch.save that is not known; save it with a later torch")
    value, keys = part(TORCH_NAMES), part()
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys) or {*keys} != {*storages.found}:
        raise PredictionError(f"{where}: does not name each storage once; copy the file again")
    for key in () if is_outline else keys:
        storage = storages.found[key]
        if int.from_bytes(stream.read(8), "little") != storage.n:
            raise PredictionError(f"{where}: storage {key} is of another size; copy the file again")
        storage.fill(stream, where)
    if not is_outline and stream.read(1):
        raise PredictionError(f"{where}: has more bytes behind its end; copy the file again")
    return value


def check_stored(path: Path) -> None:
    """Refuses an archive of torch.save that is compressed: torch writes none, and would unpack any."""
    with reading(shown(path)), opened(path) as stream:
        is_zip = stream.read(4) == ZIP_START
    if is_zip:
        with opened_zip(path) as archive:
            members, n_bytes = archive.infolist(), path.stat().st_size
        is_stored = all(info.compress_type == zipfile.ZIP_STORED for info in members)
        if not is_stored or sum(info.file_size for info in members) > n_bytes:
            raise PredictionError(f"{shown(path)}: is compressed, which torch.save does not do; copy the file again")
