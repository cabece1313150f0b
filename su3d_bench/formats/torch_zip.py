"""Files of ``torch.save``, read without torch: a zip archive of one pickle and the bytes of each storage."""

from __future__ import annotations

import io
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, reading, shown
from su3d_bench.core.files.unpacking import Allowance, allowance_of
from su3d_bench.core.system.files import opened
from su3d_bench.formats.numpy_files import opened_zip, read_member
from su3d_bench.formats.pickles.pickle_constructors import (
    CONSTRUCTORS,
    Budget,
    Constructor,
    Constructors,
    Named,
    RefusedError,
    checked_shape,
    clip,
    inert,
    is_word,
    named,
)
from su3d_bench.formats.pickles.pickles import read_pickle

Kind = Literal["tensor", "sparse", "array", "dict", "tuple", "other"]
ZIP_START = b"PK\x03\x04"
PICKLE_NAME = "data.pkl"
SPARSE = "torch.sparse_coo"
# NumPy codes of torch's storages and dtypes; those that NumPy lacks (quantised ones) are refused by name.
BFLOAT16 = "BFloat16"  # the upper halves of float32, which is what they become
CODES = {
    BFLOAT16: "u2",
    "Bool": "b1",
    "Byte": "u1",
    "Char": "i1",
    "Short": "i2",
    "Int": "i4",
    "Long": "i8",
    "Half": "f2",
    "Float": "f4",
    "Double": "f8",
}
DTYPES = {
    "bool": "b1",
    **{f"uint{n}": f"u{n // 8}" for n in (8, 16, 32, 64)},
    **{f"int{n}": f"i{n // 8}" for n in (8, 16, 32, 64)},
    **{f"float{n}": f"f{n // 8}" for n in (16, 32, 64)},
}
# How the pickle of protocol 2 begins and ends, by what it holds.
ENDINGS: tuple[tuple[Kind, re.Pattern[bytes]], ...] = (
    ("tuple", re.compile(rb".*(?<!q)[\x85\x86\x87t](?:q.|r....)?\.", re.DOTALL)),
    ("sparse", re.compile(rb"\x80.ctorch\._utils\n_rebuild_sparse_tensor\n.*", re.DOTALL)),
    ("tensor", re.compile(rb"\x80.ctorch\._utils\n_rebuild_(?:tensor|parameter).*", re.DOTALL)),
    ("array", re.compile(rb"\x80.cnumpy\._?core\.multiarray\n_reconstruct\n.*", re.DOTALL)),
    ("dict", re.compile(rb"\x80.(?:\}|ccollections\nOrderedDict\n).*", re.DOTALL)),
)


@dataclass(frozen=True)
class SparseTensor:
    """Values (nnz, ...) at ``indices`` (dimensions, nnz) of an array of ``shape``; equal places add up."""

    indices: NDArray[Any]
    values: NDArray[Any]
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Storage:
    """The bytes that tensors are views of; ``code`` is None where the tensor says the type."""

    content: bytes
    code: str | None
    order: str


@dataclass(frozen=True)
class StorageReference:
    """What a pickle says of a storage that stands outside of it: ``n`` values of a ``kind`` such as ``Float``."""

    name: str
    kind: str
    n: int

    @classmethod
    def of(cls, key: object) -> StorageReference:
        """That of ("storage", type, name, place, number of values)."""
        if (
            not isinstance(key, tuple)
            or len(key) < 5
            or not is_word(key[0], "storage")
            or not isinstance(key[1], Named)
            or any(value is not None for value in key[5:])  # views of torch before 0.4
        ):
            raise RefusedError("a reference that is no storage")
        name, n = key[2], key[4]
        if not isinstance(name, str) or re.fullmatch(r"\d{1,20}", name) is None or type(n) is not int:
            raise RefusedError("a reference without a valid name or size")
        return cls(name, key[1].name.removesuffix("Storage"), n)

    @property
    def width(self) -> int:
        """Bytes of a value; 1 where the storage does not say."""
        return int(CODES.get(self.kind, "u1")[-1])

    def storage(self, content: bytes, order: str) -> Storage:
        """The storage with this content, in the byte order "<" or ">"."""
        code = CODES.get(self.kind)
        if code is not None and self.n * self.width != len(content):
            raise RefusedError(f"storage {self.name} of {self.n} values has {len(content)} bytes")
        if self.kind == BFLOAT16:
            upper = np.frombuffer(content, f"{order}u2").astype("<u4")
            return Storage((upper << 16).tobytes(), "f4", "<")
        return Storage(content, code, order)


def torch_kind(path: Path) -> Kind | None:
    """What a file of ``torch.save`` holds, from the ends of its pickle; None where it is no such file."""
    try:
        with opened(path) as stream, opened_zip(path) as archive:
            if stream.read(4) != ZIP_START:
                return None
            info = archive.getinfo(_pickle_name(archive, path))
            stream.seek(info.header_offset + 26)  # the lengths of name and extra field in the local header
            sizes = stream.read(4)
            start = info.header_offset + 30 + int.from_bytes(sizes[:2], "little") + int.from_bytes(sizes[2:], "little")
            stream.seek(start)
            head = stream.read(min(info.file_size, 64))
            stream.seek(max(start, start + info.file_size - 16))
            tail = stream.read(min(info.file_size, 16))
    except (PredictionError, OSError, KeyError):
        return None
    return next((kind for kind, form in ENDINGS if form.fullmatch(head + tail)), "other")


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


def read_torch(path: Path) -> object:
    """The value that ``torch.save`` wrote: tensors as read-only arrays or ``SparseTensor``, containers, plain values.

    Raises ``PredictionError`` for whatever is damaged or not plain data, and for the form of torch before 1.6.
    """
    _check_start(path)
    with opened_zip(path) as archive:
        name, allowance = _pickle_name(archive, path), allowance_of(archive)
        content = read_member(archive, name, shown(path), allowance)
        storages = _Storages(archive, name.removesuffix(PICKLE_NAME), path, allowance)
        return read_pickle(
            io.BytesIO(content),
            len(content),
            shown(path),
            n_packed=path.stat().st_size,
            constructors=constructors(),
            persistent=storages.find,
        )


def _check_start(path: Path) -> None:
    with reading(shown(path)), opened(path) as stream:
        start = stream.read(4)
    if start != ZIP_START:
        raise PredictionError(
            f"{shown(path)}: not a zip archive of torch.save, or of torch before 1.6; copy it again, or write it anew "
            "with a later torch: torch.save(torch.load(name), name)"
        )


def _pickle_name(archive: zipfile.ZipFile, path: Path) -> str:
    names = [name for name in archive.namelist() if name.split("/")[1:] == [PICKLE_NAME]]
    if len(names) != 1:
        raise PredictionError(
            f"{shown(path)}: a zip archive, but not one of torch.save: it has {len(names)} '*/data.pkl'"
        )
    return names[0]


class _Storages:
    """The storages of an archive, each read once."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str, path: Path, allowance: Allowance) -> None:
        self._archive, self._prefix, self._path, self._allowance = archive, prefix, path, allowance
        self._contents: dict[str, bytes] = {}
        self._storages: dict[StorageReference, Storage] = {}
        self._n_left = path.stat().st_size
        self._order = "<"
        if f"{prefix}byteorder" in archive.namelist():
            order = read_member(archive, f"{prefix}byteorder", shown(path), allowance)
            if order not in {b"little", b"big"}:
                raise PredictionError(f"{shown(path)}: byteorder is {clip(order)}; expected little or big")
            self._order = "<" if order == b"little" else ">"

    def find(self, key: object) -> object:
        """The storage of a reference."""
        reference = StorageReference.of(key)
        if reference.name not in self._contents:
            self._contents[reference.name] = self._read(f"{self._prefix}data/{reference.name}")
        if reference not in self._storages:
            self._storages[reference] = reference.storage(self._contents[reference.name], self._order)
        return self._storages[reference]

    def _read(self, member: str) -> bytes:
        info = self._archive.NameToInfo.get(member)
        self._n_left -= 0 if info is None else info.file_size
        if self._n_left < 0:
            raise RefusedError("its storages are larger than the file; torch.save does not compress them")
        return read_member(self._archive, member, shown(self._path), self._allowance)


def _tensor(args: tuple[object, ...], _budget: Budget) -> object:
    """``_rebuild_tensor[_v2](storage, offset, size, stride, ...)``."""
    if len(args) < 4 or not isinstance(args[0], Storage) or args[0].code is None:
        raise RefusedError("a tensor without a valid storage")
    return _view(args[0], args[0].code, args[1:4])


def _tensor_with_type(args: tuple[object, ...], _budget: Budget) -> object:
    """``_rebuild_tensor_v3(storage, offset, size, stride, requires_grad, hooks, dtype, ...)``."""
    if len(args) < 7 or not isinstance(args[0], Storage) or not isinstance(args[6], Named):
        raise RefusedError("a tensor without a valid storage")
    return _view(args[0], DTYPES.get(args[6].name, ""), args[1:4])


def _view(storage: Storage, code: str, place: tuple[object, ...]) -> NDArray[Any]:
    offset, size, strides = place[0], checked_shape(place[1]), checked_shape(place[2])
    n = math.prod(size)
    if type(offset) is not int or offset < 0 or len(size) != len(strides) or not code:
        raise RefusedError("a tensor without a valid place in its storage")
    width = int(code[-1])
    n_stored = len(storage.content) // width
    end = offset + sum((n_items - 1) * stride for n_items, stride in zip(size, strides, strict=True)) + 1
    if n and (end > n_stored or n > n_stored):
        raise RefusedError(f"a tensor of shape {size} lies beyond the {n_stored} values of its storage")
    if not n:
        return _no_values(size, code)
    values = np.frombuffer(storage.content, np.dtype(storage.order + code))
    steps = [stride * values.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(values[offset:], size, steps, writeable=False)


def _no_values(size: tuple[int, ...], code: str) -> NDArray[Any]:
    try:
        return np.zeros(size, code)
    except ValueError as error:  # sizes beyond what NumPy can multiply
        raise RefusedError(f"a tensor of shape {size}") from error


def _parameter(args: tuple[object, ...], _budget: Budget) -> object:
    if not args or not isinstance(args[0], np.ndarray):
        raise RefusedError("a parameter without a tensor")
    return args[0]


def _size(args: tuple[object, ...], _budget: Budget) -> object:
    return checked_shape(args[0] if args else None)


def _layout(args: tuple[object, ...], _budget: Budget) -> object:
    if len(args) != 1 or not is_word(args[0], SPARSE):
        raise RefusedError(f"a layout {clip(args[0] if args else None)}; only torch.sparse_coo is read")
    return SPARSE


def _sparse(args: tuple[object, ...], _budget: Budget) -> object:
    """``_rebuild_sparse_tensor("torch.sparse_coo", (indices, values, size, ...))``."""
    parts = args[1] if len(args) == 2 and is_word(args[0], SPARSE) else ()
    if not isinstance(parts, tuple) or len(parts) < 3:
        raise RefusedError("a sparse tensor without indices and values")
    indices, values, shape = parts[0], parts[1], checked_shape(parts[2])
    if not isinstance(indices, np.ndarray) or not isinstance(values, np.ndarray) or indices.dtype.kind not in "iu":
        raise RefusedError("a sparse tensor without indices and values")
    if indices.shape != (len(shape), len(values) if values.ndim else 0) or values.ndim != 1:
        raise RefusedError(f"a sparse tensor of shape {shape} with indices of {indices.shape}")
    limits = np.array(shape, np.int64)[:, np.newaxis]
    if indices.size and ((indices < 0) | (indices >= limits)).any():
        raise RefusedError(f"a sparse tensor of shape {shape} with a value outside of it")
    return SparseTensor(indices, values, shape)


def constructors() -> Constructors:
    """What a pickle of torch.save may name."""
    table: dict[str, Constructor | None] = {
        "torch._utils._rebuild_tensor": _tensor,
        "torch._utils._rebuild_tensor_v2": _tensor,
        "torch._utils._rebuild_tensor_v3": _tensor_with_type,
        "torch._utils._rebuild_parameter": _parameter,
        "torch._utils._rebuild_sparse_tensor": _sparse,
        "torch.serialization._get_layout": _layout,
        "torch.Size": _size,
        "torch.device": inert,
        "torch.storage.UntypedStorage": None,
        **{f"torch.{name}Storage": None for name in CODES},
        **{f"torch.{name}": None for name in DTYPES},
    }
    return {**CONSTRUCTORS, **named(table)}
