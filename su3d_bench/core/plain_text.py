"""Text that came out of files, made fit to be shown: no control character reaches a terminal or a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

MOST_CHARACTERS = 500  # of one message: a hostile file may hold a line of any length


def printable(text: str, limit: int = MOST_CHARACTERS) -> str:
    """``text`` on one line, what cannot be printed (terminal escapes, direction marks) written as its escape.

    >>> printable("room\\x1b[31m 0\\n")
    'room\\\\x1b[31m 0'
    """
    line = " ".join(text.split())
    plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
    return plain if len(plain) <= limit else plain[: limit - 3] + "..."


def shown(path: Path) -> str:
    """A path as messages show it."""
    return printable(str(path), 300)


def printable_json(value: Any) -> Any:
    """A JSON-like value with every text in it made printable; paths become texts."""
    if isinstance(value, dict):
        return {printable(str(key)): printable_json(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [printable_json(one) for one in value]
    return printable(str(value)) if isinstance(value, str | Path) else value
