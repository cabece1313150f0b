"""``su3d-bench protocols``: list protocols, show rules, compare two, encode texts, or create your own."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.new import add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb, output_path, perception_config
from su3d_bench.cli.output import answer_either, answer_tables, remark
from su3d_bench.core.errors import ConfigError, shown, suggest

if TYPE_CHECKING:
    from su3d_bench.metrics.protocols.loading import ResolvedOriginal
    from su3d_bench.metrics.protocols.model import ProtocolRules


def add_parser(verbs: Verbs) -> None:
    """List protocols, show their rules, compare two, or create your own.

    su3d-bench protocols show homes-semantic
    su3d-bench protocols diff homes-semantic replica-mesh-ex6
    """
    actions = add_group(verbs, "protocols", add_parser, lists=True)
    add_verb(actions, "list", call_list)
    parser = add_verb(actions, "show", call_show)
    parser.option("name PROTOCOL", "protocol, or .toml file")
    parser.option("--list-texts", "print the texts that are encoded, one per line")
    parser.shared("--queries")
    parser = add_verb(actions, "diff", call_diff)
    parser.option("name PROTOCOL", "protocol, or .toml file")
    parser.option("other PROTOCOL", "protocol to compare with")
    parser.shared("--format")
    parser = add_verb(actions, "texts", call_texts)
    parser.option("--protocol PROTOCOL", "protocol to use (or .toml file)", required=True)
    parser.option("--encoder ENCODER", "encoder to use (embedded, or from models list; default: the protocol's)")
    parser.shared("--queries", "--device", "--set")
    parser.option("--out FILE", ".npz file to write", type=output_path, required=True)
    add_new(actions, "protocol")


def call_list(arguments: argparse.Namespace) -> None:
    """List the protocols and the evaluations that they reproduce.

    su3d-bench protocols list
    su3d-bench protocols list --json
    """
    from su3d_bench.metrics.protocols.loading import load_protocol, original_of, protocol_names

    rows = [(load_protocol(name), original_of(name)) for name in protocol_names()]
    fields = {"name", "version", "summary", "kind", "datasets", "headline", "ground_truth", "label_space"}
    values = [rules.model_dump(mode="json", include=fields) | {"original": _plain(stated)} for rules, stated in rows]
    width = max(len(rules.name) for rules, _ in rows)
    lines = []
    for rules, stated in rows:
        lines.append(f"{rules.name:<{width}}  {rules.summary}")
        if stated is not None:
            fact_text = "; ".join(f"{name}: {text}" for name, text in stated.facts.items())
            lines += [f"    {line}" for line in wrap(fact_text, 116, break_on_hyphens=False)]
    answer_either(arguments, values, *lines)


def call_show(arguments: argparse.Namespace) -> None:
    """Show every rule of a protocol with its source.

    su3d-bench protocols show homes-semantic
    su3d-bench protocols show homes-semantic --list-texts
    """
    from su3d_bench.metrics.compatibility import labels_taken
    from su3d_bench.metrics.protocols.loading import load_protocol, original_of, rules_files

    rules = load_protocol(arguments.name)
    if arguments.list_texts:
        _answer_names(arguments, rules)
        return
    if arguments.queries is not None:
        raise ConfigError("protocols show: --queries needs --list-texts")
    stated = original_of(arguments.name)
    value = rules.model_dump(mode="json") | {"digest": rules.digest, "labels_taken": labels_taken(rules)}
    facts = {"original": "not said"} if stated is None else stated.facts
    lines = [*_rules_lines(rules, rules_files(arguments.name)), ""]
    lines += [f"{name:<28} {text}" for name, text in facts.items()]
    answer_either(arguments, value | {"original": _plain(stated)}, *lines)


def _plain(stated: ResolvedOriginal | None) -> dict[str, Any] | None:
    return None if stated is None else stated.original.model_dump(mode="json") | {"of": stated.base}


def call_diff(arguments: argparse.Namespace) -> None:
    """Show the rules in which two protocols differ.

    su3d-bench protocols diff homes-semantic replica-mesh-ex6
    su3d-bench protocols diff homes-instance replica-openmask3d --json
    """
    from su3d_bench.metrics.protocols.loading import load_protocol, rule_differences
    from su3d_bench.reports.tables.comparison import rules_tables

    first, second = load_protocol(arguments.name), load_protocol(arguments.other)
    rows = rule_differences(first, second)
    value = {"schema": 2, "first": first.name, "second": second.name, "differing": rows}
    answer_tables(arguments, value, rules_tables(value))


def _answer_names(arguments: argparse.Namespace, rules: ProtocolRules) -> None:
    from su3d_bench.evaluation.texts import distinct_texts, named_texts

    named = named_texts(rules, arguments.queries)
    names = [{"name": name, "texts": list(texts)} for name, texts in named.items()]
    value = {"protocol": rules.name, "encoder": rules.encoder, "names": names}
    answer_either(arguments, value, *distinct_texts(named))


def _rules_lines(rules: ProtocolRules, files: Sequence[Path]) -> list[str]:
    """One line per rule, followed by the comment of the file that sets it."""
    from su3d_bench.core.config import flatten, toml_value
    from su3d_bench.metrics.compatibility import labels_taken
    from su3d_bench.metrics.protocols.loading import HEADING, not_comparable_with, remarks_of

    remarks = remarks_of(files)
    shown = rules.model_dump(mode="json", exclude={"classes"}) | {"not_comparable_with": not_comparable_with(rules)}
    lines = [*remarks.pop(HEADING, []), ""]
    for path, value in flatten(shown):
        key = ".".join(path)
        lines.append(f"{key:<28} {'none' if value is None else toml_value(value)}")
        lines += [f"    {remark}" for remark in remarks.pop(key, [])]
    lines += [f"    {remark}" for key in remarks if key != "classes" for remark in remarks[key]]
    lines += [f"{'labels taken':<28} {labels_taken(rules)}", f"{'digest':<28} {rules.digest}"]
    if rules.classes:
        lines += ["", f"{len(rules.scored)} of {len(rules.classes)} classes are scored (id, name, group):"]
        lines += [f"    {remark}" for remark in remarks.get("classes", [])]
    for entry in rules.classes:
        remark = "" if entry in rules.scored else "  (ignored)"
        lines.append(f"{entry.id:>6}  {entry.name}{f'  {entry.group}' if entry.group else ''}{remark}")
    return lines


EVALUATE_SUFFIXES = (".toml", ".csv")  # of queries and their objects


def call_texts(arguments: argparse.Namespace) -> None:
    """Encode the class names or queries of a protocol, for evaluate --text-features.

    su3d-bench protocols texts --protocol homes-semantic --encoder embedded --out texts.npz
    su3d-bench protocols texts --protocol replica-openmask3d --encoder clip-vit-l-14-336 --out texts.npz
    """
    from su3d_bench.core.files.atomic import make_folder, write_npz
    from su3d_bench.evaluation.texts import distinct_texts, named_texts, text_arrays
    from su3d_bench.metrics.protocols.loading import load_protocol
    from su3d_bench.perception.models.loading import load_encoder

    out: Path = arguments.out
    if out.suffix != ".npz":
        raise ConfigError(f"protocols texts: --out {shown(out)}: expected a file that ends in .npz")
    rules = load_protocol(arguments.protocol)
    named = named_texts(rules, arguments.queries)
    name = _encoder_name(arguments.encoder, rules.name, rules.encoder)
    encoder = load_encoder(perception_config(arguments).models.model_copy(update={"encoder": name}))
    texts = distinct_texts(named)
    arrays = text_arrays(texts, encoder)
    make_folder(out.parent)
    write_npz(out, arrays)
    numbers = {"n_names": len(named), "n_texts": len(texts), "n_dimensions": int(arrays["features"].shape[1])}
    names = {"file": str(out), "protocol": rules.name, "encoder": encoder.name, "encoder_digest": encoder.digest}
    line = "{file}: {n_texts} texts for {n_names} names of {protocol}, {n_dimensions} dimensions, encoder '{encoder}'"
    answer_either(arguments, names | numbers, line.format(**names, **numbers))
    words = ["--protocols", arguments.protocol, "--text-features", str(out)]
    if arguments.queries is not None and arguments.queries.suffix.lower() in EVALUATE_SUFFIXES:
        words += ["--queries", str(arguments.queries)]
    remark(f"use: su3d-bench evaluate PREDICTIONS {shlex.join(words)}", quiet=arguments.quiet)


def _encoder_name(said: str | None, protocol: str, of_protocol: str | None) -> str:
    """The name of the requested encoder, or of that of the protocol."""
    from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
    from su3d_bench.perception.models.catalogue import MODELS, encoder_known_as
    from su3d_bench.perception.models.config import EMBEDDED

    known = [EMBEDDED, *(entry.name for entry in MODELS.values() if entry.kind == "encoder")]
    asked = said or of_protocol
    if asked is None:
        listed = ", ".join(known)
        raise ConfigError(f"protocols texts: protocol '{protocol}' has no encoder; choose one with --encoder: {listed}")
    if asked in (*known, EmbeddedEncoder.name):
        return asked if asked in known else EMBEDDED
    if (entry := encoder_known_as(asked)) is not None:
        return entry.name
    whose = "" if said is not None else f" of protocol '{protocol}'"
    raise ConfigError(f"protocols texts: unknown encoder '{asked}'{whose}{suggest(asked, known)}")
