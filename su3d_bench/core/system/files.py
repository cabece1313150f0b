"""Open files for reading: only regular files, otherwise an ``OSError`` at once; the working directory of user code.

Reading a pipe would wait for ever, and a device such as ``/dev/zero`` has no end. No other module opens a file for
reading.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_NOTED: list[dict[Path, None]] = []
_USER_CODE = threading.RLock()


@contextmanager
def user_folder(last: list[str], *, waits: bool = False) -> Iterator[None]:
    """Run user-defined code in the working directory that it ``last`` changed to, and return to our own.

    So relative paths of a command, such as ``--out``, hold whatever a method does. ``last`` is empty, or one path.
    While another thread is in such a block, this one does nothing or ``waits``.
    """
    if not _USER_CODE.acquire(blocking=waits):
        yield
        return
    try:
        ours = os.getcwd()
        for folder in last:
            os.chdir(folder)
        try:
            yield
        finally:
            with suppress(OSError):  # theirs was removed
                last[:] = [os.getcwd()]
            os.chdir(ours)
    finally:
        _USER_CODE.release()


@contextmanager
def noted() -> Iterator[dict[Path, None]]:
    """The files read in the block, without duplicates, in the order in which they were first opened."""
    files: dict[Path, None] = {}
    _NOTED.append(files)
    try:
        yield files
    finally:
        _NOTED.pop()


def regular(path: Path) -> Path:
    """``path``, for a library that opens files itself; an ``OSError`` if it is not a regular file."""
    _check_no_others(os.stat(path).st_mode, path)
    for files in _NOTED:
        files[path] = None
    return path


def opened(path: Path) -> io.BufferedReader:
    """The content of ``path`` as a stream; an ``OSError`` if it is not a regular file."""
    regular(path)  # opening a device may have side effects
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    try:
        _check_no_others(os.fstat(handle).st_mode, path)  # it may have been replaced since the check
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def opened_text(path: Path, *, errors: str = "strict", newline: str | None = None) -> IO[str]:
    """The UTF-8 text in ``path`` as a stream; ``newline`` as in ``open``."""
    return io.TextIOWrapper(opened(path), "utf-8", errors, newline)


def file_bytes(path: Path) -> bytes:
    """The content of ``path``."""
    with opened(path) as stream:
        return stream.read()


def file_text(path: Path, *, errors: str = "strict") -> str:
    """The UTF-8 text in ``path``, with line ends ``\\n``."""
    with opened_text(path, errors=errors) as stream:
        return stream.read()


def _check_no_others(mode: int, path: Path) -> None:
    if stat.S_ISREG(mode):
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    kind = next((name for is_kind, name in KINDS if is_kind(mode)), "something else")
    raise OSError(errno.EINVAL, f"{kind} is in the place of a file", str(path))


MAX_PARTS = 64  # of a dotted key; the deepest setting has five
_PART = r"""(?:[A-Za-z0-9_-]{1,200}+|"(?:[^"\\\n]|\\.){0,200}+"|'[^'\n]{0,200}+')"""
# tomllib is quadratic in the number of a key's parts, and 60 kB can have 30,000 of them. Parts and gaps have bounded
# lengths here, so that the search itself is linear in the length of the text.
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}[ \t]{{0,50}}+\.[ \t]{{0,50}}+){{{MAX_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """The table in a TOML ``text``; ``tomllib.TOMLDecodeError``, a ``ValueError``, if it is invalid or nested too deep.

    >>> parse_toml("a.b = 1")
    {'a': {'b': 1}}
    """
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise tomllib.TOMLDecodeError(f"Key has more than {MAX_PARTS} parts (at line {line}, column 1)")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except (RecursionError, ValueError) as error:  # nested too deep, or an integer of thousands of digits
        raise tomllib.TOMLDecodeError(f"Cannot be read: {error}") from error
