"""The state of a method in a folder: its values as JSON, and their arrays without pickle in a second file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import read_json, read_npz, replacing, write_json

ARRAYS, VALUES = "arrays.npz", "values.json"


def write_state(folder: Path, values: Mapping[str, Any]) -> None:
    """Write values of texts, numbers, arrays, lists, tuples, mappings and dataclass objects."""
    parts: dict[str, list[NDArray[Any]]] = {}
    write_json(folder / VALUES, _packed(values, parts))
    with replacing(folder / ARRAYS) as stream:
        np.savez(stream, allow_pickle=False, **{name: np.concatenate(of_type) for name, of_type in parts.items()})


def _packed(value: Any, parts: dict[str, list[NDArray[Any]]]) -> Any:
    if isinstance(value, np.ndarray):
        of_type = parts.setdefault(value.dtype.str[1:], [])
        of_type.append(np.ascontiguousarray(value).reshape(-1))
        return {"array": [value.dtype.str[1:], list(value.shape)]}
    if is_dataclass(value) and not isinstance(value, type):
        own = [[one.name, _packed(getattr(value, one.name), parts)] for one in fields(value)]
        return {type(value).__name__: own}
    if isinstance(value, Mapping):
        return {"map": [[key, _packed(one, parts)] for key, one in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_packed(one, parts) for one in value]}
    return value.item() if isinstance(value, np.generic) else value


def read_state(folder: Path, forms: Mapping[str, str], classes: Sequence[type] = ()) -> dict[str, Any]:
    """The values, with objects of ``classes``; arrays are checked against ``forms``, by the names of their fields.

    A form is a dtype and a shape, such as ``f8 N 3``; a letter is any length, the same within a mapping or object, and
    ``N+1`` one more. Raises ``StoreError``, or a ``ValueError``, ``TypeError`` or ``LookupError`` for invalid values.
    """
    reader = _Reader(read_npz(folder / ARRAYS), forms, {one.__name__: one for one in classes})
    values: dict[str, Any] = reader.value(read_json(folder / VALUES))
    return values


class _Reader:
    def __init__(
        self, arrays: Mapping[str, NDArray[Any]], forms: Mapping[str, str], classes: Mapping[str, type]
    ) -> None:
        self._arrays, self._forms, self._classes = arrays, forms, classes
        self._n_read = dict.fromkeys(arrays, 0)

    def value(self, tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        ((kind, content),) = tree.items()
        if kind == "array":
            dtype, shape = content
            first = self._n_read[dtype]
            self._n_read[dtype] += prod(shape)
            return self._arrays[dtype][first : self._n_read[dtype]].reshape(shape).copy()
        if kind in ("list", "tuple"):
            of_list = [self.value(one) for one in content]
            return of_list if kind == "list" else tuple(of_list)
        named = {name: self.value(one) for name, one in content}
        self._check(named)
        return named if kind == "map" else self._classes[kind](**named)

    def _check(self, named: Mapping[Any, Any]) -> None:
        lengths: dict[str, int] = {}
        for name in self._forms.keys() & named.keys():
            dtype, *shape = self._forms[name].split()
            array = named[name]
            if array is None:
                continue
            fits = isinstance(array, np.ndarray) and array.dtype == np.dtype(dtype) and array.ndim == len(shape)
            for n, wanted in zip(array.shape if fits else (), shape, strict=False):
                letter, plus, _ = wanted.partition("+")
                n -= bool(plus)
                fits &= n >= 0 and n == (int(letter) if letter.isdigit() else lengths.setdefault(letter, n))
            if not fits or (array.dtype.kind == "f" and not np.isfinite(array).all()):
                raise StoreError(f"saved state: '{name}' is not {self._forms[name]} with finite values")


def check_range(name: str, numbers: NDArray[Any], low: int, high: int) -> None:
    """``StoreError`` if one of ``numbers`` is below ``low``, or is ``high`` or above."""
    if numbers.size and not low <= int(numbers.min()) <= int(numbers.max()) < high:
        raise StoreError(f"saved state: '{name}' has numbers outside {low} to {high - 1}")
