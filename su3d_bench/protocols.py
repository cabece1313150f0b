"""Named, versioned evaluations: everything that moves a number, read from ``rules/*.toml``.

A protocol is chosen by name, or by the path of a TOML file of the same form. Unknown keys and wrong values are errors
of one line that name the file and the key.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.errors import ConfigError, suggest

RULES = Path(__file__).parent / "rules"
_TABLE_PREFIX = "classes."  # rules/classes.<name>.toml holds a class table, not a protocol


class ClassEntry(BaseModel):
    """A class of the label set: its id in the label space, its name, the group it is averaged in."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    id: Annotated[int, Field(ge=0)]
    name: str
    group: str | None = None


class TransferRules(BaseModel):
    """How a prediction on other points than the truth's reaches the scored points.

    ``candidates``: ``object-points`` (only points that belong to an instance, as ConceptGraphs concatenates its object
    clouds) or ``map-points`` (all points of the map; the nearest being background means no instance). ``cap_m``:
    farther neighbours do not count, no cap when absent; a point without a neighbour is predicted as nothing. Each mask
    is first reduced to one point a voxel of ``evaluation_voxel_m`` where that is above 0. Predictions on the scored
    points themselves are taken as they are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    candidates: Literal["object-points", "map-points"]
    cap_m: Annotated[float, Field(gt=0)] | None = None
    evaluation_voxel_m: Annotated[float, Field(ge=0)] = 0.0


class ProtocolRules(BaseModel):
    """One evaluation, complete: the same rules and the same prediction give the same number.

    ``classes`` is the label set in the order of the original; ``ignore`` names classes that are known but not scored.
    ``vocabulary``: the classifier chooses among ``all`` classes, the ``scored`` ones, or those scored ones that the
    ``scene``'s ground truth contains. ``prompt`` has ``{}`` for the class name, which ``prompt_names`` may replace.
    ``confidence``: ``ones`` for every mask, or the ``prediction``'s own.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: str
    version: Annotated[int, Field(ge=1)]
    summary: str
    kind: Literal["semantic", "instance"]
    metric: Literal["conceptgraphs", "scannet"]
    datasets: tuple[str, ...]
    label_space: str
    ground_truth: str
    classes: tuple[ClassEntry, ...]
    ignore: tuple[str, ...] = ()
    ignore_rule: Literal["exact", "substring"] = "exact"
    vocabulary: Literal["all", "scored", "scene"]
    prompt: str
    prompt_names: dict[str, str] = {}
    encoder: str | None = None
    transfer: TransferRules
    min_region_size: Annotated[int, Field(ge=1)] | None = None
    thresholds: tuple[float, ...] = ()
    confidence: Literal["ones", "prediction"] | None = None
    aggregate: Literal["pooled", "scene-mean"] = "pooled"
    headline: Annotated[tuple[str, ...], Field(min_length=1)]
    not_comparable_with: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names = [entry.name for entry in self.classes]
        if len(set(names)) != len(names) or len({entry.id for entry in self.classes}) != len(names):
            raise ValueError("classes: each id and each name may stand there once")
        if "{}" not in self.prompt:
            raise ValueError(f"prompt: '{self.prompt}' has no {{}} for the class name")
        unknown = [name for name in (*self.ignore, *self.prompt_names) if not any(name in known for known in names)]
        if unknown:
            raise ValueError(f"ignore or prompt_names: '{unknown[0]}' is no class{suggest(unknown[0], names)}")
        known = {"semantic": ("mAcc", "mIoU", "F-mIoU"), "instance": ("AP", "AP50", "AP25")}[self.kind]
        if not set(self.headline) <= set(known):
            raise ValueError(f"headline: a protocol of kind '{self.kind}' has {', '.join(known)}")
        if self.kind == "semantic" and (self.min_region_size or self.thresholds or self.confidence):
            raise ValueError("min_region_size, thresholds and confidence belong to kind 'instance'")
        if self.kind == "instance":
            if self.metric != "scannet" or self.min_region_size is None or self.confidence is None:
                raise ValueError("kind 'instance' needs metric 'scannet', min_region_size, thresholds and confidence")
            if not {0.25, 0.5} <= set(self.thresholds):
                raise ValueError("thresholds: 0.25 and 0.5 must be among them")
            if self.transfer.candidates != "map-points":
                raise ValueError("transfer.candidates: kind 'instance' takes 'map-points'")
        return self

    def is_ignored(self, name: str) -> bool:
        """Whether the class ``name`` is left out, by exact name or, under the substring rule, by a part of it."""
        return name in self.ignore if self.ignore_rule == "exact" else any(part in name for part in self.ignore)

    @property
    def scored(self) -> tuple[ClassEntry, ...]:
        """The classes that count, in order."""
        return tuple(entry for entry in self.classes if not self.is_ignored(entry.name))

    def prompt_of(self, name: str) -> str:
        """The text that stands for the class ``name``."""
        return self.prompt.replace("{}", self.prompt_names.get(name, name))

    @property
    def digest(self) -> str:
        """A content key of all rules."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def protocol_names() -> list[str]:
    """The names of the built-in protocols."""
    return sorted(path.stem for path in RULES.glob("*.toml") if not path.name.startswith(_TABLE_PREFIX))


def protocols_for(dataset: str) -> list[str]:
    """The protocols under which a dataset is scored unless others are named."""
    return [name for name in protocol_names() if dataset in load_protocol(name).datasets]


@lru_cache(maxsize=64)
def load_protocol(name: str) -> ProtocolRules:
    """The rules called ``name``, or those in the file ``name`` when it ends in ``.toml``."""
    known = protocol_names()
    if name in known:
        return read_protocol(RULES / f"{name}.toml")
    if name.endswith(".toml"):
        rules = read_protocol(Path(name))
        if rules.name in known:
            raise ConfigError(f"{name}: the protocol name '{rules.name}' is built in; choose another name")
        return rules
    raise ConfigError(f"unknown protocol '{name}'{suggest(name, known) or '; known: ' + ', '.join(known)}")


def read_protocol(path: Path) -> ProtocolRules:
    """The rules in a TOML file, where ``classes`` names a class table or lists rows [id, name] or [id, name, group]."""
    content = _read_toml(path)
    table = content.get("classes")
    if isinstance(table, str):
        tables = {p.stem.removeprefix(_TABLE_PREFIX): p for p in RULES.glob(f"{_TABLE_PREFIX}*.toml")}
        if table not in tables:
            known = suggest(table, tables) or "; known: " + ", ".join(sorted(tables))
            raise ConfigError(f"{_line_of(path, 'classes')}: unknown class table '{table}'{known}")
        content["classes"] = _read_toml(tables[table])["classes"]
    content["classes"] = _entries(path, content.get("classes"))
    try:
        return ProtocolRules.model_validate(_with_tuples(content))
    except ValidationError as error:
        raise ConfigError(_first_line(path, error)) from error


def _entries(path: Path, table: Any) -> list[dict[str, Any]]:
    keys = ("id", "name", "group")
    if not isinstance(table, list) or not all(isinstance(row, list) and 2 <= len(row) <= 3 for row in table):
        raise ConfigError(f"{_line_of(path, 'classes')}: classes must be a table's name or rows of [id, name]")
    return [dict(zip(keys, row, strict=False)) for row in table]


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is no valid TOML: {error}") from error


def _with_tuples(value: Any) -> Any:
    """TOML knows lists alone; the strict model wants its tuples."""
    if isinstance(value, list):
        return tuple(_with_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return value


def _first_line(path: Path, error: ValidationError) -> str:
    """The first complaint as one line with the file, the line and, for an unknown key, the likely one."""
    # a misspelt key is both unknown and, under its right name, missing: the first says more
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        last = str(first["loc"][-1])
        fields = TransferRules.model_fields if key.startswith("transfer.") else ProtocolRules.model_fields
        return f"{_line_of(path, last)}: unknown key '{key}'{suggest(last, fields)}"
    if first["type"] == "missing":
        return f"{path}: the key '{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    where = _line_of(path, str(first["loc"][-1]) if first["loc"] else message.split(":")[0])
    message = message[0].lower() + message[1:]
    return f"{where}: {key}: {message}, not {first['input']!r}" if key else f"{where}: {message}"


def _line_of(path: Path, key: str) -> str:
    """``path:line`` of the first line that sets ``key``, or ``path`` alone."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if re.match(rf"\s*{re.escape(key)}\s*=", line):
            return f"{path}:{number}"
    return str(path)
