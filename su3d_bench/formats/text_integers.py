"""One integer a line, as ScanNet's tools write masks and labels: fast where the lines are plain, strict everywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable

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
