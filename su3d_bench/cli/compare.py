"""``su3d-bench compare`` and ``check``: compare two runs, and check a run for regressions in CI."""

from __future__ import annotations

import argparse
import os

from su3d_bench.cli import output
from su3d_bench.cli.options import Verbs, add_verb, output_path
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "compare", call_compare)
    parser.option("left A", "run folder or FOLDER:METHOD; FOLDER,FOLDER for several seeds")
    parser.option("right B", "run to compare with A; differences are B - A")
    parser.option("--method METHOD", "method to use (default: all that both runs have)")
    parser.shared("--protocols")
    parser.option("--per-class", "also show each class")
    parser.shared("--format")
    parser = add_verb(verbs, "check", call_check, data=True)
    parser.option("runs [RUN...]", "run to check")
    parser.option("--against FILE", "reference file")
    parser.option("--recompute", "also score the maps again (slower)")
    parser.option("--build-from RUN...", "repetitions of one run to build the reference from")
    parser.option("--out FILE", "reference file that --build-from writes", type=output_path)
    parser.option(
        "--cost-limit TIMES", "fail above this slowdown of a method (with --build-from; default: a remark)", type=float
    )
    parser.option(
        "--machine-tolerance POINTS",
        "percentage points of tolerance across machines (with --build-from; default: 2)",
        type=float,
    )
    parser.option("--markdown FILE", "write the table as Markdown, for a pull request", type=output_path)
    parser.option("--junit FILE", "write JUnit XML", type=output_path)
    parser.option(
        "--github", "print GitHub annotations (default: in GitHub workflows)", action=argparse.BooleanOptionalAction
    )


def call_compare(arguments: argparse.Namespace) -> None:
    """Compare two runs on their common scenes: differences with confidence intervals and exact tests.

    su3d-bench compare runs/before runs/after --per-class
    su3d-bench compare runs/old-0,runs/old-1 runs/new-0,runs/new-1 --protocols homes-instance --json
    """
    from su3d_bench.analysis.comparison import compare
    from su3d_bench.reports.tables.comparison import comparison_tables

    chosen = {name: getattr(arguments, name) for name in ("method", "protocols", "per_class")}
    comparison = compare(arguments.left, arguments.right, **chosen).to_json()
    output.answer_tables(arguments, comparison, comparison_tables(comparison))


def call_check(arguments: argparse.Namespace) -> int:
    """Fail if a run regresses against a reference; or build a reference from runs.

    su3d-bench check --build-from runs/a runs/b runs/c --out reference.json
    su3d-bench check runs/mine --against reference.json --markdown comment.md --junit check.xml
    """
    if arguments.build_from:
        return _learn(arguments)
    if len(arguments.runs) != 1 or arguments.against is None:
        raise ConfigError("check: give one RUN and --against FILE, or --build-from RUN... and --out FILE")
    if arguments.out is not None or arguments.cost_limit is not None or arguments.machine_tolerance is not None:
        raise ConfigError("check: --out, --cost-limit and --machine-tolerance belong to --build-from")
    return _check(arguments)


def _learn(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.regression_check import ACROSS_MACHINES, MAX_COST_LIMIT, learn, no_cost_reason
    from su3d_bench.core.errors import counted, printable
    from su3d_bench.core.files.atomic import json_text
    from su3d_bench.runs.finished import read_run

    if arguments.runs or arguments.against or arguments.recompute or arguments.out is None:
        raise ConfigError(
            "check: --build-from takes the runs and needs --out FILE, without RUN, --against and --recompute"
        )
    cost_limit: float | None = arguments.cost_limit
    across = ACROSS_MACHINES if arguments.machine_tolerance is None else arguments.machine_tolerance / 100
    if not 1 < (MAX_COST_LIMIT if cost_limit is None else cost_limit) <= MAX_COST_LIMIT or not 0 <= across <= 1:
        raise ConfigError(
            f"check: --cost-limit is a factor above 1 and up to {MAX_COST_LIMIT:g}, --machine-tolerance from 0 to 100 "
            "points"
        )
    runs = [read_run(path) for path in arguments.build_from]
    reference = learn(runs, across, cost_limit)
    output.written(arguments.out, json_text(reference.model_dump(mode="json", exclude_defaults=True)))
    n_exact = sum(metric.tolerance == 0 for each in reference.results for metric in each.metrics.values())
    n_values = sum(len(each.metrics) for each in reference.results)
    about = {"reference": str(arguments.out), "n_runs": reference.n_runs, "n_values": n_values, "n_exact": n_exact}
    line = f"{arguments.out}: {n_values} headline values from {counted(reference.n_runs, 'run')}, {n_exact} exact"
    output.answer_either(arguments, about, line)
    if reference.n_runs == 1:
        remark("built from one run: every value must match exactly; use several runs if results vary")
    for method in runs[0].methods:
        if method not in reference.costs:
            remark(f"{printable(method, 80)}: no cost limit: {no_cost_reason(runs[0], method)}")
    return EXIT_DONE


def _check(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.regression_check import check, read_reference
    from su3d_bench.core.safe_output import terminal_width
    from su3d_bench.reports.regression_check import github_lines, junit_xml, markdown, plain_parts
    from su3d_bench.reports.tables.formats import plain
    from su3d_bench.runs.finished import read_run

    run, reference = read_run(arguments.runs[0]), read_reference(arguments.against)
    with output.steps("check", is_quiet=arguments.quiet) as step:
        verdict = check(run, reference, recompute=arguments.recompute, progress=step)
    for path, text in ((arguments.markdown, markdown), (arguments.junit, junit_xml)):
        if path is not None:
            output.written(path, text(verdict))
    if not output.answer_json(arguments, {"passed": verdict.is_passed, **asdict(verdict)}):
        output.answer_document(plain(plain_parts(verdict), terminal_width()))
        in_workflow = os.environ.get("GITHUB_ACTIONS") == "true"
        if in_workflow if arguments.github is None else arguments.github:
            output.answer_commands(github_lines(verdict))
    remark(*verdict.remarks, quiet=arguments.quiet)
    return EXIT_DONE if verdict.is_passed else EXIT_CHECK_FAILED
