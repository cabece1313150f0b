"""The configuration of a run: defaults, then a TOML file, then the command line; every value records its source.

A configuration is a list of *settings*: one entry per leaf, keyed by its path (``("method", "opensu3d", "top_m")``).
``resolve`` turns the settings under a prefix into a strict model; its errors name the file and line, or the flag.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.safe_output import one_line
from su3d_bench.core.system.files import file_text, parse_toml

HEADER = re.compile(r"^\s*\[+([^\[\]]+)\]+\s*(?:#.*)?$")
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
    """``key`` in TOML: bare if allowed, otherwise quoted."""
    return key if BARE_KEY.match(key) else json.dumps(key, ensure_ascii=False)


def toml_value(value: Any) -> str:
    """``value`` in TOML: bool, int, float, text, path, and lists of these."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else {math.inf: "inf", -math.inf: "-inf"}.get(value, "nan")
    if isinstance(value, str | Path):
        text = json.dumps(str(value), ensure_ascii=False)  # every JSON string is a TOML string
        return text if text.isprintable() else "".join(map(_in_toml, text))
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    raise TypeError(f"no TOML form for {type(value).__name__}")


def _in_toml(character: str) -> str:
    """A character of a text, escaped if it would act on a terminal that shows the file."""
    if character.isprintable():
        return character
    return f"\\u{ord(character):04x}" if ord(character) <= 0xFFFF else f"\\U{ord(character):08x}"


def write_toml(leaves: Sequence[tuple[tuple[str, ...], Any, str]]) -> str:
    """TOML text of (path, value, remark) leaves, each remark as a comment after its value; None as a comment only."""
    tables: dict[tuple[str, ...], list[str]] = {(): []}
    for path, value, remark in leaves:
        key, remark = toml_key(path[-1]), one_line(remark)
        line = f"# {key} is not set  # {remark}" if value is None else f"{key} = {toml_value(value)}  # {remark}"
        tables.setdefault(path[:-1], []).append(line)
    blocks = []
    for table, rows in tables.items():
        header = [f"[{'.'.join(toml_key(key) for key in table)}]"] if table else []
        blocks.append("\n".join([*header, *rows]))
    return "\n\n".join(block for block in blocks if block) + "\n"


Model = TypeVar("Model", bound=BaseModel)
KeyPath = tuple[str, ...]
SECTIONS = ("method", "dataset", "perception")
DEFAULT_SOURCE = "default"


# Where scenes run and whether pictures are drawn: this changes no number.
NEUTRAL_SETTINGS = frozenset({
    "jobs", "pictures", "offline", "accept_poses", "executor", "gpus_per_job", "retries", "slurm",
    "memory",
})  # fmt: skip


def size_bytes(text: str) -> int:
    """The number of bytes in a valid ``memory`` of a run.

    >>> size_bytes("8G"), size_bytes("500M")
    (8589934592, 524288000)
    """
    return int(text[:-1]) << 10 * (1 + "KMGT".index(text[-1]))


class RunConfig(BaseModel):
    """The settings of a run that do not belong to a dataset, method or perception profile.

    ``protocols`` empty: the headline protocol of each dataset, ``all``: every default one; ``stride`` 0: the method's
    default; ``jobs`` 0: one per scene, at most one per CPU core, and with foundation models on GPUs at most two per
    GPU; ``limit`` 0: all frames, otherwise the first ``limit`` frames of each scene, and the run is partial;
    ``question_solver``: how reasoning questions are answered, by geometry alone or by the text model of
    ``perception.language``; ``refiner``: how labels n' are chosen, by vote or by that model; ``offline``: no language
    model is called, replies stored with the run are used; ``accept_poses``: also run recordings whose depth contradicts
    their poses; ``anytime``: fractions of the updates after which the map so far is also scored, such as 0.1 0.25 0.5,
    or ``anytime_every``: a number of updates between such maps, 0 for none; ``seen_so_far``: score these maps and the
    last one also against what the frames until then have shown; ``realtime``: frames that arrive per second, 0: each
    waits for the method; ``queue`` and ``queue_size`` (0: 1 for ``newest``, otherwise 10): which frames wait while it
    is busy; ``schedule``: a run or file to replay; ``cost``: a file of durations to simulate; ``executor`` auto: this
    process for one job, otherwise processes; ``retries``: for a scene whose job died; ``slurm``: KEY=VALUE for
    submitit; ``memory``: the limit of each worker process, such as 8G.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    scenes: tuple[str, ...] = ("homes/test*",)
    methods: tuple[str, ...] = ("opensu3d",)
    profile: str = "auto"
    protocols: tuple[str, ...] = ()
    stride: int = Field(default=0, ge=0)
    seed: int = Field(default=0, ge=0, lt=2**31)
    limit: int = Field(default=0, ge=0)
    jobs: int = Field(default=0, ge=0)
    pictures: bool = True
    question_solver: Literal["built-in", "llm"] = "built-in"
    refiner: Literal["vote", "model"] = "vote"
    offline: bool = False
    accept_poses: bool = False
    anytime: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = ()
    anytime_every: int = Field(default=0, ge=0)
    seen_so_far: bool = False
    realtime: float = Field(default=0, ge=0, le=1e6, allow_inf_nan=False)
    queue: Literal["newest", "drop-new", "drop-old"] = "newest"
    queue_size: int = Field(default=0, ge=0, le=10_000_000)
    schedule: Path | None = None
    cost: Path | None = None
    executor: Literal["auto", "inline", "processes", "slurm"] = "auto"
    gpus_per_job: int = Field(default=0, ge=0, le=64)
    retries: int = Field(default=2, ge=0)
    slurm: tuple[str, ...] = ()
    memory: str = Field(default="", pattern="^([1-9][0-9]{0,8}[KMGT])?$")

    @field_validator("anytime_every")
    @classmethod
    def _is_alone(cls, every: int, others: ValidationInfo) -> int:
        if every and others.data.get("anytime"):
            raise ValueError("not together with anytime; choose one of them")
        return every

    @property
    def shares(self) -> tuple[float, ...]:
        """The fractions of ``anytime``, ascending, without duplicates."""
        return tuple(sorted(set(self.anytime)))

    @property
    def anytime_text(self) -> str:
        """Which intermediate maps are scored, for keys; '' if none."""
        return f"every {self.anytime_every}" if self.anytime_every else str(self.shares) if self.shares else ""

    def anytime_points(self, n_updates: int) -> dict[float, int]:
        """The intermediate maps of ``n_updates`` updates, ascending: the number of updates before each, by the fraction
        of the updates, below 1, or with ``anytime_every`` by that number.

        >>> RunConfig(anytime=(0.5, 0.1)).anytime_points(15), RunConfig(anytime_every=5).anytime_points(15)
        ({0.1: 2, 0.5: 8}, {5: 5, 10: 10})
        """
        if self.anytime_every:
            return {n: n for n in range(self.anytime_every, n_updates, self.anytime_every)}
        return {share: math.ceil(share * n_updates) for share in self.shares} if n_updates else {}


@dataclass(frozen=True)
class Setting:
    """One configured value and its source: ``run.toml:3`` or ``--set opensu3d.top_m``."""

    path: KeyPath
    value: Any
    source: str


@dataclass(frozen=True)
class Settings:
    """All configured values; later entries override earlier ones with the same path."""

    entries: tuple[Setting, ...] = ()

    def __add__(self, other: Settings) -> Settings:
        return Settings(self.entries + other.entries)

    def under(self, prefix: KeyPath) -> list[Setting]:
        """The settings below ``prefix``, with paths relative to it."""
        n = len(prefix)
        below = [entry for entry in self.entries if entry.path[:n] == prefix and len(entry.path) > n]
        return [Setting(entry.path[n:], entry.value, entry.source) for entry in below]

    def source(self, path: KeyPath) -> str:
        """The source of the value at ``path``; ``default`` if it is not set."""
        for entry in reversed(self.entries):
            if entry.path[: len(path)] == path or path[: len(entry.path)] == entry.path:
                return entry.source
        return DEFAULT_SOURCE


def read_file(path: Path) -> Settings:
    """The settings of a TOML file; a syntax error names file and line."""
    try:
        text = file_text(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a UTF-8 text file; a configuration is TOML") from error
    try:
        table = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        reason, _, place = str(error).partition(" (at ")
        line = place.split(",")[0].removeprefix("line ") if place.startswith("line ") else str(text.count("\n") + 1)
        raise ConfigError(f"{path}:{line}: not valid TOML: {reason[:1].lower()}{reason[1:]}") from error
    lines = key_lines(text)
    return Settings(tuple(Setting(leaf, value, f"{path}:{_line(lines, leaf)}") for leaf, value in flatten(table)))


def _line(lines: Mapping[KeyPath, int], path: KeyPath) -> int:
    for n in range(len(path), 0, -1):
        if path[:n] in lines:
            return lines[path[:n]]
    return 1


def flatten(table: Mapping[str, Any], prefix: KeyPath = ()) -> list[tuple[KeyPath, Any]]:
    """Leaves of nested tables with their paths, in order; an empty table has none."""
    leaves: list[tuple[KeyPath, Any]] = []
    for key, value in table.items():
        if isinstance(value, Mapping):
            leaves += flatten(value, (*prefix, key))
        else:
            leaves.append(((*prefix, key), value))
    return leaves


def nest(leaves: Sequence[tuple[KeyPath, Any]]) -> dict[str, Any]:
    """The nested table of ``leaves``; the reverse of ``flatten``."""
    table: dict[str, Any] = {}
    for path, value in leaves:
        inner = table
        for key in path[:-1]:
            below = inner.get(key)
            if not isinstance(below, dict):
                below = inner[key] = {}
            inner = below
        inner[path[-1]] = value
    return table


def read_assignments(texts: Sequence[str], methods: Sequence[str], datasets: Sequence[str]) -> Settings:
    """The settings of ``--set KEY=VALUE``: KEY is ``<method>.x``, ``<dataset>.x`` or ``perception.x``,
    or the form used in files, ``method.<method>.x`` or ``dataset.<dataset>.x``.

    ``methods`` and ``datasets`` are the names that the run uses; VALUE is TOML, otherwise plain text.
    """
    entries = []
    for text in texts:
        key, equals, value = text.partition("=")
        path = tuple(key.strip().split("."))
        if not equals or not all(path):
            raise ConfigError(f"--set {text}: expected KEY=VALUE, such as opensu3d.top_m=10")
        entries.append(Setting(_full_path(text, path, methods, datasets), parse_value(value), f"--set {key.strip()}"))
    return Settings(tuple(entries))


def _full_path(text: str, path: KeyPath, methods: Sequence[str], datasets: Sequence[str]) -> KeyPath:
    if len(path) == 1 and path[0] in RunConfig.model_fields:
        raise ConfigError(f"--set {text}: '{path[0]}' has its own flag: --{path[0].replace('_', '-')}")
    for section, names in (("method", methods), ("dataset", datasets)):
        if path[0] == section and len(path) > 2 and path[1] in names:
            return path  # the form used in files: [method.opensu3d]
        if path[0] in names and len(path) > 1:
            return (section, *path)
    if path[0] == "perception" and len(path) > 1:
        return path
    known = [*methods, *datasets, "perception"]
    raise ConfigError(f"--set {text}: '{path[0]}' is not a method or dataset of this run{suggest(path[0], known)}")


def parse_value(text: str) -> Any:
    """A TOML value, or plain text if it is not valid TOML."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text.strip()


def check_keys(settings: Settings) -> None:
    """Raise ``ConfigError`` for a top-level key that is neither a field of ``RunConfig`` nor a section."""
    known = [*RunConfig.model_fields, *SECTIONS]
    for entry in settings.entries:
        if entry.path[0] not in known:
            raise ConfigError(f"{entry.source}: unknown key '{entry.path[0]}'{suggest(entry.path[0], known)}")
        depth = {"perception": 2, "method": 3, "dataset": 3}.get(entry.path[0], 1)
        if len(entry.path) < depth:
            names = ".".join([*entry.path, "<name>"][: depth - 1])
            raise ConfigError(f"{entry.source}: '{'.'.join(entry.path)}' is a section; write [{names}] and its keys")


def check_names(section: str, settings: Settings, known: Sequence[str]) -> None:
    """Raise ``ConfigError`` for ``[section.name]`` if ``name`` is not ``known``."""
    for entry in settings.under((section,)):
        if entry.path[0] not in known:
            raise ConfigError(f"{entry.source}: unknown {section} '{entry.path[0]}'{suggest(entry.path[0], known)}")


def resolve(settings: Settings, prefix: KeyPath, model: type[Model]) -> Model:
    """The strict ``model`` filled from the settings under ``prefix``; the first invalid value is a one-line error."""
    below = settings.under(prefix)
    if not prefix:
        below = [entry for entry in below if entry.path[0] not in SECTIONS]
    table = nest([(entry.path, entry.value) for entry in below])
    try:
        # Through JSON: only there do strict models accept a list as a tuple and a string as a path.
        return model.model_validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        raise ConfigError(_explain(error, settings, prefix, model)) from error


def _explain(error: ValidationError, settings: Settings, prefix: KeyPath, model: type[BaseModel]) -> str:
    first = error.errors()[0]
    path = tuple(part for part in first["loc"] if isinstance(part, str))
    where = settings.source((*prefix, *path)) if path else settings.source(prefix)
    dotted = ".".join((*prefix[1:], *path)) or ".".join(prefix)
    if first["type"] == "extra_forbidden":
        return f"{where}: unknown key '{path[-1]}'{suggest(path[-1], _fields(model, path[:-1]))}"
    reason = first["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    value = first["input"] if not isinstance(first["input"], Mapping) else "..."
    return f"{where}: {dotted} = {value!r}: {reason[:1].lower()}{reason[1:]}"


def _fields(model: type[BaseModel], path: KeyPath) -> list[str]:
    for key in path:
        field = model.model_fields.get(key)
        inner = field.annotation if field is not None else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return list(model.model_fields)
