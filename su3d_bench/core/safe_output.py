"""Safe output to terminals and logs: text from files and programs is never interpreted as control sequences.

Unprintable characters (terminal escapes, returns, direction marks, invisible characters) are escaped, and so is text
that a CI runner would execute as a command: ``::stop-commands::`` at the beginning of a line, ``##[error]`` and
``##vso[...]`` anywhere in it.
"""

from __future__ import annotations

import io
import json
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO

# The parsers of GitHub's runner (ActionCommand.cs), Azure Pipelines (Command.cs) and TeamCity's service messages.
_COMMAND_FIRST = re.compile(r"^( *):(?=:)")
_COMMAND_ANYWHERE = re.compile(r"##(?=\w*\[)")

MIN_WIDTH = 40  # narrower terminals do not wrap text


def one_line(text: str) -> str:
    """``text`` on one line, spaces unchanged, everything that acts on a terminal or a log escaped.

    >>> one_line("room\\x1b[31m  0\\n::stop-commands::x"), one_line("::error::x"), one_line("a ##[group]")
    ('room\\\\x1b[31m  0\\\\n::stop-commands::x', '\\\\x3a:error::x', 'a #\\\\x23[group]')
    """
    return _COMMAND_FIRST.sub(r"\1\\x3a", escaped(text))


def escaped(text: str) -> str:
    """``text`` with unprintable characters (including all blanks except the space) escaped, and commands that work
    anywhere in a line.
    """
    plain = text if text.isprintable() else "".join(map(_shown, text))
    return _COMMAND_ANYWHERE.sub(r"#\\x23", plain) if "##" in plain else plain


def plain_text(text: str) -> str:
    """Lines of ``text``, each escaped as by ``one_line``; line breaks stay."""
    return "\n".join(map(one_line, text.split("\n")))


def plain_value(value: Any, plain: Callable[[str], str] | None = None) -> Any:
    """A JSON-like value with ``plain`` applied to every string, by default ``escaped`` except line breaks; paths become
    strings."""
    plain = plain or (lambda text: "\n".join(map(escaped, text.split("\n"))))
    if isinstance(value, Mapping):
        return {plain(str(key)): plain_value(item, plain) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(item, plain) for item in value]
    return plain(str(value)) if isinstance(value, str | Path) else value


def escaped_json(value: Any, **form: Any) -> str:
    """JSON that reads back as ``value`` and has no character that acts on a terminal; ``form``: options of ``dumps``.

    >>> escaped_json({"name": "caf\\u00e9\\u202e\\x9b"})
    '{"name": "café\\\\u202e\\\\u009b"}'
    """
    text = json.dumps(value, ensure_ascii=False, **form)
    if not text.isprintable():
        # Outside its strings, the only such characters in JSON are the line breaks from ``indent``.
        text = "\n".join(line if line.isprintable() else "".join(map(_in_json, line)) for line in text.split("\n"))
    return _COMMAND_ANYWHERE.sub(r"#\\u0023", text)


def _shown(character: str) -> str:
    return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")


def _in_json(character: str) -> str:
    return character if character.isprintable() else json.dumps(character)[1:-1]


class SafeStream(io.TextIOBase):
    """A stream that passes on whole lines, escaped; what cannot be written is dropped without an error.

    ``refused`` is the reason, None if all was written or the reader has closed, as ``head`` does. ``stream`` is None if
    the process was started without one.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.stream = stream
        self.refused: OSError | None = None
        self._is_open = stream is not None
        self._begun = ""  # an incomplete line
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
        """Write one of our own lines as a command to the CI runner; the caller escapes what it quotes."""
        with self._lock:
            self.flush()
            self._sink(line + "\n")

    def end(self) -> None:
        """Pass on the rest, and drop what a library that holds this stream writes when the interpreter exits."""
        self.flush()
        self._is_open = False

    @contextmanager
    def through(self, sink: Callable[[str], object]) -> Iterator[None]:
        """Pass what is written in the block to ``sink``, for example while progress bars use the same terminal."""
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
        except (BrokenPipeError, ValueError):  # the reader has gone, or the stream was closed
            self._shut()
        except OSError as error:
            self.refused = error
            self._shut()

    def _shut(self) -> None:
        """Drop all further output, including what the interpreter would write on exit."""
        self._is_open = False
        with suppress(OSError, ValueError), Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), self.fileno())


def terminal_width() -> int | None:
    """The width of stdout in characters: ``COLUMNS``, otherwise that of its terminal; None if it is not a terminal."""
    width_text, stream = os.environ.get("COLUMNS", "")[:6], answer_stream()
    if width_text.isdecimal() and int(width_text):
        return max(int(width_text), MIN_WIDTH)
    return max(os.get_terminal_size(stream.fileno()).columns, MIN_WIDTH) if stream.isatty() else None


@contextmanager
def doors() -> Iterator[SafeStream]:
    """Escape everything printed in the block, including tracebacks and warnings; yields the stream of stdout."""
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


_answers: list[SafeStream] = []


def answer_stream() -> TextIO | SafeStream:
    """The stream for the answer of a command: stdout, also inside ``answers_apart``."""
    return _answers[-1] if _answers else sys.stdout


@contextmanager
def answers_apart() -> Iterator[None]:
    """In a block inside ``doors``, only ``answer_stream`` writes to stdout: what user-defined code, libraries and their
    programs print goes to stderr.
    """
    out = sys.stdout
    assert isinstance(out, SafeStream)
    inner = out.stream
    out.flush()
    _answers.append(out)
    if inner is sys.__stdout__ is not None:  # what is written to its number without Python moves, too
        out.stream = os.fdopen(os.dup(1), "w", encoding=out.encoding)
        os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _answers.pop()
        out.flush()
        if out.stream is not inner and out.stream is not None:
            os.dup2(out.stream.fileno(), 1)
            out.stream.close()
            out.stream = inner


def _occupy(number: int) -> None:
    """Keep a file that is opened later from replacing a standard stream that was closed at the start."""
    try:
        os.fstat(number)
    except OSError:
        os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one


def stream_behind(stream: Any) -> Any:
    """The underlying stream, for code that draws on a terminal and escapes its own text."""
    return stream.stream if isinstance(stream, SafeStream) else stream
