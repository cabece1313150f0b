"""The two things about TOML that the standard library lacks: the line a key stands on, and writing."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HEADER = re.compile(r"^\s*\[+\s*([^\[\]]+?)\s*\]+\s*(?:#.*)?$")
ASSIGNMENT = re.compile(r"""^\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
KEY = re.compile(r"""[\w-]+|"[^"]*"|'[^']*'""")
BARE_KEY = re.compile(r"^[A-Za-z0-9_-]+$")


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Line number (from 1) of every table header and assignment in valid TOML ``text``."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := HEADER.match(line):
            table = _split(header.group(1))
            lines.setdefault(table, number)
        elif assignment := ASSIGNMENT.match(line):
            lines.setdefault((*table, *_split(assignment.group(1))), number)
    return lines


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in KEY.findall(dotted))


def toml_key(key: str) -> str:
    """``key`` as TOML writes it: bare where that is allowed, quoted otherwise."""
    return key if BARE_KEY.match(key) else json.dumps(key, ensure_ascii=False)


def toml_value(value: Any) -> str:
    """``value`` as TOML writes it: bool, int, float, text, path, and lists of these."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else {math.inf: "inf", -math.inf: "-inf"}.get(value, "nan")
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    raise TypeError(f"no TOML form for {type(value).__name__}")


def write_toml(leaves: Sequence[tuple[tuple[str, ...], Any, str]]) -> str:
    """TOML text of (path, value, remark) leaves, each remark as a comment behind its value; None as a comment only."""
    tables: dict[tuple[str, ...], list[str]] = {(): []}
    for path, value, remark in leaves:
        key = toml_key(path[-1])
        line = f"# {key} is not set  # {remark}" if value is None else f"{key} = {toml_value(value)}  # {remark}"
        tables.setdefault(path[:-1], []).append(line)
    blocks = []
    for table, rows in tables.items():
        header = [f"[{'.'.join(toml_key(key) for key in table)}]"] if table else []
        blocks.append("\n".join([*header, *rows]))
    return "\n\n".join(block for block in blocks if block) + "\n"
