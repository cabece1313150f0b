"""``su3d-bench protocols``: the evaluations, every rule of one, and in which rules two of them differ."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import texts
from su3d_bench.cli.new import add_new
from su3d_bench.cli.shared.answers import answer_either, answer_tables, remark, show
from su3d_bench.cli.shared.bars import progress
from su3d_bench.cli.shared.flags import add_group, add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError

if TYPE_CHECKING:
    from su3d_bench.metrics.protocols.loading import Stated
    from su3d_bench.metrics.protocols.model import ProtocolRules


def add_parser(verbs: Any) -> None:
    actions = add_group(
        verbs,
        "protocols",
        "List the protocols, show the rules of one, compare the rules of two, or write one of your own.",
        ("su3d-bench protocols show rooms-semantic", "su3d-bench protocols diff rooms-semantic replica-mesh-ex6"),
        lists=True,
    )
    add_verb(
        actions,
        "list",
        "List the protocols and whose evaluations they repeat.",
        ("su3d-bench protocols list", "su3d-bench protocols list --json"),
        call_list,
    )
    parser = add_verb(
        actions,
        "show",
        "Print every rule of a protocol with its source, or the texts that features are compared with.",
        ("su3d-bench protocols show rooms-semantic", "su3d-bench protocols show rooms-semantic --names"),
        call_show,
    )
    parser.add_argument("name", metavar="PROTOCOL", help="its name, or a .toml file of the same form")
    parser.add_argument("--names", action="store_true", help="the texts, one a line, to encode elsewhere")
    texts.add_queries(parser)
    parser = add_verb(
        actions,
        "diff",
        "Print the rules in which two protocols differ, and with --prediction what each does to the numbers.",
        (
            "su3d-bench protocols diff rooms-semantic replica-mesh-ex6",
            "su3d-bench protocols diff rooms-semantic replica-mesh-ex6 --prediction runs/demo --out steps.png",
        ),
        call_diff,
    )
    parser.add_argument("name", metavar="A", help="a protocol's name, or a .toml file of the same form")
    parser.add_argument("other", metavar="B", help="the protocol that it is compared with")
    parser.add_argument(
        "--prediction",
        metavar="RUN[:METHOD]",
        help="score it under every choice of the rules, and split the difference of its numbers among them",
    )
    parser.add_argument("--out", type=Path, metavar="PNG", help="with --prediction: draw the steps to this file")
    parser.add_argument(
        "--jobs", type=int, default=0, metavar="N", help="scenes scored side by side (default: the CPU cores)"
    )
    add_table_format(parser)
    texts.add_parser(actions)
    add_new(actions, "protocol")


def call_list(arguments: argparse.Namespace) -> int:
    from su3d_bench.metrics.protocols.loading import load_protocol, original_of, protocol_names

    rows = [(load_protocol(name), original_of(name)) for name in protocol_names()]
    fields = {"name", "version", "summary", "kind", "datasets", "headline", "ground_truth", "label_space"}
    values = [rules.model_dump(mode="json", include=fields) | {"original": _plain(stated)} for rules, stated in rows]
    width = max(len(rules.name) for rules, _ in rows)
    lines = []
    for rules, stated in rows:
        lines.append(f"{rules.name:<{width}}  {rules.summary}")
        if stated is not None:
            lines += [f"    {line}" for line in wrap(stated.in_short, 116, break_on_hyphens=False)]
    answer_either(arguments, values, *lines)
    return EXIT_DONE


def call_show(arguments: argparse.Namespace) -> int:
    from su3d_bench.metrics.labels import labels_taken
    from su3d_bench.metrics.protocols.loading import load_protocol, original_of, rules_files

    rules = load_protocol(arguments.name)
    if arguments.names:
        return _answer_names(arguments, rules)
    if arguments.queries is not None:
        raise ConfigError("protocols show: --queries belongs to --names")
    stated = original_of(arguments.name)
    value = rules.model_dump(mode="json") | {"digest": rules.digest, "labels_taken": labels_taken(rules)}
    lines = [*_rules_lines(rules, rules_files(arguments.name)), *_original_lines(stated)]
    answer_either(arguments, value | {"original": _plain(stated)}, *lines)
    return EXIT_DONE


def _plain(stated: Stated | None) -> dict[str, Any] | None:
    return None if stated is None else stated.original.model_dump(mode="json") | {"of": stated.base}


def _original_lines(stated: Stated | None) -> list[str]:
    facts = {"original": "not said"} if stated is None else stated.facts
    return ["", *(f"{name:<28} {text}" for name, text in facts.items())]


def call_diff(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.rules_walk import Walker, rules_apart
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.reports.tables.rules import rules_tables

    if arguments.out is not None and arguments.prediction is None:
        raise ConfigError("protocols diff: --out draws the steps of a --prediction; name one")
    if arguments.jobs < 0:
        raise ConfigError(f"--jobs {arguments.jobs}: must be 1 or more; 0 stands for the CPU cores")
    first, second = load_protocol(arguments.name), load_protocol(arguments.other)
    apart = rules_apart(first, second)
    if arguments.prediction is not None:
        walker = Walker.of(first, second, arguments.prediction)
        with progress(len(walker.scenes), is_quiet=arguments.quiet) as report:
            walk = walker.walk(arguments.jobs or os.cpu_count() or 1, report)
        apart = rules_apart(first, second, walk)
    value = apart.to_json()
    answer_tables(arguments, value, rules_tables(value))
    if arguments.out is not None:
        from su3d_bench.reports.pictures.plots import draw_walk

        show()  # the plot takes longer than the answer
        draw_walk(value, arguments.out)
        remark(f"plot: {arguments.out}", quiet=arguments.quiet)
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
    from su3d_bench.metrics.labels import labels_taken
    from su3d_bench.metrics.protocols.loading import HEADING, not_comparable_with, remarks_of

    remarks = remarks_of(files)
    shown = rules.model_dump(mode="json", exclude={"classes"}) | {"not_comparable_with": not_comparable_with(rules)}
    lines = [*remarks.pop(HEADING, []), ""]
    for path, value in flatten(shown):
        key = ".".join(path)
        lines.append(f"{key:<28} {'none' if value is None else toml_value(value)}")
        lines += [f"    {remark}" for remark in remarks.pop(key, [])]
    lines += [f"    {remark}" for key in remarks if key != "classes" for remark in remarks[key]]
    lines.append(f"{'labels taken':<28} {labels_taken(rules)}")
    lines.append(f"{'digest':<28} {rules.digest}")
    if rules.classes:
        lines += ["", f"{len(rules.scored)} of {len(rules.classes)} classes are scored (id, name, group):"]
        lines += [f"    {remark}" for remark in remarks.get("classes", [])]
    for entry in rules.classes:
        remark = "" if entry in rules.scored else "  (ignored)"
        lines.append(f"{entry.id:>6}  {entry.name}{f'  {entry.group}' if entry.group else ''}{remark}")
    return lines
