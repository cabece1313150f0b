"""The TOML files of protocols: which there are, what one holds with what it extends, where a key stands, and what
comments say of a rule: its source, or that it is ours."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml

RULES = Path(__file__).parents[1] / "rules"  # a folder for the protocols of each dataset
CLASS_TABLES = RULES / "classes"  # no protocols
HEADING = ""  # stands for the comments above the first rule of a file
_KEY = re.compile(r"(\w+)\s*=")
_SECTION = re.compile(r"\[(\w+)\]")
_COMMENT = re.compile(r"""(?:[^"'#]|"[^"]*"|'[^']*')*#\s*(.*)""")
_ABSENT = re.compile(r"no (\w+)")


def protocol_names() -> list[str]:
    """The names of the built-in protocols."""
    return sorted(_places())


@cache
def _places() -> dict[str, Path]:
    return {path.stem: path for path in RULES.glob("*/*.toml") if path.parent != CLASS_TABLES}


@cache
def class_names() -> tuple[str, ...]:
    """Every name of the class tables, each once, those of the smaller tables first."""
    tables = [_class_rows(path) for path in sorted(CLASS_TABLES.glob("*.toml"))]
    return tuple(dict.fromkeys(str(row[1]) for table in sorted(tables, key=len) for row in table))


def rules_files(name: str) -> tuple[Path, ...]:
    """Where the rules called ``name`` are read from: their own file, then the one that it extends, and so on."""
    return read_content(rules_file(name)).files


def rules_file(name: str) -> Path:
    """The file of the rules called ``name``, or the path ``name`` itself."""
    return _places().get(name) or Path(name)


@dataclass(frozen=True)
class Content:
    """All rules that a file sets or extends, as ``values``; ``files``: the file itself, the one that it extends, ...

    ``original``: the first of them with a table of that name, and the table.
    """

    values: dict[str, Any]
    files: tuple[Path, ...]
    original: tuple[Path, dict[str, Any]] | None


def read_content(path: Path) -> Content:
    """What a TOML file holds, where ``classes`` names a class table or lists rows [id, name] or [id, name, group].

    A file that ``extends`` another, by a protocol's name or by a path from its own folder, has all its rules but those
    that it sets itself; sections are joined key by key, but for ``[original]``, which is no rule.
    """
    chain = _chain(path)
    files = tuple(file for file, _ in chain)
    original = next(((file, own["original"]) for file, own in chain if "original" in own), None)
    if original is not None and not isinstance(original[1], dict):
        raise ConfigError(f"{line_of([original[0]], 'original')}: original must be a table, [original]")
    values: dict[str, Any] = {}
    for _, own in reversed(chain):
        for key, value in own.items():
            if key == "original":
                continue
            is_section = isinstance(value, dict) and isinstance(values.get(key), dict)
            values[key] = values[key] | value if is_section else value
    table = values.get("classes")
    if isinstance(table, str):
        tables = {path.stem: path for path in CLASS_TABLES.glob("*.toml")}
        if table not in tables:
            hint = suggest(table, sorted(tables))
            raise ConfigError(f"{line_of(files, 'classes')}: unknown class table '{table}'{hint}")
        values["classes"] = _class_rows(tables[table])
    if "classes" in values:
        values["classes"] = _entries(files, values.get("classes"))
    return Content(values, files, original)


def _class_rows(path: Path) -> list[Any]:
    """The rows of a class table: those of the one that it ``extends``, then its own.

    With ``groups`` of ``thirds`` the first third of all rows, rounded down, is head, the second common, the next tail.
    """
    content = _read_toml(path)
    rows: list[Any] = content.get("classes", [])
    if "extends" in content:
        rows = [*_class_rows(CLASS_TABLES / f"{content['extends']}.toml"), *rows]
    if content.get("groups") != "thirds":
        return rows
    third = len(rows) // 3
    groups = [*(["head"] * third), *(["common"] * third), *(["tail"] * third)]
    return [[*row[:2], *groups[place : place + 1]] for place, row in enumerate(rows)]


def _chain(path: Path) -> list[tuple[Path, dict[str, Any]]]:
    """A protocol's file and what it holds, the file that it extends, and so on."""
    chain: list[tuple[Path, dict[str, Any]]] = []
    while True:
        content = _read_toml(path)
        chain.append((path, content))
        if "extends" not in content:
            return chain
        name, where = content.pop("extends"), line_of([path], "extends")
        if not isinstance(name, str):
            raise ConfigError(f"{where}: extends must be a protocol's name or the path of a .toml file, not {name!r}")
        known = protocol_names()
        if name not in known and not name.endswith(".toml"):
            raise ConfigError(f"{where}: extends the unknown protocol '{name}'{suggest(name, known)}")
        path = rules_file(name) if name in known else path.parent / name
        if path.resolve() in [file.resolve() for file, _ in chain]:
            raise ConfigError(f"{where}: extends itself: {' -> '.join(file.name for file, _ in chain)} -> {path.name}")


def _entries(files: Sequence[Path], table: Any) -> list[dict[str, Any]]:
    keys = ("id", "name", "group")
    if not isinstance(table, list) or not all(isinstance(row, list) and 2 <= len(row) <= 3 for row in table):
        raise ConfigError(f"{line_of(files, 'classes')}: classes must be a table's name or rows of [id, name]")
    return [dict(zip(keys, row, strict=False)) for row in table]


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return parse_toml(file_text(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, thousands of digits, nested thousands deep
        raise ConfigError(f"{path}: is no valid TOML: {error}") from error


def line_of(files: Sequence[Path], key: str) -> str:
    """``path:line`` of the first line that sets ``key``, or the first file alone."""
    for path in files:
        for number, line in enumerate(file_text(path).splitlines(), start=1):
            if re.match(rf"\s*{re.escape(key)}\s*=", line):
                return f"{path}:{number}"
    return str(files[0])


def remarks_of(files: Sequence[Path]) -> dict[str, list[str]]:
    """The comments of a protocol's file and of those that it extends; one that sets a rule alone speaks of it."""
    each = [read_remarks(file) for file in files]
    remarks = {key: lines for own in reversed(each) for key, lines in own.items()}
    remarks[HEADING] = list(each[0].get(HEADING, []))
    for file, own in zip(files[1:], each[1:], strict=True):
        remarks[HEADING] += [f"extends {file.stem}:", *own.get(HEADING, [])]
    return remarks


def read_remarks(file: Path) -> dict[str, list[str]]:
    """The comments of a protocol's file by the rule that they stand at or above, the first ones as its heading.

    A comment ``no cap_m ...`` speaks of the rule that it names; comments with no rule after them belong to their
    section.
    """
    from su3d_bench.metrics.protocols.model import ProtocolRules, TransferRules

    remarks: dict[str, list[str]] = {}
    section, waiting, has_key = "", list[str](), False
    for line in file_text(file).splitlines():
        match = _COMMENT.match(line)
        comment = [match[1]] if match is not None else []
        key, header = _KEY.match(line), _SECTION.match(line)
        if key or header:
            name = section + key[1] if key else header[1] if header else ""
            remarks.setdefault(name if has_key else HEADING, []).extend(waiting)
            remarks.setdefault(name, []).extend(comment)
            waiting, has_key = [], True
            section = f"{header[1]}." if header else section
        elif comment:
            absent = _ABSENT.match(comment[0])
            fields = TransferRules.model_fields if section else ProtocolRules.model_fields
            names_one = absent is not None and absent[1] in fields
            (remarks.setdefault(section + absent[1], []) if absent and names_one else waiting).extend(comment)
    remarks.setdefault(section.rstrip(".") or HEADING, []).extend(waiting)
    return remarks
