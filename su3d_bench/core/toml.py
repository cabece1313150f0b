"""TOML of others as tables of bounded depth, read in bounded time."""

from __future__ import annotations

import re
import tomllib
from typing import Any

MOST_CHARACTERS = 8 << 20  # the largest files, of queries and classes, have some hundred kilobytes
MOST_PARTS = 64  # of a key, and levels of a table; the deepest setting has five
_PART = r"""(?:[A-Za-z0-9_-]{1,200}+|"(?:[^"\\\n]|\\.){0,200}+"|'[^'\n]{0,200}+')"""
# tomllib takes time with the square of a key's parts, of which 60 kB can hold 30,000. Parts and gaps are of bounded
# length here, so that the search itself takes time with the length of the text alone.
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}[ \t]{{0,50}}+\.[ \t]{{0,50}}+){{{MOST_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """The table that ``text`` is; ``tomllib.TOMLDecodeError``, a ``ValueError``, where it is none or deeper than use.

    >>> parse_toml("a.b = 1")
    {'a': {'b': 1}}
    """
    if len(text) > MOST_CHARACTERS:
        raise tomllib.TOMLDecodeError(f"Has {len(text)} characters, more than {MOST_CHARACTERS}")
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise tomllib.TOMLDecodeError(f"A key of more than {MOST_PARTS} parts (at line {line}, column 1)")
    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise tomllib.TOMLDecodeError(_TOO_DEEP) from error
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # an integer of thousands of digits
        raise tomllib.TOMLDecodeError(str(error)) from error
    _check_depth(table)
    return table


_TOO_DEEP = f"Nested more than {MOST_PARTS} deep"


def _check_depth(table: dict[str, Any]) -> None:
    level: list[Any] = [table]
    for _ in range(MOST_PARTS):
        inner = [list(one.values()) if isinstance(one, dict) else one for one in level if isinstance(one, dict | list)]
        if not inner:
            return
        level = [value for values in inner for value in values]
    if any(isinstance(one, dict | list) for one in level):
        raise tomllib.TOMLDecodeError(_TOO_DEEP)
