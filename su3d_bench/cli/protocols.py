"""``su3d-bench protocols``: the evaluations, and every rule of one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.common import add_verb, answer_either
from su3d_bench.cli.texts import add_queries
from su3d_bench.core.errors import EXIT_DONE, ConfigError, suggest

if TYPE_CHECKING:
    from su3d_bench.metrics.protocols.model import ProtocolRules

ACTIONS = ("list", "show")


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "protocols",
        "List the protocols; 'show NAME' prints every rule of one, with --names the texts that are compared.",
        ("su3d-bench protocols", "su3d-bench protocols show rooms-semantic --names"),
        call,
    )
    parser.add_argument("action", nargs="?", default="list", metavar="list|show")
    parser.add_argument("name", nargs="?", help="a protocol's name, or a .toml file of the same form")
    parser.add_argument(
        "--names",
        action="store_true",
        help="the texts that features are compared with, one a line, to encode elsewhere",
    )
    add_queries(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.metrics.protocols.files import protocol_names, rules_files
    from su3d_bench.metrics.protocols.loading import load_protocol

    if arguments.action not in ACTIONS:
        raise ConfigError(f"protocols: unknown action '{arguments.action}'{suggest(arguments.action, ACTIONS)}")
    if arguments.names and arguments.action != "show":
        raise ConfigError("protocols: --names belongs to show NAME")
    if arguments.queries is not None and not arguments.names:
        raise ConfigError("protocols: --queries belongs to show NAME --names")
    if arguments.action == "show":
        if arguments.name is None:
            raise ConfigError(f"protocols show: name one of {', '.join(protocol_names())}")
        rules = load_protocol(arguments.name)
        if arguments.names:
            return _answer_names(arguments, rules)
        value = rules.model_dump(mode="json") | {"digest": rules.digest}
        answer_either(arguments, value, *_rules_lines(rules, rules_files(arguments.name)))
        return EXIT_DONE
    rows = [load_protocol(name) for name in protocol_names()]
    fields = {"name", "version", "summary", "kind", "datasets", "headline", "ground_truth", "label_space"}
    width = max(len(rules.name) for rules in rows)
    lines = [f"{rules.name:<{width}}  {rules.summary}" for rules in rows]
    answer_either(arguments, [rules.model_dump(mode="json", include=fields) for rules in rows], *lines)
    return EXIT_DONE


def _answer_names(arguments: argparse.Namespace, rules: ProtocolRules) -> int:
    from su3d_bench.evaluation.texts import distinct_texts, named_texts

    named = named_texts(rules, arguments.queries)
    names = [{"name": name, "texts": list(texts)} for name, texts in named.items()]
    value = {"protocol": rules.name, "encoder": rules.encoder, "names": names}
    answer_either(arguments, value, *distinct_texts(named))
    return EXIT_DONE


def _rules_lines(rules: ProtocolRules, files: Sequence[Path]) -> list[str]:
    """Every rule as a line, beneath it what the file that sets it says of it: its source, or that it is ours."""
    from su3d_bench.core.config import flatten, toml_value
    from su3d_bench.metrics.protocols.files import HEADING, remarks_of
    from su3d_bench.metrics.protocols.loading import not_comparable_with

    remarks = remarks_of(files)
    shown = rules.model_dump(mode="json", exclude={"classes"}) | {"not_comparable_with": not_comparable_with(rules)}
    lines = [*remarks.pop(HEADING, []), ""]
    for path, value in flatten(shown):
        key = ".".join(path)
        lines.append(f"{key:<28} {'none' if value is None else toml_value(value)}")
        lines += [f"    {remark}" for remark in remarks.pop(key, [])]
    lines += [f"    {remark}" for key in remarks if key != "classes" for remark in remarks[key]]
    lines.append(f"{'digest':<28} {rules.digest}")
    if rules.classes:
        lines += ["", f"{len(rules.scored)} of {len(rules.classes)} classes are scored (id, name, group):"]
        lines += [f"    {remark}" for remark in remarks.get("classes", [])]
    for entry in rules.classes:
        remark = "" if entry in rules.scored else "  (ignored)"
        lines.append(f"{entry.id:>6}  {entry.name}{f'  {entry.group}' if entry.group else ''}{remark}")
    return lines
