"""TOML of others as tables, read in bounded time."""

from __future__ import annotations

import re
import tomllib
from typing import Any

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
