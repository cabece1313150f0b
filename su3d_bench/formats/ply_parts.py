"""The rows of a PLY file behind its header: bytes of a binary file or values of a text file, addressed alike."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.formats.ply_header import BYTE_ORDERS, Header, clip

AnyArray = NDArray[Any]


class UnfitValueError(ValueError):
    """A text value that its property's type cannot hold, at ``index`` among those asked for."""

    def __init__(self, index: int, value: float) -> None:
        super().__init__(f"{value:g}")
        self.index = index


class Body(Protocol):
    """The rows behind the header, addressed in units: bytes of a binary file, values of a text file."""

    unit: str
    start: int
    n_units: int

    def size(self, kind: np.dtype[Any]) -> int:
        """Units of one value."""
        ...

    def count(self, at: int, kind: np.dtype[Any]) -> int:
        """The list length at ``at``; -1 where there is none."""
        ...

    def strided(self, at: int, stride: int, n_rows: int, n_values: int, kind: np.dtype[Any]) -> AnyArray:
        """Values (n_rows, n_values) that begin at ``at`` and again every ``stride`` units."""
        ...

    def gathered(self, starts: Int64Array, kind: np.dtype[Any]) -> AnyArray:
        """One value at each of ``starts``."""
        ...

    def n_left_over(self, at: int) -> int:
        """Units from ``at`` on that are not mere white space."""
        ...


class BinaryBody:
    unit = "bytes"

    def __init__(self, content: bytes, header: Header) -> None:
        self._content = content
        self._bytes = np.frombuffer(content, np.uint8)
        self._order = BYTE_ORDERS[header.format]
        self.start, self.n_units = header.n_bytes, len(content)

    def size(self, kind: np.dtype[Any]) -> int:
        return kind.itemsize

    def count(self, at: int, kind: np.dtype[Any]) -> int:
        order: Literal["little", "big"] = "little" if self._order == "<" else "big"
        return int.from_bytes(self._content[at : at + kind.itemsize], order, signed=kind.kind == "i")

    def strided(self, at: int, stride: int, n_rows: int, n_values: int, kind: np.dtype[Any]) -> AnyArray:
        stored = kind.newbyteorder(self._order)
        shape, strides = (n_rows, n_values), (stride, kind.itemsize)
        if n_rows * n_values == 0:
            return np.zeros(shape, kind)
        return np.ndarray(shape, stored, self._content, at, strides).astype(kind)

    def gathered(self, starts: Int64Array, kind: np.dtype[Any]) -> AnyArray:
        raw = np.empty((len(starts), kind.itemsize), np.uint8)
        for byte in range(kind.itemsize):
            raw[:, byte] = self._bytes[starts + byte]
        return raw.view(kind.newbyteorder(self._order)).reshape(-1).astype(kind)

    def n_left_over(self, at: int) -> int:
        return len(self._content[at:].strip())


class TextBody:
    """Values of a text file as float64, which holds every PLY type exactly."""

    unit = "values"

    def __init__(self, content: bytes, header: Header, where: str) -> None:
        text = content[header.n_bytes :].strip()
        try:
            # numpy answers -1 for a text without values
            self._values: Float64Array = np.fromstring(text, np.float64, sep=" ") if text else np.zeros(0)
        except ValueError as error:
            raise DataError(f"{where}{_place_of_stranger(content, header)}; the file is damaged") from error
        self.start, self.n_units = 0, len(self._values)

    def size(self, kind: np.dtype[Any]) -> int:
        return 1

    def count(self, at: int, kind: np.dtype[Any]) -> int:
        value = float(self._values[at])
        return int(value) if value.is_integer() and value <= np.iinfo(kind).max else -1

    def strided(self, at: int, stride: int, n_rows: int, n_values: int, kind: np.dtype[Any]) -> AnyArray:
        if n_rows * n_values == 0:
            return np.zeros((n_rows, n_values), kind)
        step = self._values.itemsize
        shape, strides = (n_rows, n_values), (stride * step, step)
        return self._typed(np.ndarray(shape, np.float64, self._values.data, at * step, strides), kind)

    def gathered(self, starts: Int64Array, kind: np.dtype[Any]) -> AnyArray:
        return self._typed(self._values[starts], kind)

    def n_left_over(self, at: int) -> int:
        return self.n_units - at

    def _typed(self, values: Float64Array, kind: np.dtype[Any]) -> AnyArray:
        with np.errstate(over="ignore", invalid="ignore"):
            typed: AnyArray = values.astype(kind)
            is_unfit = typed.astype(np.float64) != values if kind.kind != "f" else np.isinf(typed) & np.isfinite(values)
        if is_unfit.any():
            index = int(np.flatnonzero(is_unfit)[0])
            raise UnfitValueError(index, float(values.reshape(-1)[index]))
        return typed


def _place_of_stranger(content: bytes, header: Header) -> str:
    """A clause for the first word of the body that is no number, with its line."""
    for number, line in enumerate(content[header.n_bytes :].splitlines(), header.n_lines + 1):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return f":{number}: '{clip(word.decode('utf-8', 'replace'))}' is not a number"
    return ": it holds something that is not a number"
