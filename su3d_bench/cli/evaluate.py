"""``su3d-bench evaluate``: score predictions of other programs under the published protocols."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.cli.options import Verbs, add_verb, run_folder
from su3d_bench.cli.output import answer_tables, remark, steps
from su3d_bench.core.errors import ConfigError

SCHEMA = 1  # version of the JSON for several methods
REQUEST_OPTIONS = (
    "dataset",
    "ground_truth",
    "ground_truth_values",
    "text_features",
    "confidences",
    "queries",
)


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "evaluate", call, data=True)
    parser.option("paths [PREDICTIONS...]", "folder of predictions, run folder, or files", type=Path)
    parser.option("--name NAME", "name of the method (default: name of --out)")
    parser.option("--predictions METHOD=PREDICTIONS...", "predictions of several methods", action="extend", default=[])
    parser.option("--out DIR", "write a run folder, for compare, check, report, sheets and query", type=run_folder)
    parser.option("--dataset DATASET", "dataset with the ground truth, in $SU3D_DATA: replica, scannet, ...")
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
    parser.option("--input-format FORMAT", "format of the predictions (default: detected)")
    parser.shared("--text-features")
    parser.option(
        "--confidences",
        "confidences by protocol (default) or file (default for ScanNet, MaskClustering)",
        choices=("protocol", "file"),
    )
    parser.shared("--queries")
    parser.option("--per-class", "also show each class")
    parser.shared("--format")


def call(arguments: argparse.Namespace) -> None:
    """Score predictions of other programs under every protocol that fits.

    su3d-bench evaluate pred/ --ground-truth gt/ --protocols scannet-instance --out runs/mine
    su3d-bench evaluate --predictions mine=predA theirs=predB --dataset replica --out runs/both
    """
    from su3d_bench.evaluation.evaluate import warnings_of
    from su3d_bench.evaluation.result import Request
    from su3d_bench.evaluation.run_output import evaluate_methods
    from su3d_bench.reports.tables.run import run_tables
    from su3d_bench.store.records import plain

    chosen: dict[str, Any] = {name: getattr(arguments, name) for name in REQUEST_OPTIONS}
    chosen |= {
        "format": arguments.input_format,
        "protocols": tuple(arguments.protocols),
        "scenes": tuple(arguments.scenes),
    }
    requests = {method: Request(tuple(paths), method=method, **chosen) for method, paths in _named(arguments).items()}
    with steps("evaluate", is_quiet=arguments.quiet) as step:
        run = evaluate_methods(requests, arguments.out, step)
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
    from su3d_bench.predictions.run_predictions import methods_of

    if not arguments.paths and not arguments.predictions:
        raise ConfigError("evaluate: no predictions given; name a folder or files, or --predictions METHOD=PREDICTIONS")
    if arguments.predictions and (arguments.paths or arguments.name is not None):
        raise ConfigError("evaluate: --predictions names methods and predictions; leave out PREDICTIONS and --name")
    named: dict[str, list[Path]] = {}
    if len(arguments.paths) == 1 and arguments.name is None and (methods := methods_of(arguments.paths[0])):
        return dict.fromkeys(methods, arguments.paths)
    for text in arguments.predictions:
        method, _, path = text.partition("=")
        if not method or not path:
            raise ConfigError(f"evaluate: --predictions {text}: expected METHOD=PREDICTIONS")
        named.setdefault(method, []).append(Path(path))
    if arguments.out is None and (arguments.name is not None or len(named) == 1):
        raise ConfigError("evaluate: a run has names of methods; add --out DIR")
    return named or {arguments.name or default_name(arguments.out): arguments.paths}


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
