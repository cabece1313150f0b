"""Arrays out of files, checked before they are used: masks as matrices and run lengths, points, features, scores."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, PredictionError, printable, shown
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array
from su3d_bench.formats.images import read_bytes

MOST_POINTS = 100_000_000  # points of one scene; the largest scans of rooms have some millions
MOST_MASKS = 100_000  # of one scene; methods give some hundred
MOST_MEMBERS = 50_000_000  # points of all masks of a scene together; 600 of a large ScanNet scene have 10 million
ROWS_AT_ONCE, VALUES_AT_ONCE = 1 << 16, 1 << 25  # 600 masks of 55,000 points


def matrix_of(value: object, where: str, what: str = "the masks") -> NDArray[Any]:
    """``value`` as a matrix of numbers of which none is NaN or infinite."""
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind not in "biuf":
        raise PredictionError(f"{where}: {what} are {kind_of(value)}; expected a matrix of numbers")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise PredictionError(f"{where}: {what} have values that are NaN or infinite; expected 0 and 1")
    return value


def check_sizes(n_points: int, n_masks: int, where: str) -> None:
    """Refuses more points or masks than any scene has, which cost memory even where the masks are empty."""
    if n_points > MOST_POINTS or n_masks > MOST_MASKS:
        raise PredictionError(f"{where}: {n_masks} masks of {n_points} points; is it damaged?")


def check_members(n: int, where: str) -> None:
    """Refuses masks that hold more points together than those of any scene, before they take memory."""
    if n > MOST_MEMBERS:
        raise PredictionError(f"{where}: the masks hold more than {MOST_MEMBERS} points together; is it damaged?")


def column_members(matrix: NDArray[Any], where: str) -> list[Int32Array]:
    """The rows that are not zero in each column of (points, masks)."""
    n_points, n_masks = matrix.shape
    check_sizes(n_points, n_masks, where)
    parts: list[list[Int32Array]] = [[] for _ in range(n_masks)]
    n = 0
    n_rows = max(1, min(ROWS_AT_ONCE, VALUES_AT_ONCE // max(n_masks, 1)))
    for start in range(0, n_points, n_rows):
        part = np.ascontiguousarray((matrix[start : start + n_rows] != 0).T)
        check_members(n := n + int(np.count_nonzero(part)), where)
        for k in range(n_masks):
            parts[k].append((np.flatnonzero(part[k]) + start).astype(np.int32))
    return [np.concatenate([np.zeros(0, np.int32), *part]) for part in parts]


def run_members(length: object, counts: object, where: str) -> Int32Array:
    """The points of a run-length mask: ``counts`` are start, length, start, length, ... with starts from 1 on.

    ``counts`` may be a text, a list or an array, as the programs write it.
    """
    if isinstance(length, bool) or not isinstance(length, int | np.integer) or not 0 <= length <= MOST_POINTS:
        raise PredictionError(f"{where}: 'length' is {kind_of(length)}; expected the number of points")
    runs = _run_numbers(counts, where).reshape(-1, 2)
    starts, sizes = runs[:, 0] - 1, runs[:, 1]
    is_wrong = (starts < 0) | (sizes < 0) | (starts > length) | (sizes > length - starts)
    is_wrong[1:] |= starts[1:] < starts[:-1] + sizes[:-1]
    if is_wrong.any():
        start, size = (int(number) for number in runs[int(np.argmax(is_wrong))])
        raise PredictionError(
            f"{where}: run of {size} points from {start} on, of {length} points; runs count from 1 and ascend"
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
        raise PredictionError(f"{where}: the runs are no numbers") from error
    numbers = values if isinstance(values, np.ndarray) else np.array("")
    if not numbers.size:
        return np.zeros(0, np.int64)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) % 2:
        raise PredictionError(f"{where}: the runs are {kind_of(counts)}; expected pairs of start and length")
    if int(numbers.max()) > MOST_POINTS or int(numbers.min()) < 0:
        raise PredictionError(f"{where}: a run with {int(numbers.max())}; is it damaged?")
    return numbers.astype(np.int64)


def scores_of(value: object, n_masks: int, where: str) -> Float64Array:
    """Scores, one a mask."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf" or value.shape != (n_masks,):
        raise PredictionError(f"{where}: {n_masks} masks, but the scores are {kind_of(value)}")
    return value.astype(np.float64)


def classes_of(value: object, n_masks: int, where: str) -> Int32Array:
    """Class numbers, one a mask, from an array of integers or of floats without a fraction."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf" or value.shape != (n_masks,):
        raise PredictionError(f"{where}: {n_masks} masks, but the classes are {kind_of(value)}")
    is_whole = np.isfinite(value) & (np.abs(value.astype(np.float64)) < 1 << 31)
    is_whole[is_whole] = value[is_whole] == np.floor(value[is_whole])
    if not is_whole.all():
        worst = int(np.argmin(is_whole))
        raise PredictionError(f"{where}: mask {worst} has class {value[worst]}; expected an integer")
    return value.astype(np.int32)


def kind_of(value: object) -> str:
    """What a value out of a file is, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} {value.dtype.name}"
    return printable(str(value), 40) if isinstance(value, int | float) else f"a {type(value).__name__}"


def checked_points(values: object, where: str) -> Float32Array:
    """Points (N, 3) as float32; ``PredictionError`` for another shape, and for what float32 metres cannot hold."""
    is_table = isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == 3
    if not isinstance(values, np.ndarray) or not is_table or values.dtype.kind not in "fiu":
        raise PredictionError(f"{where}: the points are {kind_of(values)}; expected three coordinates a point")
    if len(values) > MOST_POINTS:
        raise PredictionError(f"{where}: has {len(values)} points; is it damaged?")
    with np.errstate(over="ignore", invalid="ignore"):
        points = values.astype(np.float32)
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        raise PredictionError(f"{where}: point {row} is at {values[row].tolist()}; expected finite metres")
    return points


def feature_table(value: object, file: Path) -> Float32Array:
    """A row of features an object, as float32."""
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind != "f" or not value.shape[1]:
        raise PredictionError(f"{shown(file)}: holds {kind_of(value)}; expected a row of features an object")
    with np.errstate(over="ignore", invalid="ignore"):
        return value.astype(np.float32, copy=False)


def without_nonfinite(features: Float32Array, what: str) -> tuple[Float32Array, tuple[str, ...]]:
    """``features`` with rows of zeros in place of rows that hold NaN or infinity, and how many rows have no feature."""
    is_bad = ~np.isfinite(features).all(axis=1)
    if is_bad.any():
        features = features.copy()
        features[is_bad] = 0
    n = int((~features.any(axis=1)).sum())
    return features, (f"{n} {what} have no feature (a row of zeros or NaN)",) if n else ()


def half_rows(table: NDArray[np.floating[Any]]) -> NDArray[np.float16]:
    """``table`` (N, D) in float16, rows of zeros in place of those that hold what it cannot."""
    with np.errstate(over="ignore", invalid="ignore"):
        rows = table.astype(np.float16)
    rows[~np.isfinite(rows).all(axis=1)] = 0
    return rows


IntegerArray = NDArray[np.integer[Any]]
DIGIT_AND_NEWLINE = 0x0A30  # "0\n" as a little-endian pair
MOST_DIGITS = 18  # of a number that int64 surely holds
LIMIT = 1 << 62
WORD = 8  # characters, the first of which is the lowest byte
LFS_POINTER = b"version https://git-lfs.github.com/spec/"  # how the file begins that stands for one not fetched
ZEROS = 0x3030303030303030  # "00000000"
# Neighbours become one number of twice their width: two digits, then two pairs of digits, then two of four.
PAIRS = tuple(
    (np.uint64(bits), np.uint64(factor), np.uint64(kept))
    for bits, factor, kept in ((8, 10, 0x00FF00FF00FF00FF), (16, 100, 0x0000FFFF0000FFFF), (32, 10_000, 0xFFFFFFFF))
)


def integer_lines(content: bytes, where: str) -> IntegerArray:
    """The integer of each line; the last line may lack its end. ``PredictionError`` names the first line without one.

    >>> integer_lines(b"0\\n1\\n0\\n", "mask.txt").tolist()
    [0, 1, 0]
    >>> integer_lines(b"12\\n-1", "labels.txt").tolist()
    [12, -1]
    """
    if b"\r" in content:
        if b"\r" in content.replace(b"\r\n", b""):
            return _any_numbers(content, where)  # a carriage return alone ends a line, too
        content = content.replace(b"\r\n", b"\n")
    if content and not content.endswith(b"\n"):
        content += b"\n"
    values = _single_digits(content)
    if values is None:
        values = _plain_numbers(content)
    return _any_numbers(content, where) if values is None else values


def _single_digits(content: bytes) -> IntegerArray | None:
    """The values where every line is one digit; None where one is not."""
    if len(content) % 2:
        return None
    values = np.frombuffer(content, "<u2") - np.uint16(DIGIT_AND_NEWLINE)  # wraps around for everything else
    return values if len(values) == 0 or int(values.max()) <= 9 else None


def _plain_numbers(content: bytes) -> IntegerArray | None:
    """The values where every line is some digits; None where one is not."""
    digits = np.frombuffer(content, np.uint8) - np.uint8(ord("0"))  # wraps around: all else is above 9
    ends = np.flatnonzero(digits == np.uint8(0x100 + ord("\n") - ord("0")))
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts
    if np.count_nonzero(digits > 9) != len(ends) or lengths.min() < 1 or lengths.max() > MOST_DIGITS:
        return None
    before = b"0" * MOST_DIGITS + content  # no number reaches beyond its beginning
    eights = np.ndarray((len(before) - WORD + 1,), "<u8", before, strides=(1,))  # from every byte on
    values = np.zeros(len(ends), np.uint64)
    for place in range(0, int(lengths.max()), WORD):
        of_line = eights[ends + (MOST_DIGITS - WORD - place)]
        values += _eight_digits(of_line, lengths - place) * np.uint64(10**place)
    return values.astype(np.int64)


def _eight_digits(words: NDArray[np.uint64], n_digits: NDArray[np.int64]) -> NDArray[np.uint64]:
    """The numbers that the last ``n_digits`` characters of each eight stand for, all eight side by side in a word."""
    others = (8 * np.clip(WORD - n_digits, 0, WORD)).astype(np.uint64)  # bits; all 64 where no digit is left
    words = ((words ^ np.uint64(ZEROS)) >> others) << others
    for bits, factor, kept in PAIRS:
        words = (words * factor + (words >> bits)) & kept
    return words


def _any_numbers(content: bytes, where: str) -> IntegerArray:
    """The values of lines with signs or blanks around them."""
    if content.startswith(LFS_POINTER):
        raise PredictionError(f"{where}: is a pointer of Git LFS, not the file; run git lfs pull in its repository")
    lines = content.splitlines()
    values = np.empty(len(lines), np.int64)
    for number, line in enumerate(lines, 1):
        try:
            value = int(line) if len(line) <= 40 else LIMIT
        except ValueError as error:
            text = printable(line[:40].decode("latin1"))
            raise PredictionError(f"{where}:{number}: '{text}' is not an integer; expected one a line") from error
        if not -LIMIT < value < LIMIT:
            text = printable(line[:40].decode("latin1"))
            raise PredictionError(f"{where}:{number}: '{text}' is out of range; expected one integer a line")
        values[number - 1] = value
    return values


MAX_TEXT_BYTES = 64 << 20  # a trajectory of 100 poses a second for an hour has 30 MB


def read_text(path: Path, where: str, advice: str = "copy the file again", max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file; ``where`` names it and begins each message."""
    try:
        return read_bytes(path, where, advice, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text file, byte {error.start} is not UTF-8; {advice}") from error


def parsed_json(content: bytes | str, where: str, advice: str = "copy the file again") -> Any:
    """What a JSON file holds."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not JSON ({error}); {advice}") from error
