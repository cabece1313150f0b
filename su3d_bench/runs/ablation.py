"""A sweep over settings of one method, run as variants in one run, so that perception is computed once for all."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from su3d_bench.core import registry
from su3d_bench.core.config import parse_value, toml_value
from su3d_bench.core.errors import ConfigError, StoreError, suggest
from su3d_bench.core.files.atomic import read_json, write_json
from su3d_bench.reports.tables.ablation import SweepRow
from su3d_bench.runs.plan import COMMA_OUTSIDE_BRACKETS

FILE = "ablation.json"
MAX_VARIANTS = 1000
Short = tuple[str, Callable[[Any], Any]]


_ROWS = TypeAdapter(tuple[SweepRow, ...])


@dataclass(frozen=True)
class _Choice:
    parameter: str
    text: str
    key: str
    value: Any


def ablation_rows(method: str, vary: Sequence[str], *, is_grid: bool) -> tuple[SweepRow, ...]:
    """The rows of a sweep: each ``KEY=V1,V2`` of ``vary`` on its own, or every combination if ``is_grid``.

    ``KEY`` is a setting of the method or a short name defined in its class's ``short_names``; values are TOML. Rows
    whose settings are the defaults name the method itself. ``ConfigError`` for an unknown key or an invalid value.
    """
    method_class = registry.load("method", method)
    choices = [_choices(method, method_class, text) for text in vary]
    n_rows = math.prod(map(len, choices)) if is_grid else sum(map(len, choices))
    if n_rows > MAX_VARIANTS:
        raise ConfigError(f"ablate: {n_rows} variants; one run can have at most {MAX_VARIANTS}")
    combinations = itertools.product(*choices) if is_grid else ((choice,) for each in choices for choice in each)
    names = {_effective(method_class.Config()): str(method_class.name)}
    return tuple(_row(method_class, combination, names) for combination in combinations)


def _choices(method: str, method_class: Any, text: str) -> list[_Choice]:
    parameter, equals, values = text.partition("=")
    parameter = parameter.strip()
    if not equals or not values.strip():
        raise ConfigError(f"--vary {text}: expected KEY=VALUE,VALUE such as top_m=1,5,10")
    shorts: Mapping[str, Short] = getattr(method_class, "short_names", {})
    known = [*shorts, *method_class.Config.model_fields]
    if parameter not in known:
        raise ConfigError(f"--vary {text}: {method} has no setting '{parameter}'{suggest(parameter, known)}")
    key, change = shorts.get(parameter, (parameter, lambda value: value))
    choices = []
    for part in COMMA_OUTSIDE_BRACKETS.split(values):
        try:
            choices.append(_Choice(parameter, part.strip(), key, change(parse_value(part))))
        except (TypeError, ValueError) as error:
            raise ConfigError(f"--vary {text}: '{part.strip()}': {error}") from error
    return choices


def _row(method_class: Any, combination: Sequence[_Choice], names: dict[str, str]) -> SweepRow:
    """The row of one variant; ``names`` maps the effective settings to a method name and is extended in place."""
    keys = [choice.key for choice in combination]
    if len(set(keys)) < len(keys):
        raise ConfigError(f"--vary: '{keys[0]}' is varied twice in one variant; name it once")
    values = {choice.key: choice.value for choice in combination}
    try:
        # Through JSON, because strict models accept a list for a tuple only there.
        effective = _effective(method_class.Config.model_validate_json(json.dumps(values)))
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        text = f"{combination[0].parameter}={combination[0].text}"
        raise ConfigError(f"--vary {text}: {reason[:1].lower()}{reason[1:]}") from error
    variant = ",".join(f"{key}={_bare(value)}" for key, value in values.items()).replace(" ", "")
    return SweepRow(
        parameter=" x ".join(choice.parameter for choice in combination),
        value=" x ".join(choice.text for choice in combination),
        method=names.setdefault(effective, f"{method_class.name}@{variant}"),
        is_default=effective == next(iter(names)),
    )


def _effective(config: BaseModel) -> str:
    """The effective settings as text; a model whose settings override each other defines ``effective``."""
    return str(config.effective() if hasattr(config, "effective") else config.model_dump())


def _bare(value: Any) -> str:
    """A value in TOML, plain words without quotes, because the name of a variant is also a folder name."""
    return value if isinstance(value, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", value) else toml_value(value)


def write_rows(folder: Path, rows: Sequence[SweepRow], *, joins: bool = False) -> None:
    """Write the rows next to the run's metrics, for the table of the sweep; ``joins`` appends to the existing rows."""
    before = read_rows(folder) if joins and (folder / FILE).is_file() else ()
    rows = list(dict.fromkeys([*before, *rows]))
    write_json(folder / FILE, {"rows": [asdict(row) for row in rows]})


def read_rows(folder: Path) -> tuple[SweepRow, ...]:
    """The rows written by ``write_rows``; ``StoreError`` if the run is not a sweep."""
    if not (folder / FILE).is_file():
        raise StoreError(f"{folder}: contains no {FILE}; run a sweep with su3d-bench ablate --vary KEY=V1,V2")
    value = read_json(folder / FILE)
    try:
        return _ROWS.validate_python(value["rows"])
    except (TypeError, KeyError, ValidationError, RecursionError) as error:
        raise StoreError(f"{folder}: {FILE} is damaged; run the sweep again") from error
