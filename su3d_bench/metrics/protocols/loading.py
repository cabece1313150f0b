"""Named, versioned evaluations from the files of ``rules/`` and from user-defined files.

A protocol is chosen by name, or by the path of a TOML file of the same form. Unknown keys and wrong values are
one-line errors that name the file and the key.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.core.arguments import typed
from su3d_bench.core.config import flatten
from su3d_bench.core.errors import ConfigError, counted, suggest
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.metrics.protocols.kinds import RULES_OF_KIND
from su3d_bench.metrics.protocols.model import SECTIONS, ProtocolRules, TransferRules

Text = Annotated[str, Field(min_length=1, max_length=400)]
# Fields that name a protocol, or state its use or display, and do not affect any value.
NAMING = {"name", "version", "summary", "datasets", "by_default", "headline", "not_comparable_with"}
_OF_CODE = ("code", "commit", "files", "licence", "compared")


class Original(BaseModel):
    """The table ``[original]`` of a protocol's file.

    ``code`` is a GitHub repository, as owner/name, whose ``files`` at ``commit`` evaluate; ``licence`` is that of the
    code and ``data`` the terms of the scored data, "none stated" if unknown. ``compared`` states which values of both
    were compared, or why none were; ``problems``: the number of generated problems that both scored, with no value
    differing by more than ``largest_difference``; ``cases``: files with results of the original, as paths or patterns
    from the repository's root. ``none`` states why there is no original, instead of everything except ``data``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    none: Text | None = None
    code: Annotated[str, Field(pattern=r"^[\w.-]+/[\w.-]+$")] | None = None
    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{7,40}$")] | None = None
    files: tuple[Text, ...] = ()
    licence: Text | None = None
    data: Text
    compared: Text | None = None
    problems: Annotated[int, Field(ge=0)] = 0
    largest_difference: Annotated[float, Field(ge=0)] | None = None
    cases: tuple[Text, ...] = ()

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        there = [field for field in _OF_CODE if getattr(self, field)]
        expected = [*_OF_CODE] if self.none is None else []
        if there != expected or (self.none is not None and (self.problems or self.cases)):
            raise ValueError(f"give {', '.join(_OF_CODE)}, or only data and none = why there is no original")
        if (self.largest_difference is not None) != (self.problems > 0):
            raise ValueError("largest_difference: give it if, and only if, there are problems")
        return self

    @property
    def place(self) -> str | None:
        """The address of the code; None without an original."""
        return None if self.code is None else f"https://github.com/{self.code}/tree/{self.commit}"

    @property
    def comparison_summary(self) -> str:
        """What was compared, the number of problems, the largest difference and the files with cases.

        >>> Original(none="ours", data="made by the program").comparison_summary
        ''
        """
        if self.compared is None:
            return ""
        parts = [self.compared]
        if self.largest_difference is not None:
            parts.append(f"{self.problems:,} test cases, largest difference {self.largest_difference:g}")
        if self.cases:
            parts.append(f"cases in {', '.join(self.cases)}")
        return "; ".join(parts)

    @property
    def facts(self) -> dict[str, str]:
        """All entries by their displayed names, in order, without empty ones."""
        kind_name = {
            "original": f"{self.code} at {self.commit}" if self.none is None else f"none: {self.none}",
            "its files": ", ".join(self.files),
            "licence of its code": self.licence or "",
            "licence of the data": self.data,
            "compared": self.comparison_summary,
        }
        return {name: text for name, text in kind_name.items() if text}


@dataclass(frozen=True)
class ResolvedOriginal:
    """The original in a protocol's file, or inherited from the protocol called ``base`` that it extends."""

    original: Original
    base: str | None

    @property
    def facts(self) -> dict[str, str]:
        """Those of the original; a protocol that inherits it has additional rules."""
        facts = self.original.facts
        return facts if self.base is None else {"original of": f"{self.base}, which these rules extend", **facts}


def original_of(name: str) -> ResolvedOriginal | None:
    """The original of the protocol or file ``name``; None for a user-defined file that does not state one.

    ``ConfigError`` for an incomplete table, and for a built-in protocol without one.

    >>> original_of("scannet-instance").original.code
    'ScanNet/ScanNet'
    """
    file = rules_file(name)
    content = read_content(file)
    if content.original is None:
        if RULES in file.parents:
            raise ConfigError(
                f"{file}: the table [original] is missing; it states the source of the evaluation, or none = why"
            )
        return None
    where, table = content.original
    return ResolvedOriginal(read_original(where, table), None if where == file else where.stem)


def read_original(file: Path, table: Mapping[str, Any]) -> Original:
    """The table ``[original]`` of a file; a one-line ``ConfigError`` if it is invalid."""
    try:
        return Original.model_validate(_with_tuples(table))
    except ValidationError as error:
        raise ConfigError(_first_line([file], error, "original")) from error


RULES = Path(__file__).parents[1] / "rules"  # one folder per dataset
CLASS_TABLES = RULES / "classes"  # no protocols
ALL_PROTOCOLS = "all"  # requests every default protocol
HEADING = ""  # key of the comments above the first rule of a file
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
    """All names of the class tables, without repeats, those of smaller tables first."""
    tables = [_class_rows(path) for path in sorted(CLASS_TABLES.glob("*.toml"))]
    return tuple(dict.fromkeys(str(row[1]) for table in sorted(tables, key=len) for row in table))


def rules_files(name: str) -> tuple[Path, ...]:
    """The files of the rules called ``name``: their own file, then the one that it extends, and so on."""
    return read_content(rules_file(name)).files


def rules_file(name: str) -> Path:
    """The file of the rules called ``name``, or the path ``name`` itself."""
    return _places().get(name) or Path(name)


@dataclass(frozen=True)
class Content:
    """All rules that a file sets or inherits, as ``values``; ``files``: the file itself, the one that it extends, ...

    ``original``: the first of them with a table of that name, and the table.
    """

    values: dict[str, Any]
    files: tuple[Path, ...]
    original: tuple[Path, dict[str, Any]] | None


def read_content(path: Path) -> Content:
    """The content of a TOML file; ``classes`` names a class table or lists rows [id, name] or [id, name, group].

    A file that ``extends`` another, by a protocol's name or by a path relative to its own folder, inherits all rules
    that it does not set itself; sections are merged key by key, except ``[original]``, which is not a rule.
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
        values["classes"] = _entries(files, values["classes"])
    return Content(values, files, original)


def _class_rows(path: Path) -> list[Any]:
    """The rows of a class table: those of the table that it ``extends``, then its own.

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
    """A protocol's file with its content, the file that it extends, and so on."""
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
    except (ValueError, RecursionError) as error:  # invalid TOML or UTF-8, thousands of digits, nested thousands deep
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error


def line_of(files: Sequence[Path], key: str) -> str:
    """``path:line`` of the first line that sets ``key``, or only the first file."""
    for path in files:
        for number, line in enumerate(file_text(path).splitlines(), start=1):
            if re.match(rf"\s*{re.escape(key)}\s*=", line):
                return f"{path}:{number}"
    return str(files[0])


def remarks_of(files: Sequence[Path]) -> dict[str, list[str]]:
    """The comments of a protocol's file and of those that it extends, each rule with those of the file that sets it."""
    each = [read_remarks(file) for file in files]
    remarks = {key: lines for own in reversed(each) for key, lines in own.items()}
    remarks[HEADING] = list(each[0].get(HEADING, []))
    for file, own in zip(files[1:], each[1:], strict=True):
        remarks[HEADING] += [f"extends {file.stem}:", *own.get(HEADING, [])]
    return remarks


def read_remarks(file: Path) -> dict[str, list[str]]:
    """The comments of a protocol's file by the rule that they are at or above, the first ones as its heading.

    A comment ``no cap_m ...`` belongs to the rule that it names; comments without a following rule belong to their
    section.
    """
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


def protocols_for(dataset: str) -> list[str]:
    """The default protocols of a dataset."""
    known = map(load_protocol, protocol_names())
    return [rules.name for rules in known if rules.by_default and dataset in rules.datasets]


def headline_protocols(dataset: Any) -> tuple[str, ...]:
    """The protocol that scores a dataset by default, as a tuple; empty if the dataset declares none."""
    name: str | None = getattr(dataset, "headline_protocol", None)
    return () if name is None else (name,)


def more_protocols_line(names: Collection[str], how: str = "--all-protocols") -> str:
    """A line on ``names``, protocols that fit but were not scored, and ``how`` to score them."""
    return f"{counted(len(names), 'more protocol')} {'applies' if len(names) == 1 else 'apply'}: {how}"


def not_comparable_with(rules: ProtocolRules) -> list[str]:
    """Protocols whose values are not comparable with those of ``rules``: it names them, or they name it."""
    naming = [name for name in protocol_names() if rules.name in load_protocol(name).not_comparable_with]
    return sorted({*rules.not_comparable_with, *naming})


@typed
def load_protocol(name: str) -> ProtocolRules:
    """The rules called ``name``, or those in the file ``name`` when it ends in ``.toml``.

    ``ConfigError`` if there is no such protocol, or the file is invalid.

    >>> import su3d_bench as su3d
    >>> rules = su3d.load_protocol("rooms-instance")
    >>> rules.kind, rules.headline, rules.min_region_size
    ('instance', ('AP', 'AP50', 'AP25'), 100)
    """
    known = protocol_names()
    if name in known:
        return _built_in(name)
    if name.endswith(".toml"):
        rules = read_protocol(Path(name))
        if rules.name in known:
            raise ConfigError(f"{name}: the protocol name '{rules.name}' is built in; choose another name")
        return rules
    raise ConfigError(f"unknown protocol '{name}'{suggest(name, known)}")


@cache
def _built_in(name: str) -> ProtocolRules:
    return read_protocol(rules_file(name))


def read_protocol(path: Path) -> ProtocolRules:
    """The rules in a TOML file and in those that it extends."""
    content = read_content(path)
    if content.original is not None:
        read_original(*content.original)
    try:
        return _made(content.values)
    except ValidationError as error:
        raise ConfigError(_first_line(content.files, error)) from error


def read_rules(values: Mapping[str, Any], where: str) -> ProtocolRules:
    """The rules from their ``as_json``; a ``ConfigError`` that begins with ``where`` if invalid."""
    try:
        return _made(values)
    except (ValidationError, RecursionError) as error:
        raise ConfigError(f"{where}: are not as a run writes them; run its command again") from error


def _made(values: Mapping[str, Any]) -> ProtocolRules:
    kind_name = values.get("kind")
    rules = next((rules for kind, rules in RULES_OF_KIND.items() if kind == kind_name), ProtocolRules)
    return rules.model_validate(_with_tuples(values))


def _with_tuples(value: Any) -> Any:
    """Lists as tuples: TOML has only lists, the strict model needs tuples."""
    if isinstance(value, list):
        return tuple(_with_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return value


def _first_line(files: Sequence[Path], error: ValidationError, *section: str) -> str:
    """The first validation error as one line with the file, the line and, for an unknown key, a suggestion."""
    # a misspelt key is both unknown and, under its right name, missing: the first is more helpful
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    path = [*section, *map(str, first["loc"])]
    key = ".".join(path)
    if first["type"] == "extra_forbidden":
        fields = (SECTIONS | {"original": Original}).get(path[0], ProtocolRules).model_fields
        return f"{line_of(files, path[-1])}: unknown key '{key}'{suggest(path[-1], fields)}"
    if first["type"] == "missing":
        return f"{files[0]}: the key '{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    where = line_of(files, path[-1] if first["loc"] else message.split(":")[0])
    message = message[0].lower() + message[1:] + (f", not {first['input']!r}" if first["loc"] else "")
    return f"{where}: {key}: {message}" if key else f"{where}: {message}"


def rule_differences(first: ProtocolRules, second: ProtocolRules) -> list[dict[str, Any]]:
    """The rules, such as ``transfer.cap_m``, with different values; ``ConfigError`` for protocols of two kinds."""
    if first.kind != second.kind:
        raise ConfigError(
            f"{first.name} is of kind '{first.kind}' and {second.name} of kind '{second.kind}': they share no rules to "
            "compare; 'protocols show' prints each"
        )
    sides = [{".".join(path): value for path, value in flatten(one.model_dump(mode="json", exclude=NAMING))}
             for one in (first, second)]  # fmt: skip
    rows = [{"rule": rule, "first": sides[0].get(rule), "second": sides[1].get(rule)} for rule in sides[0] | sides[1]]
    return [row for row in rows if row["first"] != row["second"]]
