"""Typed errors for everything that a user can cause: one line each, one exit code each.

The form of a message is *where: what is wrong (value); what to do*, in lower case, without a full stop.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeGuard

from su3d_bench.core.english import plural
from su3d_bench.core.safe_output import escaped, plain_value

UNUSABLE = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM, errno.ENOTDIR)
MESSAGE_CHARACTERS = 500  # of one message: a hostile file may contain a line of any length


def printable(text: str, limit: int = MESSAGE_CHARACTERS) -> str:
    """``text`` on one line, unprintable characters (terminal escapes, direction marks) escaped.

    >>> printable("room\\x1b[31m 0\\n")
    'room\\\\x1b[31m 0'
    """
    line = " ".join(text.split())
    plain = escaped(line)
    return plain if len(plain) <= limit else plain[: limit - 3] + "..."


def counted(n: int, noun: str) -> str:
    """A number with its noun.

    >>> counted(1, "scene"), counted(2, "class")
    ('1 scene', '2 classes')
    """
    return f"{n} {noun if n == 1 else plural(noun)}"


def shown(path: Path) -> str:
    """A path as messages show it."""
    return printable(str(path), 300)


def printable_json(value: Any) -> Any:
    """A JSON-like value with every string in it made printable; paths become strings."""
    return plain_value(value, printable)


MAX_CHOICES = 30  # listed on one line; enough for every command
MAX_CHARACTERS = 1000  # of a message, which may quote a hostile file and name a deep folder
EXIT_DONE = 0
EXIT_CHECK_FAILED = 1
EXIT_WRONG_INPUT = 2
EXIT_INCOMPLETE = 3
EXIT_INTERNAL = 4


class Su3dError(Exception):
    """Base class of every error that a user can cause.

    Its text is one printable line of bounded length, because it is shown in terminals, records and pages.

    >>> import su3d_bench as su3d
    >>> try:
    ...     su3d.load_protocol("rooms-instances")
    ... except su3d.Su3dError as error:
    ...     print(str(error).partition("; known")[0].partition("? ")[0])
    unknown protocol 'rooms-instances'; did you mean 'rooms-instance'
    """

    exit_code = EXIT_WRONG_INPUT

    def __str__(self) -> str:
        return printable(super().__str__(), MAX_CHARACTERS)


class ConfigError(Su3dError):
    """A configuration value, key or command-line argument that cannot be used."""


class DataError(Su3dError):
    """A dataset, scene or file that is missing, damaged or inconsistent."""


class PlugInError(ConfigError):
    """A user-defined dataset or method that is invalid; the message begins with its file and line."""


class GroundTruthMissing(DataError):
    """The scene has no ground truth in the form that a protocol needs: it runs without a score."""


class ScenesMissing(DataError):
    """No scene of a dataset was found."""


def no_scene(dataset: str, root: Path, advice: str) -> ScenesMissing:
    """The error if ``root`` has no scene of a dataset, or does not exist; ``advice`` on how to get one."""
    return ScenesMissing(
        f"{dataset}: no scene in {root}{'' if root.is_dir() else ' (there is no such folder)'}{advice}"
    )


class FramesMissing(DataError):
    """The scene has no frames: its ground truth can be viewed, but no method can run on it."""


class PredictionError(Su3dError):
    """A prediction that cannot be scored."""


class ModelMissing(Su3dError):
    """Weights or an optional package that a profile or method needs are missing."""


class StoreError(Su3dError):
    """The run folder cannot be written, or contains another run."""


class RunIncomplete(Su3dError):
    """Some scenes of the run failed."""

    exit_code = EXIT_INCOMPLETE


class CheckFailed(Su3dError):
    """A requested check did not pass."""

    exit_code = EXIT_CHECK_FAILED


def with_notes(error: Su3dError, notes: Iterable[str]) -> Su3dError:
    """The error with further lines, which the command line prints below its own."""
    for note in notes:
        error.add_note(printable(note, MAX_CHARACTERS))
    return error


def some(names: Sequence[str], most: int) -> str:
    """The first ``most`` of ``names``, and how many more there are.

    >>> some(("a", "b", "c"), 2), some(("a", "b"), 2)
    ('a, b and 1 more', 'a, b')
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def nearest(word: str, known: Iterable[str]) -> str:
    """A clause ``; did you mean 'x'?`` for the known word nearest to ``word``, or nothing when none is near."""
    import difflib

    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


def suggest(word: str, known: Iterable[str], are: str = "known:") -> str:
    """The end of a message on an unknown choice: the nearest known word and all choices; empty without choices.

    >>> suggest("tabel", ["table", "list"]), suggest("x", ["table", "list"], "it has")
    ("; did you mean 'table'? known: table, list", '; it has table, list')
    """
    choices = list(dict.fromkeys(known))
    near = nearest(word, choices)
    return f"{near or ';'} {are} {some(choices, MAX_CHOICES)}" if choices else ""


@contextmanager
def reading(where: str, error_class: type[Su3dError] = PredictionError) -> Iterator[None]:
    """Raise missing or unreadable files and folders in the block as ``error_class``."""
    try:
        yield
    except OSError as error:
        raise error_class(f"{where}: cannot be read: {error.strerror or error}") from error


@contextmanager
def converted(known: type[Su3dError], wanted: type[Su3dError]) -> Iterator[None]:
    """Raise errors of one class in the block as errors of another, with the same text."""
    try:
        yield
    except known as error:
        raise wanted(str(error)) from error


@cache
def _library_folders() -> tuple[str, ...]:
    """The folders of the program's code and of installed packages; code elsewhere is user-defined."""
    import sysconfig

    package = Path(__file__).resolve().parents[1]
    links = (link.resolve() for link in package.iterdir() if link.is_dir())
    installed = (Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    return tuple(str(folder) for folder in (package, *links, *installed))


def is_unusable_path(error: BaseException) -> TypeGuard[OSError]:
    """Whether the system rejects a path that the user named: too long, a loop of links, or not permitted."""
    return isinstance(error, OSError) and error.errno in UNUSABLE and error.filename is not None


def user_code_line(error: BaseException) -> str:
    """``my_method.py:12``: the deepest line of a user-defined file in the traceback of ``error``; empty without one."""
    import traceback

    if isinstance(error, SyntaxError) and error.filename and not error.filename.startswith(_library_folders()):
        return printable(f"{Path(error.filename).name}:{error.lineno}", 200)
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        if not file.startswith((*_library_folders(), "<")):
            return printable(f"{Path(file).name}:{line}", 200)
    return ""


def error_line(error: BaseException) -> str:
    """One line for any error; other than a ``Su3dError``, with its type and the line of the user-defined file."""
    import traceback

    text = printable(str(traceback.TracebackException(type(error), error, None)), MAX_CHARACTERS)  # never raises
    if isinstance(error, MemoryError):
        return f"out of memory ({text or 'no details'}); try fewer --jobs or a machine with more memory"
    if isinstance(error, Su3dError):
        return text
    place = user_code_line(error)
    if is_unusable_path(error):
        text = f"{printable(str(error.filename), 200)}: {error.strerror}; choose another file or folder"
        return f"{place}: {text}" if place else text
    return ": ".join(filter(None, (place, type(error).__name__, text)))
