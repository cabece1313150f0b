"""Pickles of other programs, read as plain data: Python's unpickler with an allow-list of operations and names.

Nothing that a file names is imported: names stand for constructors of ours. NumPy's own constructors are not among
them, as a hostile state of a dtype makes them read raw bytes as pointers. The unpickler is the one of the standard
library in Python, which can pass over the masks of every view in a map of ConceptGraphs, gigabytes that the one in C
keeps. Memory and time are bounded here by the size of the file: a child process with limits would add 0.2 s to each
file of a folder, and a copy of its arrays.
"""

from __future__ import annotations

import gzip
import io
import pickle
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, cast

import numpy as np

from su3d_bench.core.errors import PredictionError, printable, reading, shown
from su3d_bench.core.files.atomic import Allowance, UnpackingError
from su3d_bench.core.system.files import opened
from su3d_bench.formats.numpy_files import plain_array, plain_type

GZIP_START = b"\x1f\x8b"
MAX_INFLATED = 16 << 30  # bytes of a gzip stream; a map of ConceptGraphs with all its masks has some GiB
INFLATED_A_READ, SKIPPED_A_READ = 1 << 17, 1 << 16
# Reads of one byte, one or two an operation; a map of ConceptGraphs takes less than a million of them.
FREE_STEPS, MAX_STEPS = 2_000_000, 20_000_000
MAX_NAME = 1024
MIN_SKIPPED_BYTES = 1 << 12  # bytes; smaller payloads are kept
MAX_KEY = 1 << 60  # larger integers can be crafted to share one place in a dict
# Of protocols 2 to 5, what holds plain values; ``torch.save`` uses 2.
OPERATIONS = (
    "PROTO MARK POP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE "
    "BINUNICODE8 EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT BINPUT LONG_BINPUT "
    "MEMOIZE GLOBAL STACK_GLOBAL REDUCE NEWOBJ BINPERSID STOP"
)
CODES = {getattr(pickle, name)[0] for name in OPERATIONS.split()}
# What the unpickler and the constructors raise where a file is not what it should be.
DAMAGE = (pickle.UnpicklingError, ValueError, TypeError, LookupError, AttributeError, OverflowError, struct.error)


class Opaque:
    """The place of an object without meaning here (settings, paths, pictures): it takes any state and keeps none."""

    def __init__(self, *_args: object) -> None: ...


class Skipped:
    """The place of a payload that the caller asked not to keep."""


@dataclass(frozen=True)
class GlobalRef:
    """A class that the file names as a value."""

    name: str


@dataclass(eq=False)
class Deferred:
    """An object whose state follows, of which ``build`` makes its ``value``."""

    build: Callable[[Any], object]
    value: object = None


OBJECTS = GlobalRef("numpy.object_")  # NumPy's dtype of Python objects


class Source:
    """The bytes of a pickle, of which no more are read than the file can hold, in a bounded number of steps."""

    def __init__(self, stream: BinaryIO, n_bytes: int, n_packed: int) -> None:
        self._stream, self._n_left, self._allowance = stream, n_bytes, Allowance(n_packed)
        self._n_steps = min(MAX_STEPS, max(FREE_STEPS, n_packed))

    def read(self, n: int) -> bytes:
        if n == 1:
            self._n_steps -= 1
            if self._n_steps < 0:
                raise ValueError("it takes too many operations")
        else:
            self.spend(n)
        self._n_left -= n
        if self._n_left < 0:
            raise ValueError(f"it promises {n} bytes, {self._n_left + n} are left")
        content = self._stream.read(n)
        if len(content) != n:
            raise EOFError
        return content

    def readline(self) -> bytes:
        return self._stream.readline(MAX_NAME)

    def skip(self, n: int) -> None:
        while n:
            self._n_left -= (n_read := len(self._stream.read(min(n, SKIPPED_A_READ))))
            if not n_read or self._n_left < 0:
                raise EOFError
            n -= n_read

    def spend(self, n: int) -> None:
        """Count ``n`` bytes that are kept."""
        self._allowance.spend(n)


Names = Mapping[str, object]  # what stands for each name that a pickle may use


class PlainUnpickler(pickle._Unpickler):
    """``forget``: the keys of dicts below which payloads are passed over."""

    # of the unpickler in the standard library
    stack: list[Any]
    metastack: list[list[Any]]
    memo: dict[int, Any]
    append: Callable[[object], None]
    read: Callable[[int], bytes]

    dispatch: ClassVar[Any] = {code: run for code, run in pickle._Unpickler.dispatch.items() if code in CODES}

    def __init__(
        self,
        source: Source,
        names: Names,
        persistent: Callable[[object], object] | None = None,
        forget: Iterable[str] = (),
    ) -> None:
        super().__init__(source)
        self._source, self._names, self._persistent = source, names, persistent
        self._forget = frozenset(forget)

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module.replace('numpy._core', 'numpy.core').replace('__builtin__', 'builtins')}.{name}"
        if full == "_codecs.encode":
            return self._encoded
        if full not in self._names:
            raise ValueError(f"it asks for {printable(full, 60)}, which is no plain data")
        return self._names[full]

    def persistent_load(self, pid: object) -> Any:
        if self._persistent is None:
            raise ValueError("it refers to something outside of it")
        return self._persistent(pid)

    def _encoded(self, text: object, encoding: object) -> object:
        """Bytes as protocol 2 has them; a pickle may say so of one text many times."""
        if not isinstance(text, str) or encoding != "latin1":
            raise ValueError("an encoding other than latin1")
        self._source.spend(len(text))
        return text.encode("latin1")

    def _payload(self, n: int) -> None:
        if n >= MIN_SKIPPED_BYTES and self._is_forgotten():
            self._source.skip(n)
            self.append(Skipped())
        else:
            self.append(self.read(n))

    def _is_forgotten(self) -> bool:
        """Whether the value of a key to forget is under way: the key lies right below it on the stack."""
        frames = (*self.metastack[-16:], self.stack)
        return any(isinstance(one, str) and one in self._forget for frame in frames for one in frame[-2:])

    def _get(self, index: int) -> None:
        value = self.memo[index]
        self.append(value.value if isinstance(value, Deferred) and value.value is not None else value)

    def _set(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict):
            raise ValueError("items of what is no dict")
        for key, value in zip(items[::2], items[1::2], strict=True):
            is_plain = key is None or isinstance(key, str | bytes) or (isinstance(key, int) and abs(key) < MAX_KEY)
            if not is_plain:
                raise ValueError("a key that is no text or number")
            target[key] = value

    def _build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, Deferred):
            self.stack[-1] = target.value = target.build(state)
        elif not isinstance(target, Opaque | dict):  # the state of an OrderedDict holds attributes, no items
            raise ValueError("a state of what has none")

    dispatch |= {
        pickle.FRAME[0]: lambda self: self.read(8),  # of use to who reads ahead
        pickle.SHORT_BINBYTES[0]: lambda self: self._payload(self.read(1)[0]),
        pickle.BINBYTES[0]: lambda self: self._payload(int.from_bytes(self.read(4), "little")),
        pickle.BINBYTES8[0]: lambda self: self._payload(int.from_bytes(self.read(8), "little")),
        pickle.BYTEARRAY8[0]: lambda self: self._payload(int.from_bytes(self.read(8), "little")),
        pickle.BINGET[0]: lambda self: self._get(self.read(1)[0]),
        pickle.LONG_BINGET[0]: lambda self: self._get(int.from_bytes(self.read(4), "little")),
        pickle.SETITEM[0]: lambda self: self._set([self.stack.pop(-2), self.stack.pop()]),
        pickle.SETITEMS[0]: lambda self: self._set(self.pop_mark()),
        pickle.BUILD[0]: _build,
    }


def _array(payload: object, kind: object, shape: object, is_fortran: object) -> object:
    """The array of a pickle; one of objects becomes a list, or its only item where it has no dimension."""
    if isinstance(payload, Skipped):
        return payload
    if kind == OBJECTS and isinstance(payload, list) and isinstance(shape, tuple) and len(shape) < 2:
        return list(payload) if shape else payload[0]
    if not isinstance(payload, bytes) or not isinstance(kind, np.dtype):
        raise ValueError("an array without values or type")
    return plain_array(payload, kind, shape, is_fortran is True)


def _reconstruct(kind: object, *_: object) -> Deferred:
    """``_reconstruct(ndarray, (0,), b"b")``, followed by (version, shape, dtype, is_fortran, values)."""
    if kind != GlobalRef("numpy.ndarray"):
        raise ValueError("an array of a foreign class")
    return Deferred(lambda state: _array(state[4], state[2], state[1], state[3]))


def _frombuffer(payload: object, kind: object, shape: object, order: object) -> object:
    """How protocol 5 holds an array."""
    return _array(payload, kind, shape, isinstance(order, str) and order == "F")


def _dtype(code: object, *_: object) -> Deferred:
    """``dtype("f2", False, True)``, followed by (version, byte order, None, None, None, ...)."""
    is_object = isinstance(code, str) and code == "O8"

    def build(state: Any) -> object:
        if any(part is not None for part in state[2:5]):
            raise ValueError("an array type with fields")
        return OBJECTS if is_object else plain_type(f"{state[1]}{code}")

    return Deferred(build)


def _scalar(kind: object, payload: object) -> object:
    array: Any = _array(payload, kind, (), False)
    return array if isinstance(array, Skipped) else array[()]


# ConceptGraphs stores its settings beside the map, a tree of omegaconf nodes with paths in it, and pictures beside its
# detections.
_INERT = (
    *(f"omegaconf.base.{name}" for name in ("ContainerMetadata", "Metadata")),
    *("omegaconf.dictconfig.DictConfig", "omegaconf.listconfig.ListConfig", "PIL.Image.Image", "torch.device"),
    *(
        f"omegaconf.nodes.{kind}Node"
        for kind in ("Any", "Boolean", "Bytes", "Float", "Integer", "Path", "String", "InterpolationResult")
    ),
    *(
        f"{module}.{kind}"
        for module in ("pathlib", "pathlib._local")
        for kind in ("Path", "PosixPath", "PurePath", "PurePosixPath", "PureWindowsPath", "WindowsPath")
    ),
)
_VALUES = (
    "numpy.ndarray",
    "typing.Any",
    *(f"builtins.{kind}" for kind in ["bool", "dict", "float", "int", "list", "str", "tuple"]),
)
NAMES: dict[str, object] = {
    **dict.fromkeys(_INERT, Opaque),
    **{name: GlobalRef(name) for name in _VALUES},
    "numpy.dtype": _dtype,
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _frombuffer,
    # OrderedDict() and defaultdict(factory), whose items follow; bytes(), how protocol 2 holds no bytes
    "collections.OrderedDict": lambda *_: {},
    "collections.defaultdict": lambda *_: {},
    "builtins.bytes": lambda: b"",
}


def read_pickle_file(path: Path, *, forget: Iterable[str] = ()) -> object:
    """The value of a pickle, plain or gzipped: plain values, lists, dicts, tuples, and read-only arrays.

    Payloads below a dict key in ``forget`` are passed over and leave ``Skipped`` in their place; settings and paths
    become ``Opaque``. Raises ``PredictionError`` for whatever is damaged or not plain data.
    """
    with reading(shown(path)), opened(path) as stream:
        is_gzip = stream.read(2) == GZIP_START
        n_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        content: BinaryIO = stream
        if is_gzip:
            inflated = cast(io.RawIOBase, gzip.GzipFile(fileobj=stream, mode="rb"))
            content = cast(BinaryIO, io.BufferedReader(inflated, INFLATED_A_READ))
        return unpickled(content, MAX_INFLATED if is_gzip else n_bytes, n_bytes, shown(path), NAMES, forget=forget)


def unpickled(
    stream: BinaryIO,
    n_bytes: int,
    n_packed: int,
    where: str,
    names: Names,
    persistent: Callable[[object], object] | None = None,
    forget: Iterable[str] = (),
) -> object:
    """The value of the pickle at ``stream``, at most ``n_bytes`` long, in a file of ``n_packed`` bytes."""
    try:
        return PlainUnpickler(Source(stream, n_bytes, n_packed), names, persistent, forget).load()
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise PredictionError(f"{where}: the file is cut short or damaged; copy it again") from error
    except (*DAMAGE, UnpackingError) as error:
        reason = f"operation or place {error} is not known" if isinstance(error, KeyError) else str(error)
        raise PredictionError(
            f"{where}: not read as a pickle of plain data: {printable(reason or type(error).__name__, 200)}"
        ) from error
