"""``su3d-bench protocols``: the evaluations, and every rule of one."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.flags import add_verb, answer, answer_json
from su3d_bench.errors import ConfigError, suggest

if TYPE_CHECKING:
    from su3d_bench.protocols import ProtocolRules

ACTIONS = ("list", "show")


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "protocols",
        "List the protocols; 'show NAME' prints every rule of one.",
        ("su3d-bench protocols", "su3d-bench protocols show rooms-semantic"),
        call,
    )
    parser.add_argument("action", nargs="?", default="list", metavar="list|show")
    parser.add_argument("name", nargs="?", help="a protocol's name, or a .toml file of the same form")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.protocols import load_protocol, protocol_names

    if arguments.action not in ACTIONS:
        hint = suggest(arguments.action, ACTIONS) or "; known: list, show NAME"
        raise ConfigError(f"protocols: unknown action '{arguments.action}'{hint}")
    if arguments.action == "show":
        if arguments.name is None:
            raise ConfigError(f"protocols show: name one of {', '.join(protocol_names())}")
        rules = load_protocol(arguments.name)
        if arguments.json:
            answer_json(rules.model_dump(mode="json") | {"digest": rules.digest})
        else:
            answer(_rules_text(rules))
        return 0
    rows = [load_protocol(name) for name in protocol_names()]
    if arguments.json:
        fields = {"name", "version", "summary", "kind", "datasets", "headline", "ground_truth", "label_space"}
        answer_json([one.model_dump(mode="json", include=fields) for one in rows])
    else:
        width = max(len(one.name) for one in rows)
        answer("\n".join(f"{one.name:<{width}}  {one.summary}" for one in rows))
    return 0


def _rules_text(rules: ProtocolRules) -> str:
    """Every rule as a line; the sources stand beside the lines of the protocol's own file."""
    from su3d_bench.config import flatten
    from su3d_bench.toml_text import toml_value

    lines = []
    for path, value in flatten(rules.model_dump(mode="json", exclude={"classes"})):
        lines.append(f"{'.'.join(path):<26} {'none' if value is None else toml_value(value)}")
    lines.append(f"{'digest':<26} {rules.digest}")
    lines.append(f"\n{len(rules.scored)} of {len(rules.classes)} classes are scored (id, name, group):")
    for entry in rules.classes:
        remark = "" if entry in rules.scored else "  (ignored)"
        lines.append(f"{entry.id:>6}  {entry.name}{f'  {entry.group}' if entry.group else ''}{remark}")
    return "\n".join(lines)
