"""What a pickle may build, and how: plain values and NumPy arrays made by our own code out of what the file says.

Nothing that a pickle names is ever imported or called. NumPy's own reconstructors are not used either: a hostile state
of a dtype can make them read raw bytes as object pointers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_DIMENSIONS = 8
MOST_CHARACTER = 0x10FFFF  # the end of Unicode
SIMPLE_TYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|U\d{1,6}|S\d{1,6}|O8?)")


class RefusedError(ValueError):
    """A part of a pickle that is damaged or would do more than hold values."""


@dataclass
class Budget:
    """Bytes that constructors may still make out of others; grows with what is read from the file."""

    n_bytes: int = 0

    def spend(self, n: int) -> None:
        if n > self.n_bytes:
            raise RefusedError("it makes more bytes than it holds")
        self.n_bytes -= n


Constructor = Callable[[tuple[object, ...], Budget], object]
Constructors = Mapping[tuple[str, str], Constructor | None]  # by module and name; None: may stand, but not be called


@dataclass(frozen=True)
class Named:
    """A class or function that the file names; ``construct`` is None where the name may only stand as a value."""

    module: str
    name: str
    construct: Constructor | None

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class Inert:
    """The place of an object without meaning here (settings, paths, pictures): it takes any state and keeps none."""


class Forgotten:
    """The place of a payload that the caller asked not to keep."""


@dataclass(eq=False)
class Unbuilt:
    """An object whose content follows in a second step; ``memo_keys`` are where the pickle remembers it."""

    build: Callable[[object], object]
    memo_keys: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class ArrayType:
    """A NumPy dtype without fields; ``is_object`` where the items are Python values."""

    dtype: np.dtype[Any]
    is_object: bool


def array_type(code: object) -> ArrayType:
    """The dtype of a code such as ``<f2``; ``RefusedError`` for everything that is no plain number, text or object."""
    if not isinstance(code, str) or SIMPLE_TYPE.fullmatch(code) is None:
        raise RefusedError(f"an array of type {clip(code)}")
    if code.lstrip("<>|=").startswith("O"):
        return ArrayType(np.dtype(object), True)
    return ArrayType(np.dtype(code), False)


def clip(value: object) -> str:
    """A short, printable form of a value out of a file."""
    if isinstance(value, str | bytes | int | float):
        text = repr(value[:40] if isinstance(value, str | bytes) else value)
        return ascii(text)[1:-1] if len(text) <= 60 else f"{ascii(text[:57])[1:-1]}..."
    return type(value).__name__


def is_word(value: object, *words: str) -> bool:
    """Whether ``value`` is one of ``words``; what else a file may hold can be costly to compare or to hash."""
    return isinstance(value, str) and value in words


def checked_shape(shape: object) -> tuple[int, ...]:
    if not isinstance(shape, tuple | list) or len(shape) > MOST_DIMENSIONS:
        raise RefusedError("an array without a valid shape")
    sizes = tuple(size for size in shape if type(size) is int and 0 <= size < 1 << 62)
    if len(sizes) != len(shape):
        raise RefusedError("an array without a valid shape")
    return sizes


def array_of(shape: object, kind: object, is_fortran: object, payload: object) -> object:
    """The array that a pickle describes, read-only over its payload.

    An array of objects becomes its only item where it has no dimension, and a list where it has one.
    """
    sizes = checked_shape(shape)
    n = math.prod(sizes)
    if not isinstance(kind, ArrayType):
        raise RefusedError("an array without a valid type")
    if isinstance(payload, Forgotten):
        return payload
    if kind.is_object:
        if not isinstance(payload, list) or len(payload) != n or len(sizes) > 1:
            raise RefusedError(f"an array of objects of shape {sizes}; only lists and single values of them are read")
        return list(payload) if sizes else payload[0]
    if not isinstance(payload, bytes):
        raise RefusedError("an array without bytes")
    if n * kind.dtype.itemsize != len(payload) or kind.dtype.itemsize == 0:
        raise RefusedError(
            f"an array of shape {sizes} {kind.dtype.name} needs {n * kind.dtype.itemsize} bytes, "
            f"{len(payload)} are there"
        )
    try:
        values = np.frombuffer(payload, kind.dtype, n).reshape(sizes, order="F" if is_fortran is True else "C")
        check_texts(values)
        return values
    except RefusedError:
        raise
    except ValueError as error:  # an empty array with sizes beyond what NumPy can multiply
        raise RefusedError(f"an array of shape {sizes}") from error


def check_texts(values: NDArray[Any]) -> None:
    """Refuses texts with characters that no text can have, which fail when they are looked at."""
    if values.dtype.kind == "U" and values.size:
        codes = np.ascontiguousarray(values).view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
        if int(codes.max()) > MOST_CHARACTER:
            raise RefusedError("a text with a character that does not exist")


def _reconstruct(args: tuple[object, ...], _budget: Budget) -> object:
    """``numpy._core.multiarray._reconstruct(ndarray, (0,), b"b")``: an array whose shape and bytes follow as state."""

    def build(state: object) -> object:
        if not isinstance(state, tuple) or len(state) not in {4, 5}:
            raise RefusedError("an array without a valid state")
        return array_of(*state[-4:])

    if not args or not isinstance(args[0], Named) or str(args[0]) != "numpy.ndarray":
        raise RefusedError("an array of a foreign class")
    return Unbuilt(build)


def _frombuffer(args: tuple[object, ...], _budget: Budget) -> object:
    """``numpy._core.numeric._frombuffer(bytes, dtype, shape, order)``, how protocol 5 holds an array."""
    if len(args) < 4:
        raise RefusedError("an array without a valid state")
    return array_of(args[2], args[1], is_word(args[3], "F"), args[0])


def _dtype(args: tuple[object, ...], _budget: Budget) -> object:
    """``numpy.dtype("f2", False, True)``; its state (version, byte order, ...) follows."""
    code = args[0] if args else None
    plain = array_type(code)

    def build(state: object) -> object:
        if not isinstance(state, tuple) or len(state) < 5 or any(value is not None for value in state[2:5]):
            raise RefusedError("an array type with fields")
        order = state[1]
        if not isinstance(order, str) or order not in {"<", ">", "|", "="}:
            raise RefusedError("an array type without a byte order")
        return plain if plain.is_object else ArrayType(plain.dtype.newbyteorder(order), False)  # type: ignore[arg-type]

    return Unbuilt(build)


def _scalar(args: tuple[object, ...], _budget: Budget) -> object:
    """``numpy._core.multiarray.scalar(dtype, bytes)``: one number."""
    kind, payload = args if len(args) == 2 else (None, None)
    if not isinstance(kind, ArrayType) or kind.is_object:
        raise RefusedError("a scalar that is no number")
    array: Any = array_of((), kind, False, payload)
    return array if isinstance(array, Forgotten) else array[()]


def _encode(args: tuple[object, ...], budget: Budget) -> object:
    """``_codecs.encode(text, "latin1")``: how protocols 0 to 2 hold bytes."""
    if len(args) != 2 or not is_word(args[1], "latin1", "latin-1"):
        raise RefusedError("an encoding other than latin1")
    if isinstance(args[0], Forgotten):
        return args[0]
    if not isinstance(args[0], str):
        raise RefusedError("an encoding of what is no text")
    budget.spend(len(args[0]))
    try:
        return args[0].encode("latin1")
    except UnicodeEncodeError as error:
        raise RefusedError("bytes beyond 255") from error


def _no_bytes(args: tuple[object, ...], _budget: Budget) -> object:
    """``bytes()``, how protocols 0 to 2 hold no bytes."""
    if args:
        raise RefusedError("bytes made of other things")
    return b""


def empty_dict(args: tuple[object, ...], _budget: Budget) -> object:
    """``collections.OrderedDict()`` or ``defaultdict(factory)``: a dict, whose items follow."""
    if any(not isinstance(value, Named | Inert) for value in args) or len(args) > 1:
        raise RefusedError("a dict made of other things than its items")
    return {}


def inert(_args: tuple[object, ...], _budget: Budget) -> object:
    return Inert()


def named(table: Mapping[str, Constructor | None]) -> dict[tuple[str, str], Constructor | None]:
    """A table by (module, name) of one by ``module.name``."""
    return {(full.rpartition(".")[0], full.rpartition(".")[2]): construct for full, construct in table.items()}


_NUMPY: dict[str, Constructor | None] = {
    "numpy.ndarray": None,
    "numpy.dtype": _dtype,
    **{f"numpy.{core}.multiarray._reconstruct": _reconstruct for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray.scalar": _scalar for core in ("core", "_core")},
    **{f"numpy.{core}.numeric._frombuffer": _frombuffer for core in ("core", "_core")},
}
_PLAIN: dict[str, Constructor | None] = {
    "_codecs.encode": _encode,
    "collections.OrderedDict": empty_dict,
    "collections.defaultdict": empty_dict,
    "typing.Any": None,
    "builtins.bytes": _no_bytes,
    "__builtin__.bytes": _no_bytes,
    **{
        f"{module}.{name}": None
        for module in ("builtins", "__builtin__")
        for name in ("bool", "dict", "float", "int", "list", "str", "tuple")
    },
}
# The settings that ConceptGraphs stores beside its map: a tree of omegaconf nodes with paths in it.
_SETTINGS: dict[str, Constructor | None] = {
    **{f"omegaconf.base.{name}": inert for name in ("ContainerMetadata", "Metadata")},
    **{f"omegaconf.{name}": inert for name in ("dictconfig.DictConfig", "listconfig.ListConfig")},
    **{
        f"omegaconf.nodes.{kind}Node": inert
        for kind in ("Any", "Boolean", "Bytes", "Float", "Integer", "Path", "String", "InterpolationResult")
    },
    **{
        f"{module}.{name}": inert
        for module in ("pathlib", "pathlib._local")
        for name in ("Path", "PosixPath", "PurePath", "PurePosixPath", "PureWindowsPath", "WindowsPath")
    },
}
# The crops that ConceptGraphs stores beside its detections.
_IMAGES: dict[str, Constructor | None] = {"PIL.Image.Image": inert}
CONSTRUCTORS: Constructors = named({**_NUMPY, **_PLAIN, **_SETTINGS, **_IMAGES})
