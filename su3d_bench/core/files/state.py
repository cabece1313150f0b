"""The state of a method as two files in a folder: arrays without pickle, and other values as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import read_json, read_npz, replacing, write_json

ARRAYS, VALUES = "arrays.npz", "values.json"


def write_state(folder: Path, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> None:
    """Write ``arrays`` and JSON-like ``values``; nothing is copied in memory."""
    with replacing(folder / ARRAYS) as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    write_json(folder / VALUES, values)


def read_state(folder: Path, forms: Mapping[str, str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays, each checked against its form, and the values; ``StoreError`` if an array has another form.

    A form is a dtype and a shape: ``f8 N 3``; a letter is any length, the same for all arrays, and ``N+1`` one more. An
    array with ``?`` before its form may be missing. Numbers must be finite.
    """
    arrays, lengths = read_npz(folder / ARRAYS), dict[str, int]()
    for name, form in forms.items():
        dtype, *shape = form.removeprefix("?").split()
        array = arrays.get(name)
        if array is None and form.startswith("?"):
            continue
        if array is None or array.dtype != np.dtype(dtype) or array.ndim != len(shape):
            raise StoreError(f"{folder / ARRAYS}: '{name}' is missing or is not {form}")
        for n, wanted in zip(array.shape, shape, strict=True):
            letter, plus, _ = wanted.partition("+")
            known = int(letter) if letter.isdigit() else lengths.setdefault(letter, max(n - bool(plus), 0))
            if n != known + bool(plus):
                raise StoreError(f"{folder / ARRAYS}: '{name}' has shape {array.shape}, which does not fit the others")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StoreError(f"{folder / ARRAYS}: '{name}' has values that are NaN or infinite")
    values = read_json(folder / VALUES)
    if not isinstance(values, dict):
        raise StoreError(f"{folder / VALUES}: is not an object")
    return arrays, values


def check_starts(name: str, starts: NDArray[Any], n: int) -> None:
    """``StoreError`` if ``starts`` (K + 1,) are not the ascending starts of parts of ``n`` rows, and their end."""
    if starts[0] != 0 or starts[-1] != n or (np.diff(starts) < 0).any():
        raise StoreError(f"saved state: '{name}' does not divide {n} rows")


def check_range(name: str, numbers: NDArray[Any], low: int, high: int) -> None:
    """``StoreError`` if one of ``numbers`` is below ``low``, or is ``high`` or above."""
    if numbers.size and not low <= int(numbers.min()) <= int(numbers.max()) < high:
        raise StoreError(f"saved state: '{name}' has numbers outside {low} to {high - 1}")


def check_texts(name: str, texts: Any, n: int) -> tuple[str, ...]:
    """``texts`` as a tuple; ``StoreError`` if they are not ``n`` texts."""
    if not isinstance(texts, list) or len(texts) != n or not all(isinstance(text, str) for text in texts):
        raise StoreError(f"saved state: '{name}' is not a list of {n} texts")
    return tuple(texts)
