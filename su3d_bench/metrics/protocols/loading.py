"""Named, versioned evaluations, as the files of ``rules/`` and files of one's own say them.

A protocol is chosen by name, or by the path of a TOML file of the same form. Unknown keys and wrong values are errors
of one line that name the file and the key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.metrics.protocols.files import line_of, protocol_names, read_content, rules_file
from su3d_bench.metrics.protocols.kinds import RULES_OF_KIND
from su3d_bench.metrics.protocols.model import SECTIONS, ProtocolRules
from su3d_bench.metrics.protocols.originals import read_original


def protocols_for(dataset: str) -> list[str]:
    """The protocols under which a dataset is scored unless others are named."""
    known = map(load_protocol, protocol_names())
    return [rules.name for rules in known if rules.by_default and dataset in rules.datasets]


def not_comparable_with(rules: ProtocolRules) -> list[str]:
    """Protocols whose numbers must not stand beside those of ``rules``: it names them, or they name it."""
    naming = [name for name in protocol_names() if rules.name in load_protocol(name).not_comparable_with]
    return sorted({*rules.not_comparable_with, *naming})


def load_protocol(name: str) -> ProtocolRules:
    """The rules called ``name``, or those in the file ``name`` when it ends in ``.toml``.

    A ``ConfigError`` where there is none of that name, or the file is none.

    >>> import su3d_bench as su3d
    >>> rules = su3d.load_protocol("rooms-instance")
    >>> rules.kind, rules.headline, rules.min_region_size
    ('instance', ('AP', 'AP50', 'AP25'), 100)
    """
    known = protocol_names()
    if name in known:
        return _built_in(name)
    if name.endswith(".toml"):
        rules = _own(Path(name).absolute(), Path(name), _state(Path(name)))
        if rules.name in known:
            raise ConfigError(f"{name}: the protocol name '{rules.name}' is built in; choose another name")
        return rules
    raise ConfigError(f"unknown protocol '{name}'{suggest(name, known)}")


@cache
def _built_in(name: str) -> ProtocolRules:
    return read_protocol(rules_file(name))


@lru_cache(maxsize=64)
def _own(place: Path, shown: Path, state: tuple[int, int] | None) -> ProtocolRules:
    """The rules in a file, read once for each ``place`` and ``state`` of it; errors name it as ``shown``."""
    return read_protocol(shown)


def _state(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


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
    """The rules that ``as_json`` of some gave; a ``ConfigError`` that begins with ``where`` if these are none."""
    try:
        return _made(values)
    except (ValidationError, RecursionError) as error:
        raise ConfigError(f"{where}: are not as a run writes them; run its command again") from error


def _made(values: Mapping[str, Any]) -> ProtocolRules:
    said = values.get("kind")
    rules = next((rules for kind, rules in RULES_OF_KIND.items() if kind == said), ProtocolRules)
    return rules.model_validate(_with_tuples(values))


def _with_tuples(value: Any) -> Any:
    """TOML knows lists alone; the strict model wants its tuples."""
    if isinstance(value, list):
        return tuple(_with_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return value


def _first_line(files: Sequence[Path], error: ValidationError) -> str:
    """The first complaint as one line with the file, the line and, for an unknown key, the likely one."""
    # a misspelt key is both unknown and, under its right name, missing: the first says more
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        last = str(first["loc"][-1])
        fields = SECTIONS.get(key.partition(".")[0], ProtocolRules).model_fields
        return f"{line_of(files, last)}: unknown key '{key}'{suggest(last, fields)}"
    if first["type"] == "missing":
        return f"{files[0]}: the key '{key}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    where = line_of(files, str(first["loc"][-1]) if first["loc"] else message.split(":")[0])
    message = message[0].lower() + message[1:]
    return f"{where}: {key}: {message}, not {first['input']!r}" if key else f"{where}: {message}"
