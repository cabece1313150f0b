"""Names of methods in a request: ``opensu3d``, ``file.py:Class``, and variants of either in one run.

A variant is ``METHOD@PRESET`` where the method's class has ``presets`` (``opensu3d@scheme4``), or
``METHOD@KEY=VALUE,KEY=VALUE`` with values in TOML (``opensu3d@top_m=1``). It counts as a method of its own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import Setting, flatten, parse_value
from su3d_bench.core.errors import ConfigError, suggest

MOST_CHARACTERS = 120  # the name is a folder's name too
_COMMA_OUTSIDE_BRACKETS = re.compile(r",(?![^\[]*\])")


@dataclass(frozen=True)
class NamedMethod:
    """``target`` finds the class, ``base`` is the name that it bears, ``name`` the one with the variant."""

    target: str
    base: str
    name: str
    settings: tuple[Setting, ...]


def named_method(text: str) -> NamedMethod:
    """What ``text`` asks for; ``ConfigError`` for an unknown method, preset or an unreadable variant."""
    start = text.rfind(".py:") + 1
    at = text.find("@", start)
    target, variant = (text, "") if at < 0 else (text[:at], text[at + 1 :])
    method = registry.load("method", target)
    base = str(method.name)
    if at < 0:
        return NamedMethod(target, base, base, ())
    name = f"{base}@{variant.replace(' ', '')}"
    if not variant or "/" in variant or not variant.isprintable() or len(name) > MOST_CHARACTERS:
        raise ConfigError(f"--methods {text}: expected METHOD@PRESET or METHOD@KEY=VALUE, such as opensu3d@top_m=1")
    values = _assigned(text, variant) if "=" in variant else _preset(text, base, method, variant)
    entries = tuple(Setting(("method", name, *path), value, f"--methods {text}") for path, value in flatten(values))
    return NamedMethod(target, base, name, entries)


def _preset(text: str, base: str, method: Any, variant: str) -> Mapping[str, Any]:
    presets: Mapping[str, Mapping[str, Any]] = getattr(method, "presets", {})
    if variant not in presets:
        hint = suggest(variant, presets) or (f"; it has {', '.join(presets)}" if presets else "; it has none")
        raise ConfigError(f"--methods {text}: {base} has no preset '{variant}'{hint}; or write {base}@KEY=VALUE")
    return presets[variant]


def _assigned(text: str, variant: str) -> Mapping[str, Any]:
    values: dict[str, Any] = {}
    for part in _COMMA_OUTSIDE_BRACKETS.split(variant):
        key, equals, value = part.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--methods {text}: '{part}' is no KEY=VALUE")
        values[key.strip()] = parse_value(value)
    return values
