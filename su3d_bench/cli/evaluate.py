"""``su3d-bench evaluate``: score predictions of other programs under the published protocols."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.cli.options import Verbs, add_verb, output_path
from su3d_bench.cli.output import answer_tables, remark
from su3d_bench.core.errors import ConfigError

SCHEMA = 1  # version of the JSON for several methods
REQUEST_OPTIONS = (
    "dataset",
    "ground_truth",
    "ground_truth_values",
    "format",
    "text_features",
    "confidences",
    "queries",
)


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "evaluate", call)
    parser.option("predictions [PREDICTIONS...]", "folder of predictions, run folder, or files", type=Path)
    parser.option(
        "--name METHOD=PREDICTIONS...",
        "method's name (default: name of --out), or METHOD=PREDICTIONS to score several",
        action="extend",
        default=[],
    )
    parser.option("--out DIR", "write a run folder, for compare, check, report, sheets and query", type=output_path)
    parser.option("--dataset NAME", "dataset with the ground truth, in $SU3D_DATA: replica, scannet, ...")
    parser.option(
        "--ground-truth DIR",
        "folder of ground truth, one <scene>.txt per scene; or OpenLex3D's release",
    )
    parser.option(
        "--ground-truth-values",
        "values in --ground-truth: class ids, label * 1000 + instance, or object numbers",
        choices=("classes", "instances", "numbers"),
    )
    parser.shared("--protocols", "--all-protocols", "--scenes")
    parser.option("--format FORMAT", "format of the predictions (default: detected)")
    parser.shared("--text-features")
    parser.option(
        "--confidences",
        "confidences by protocol (default) or file (default for ScanNet, MaskClustering)",
        choices=("protocol", "file"),
    )
    parser.shared("--queries")
    parser.option("--per-class", "also print the table of every class")
    parser.shared("--table-format")


def call(arguments: argparse.Namespace) -> None:
    """Score predictions of other programs under every protocol that fits.

    su3d-bench evaluate pred/ --ground-truth gt/ --protocols scannet-instance --out runs/mine
    su3d-bench evaluate --name mine=predA theirs=predB --dataset replica --out runs/both
    """
    from su3d_bench.evaluation.evaluate import warnings_of
    from su3d_bench.evaluation.result import Request
    from su3d_bench.evaluation.run_output import evaluate_methods
    from su3d_bench.reports.tables.run import run_tables
    from su3d_bench.store.records import plain

    chosen: dict[str, Any] = {name: getattr(arguments, name) for name in REQUEST_OPTIONS}
    chosen |= {"protocols": tuple(arguments.protocols), "scenes": tuple(arguments.scenes)}
    requests = {method: Request(tuple(paths), **chosen) for method, paths in _named(arguments).items()}
    run = evaluate_methods(requests, arguments.out)
    results = run.evaluations
    documents = {method: result.to_json() for method, result in results.items()}
    if len(results) == 1:
        (document,) = documents.values()
    else:
        document = {"schema": SCHEMA, "methods": documents}
    answer_tables(
        arguments, document, run_tables(plain(run.metrics), evaluated=documents, per_class=arguments.per_class)
    )
    for method, result in results.items():
        remark(
            *(f"{method}: {line}" if len(results) > 1 else line for line in warnings_of(result)), quiet=arguments.quiet
        )
    if arguments.out is not None:
        _print_next_steps(arguments.out, list(results), existed=run.existed, is_quiet=arguments.quiet)


def _named(arguments: argparse.Namespace) -> dict[str, list[Path]]:
    """The predictions by method name."""
    from su3d_bench.evaluation.result import default_name

    if not arguments.predictions and not arguments.name:
        raise ConfigError("evaluate: no predictions given; name a folder or files, or use --name METHOD=PREDICTIONS")
    named: dict[str, list[Path]] = {}
    for text in arguments.name:
        method, equals, path = text.partition("=")
        if equals and method and path and not arguments.predictions:
            named.setdefault(method, []).append(Path(path))
        elif equals or not arguments.predictions or len(arguments.name) > 1:
            raise ConfigError(
                f"evaluate: --name {text}: expected METHOD=PREDICTIONS for each method, or PREDICTIONS... --name METHOD"
            )
        else:
            named[text] = list(arguments.predictions)
    if len(named) == 1 and arguments.out is None:
        raise ConfigError("evaluate: --name names a method of a run; add --out DIR")
    return named or {default_name(arguments.out): list(arguments.predictions)}


def _print_next_steps(out: Path, methods: Sequence[str], *, existed: bool, is_quiet: bool) -> None:
    """Print the run folder and commands for next steps."""
    run, method = shlex.quote(str(out)), shlex.quote(methods[0])
    pair = f"{run}:{method} " + (f"{run}:{shlex.quote(methods[1])}" if len(methods) > 1 else "OTHER_RUN")
    whose = f" --method {method}" if len(methods) > 1 else ""
    state = " (unchanged: has this evaluation already)" if existed else ""
    remark(
        f"run folder: {out}{state}",
        f"next: su3d-bench compare {pair}",
        f"      su3d-bench report attribution {run}{whose}",
        f"      su3d-bench report tables {run} --format latex",
        quiet=is_quiet,
    )
