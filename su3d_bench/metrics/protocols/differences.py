"""The rules in which two protocols differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.model import ProtocolRules

# Fields that name a protocol, or state its use or display, and do not affect any value.
NAMING = ("name", "version", "summary", "datasets", "by_default", "headline", "not_comparable_with")


@dataclass(frozen=True)
class RuleDifference:
    """A rule, such as ``transfer.cap_m``, and its plain value in each protocol."""

    rule: str
    first: Any
    second: Any


def differing(first: ProtocolRules, second: ProtocolRules) -> list[RuleDifference]:
    """The rules in which two protocols differ, in the order of the model; ``ConfigError`` for two kinds."""
    if first.kind != second.kind:
        raise ConfigError(
            f"{first.name} is of kind '{first.kind}' and {second.name} of kind '{second.kind}': they share no rules to "
            "compare; 'protocols show' prints each"
        )
    found = []
    for field in type(first).model_fields:
        if field in NAMING:
            continue
        of_first, of_second = getattr(first, field), getattr(second, field)
        if isinstance(of_first, BaseModel) and isinstance(of_second, BaseModel):
            leaves = ((f"{field}.{leaf}", leaf) for leaf in type(of_first).model_fields)
            values = [(key, getattr(of_first, leaf), getattr(of_second, leaf)) for key, leaf in leaves]
        else:
            values = [(field, of_first, of_second)]
        found += [RuleDifference(key, plain(one), plain(other)) for key, one, other in values if one != other]
    return found


def plain(value: Any) -> Any:
    """The JSON value of a rule."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    return [plain(item) for item in value] if isinstance(value, tuple) else value
