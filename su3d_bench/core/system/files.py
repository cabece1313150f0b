"""The door through which files are read: a regular file, or an ``OSError`` at once.

A pipe in the place of a file is waited for, for ever, and a device such as ``/dev/zero`` has no end. Nothing outside of
this module opens a file for reading.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_NOTED: list[dict[Path, None]] = []


@contextmanager
def noted() -> Iterator[dict[Path, None]]:
    """The files that are read in the block, each once, in the order in which they were opened first."""
    files: dict[Path, None] = {}
    _NOTED.append(files)
    try:
        yield files
    finally:
        _NOTED.pop()


def regular(path: Path) -> Path:
    """``path``, for a library that opens files itself; an ``OSError`` where no regular file is there."""
    _check_no_others(os.stat(path).st_mode, path)
    for files in _NOTED:
        files[path] = None
    return path


def opened(path: Path) -> io.BufferedReader:
    """The content of ``path`` as a stream; an ``OSError`` where no regular file is there."""
    regular(path)  # a device may act on being opened
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    try:
        _check_no_others(
            os.fstat(handle).st_mode, path
        )  # what was opened may have taken the place of what was looked at
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def opened_text(path: Path, *, errors: str = "strict", newline: str | None = None) -> IO[str]:
    """The UTF-8 text in ``path`` as a stream; ``newline`` as ``open`` has it."""
    return io.TextIOWrapper(opened(path), "utf-8", errors, newline)


def file_bytes(path: Path) -> bytes:
    """The content of ``path``."""
    with opened(path) as stream:
        return stream.read()


def file_text(path: Path, *, errors: str = "strict") -> str:
    """The UTF-8 text in ``path``, its line ends as ``\\n``."""
    with opened_text(path, errors=errors) as stream:
        return stream.read()


def _check_no_others(mode: int, path: Path) -> None:
    if stat.S_ISREG(mode):
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    kind = next((name for is_kind, name in KINDS if is_kind(mode)), "something else")
    raise OSError(errno.EINVAL, f"{kind} stands where a file should be", str(path))


MAX_PARTS = 64  # of a key; the deepest setting has five
_PART = r"""(?:[A-Za-z0-9_-]{1,200}+|"(?:[^"\\\n]|\\.){0,200}+"|'[^'\n]{0,200}+')"""
# tomllib takes time with the square of a key's parts, of which 60 kB can hold 30,000. Parts and gaps are of bounded
# length here, so that the search itself takes time with the length of the text alone.
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}[ \t]{{0,50}}+\.[ \t]{{0,50}}+){{{MAX_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """The table that ``text`` is; ``tomllib.TOMLDecodeError``, a ``ValueError``, where it is none or deeper than use.

    >>> parse_toml("a.b = 1")
    {'a': {'b': 1}}
    """
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise tomllib.TOMLDecodeError(f"A key of more than {MAX_PARTS} parts (at line {line}, column 1)")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except (RecursionError, ValueError) as error:  # nested beyond use, or an integer of thousands of digits
        raise tomllib.TOMLDecodeError(f"Cannot be read: {error}") from error
