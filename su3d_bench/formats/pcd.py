"""The points of a PCD file, whatever its form (ascii, binary or binary_compressed), and such a file of points.

Source: The PCD file format, version 0.7, of the Point Cloud Library. What the header promises is compared with the
size of the file before anything is allocated; what is compressed, Open3D unpacks.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, printable, reading
from su3d_bench.core.files.atomic import Allowance, UnpackingError, write_bytes
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, Float64Array

MAX_HEADER_BYTES = 1 << 16  # headers have some hundred
MAX_FIELDS, MAX_VALUES = 256, 1 << 16  # of a point; histograms of features have some hundred values
MAX_EXPANSION = 88  # of LZF: three bytes stand for at most 264
FORMS = ("ascii", "binary", "binary_compressed")
AXES = ("x", "y", "z")
KEYS = {"VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
TYPES = {f"{kind}{size}" for kind, sizes in (("I", "1248"), ("U", "1248"), ("F", "48")) for size in sizes}
_NUMBER = re.compile(r"\d{1,12}")
BLANKS = b"\0\r\n\t "


def read_pcd_points(path: Path, where: str | None = None) -> Float64Array:
    """Coordinates (N, 3) of every point, NaN where an organised cloud has none; ``where`` begins each message.

    Raises ``DataError`` for a file that is missing, damaged, cut short or longer than its header says.
    """
    where = where or str(path)
    with reading(where, DataError):
        content = file_bytes(path)
    row, n, form, at = _read_header(content, where)
    body = content[at:]
    if form == "ascii":
        return _text_points(body.strip(), row, n, where)
    n_bytes, there = n * row.itemsize, len(body)
    if form == "binary":
        is_whole = n_bytes <= there and not body[n_bytes:].strip(BLANKS)
    else:
        n_packed, n_plain = (int.from_bytes(body[k : k + 4], "little") for k in (0, 4))
        is_whole = 8 + n_packed <= there and not body[8 + n_packed :].strip(BLANKS)
        is_whole &= n_plain == n_bytes <= n_packed * MAX_EXPANSION
    if not is_whole:
        raise DataError(
            f"{where}: the header promises {n} points of {row.itemsize} bytes, the file has {there} bytes of "
            f"{form} behind it; it is cut short or damaged"
        )
    if not n:
        return np.zeros((0, 3))
    if form == "binary":
        table: Any = np.frombuffer(body, row, n)
        with np.errstate(invalid="ignore"):  # NaN of any kind is NaN
            return np.stack([table[axis].astype(np.float64) for axis in AXES], axis=1)
    return _unpacked_points(path, n, n_bytes, len(content), where)


def _read_header(content: bytes, where: str) -> tuple[np.dtype[Any], int, str, int]:
    """The type of a point, how many there are, in which form, and where they begin."""
    lines: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in lines:
        end = content.find(b"\n", at, MAX_HEADER_BYTES)
        if end < 0:
            raise DataError(f"{where}: not a PCD file, or cut short: its header has no line 'DATA'")
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        if not words or words[0].startswith("#"):
            continue
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]  # the name before version 0.7
        if key not in KEYS or lines.setdefault(key, words[1:]) != words[1:]:
            raise DataError(f"{where}: header line '{printable(' '.join(words), 60)}' is wrong or stands there twice")
    names, sizes, kinds = (lines.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts, form = lines.get("COUNT", ["1"] * len(names)), " ".join(lines["DATA"])
    types = [kind + size for kind, size in zip(kinds, sizes, strict=False)]
    numbers = [lines.get(key, []) for key in ("WIDTH", "HEIGHT")]
    are_whole = all(len(words) == 1 and _NUMBER.fullmatch(words[0]) for words in numbers)
    n = int(numbers[0][0]) * int(numbers[1][0]) if are_whole else -1
    of_axes = [(name, count) for name, count in zip(names, counts, strict=False) if name in AXES]
    is_sound = (
        len(names) == len(sizes) == len(kinds) == len(counts) <= MAX_FIELDS
        and {*types} <= TYPES
        and all(_NUMBER.fullmatch(count) and 0 < int(count) <= MAX_VALUES for count in counts)
        and lines.get("POINTS", [str(n)]) == [str(n)]
        and form in FORMS
        and sorted(of_axes) == [(axis, "1") for axis in AXES]
    )
    if not is_sound:
        raise DataError(
            f"{where}: fields ({printable(', '.join(names), 120)}), sizes, counts, numbers of points or form of its "
            "header do not fit; expected x, y and z, one value each"
        )
    fields = [
        (name if name in AXES else f"field {k}", f"<{kind.lower()}", (int(count),) if count != "1" else ())
        for k, (name, kind, count) in enumerate(zip(names, types, counts, strict=True))
    ]
    return np.dtype(fields), n, form, at


def _text_points(text: bytes, row: np.dtype[Any], n: int, where: str) -> Float64Array:
    assert row.names is not None and row.fields is not None
    sizes = [int(np.prod(row.fields[name][0].shape, dtype=int)) for name in row.names]
    n_values = n * sum(sizes)
    try:
        values: Float64Array = np.fromstring(text, np.float64, sep=" ") if text else np.zeros(0)
    except ValueError as error:
        raise DataError(f"{where}: holds something that is no number among its points; the file is damaged") from error
    if len(values) != n_values:
        raise DataError(f"{where}: the header promises {n_values} values, the file has {len(values)}; it is damaged")
    first = dict(zip(row.names, np.cumsum([0, *sizes]).tolist(), strict=False))
    return np.ascontiguousarray(values.reshape(n, sum(sizes))[:, [first[axis] for axis in AXES]])


def _unpacked_points(path: Path, n: int, n_plain: int, n_file: int, where: str) -> Float64Array:
    from open3d import t, utility

    try:
        Allowance(n_file).spend(n_plain + n * len(AXES) * 8)
        with utility.VerbosityContextManager(utility.VerbosityLevel.Error):
            cloud = t.io.read_point_cloud(str(path), format="pcd")
        points: Float64Array = cloud.point.positions.numpy().astype(np.float64)
    except (UnpackingError, RuntimeError, KeyError) as error:
        raise DataError(f"{where}: its compressed points are damaged: {printable(str(error), 120)}") from error
    if points.shape != (n, 3):
        raise DataError(f"{where}: its compressed points are damaged; copy the file again")
    return points


def write_pcd_points(path: Path, points: Float32Array) -> None:
    """Write points (N, 3) as a binary PCD file, whole or not at all."""
    n = len(points)
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F"]
    lines += ["COUNT 1 1 1", f"WIDTH {n}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {n}", "DATA binary", ""]
    write_bytes(path, "\n".join(lines).encode() + np.ascontiguousarray(points, "<f4").tobytes())
