"""The one door to terminals and logs: nothing of a file's or a program's text acts on what it is printed to.

What cannot be printed (terminal escapes, returns, direction marks, invisible characters) is written as its escape, and
so is what a machine that runs a job would take for a command to itself: ``::stop-commands::`` at the beginning of a
line, ``##[error]`` and ``##vso[...]`` anywhere in it.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

# The parsers of GitHub's runner (ActionCommand.cs), Azure Pipelines (Command.cs) and TeamCity's service messages.
_COMMAND_FIRST = re.compile(r"^( *):(?=:)")
_COMMAND_ANYWHERE = re.compile(r"##(?=\w*\[)")

MIN_WIDTH = 40  # below which nothing is folded any more


def one_line(text: str) -> str:
    """``text`` on one line, blanks as they are, what acts on a terminal or a log written as its escape.

    >>> one_line("room\\x1b[31m  0\\n::stop-commands::x"), one_line("::error::x"), one_line("a ##[group]")
    ('room\\\\x1b[31m  0\\\\n::stop-commands::x', '\\\\x3a:error::x', 'a #\\\\x23[group]')
    """
    return _COMMAND_FIRST.sub(r"\1\\x3a", escaped(text))


def escaped(text: str) -> str:
    """``text`` with what cannot be printed (also every blank but the common one) written as its escape, and what is a
    command wherever it stands.
    """
    plain = text if text.isprintable() else "".join(map(_shown, text))
    return _COMMAND_ANYWHERE.sub(r"#\\x23", plain) if "##" in plain else plain


def plain_text(text: str) -> str:
    """Lines of ``text``, each as ``one_line`` has it; for a text whose new lines are its own."""
    return "\n".join(map(one_line, text.split("\n")))


def plain_value(value: Any, plain: Callable[[str], str] | None = None) -> Any:
    """A JSON-like value with every text in it as ``plain`` makes it, else ``escaped`` but for its new lines; paths
    become texts."""
    plain = plain or (lambda text: "\n".join(map(escaped, text.split("\n"))))
    if isinstance(value, Mapping):
        return {plain(str(key)): plain_value(item, plain) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(item, plain) for item in value]
    return plain(str(value)) if isinstance(value, str | Path) else value


def escaped_json(value: Any, **form: Any) -> str:
    """JSON that reads back to just ``value`` and holds no character that acts on a terminal; ``form``: as ``dumps``.

    >>> escaped_json({"name": "caf\\u00e9\\u202e\\x9b"})
    '{"name": "café\\\\u202e\\\\u009b"}'
    """
    text = json.dumps(value, ensure_ascii=False, **form)
    if not text.isprintable():
        # Outside its strings JSON holds no such character but the new lines of ours.
        text = "\n".join(line if line.isprintable() else "".join(map(_in_json, line)) for line in text.split("\n"))
    return _COMMAND_ANYWHERE.sub(r"#\\u0023", text)


def _shown(character: str) -> str:
    return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")


def _in_json(character: str) -> str:
    return character if character.isprintable() else json.dumps(character)[1:-1]


class SafeStream(io.TextIOBase):
    """A stream that hands on whole lines, plain; what cannot be written is dropped, and never an error of the writer.

    ``refused`` is why, None where all was written or the reader has gone, as ``head`` does. ``stream`` is None where
    the process was started without one.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.stream = stream
        self.refused: OSError | None = None
        self._is_open = stream is not None
        self._begun = ""  # of a line
        self._sink: Callable[[str], object] = self._put
        self._lock = threading.RLock()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self.stream, "encoding", None) or "utf-8"

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self.stream is not None and not self.stream.closed and self.stream.isatty()

    def fileno(self) -> int:
        if self.stream is None:
            raise io.UnsupportedOperation("no such stream")
        return self.stream.fileno()

    def write(self, text: str) -> int:
        with self._lock:
            lines, newline, self._begun = (self._begun + text).rpartition("\n")
            if newline:
                self._sink(plain_text(lines) + "\n")
        return len(text)

    def flush(self) -> None:
        with self._lock:
            if self._begun:
                self._sink(plain_text(self._begun))
                self._begun = ""
            self._trying(lambda stream: stream.flush())

    def write_command(self, line: str) -> None:
        """A line of ours that is meant as a command to the machine that runs the job; what it quotes is escaped."""
        with self._lock:
            self.flush()
            self._sink(line + "\n")

    def end(self) -> None:
        """Hand on what is left, and drop what a library that keeps this stream writes when the interpreter ends."""
        self.flush()
        self._is_open = False

    @contextmanager
    def through(self, sink: Callable[[str], object]) -> Iterator[None]:
        """Give what is written in the block to ``sink``, as where bars are drawn on the same terminal."""
        before, self._sink = self._sink, sink
        try:
            yield
        finally:
            self.flush()
            self._sink = before

    def _put(self, text: str) -> None:
        known = text.encode(self.encoding, "backslashreplace").decode(self.encoding)
        self._trying(lambda stream: stream.write(known))

    def _trying(self, act: Callable[[TextIO], object]) -> None:
        if self.stream is None or not self._is_open:
            return
        try:
            act(self.stream)
        except (BrokenPipeError, ValueError):  # the reader has gone, or somebody closed the stream
            self._shut()
        except OSError as error:
            self.refused = error
            self._shut()

    def _shut(self) -> None:
        """Drop all from here on, and what the interpreter would still write at its end."""
        self._is_open = False
        with suppress(OSError, ValueError), Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), self.fileno())


def terminal_width() -> int | None:
    """How many characters a line of stdout may have: what ``COLUMNS`` says, else as wide as its terminal is; None where
    it is none."""
    said = os.environ.get("COLUMNS", "")[:6]
    if not sys.stdout.isatty() and not (said.isdecimal() and int(said)):
        return None
    return max(shutil.get_terminal_size().columns, MIN_WIDTH)


@contextmanager
def doors() -> Iterator[SafeStream]:
    """Everything that is printed in the block goes through doors, tracebacks and warnings too; that of stdout."""
    for number in range(3):
        _occupy(number)
    before = sys.stdout, sys.stderr
    out, err = (stream if isinstance(stream, SafeStream) else SafeStream(stream) for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        yield out
    finally:
        sys.stdout, sys.stderr = before
        for door in {out, err}.difference(before):
            door.end()


def _occupy(number: int) -> None:
    """Keep a file that is opened later from taking the place of a standard stream that was closed at the start."""
    try:
        os.fstat(number)
    except OSError:
        os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one


def stream_behind(stream: Any) -> Any:
    """The stream itself, for what draws on a terminal and cleans its texts before."""
    return stream.stream if isinstance(stream, SafeStream) else stream
