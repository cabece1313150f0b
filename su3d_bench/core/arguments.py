"""Arguments of the Python API, checked against their annotations where they enter: a wrong one is a typed error."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, get_args, get_origin

from su3d_bench.core.errors import ConfigError, Su3dError, printable

P = ParamSpec("P")
R = TypeVar("R")
# Annotation, without what is in brackets -> accepted types, and their name in messages.
_KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    "str": ((str,), "text"),
    "int": ((Integral,), "an integer"),
    "float": ((Real,), "a number"),
    "None": ((NoneType,), "None"),
    "Place": ((str, Path), "a path"),
    "Mapping": ((Mapping,), "a mapping"),
}


def fault(annotation: str, value: Any, known: Mapping[str, Any]) -> str | None:
    """What is wrong with a value under an annotation; None if nothing, or if it can have values of any type.

    ``known``: the names of the module of the annotation, whose classes and choices are looked up there.

    >>> fault("int | None", "3", {}), fault("int | None", 3, {})
    ("is '3'; expected an integer or None", None)
    """
    words = dict[str, None]()
    for part in annotation.split(" | "):
        name = part.partition("[")[0]
        own = known.get(name)
        accepted, word = _KINDS.get(name) or ((own,) if isinstance(own, type) and own is not Any else (), name)
        if name.endswith("Array"):
            fits, word = isinstance(value, sys.modules["numpy"].ndarray) and value.ndim > 0, "an array"
        elif name in ("tuple", "Sequence"):
            fits, word = is_sequence(value), "a sequence"
        elif get_origin(own) is Literal:
            fits = isinstance(value, str) and value in get_args(own)
            word = f"one of {', '.join(map(repr, get_args(own)))}"
        elif name not in _KINDS and isinstance(own, UnionType) and not any(map(get_origin, get_args(own))):
            fits = isinstance(value, own)
        elif getattr(own, "_is_protocol", False):  # any object of a class may have its members
            fits = type(value).__module__ != "builtins"
        else:
            fits = not accepted or (isinstance(value, accepted) and not (isinstance(value, str) and "\0" in value))
        if fits:
            return None
        words[word] = None
    found = repr(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
    return f"is {printable(found, 60)}; expected {' or '.join(words)}"


def check_fields(value: Any, where: str, error: type[Su3dError]) -> None:
    """Raise ``error`` if a field of the dataclass object ``value`` is not of its annotated type."""
    known = vars(sys.modules[type(value).__module__])
    for name, field in type(value).__dataclass_fields__.items():
        if (wrong := fault(str(field.type), getattr(value, name), known)) is not None:
            raise error(f"{where}: {name} {wrong}")


def is_sequence(value: Any) -> bool:
    """Whether ``value`` is a list, tuple, array, table column, generator or the like, not a text."""
    if isinstance(value, str | bytes | Mapping | type) or getattr(value, "ndim", 1) == 0:
        return False
    return hasattr(value, "__iter__") and (hasattr(value, "__len__") or isinstance(value, Iterator))


def several(name: str, value: Any, kind: Any = str) -> tuple[Any, ...]:
    """One value of ``kind`` or several of them, as a tuple; ``ConfigError`` otherwise."""
    found = tuple(value) if is_sequence(value) else (value,)
    for one in found:
        if not isinstance(one, kind) or (isinstance(one, str) and "\0" in one):
            raise ConfigError(f"{name}: expected a name, a path or several, not {printable(repr(one), 60)}")
    return found


def typed(function: Callable[P, R]) -> Callable[P, R]:
    """``function``, with a ``ConfigError`` for arguments that it does not have or that are of a wrong type."""
    signature, called = inspect.signature(function), function.__qualname__.removesuffix(".__init__")

    @wraps(function)
    def checked(*values: P.args, **named: P.kwargs) -> R:
        try:
            given = signature.bind(*values, **named).arguments
        except TypeError as error:
            raise ConfigError(f"{called}: {error}") from error
        for name, value in given.items():
            annotation = str(signature.parameters[name].annotation)
            if (wrong := fault(annotation, value, function.__globals__)) is not None:
                raise ConfigError(f"{called}: {name} {wrong}")
        return function(*values, **named)

    return checked
