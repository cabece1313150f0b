"""``su3d-bench protocols``: the evaluations, and every rule of one."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.common import add_verb, answer_either
from su3d_bench.core.errors import EXIT_DONE, ConfigError, suggest

if TYPE_CHECKING:
    from su3d_bench.metrics.protocols import ProtocolRules

ACTIONS = ("list", "show")
HEADING = ""  # stands for the comments above the first rule of a file
_KEY = re.compile(r"(\w+)\s*=")
_SECTION = re.compile(r"\[(\w+)\]")
_COMMENT = re.compile(r"""(?:[^"'#]|"[^"]*"|'[^']*')*#\s*(.*)""")
_ABSENT = re.compile(r"no (\w+)")


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
    from su3d_bench.metrics.protocol_files import protocol_names, rules_files
    from su3d_bench.metrics.protocols import load_protocol

    if arguments.action not in ACTIONS:
        hint = suggest(arguments.action, ACTIONS) or "; known: list, show NAME"
        raise ConfigError(f"protocols: unknown action '{arguments.action}'{hint}")
    if arguments.action == "show":
        if arguments.name is None:
            raise ConfigError(f"protocols show: name one of {', '.join(protocol_names())}")
        rules = load_protocol(arguments.name)
        value = rules.model_dump(mode="json") | {"digest": rules.digest}
        answer_either(arguments, value, _rules_text(rules, rules_files(arguments.name)))
        return EXIT_DONE
    rows = [load_protocol(name) for name in protocol_names()]
    fields = {"name", "version", "summary", "kind", "datasets", "headline", "ground_truth", "label_space"}
    width = max(len(rules.name) for rules in rows)
    text = "\n".join(f"{rules.name:<{width}}  {rules.summary}" for rules in rows)
    answer_either(arguments, [rules.model_dump(mode="json", include=fields) for rules in rows], text)
    return EXIT_DONE


def _rules_text(rules: ProtocolRules, files: Sequence[Path]) -> str:
    """Every rule as a line, beneath it what the file that sets it says of it: its source, or that it is ours."""
    from su3d_bench.core.config import flatten, toml_value
    from su3d_bench.metrics.protocols import not_comparable_with

    remarks = _remarks_of(files)
    shown = rules.model_dump(mode="json", exclude={"classes"}) | {"not_comparable_with": not_comparable_with(rules)}
    lines = [*remarks.pop(HEADING, []), ""]
    for path, value in flatten(shown):
        key = ".".join(path)
        lines.append(f"{key:<28} {'none' if value is None else toml_value(value)}")
        lines += [f"    {remark}" for remark in remarks.pop(key, [])]
    lines += [f"    {remark}" for key in remarks if key != "classes" for remark in remarks[key]]
    lines.append(f"{'digest':<28} {rules.digest}")
    if rules.classes:
        lines.append(f"\n{len(rules.scored)} of {len(rules.classes)} classes are scored (id, name, group):")
        lines += [f"    {remark}" for remark in remarks.get("classes", [])]
    for entry in rules.classes:
        remark = "" if entry in rules.scored else "  (ignored)"
        lines.append(f"{entry.id:>6}  {entry.name}{f'  {entry.group}' if entry.group else ''}{remark}")
    return "\n".join(lines)


def _remarks_of(files: Sequence[Path]) -> dict[str, list[str]]:
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
    from su3d_bench.metrics.protocols import ProtocolRules, TransferRules

    remarks: dict[str, list[str]] = {}
    section, waiting, has_key = "", list[str](), False
    for line in file.read_text(encoding="utf-8").splitlines():
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
