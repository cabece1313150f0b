"""Arrays from files, checked before use: masks as matrices and run lengths, points, features, scores."""

from __future__ import annotations

import json
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, printable, shown
from su3d_bench.core.files.atomic import Allowance, UnpackingError
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array
from su3d_bench.formats.images import read_bytes

MAX_POINTS = 100_000_000  # points of one scene; the largest room scans have a few million
MAX_MASKS = 100_000  # of one scene; methods return a few hundred
MAX_MEMBERS = 50_000_000  # points of all masks of a scene; 600 masks of a large ScanNet scene have 10 million
ROWS_AT_ONCE, VALUES_AT_ONCE = 1 << 16, 1 << 25  # 600 masks of 55,000 points
NOT_EMPTY = -1


def array_of(value: object, found: str, expected: str, kinds: str, *shape: int | None) -> NDArray[Any]:
    """``value``, an array of these dtype kinds and this ``shape``: None is any size, ``NOT_EMPTY`` any but 0.

    ``found`` begins the error message, which continues with the value.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind in kinds and _has_shape(value, shape):
        return value
    raise PredictionError(f"{found} {kind_of(value)}; expected {expected}")


def _has_shape(array: NDArray[Any], shape: tuple[int | None, ...]) -> bool:
    pairs = zip(shape, array.shape, strict=False)
    return array.ndim == len(shape) and all(n in (None, size) or (n == NOT_EMPTY and size > 0) for n, size in pairs)


def as_float32(values: NDArray[Any]) -> Float32Array:
    """``values`` in single precision; values out of range become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def check_memory(n_bytes: int, file: Path) -> None:
    """Raise ``PredictionError`` if the data takes far more memory than its file, for example with shared values."""
    try:
        Allowance(file.stat().st_size).spend(n_bytes)
    except UnpackingError as error:
        raise PredictionError(f"{shown(file)}: {error}") from error


def matrix_of(value: object, where: str) -> NDArray[Any]:
    """``value`` as a matrix of finite numbers."""
    matrix = array_of(value, f"{where}: the masks are", "a matrix of numbers", "biuf", None, None)
    if matrix.dtype.kind == "f" and not np.isfinite(matrix).all():
        raise PredictionError(f"{where}: the masks have values that are NaN or infinite; expected 0 and 1")
    return matrix


def check_sizes(n_points: int, n_masks: int, where: str) -> None:
    """Raise ``PredictionError`` for more points or masks than any scene has; even empty masks take memory."""
    if n_points > MAX_POINTS or n_masks > MAX_MASKS:
        raise PredictionError(f"{where}: {n_masks} masks of {n_points} points; is it damaged?")


def check_members(n: int, where: str) -> None:
    """Raise ``PredictionError`` for masks with more points in total than in any scene, before allocating memory."""
    if n > MAX_MEMBERS:
        raise PredictionError(f"{where}: the masks have more than {MAX_MEMBERS} points in total; is it damaged?")


def column_members(matrix: NDArray[Any], where: str) -> list[Int32Array]:
    """The nonzero rows of each column of a matrix (points, masks); ``PredictionError`` for values between 0 and 1."""
    n_points, n_masks = matrix.shape
    check_sizes(n_points, n_masks, where)
    parts: list[list[Int32Array]] = [[] for _ in range(n_masks)]
    n = 0
    n_rows = max(1, min(ROWS_AT_ONCE, VALUES_AT_ONCE // max(n_masks, 1)))
    for start in range(0, n_points, n_rows):
        values = matrix[start : start + n_rows]
        if values.dtype.kind == "f" and ((values > 0) & (values < 1)).any():
            raise PredictionError(f"{where}: the masks have values between 0 and 1; apply a threshold to them first")
        part = np.ascontiguousarray((values != 0).T)
        check_members(n := n + int(np.count_nonzero(part)), where)
        for k in range(n_masks):
            parts[k].append((np.flatnonzero(part[k]) + start).astype(np.int32))
    return [np.concatenate([np.zeros(0, np.int32), *part]) for part in parts]


def run_members(length: object, counts: object, where: str) -> Int32Array:
    """The points of a run-length mask: ``counts`` are start, length, start, length, ... with starts counted from 1.

    ``counts`` may be a string, a list or an array.
    """
    if isinstance(length, bool) or not isinstance(length, int | np.integer) or not 0 <= length <= MAX_POINTS:
        raise PredictionError(f"{where}: 'length' is {kind_of(length)}; expected the number of points")
    runs = _run_numbers(counts, where).reshape(-1, 2)
    starts, sizes = runs[:, 0] - 1, runs[:, 1]
    is_wrong = (starts < 0) | (sizes < 0) | (starts > length) | (sizes > length - starts)
    is_wrong[1:] |= starts[1:] < starts[:-1] + sizes[:-1]
    if is_wrong.any():
        start, size = (int(number) for number in runs[int(np.argmax(is_wrong))])
        raise PredictionError(
            f"{where}: run of {size} points from {start} in {length} points; starts must count from 1 and ascend"
        )
    check_members(int(sizes.sum()), where)
    before = np.cumsum(sizes) - sizes
    members: Int32Array = np.arange(int(sizes.sum()), dtype=np.int32)
    members += np.repeat((starts - before).astype(np.int32), sizes)
    return members


def _run_numbers(counts: object, where: str) -> NDArray[np.int64]:
    try:
        values = [int(word) for word in counts.split()] if isinstance(counts, str) else counts
        if isinstance(values, list | tuple) and all(type(value) is int for value in values):
            values = np.array(values, np.int64)
    except (ValueError, OverflowError) as error:
        raise PredictionError(f"{where}: the runs are not numbers") from error
    numbers = values if isinstance(values, np.ndarray) else np.array("")
    if not numbers.size:
        return np.zeros(0, np.int64)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) % 2:
        raise PredictionError(f"{where}: the runs are {kind_of(counts)}; expected pairs of start and length")
    if int(numbers.max()) > MAX_POINTS or int(numbers.min()) < 0:
        raise PredictionError(f"{where}: run value {int(numbers.max())} is out of range; is it damaged?")
    return numbers.astype(np.int64)


def scores_of(value: object, n_masks: int, where: str) -> Float64Array:
    """Scores, one per mask."""
    found = f"{where}: {n_masks} masks, but the scores are"
    return array_of(value, found, "one per mask", "biuf", n_masks).astype(np.float64)


def classes_of(value: object, n_masks: int, where: str) -> Int32Array:
    """Class numbers, one per mask, from an array of integers or of integral floats."""
    classes = array_of(value, f"{where}: {n_masks} masks, but the classes are", "one number per mask", "iuf", n_masks)
    numbers = classes.astype(np.float64)
    is_whole = (np.abs(numbers) < 1 << 31) & (numbers == np.floor(numbers))
    if not is_whole.all():
        worst = int(np.argmin(is_whole))
        raise PredictionError(f"{where}: mask {worst} has class {classes[worst]}; expected an integer")
    return classes.astype(np.int32)


def kind_of(value: object) -> str:
    """A description of a value from a file, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} {value.dtype.name}"
    return printable(str(value), 40) if isinstance(value, int | float) else f"a {type(value).__name__}"


def checked_points(values: object, where: str) -> Float32Array:
    """Points (N, 3) as float32; ``PredictionError`` for another shape, and for values not finite in float32."""
    table = array_of(values, f"{where}: the points are", "three coordinates per point", "fiu", None, 3)
    if len(table) > MAX_POINTS:
        raise PredictionError(f"{where}: has {len(table)} points; is it damaged?")
    points = as_float32(table)
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        raise PredictionError(f"{where}: point {row} is at {table[row].tolist()}; expected finite metres")
    return points


def feature_table(value: object, file: Path) -> Float32Array:
    """Features, one row per object, as float32."""
    found = f"{shown(file)}: contains"
    table = array_of(value, found, "one row of features per object", "f", None, NOT_EMPTY)
    return table if table.dtype == np.float32 else as_float32(table)


def without_nonfinite(features: Float32Array, what: str) -> tuple[Float32Array, tuple[str, ...]]:
    """``features`` with non-finite rows set to zero, and a remark on the number of rows without a feature."""
    is_bad = ~np.isfinite(features).all(axis=1)
    if is_bad.any():
        features = features.copy()
        features[is_bad] = 0
    n = int((~features.any(axis=1)).sum())
    return features, (f"{n} {what} have no feature (a row of zeros or NaN)",) if n else ()


def half_rows(table: NDArray[np.floating[Any]]) -> NDArray[np.float16]:
    """``table`` (N, D) in float16; rows with values out of range are set to zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        rows = table.astype(np.float16)
    rows[~np.isfinite(rows).all(axis=1)] = 0
    return rows


IntegerArray = NDArray[np.integer[Any]]
DIGIT_AND_NEWLINE = 0x0A30  # "0\n" as a little-endian pair
MAX_DIGITS = 18  # of a number that certainly fits int64
LIMIT, MAX_CHARACTERS = 1 << 62, 40  # of a number
LFS_POINTER = b"version https://git-lfs.github.com/spec/"  # the beginning of a file that Git LFS has not fetched


def integer_lines(content: bytes, where: str) -> IntegerArray:
    """The integer of each line; the last newline and a byte-order mark are optional. ``PredictionError`` names the
    first line without one.

    >>> integer_lines(b"0\\n1\\n0\\n", "mask.txt").tolist()
    [0, 1, 0]
    >>> integer_lines(b"12\\n-1", "labels.txt").tolist()
    [12, -1]
    """
    content = content.removeprefix(BOM_UTF8)
    if b"\r" in content:
        if b"\r" in content.replace(b"\r\n", b""):
            return _any_numbers(content, where)  # a single carriage return also ends a line
        content = content.replace(b"\r\n", b"\n")
    if content and not content.endswith(b"\n"):
        content += b"\n"
    values = _single_digits(content)
    if values is None:
        values = _plain_numbers(content)
    return _any_numbers(content, where) if values is None else values


def _single_digits(content: bytes) -> IntegerArray | None:
    """The values if every line is one digit; otherwise None."""
    if len(content) % 2:
        return None
    values = np.frombuffer(content, "<u2") - np.uint16(DIGIT_AND_NEWLINE)  # wraps around for everything else
    return values if len(values) == 0 or int(values.max()) <= 9 else None


def _plain_numbers(content: bytes) -> IntegerArray | None:
    """The values if every line consists of digits; otherwise None."""
    digits = np.frombuffer(content, np.uint8) - np.uint8(ord("0"))  # wraps around: everything else is above 9
    ends = np.flatnonzero(digits == np.uint8(0x100 + ord("\n") - ord("0")))
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts
    if np.count_nonzero(digits > 9) != len(ends) or lengths.min() < 1 or lengths.max() > MAX_DIGITS:
        return None
    return np.fromstring(content, np.int64, sep="\n")


def _any_numbers(content: bytes, where: str) -> IntegerArray:
    """The values of lines with signs or blanks around them."""
    if content.startswith(LFS_POINTER):
        raise PredictionError(f"{where}: is a Git LFS pointer, not the file; run git lfs pull in its repository")
    values: list[int] = []
    for number, line in enumerate(content.splitlines(), 1):
        try:
            values.append(int(line) if len(line) <= MAX_CHARACTERS else LIMIT)
        except ValueError:
            values.append(LIMIT)
        if not -LIMIT < values[-1] < LIMIT:
            text = printable(line[:MAX_CHARACTERS].decode("latin1"))
            raise PredictionError(f"{where}:{number}: '{text}' is not a 64-bit integer; expected one per line")
    return np.array(values, np.int64)


MAX_TEXT_BYTES = 64 << 20  # a trajectory with 100 poses per second for one hour has 30 MB


def read_text(path: Path, where: str, advice: str = "copy the file again", max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file; ``where`` names it in messages."""
    try:
        return read_bytes(path, where, advice, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text file, byte {error.start} is not UTF-8; {advice}") from error


def parsed_json(content: bytes | str, where: str, advice: str = "copy the file again") -> Any:
    """The value of a JSON text."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not JSON ({error}); {advice}") from error
