"""``su3d-bench robustness``: methods under corruptions of their inputs, and the errors that they tolerate."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import output
from su3d_bench.cli.options import Parser, Verbs, add_group, add_verb, index, output_path
from su3d_bench.cli.run import add_run_options, execute, plan_of, settings_of
from su3d_bench.core.errors import EXIT_DONE, ConfigError, DataError, counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from su3d_bench.analysis.sides import Numbers
    from su3d_bench.core.types import UInt8Array
    from su3d_bench.corruptions.apply import Cell
    from su3d_bench.robustness.tolerance import Tolerance
    from su3d_bench.runs.finished import FinishedRun
    from su3d_bench.runs.runner import RunResult


def add_parser(verbs: Verbs) -> None:
    """Run methods under corruptions of their inputs, and measure the errors that they tolerate.

    su3d-bench robustness run --scenes 'homes/test*' --methods opensu3d conceptgraphs --out runs/robust
    su3d-bench robustness report runs/robust --format latex --out robust.tex
    """
    group = add_group(verbs, "robustness", add_parser)
    parser = add_verb(group, "list", call_list)
    parser.shared("--format")
    parser = add_verb(group, "show", call_show, data=True)
    parser.option("scene SCENE", "scene, such as homes/tuning0")
    _add_corruptions(parser)
    parser.option("--severities N...", "severities to use (default: 0 to 5)", type=int, default=list(range(6)))
    parser.option("--frame N", "frame to draw (default: the middle one)", type=index)
    parser.option("--out FILE.png", "picture to write", type=output_path, required=True)
    parser.shared("--set")
    parser = add_verb(group, "run", call_run, resumes=True, data=True)
    _add_methods(parser)
    parser.option("--severities N...", "severities to use (default: 1 3 5)", type=int, default=[1, 3, 5])
    parser.option("--only CONDITION...", "conditions to run, such as depth/holes/4", default=[])
    add_run_options(parser)
    parser = add_verb(group, "tolerance", call_tolerance, resumes=True, data=True)
    _add_methods(parser)
    parser.option("--share SHARE", "share of the clean score to keep (default: 0.95)", type=float, default=0.95)
    _add_metric(parser)
    add_run_options(parser)
    parser = add_verb(group, "report", call_report)
    parser.shared("run")
    _add_metric(parser)
    parser.option("--baseline METHOD", "method that mCE is relative to (default: the first)")
    parser.option("--tolerance", "also show the errors at which 95 % of the clean score is kept, between severities")
    parser.option("--figure FIGURE", "figure to write (.pdf, .png or .svg)")
    parser.option("--out FILE", "file to write", type=output_path)
    parser.shared("--format")


def _add_methods(parser: Parser) -> None:
    parser.option("--methods METHOD...", "methods to use (variants, file.py:Class or all; default: opensu3d)")
    _add_corruptions(parser)


def _add_corruptions(parser: Parser) -> None:
    parser.option(
        "--corruptions NAME...", "families, corruptions or pairs to use, such as depth pose/drift (default: all)",
        default=[],
    )  # fmt: skip


def _add_metric(parser: Parser) -> None:
    parser.option("--protocol PROTOCOL", "protocol to use (default: the first of the run)")
    parser.option("--metric METRIC", "metric of the score (default: the first of the protocol)")


def call_list(arguments: argparse.Namespace) -> None:
    """List the corruptions, their severities and sources.

    su3d-bench robustness list
    su3d-bench robustness list --format markdown
    """
    from su3d_bench.corruptions.apply import CORRUPTIONS
    from su3d_bench.formats.tables.table import text_table

    rows = [["corruption", "unit", "severities 1 to 5", "source"]]
    for name, row in CORRUPTIONS.items():
        rows.append([name, row.unit, ", ".join(f"{value:.4g}" for value in row.values), row.source])
    value = [
        {"name": name, "unit": row.unit, "values": list(row.values), "source": row.source}
        for name, row in CORRUPTIONS.items()
    ]
    output.answer_tables(arguments, value, [text_table("corruptions", rows)])


def call_show(arguments: argparse.Namespace) -> None:
    """Draw what corruptions do to a frame, the trajectory, perfect masks and class names of a scene.

    su3d-bench robustness show homes/tuning0 --corruptions depth pose --out depth.png
    su3d-bench robustness show replica/room0 --corruptions light/motion-blur --frame 120 --out blur.png
    """
    from su3d_bench.cli.scenes import chosen_scenes
    from su3d_bench.core.files.atomic import write_bytes
    from su3d_bench.formats.images import png_bytes
    from su3d_bench.robustness.pictures import clean_inputs, sheet, tiles
    from su3d_bench.robustness.sweep import conditions_of

    conditions = conditions_of(arguments.corruptions, arguments.severities[:1], [])
    dataset, scene = chosen_scenes([arguments.scene], arguments.set, is_quiet=arguments.quiet)[0]
    inputs = clean_inputs(dataset, scene, arguments.frame)
    pictures: dict[str, UInt8Array] = {}
    for (condition,) in (one for one in conditions if len(one) == 1):
        pictures |= tiles(condition.corruption, inputs, arguments.severities)
    if not pictures:
        raise DataError(f"{inputs.scene}: has no ground-truth masks or class names; choose other --corruptions")
    write_bytes(arguments.out, png_bytes(sheet(pictures, len(arguments.severities))))
    line = f"{arguments.out}: {counted(len(pictures), 'picture')}"
    output.answer_either(arguments, {"picture": str(arguments.out), "n_pictures": len(pictures)}, line)


def call_run(arguments: argparse.Namespace) -> int:
    """Run methods clean and under corruptions, in one run; the same command resumes an interrupted sweep.

    su3d-bench robustness run --methods opensu3d conceptgraphs --corruptions depth pose/drift --out runs/robust
    su3d-bench robustness run homes/tuning0 --only depth/holes/4 --out runs/one
    """
    from su3d_bench.robustness.sweep import conditions_of, methods_of
    from su3d_bench.runs.advice import estimate

    conditions = conditions_of(arguments.corruptions, arguments.severities, arguments.only)
    arguments.methods = methods_of(_clean_targets(arguments), conditions)
    plan = plan_of(arguments)
    minutes = sum(row.seconds for row in estimate(plan) if not row.is_done) / plan.n_workers / 60
    cells = f"{counted(len(plan.methods), 'cell')} on {counted(len(plan.jobs), 'scene')}"
    output.remark(f"{cells}: about {counted(max(1, round(minutes)), 'minute')}", quiet=arguments.quiet)
    return execute(plan, arguments, _answer_sweep)


def _clean_targets(arguments: argparse.Namespace) -> list[str]:
    """The requested methods, from the flag or the file; no pictures are drawn unless one of these asks for them."""
    from su3d_bench.core.config import DEFAULT_SOURCE, RunConfig, resolve
    from su3d_bench.robustness.sweep import clean_targets

    settings = settings_of(arguments)
    if settings.source(("pictures",)) == DEFAULT_SOURCE:
        arguments.pictures = False
    return clean_targets(resolve(settings, (), RunConfig).methods)


def _answer_sweep(result: RunResult, arguments: argparse.Namespace) -> None:
    """Print the changes of each protocol's first metric, the run folder, and commands for next steps."""
    from su3d_bench.robustness.measures import sweep_result
    from su3d_bench.robustness.tables import is_of_embedded, sweep_tables
    from su3d_bench.runs.verify import read_checked

    folder = result.plan.folder.path
    run = read_checked(folder)
    scored = [name for name in run.protocols if any(run.results[method, name].result for method in run.methods)]
    swept = [sweep_result(run, name, run.rules(name).headline[0]) for name in scored]
    tables = [table for one in swept for table in sweep_tables(one, of_embedded=is_of_embedded(run))]
    output.answer_tables(arguments, [one.to_json() for one in swept], tables)
    lines = [f"run folder: {folder}", f"next: su3d-bench robustness report {shlex.quote(str(folder))} --tolerance"]
    output.remark(*result.remarks, *lines, quiet=arguments.quiet)


def call_report(arguments: argparse.Namespace) -> None:
    """Report a sweep: drops with intervals, means over families, mCE and resilience.

    su3d-bench robustness report runs/robust --tolerance --format markdown --figure robust.png
    su3d-bench robustness report runs/robust --protocol homes-instance --metric AP50 --baseline conceptgraphs --json
    """
    from su3d_bench.robustness.measures import sweep_result
    from su3d_bench.robustness.pictures import draw_sweep
    from su3d_bench.robustness.tables import is_of_embedded, sweep_tables, tolerance_tables
    from su3d_bench.robustness.tolerance import SHARE_KEPT, swept_tolerances
    from su3d_bench.runs.verify import read_checked

    run = read_checked(arguments.run)
    score = _score_of(run, arguments)
    result = sweep_result(run, *score, arguments.baseline)
    value, tables = result.to_json(), sweep_tables(result, of_embedded=is_of_embedded(run))
    if arguments.tolerance:
        found = swept_tolerances(run, *score)
        value["tolerances"] = _tolerances_json(found)
        tables += tolerance_tables(found, *score, SHARE_KEPT, len(result.scenes))
    if arguments.figure is not None:
        draw_sweep(result, arguments.figure)
    output.answer_or_write(arguments, value, tables)


def call_tolerance(arguments: argparse.Namespace) -> int:
    """Find the largest error of each kind at which a method keeps 95 % of its clean score.

    su3d-bench robustness tolerance --methods opensu3d --corruptions pose depth/scale --out runs/tolerance
    su3d-bench robustness tolerance --corruptions calibration --protocol homes-instance --metric AP50 --dry-run
    """
    from su3d_bench.corruptions.apply import CORRUPTIONS, Condition
    from su3d_bench.corruptions.model import MAX_SEVERITY
    from su3d_bench.robustness.sweep import conditions_of, methods_of
    from su3d_bench.robustness.tables import tolerance_tables
    from su3d_bench.robustness.tolerance import find_tolerances, numbers_of
    from su3d_bench.runs.plan import named_method
    from su3d_bench.runs.runner import run_plan
    from su3d_bench.runs.verify import read_checked

    if not 0 < arguments.share < 1:
        raise ConfigError(f"--share {arguments.share:g}: must be above 0 and below 1")
    if arguments.out is None:
        raise ConfigError("robustness tolerance: name the run folder with --out, such as --out runs/tolerance")
    conditions = conditions_of(arguments.corruptions, [1], [])
    corruptions = [CORRUPTIONS[one[0].corruption.address] for one in conditions if len(one) == 1]
    target_of = {named_method(text).name: text for text in _clean_targets(arguments)}
    if arguments.dry_run:  # one of its steps
        highest = [(Condition(corruption, MAX_SEVERITY),) for corruption in corruptions]
        arguments.methods = methods_of(list(target_of.values()), highest)
        return execute(plan_of(arguments), arguments)
    requested: dict[str, None] = {}
    score: list[tuple[str, str]] = []
    n_scenes = 0

    def evaluate(cells: Sequence[Cell]) -> Mapping[Cell, Numbers]:
        nonlocal n_scenes
        requested.update(dict.fromkeys(target_of[cell.method] + cell.suffix for cell in cells))
        arguments.methods, arguments.extend = list(requested), Path(arguments.out, "run.json").is_file()
        plan = plan_of(arguments)
        with output.progress(len(plan.jobs), is_quiet=arguments.quiet) as report:
            result = run_plan(plan, report)
        if result.failures:
            raise DataError(f"{arguments.out}: {result.failures[0][2]}; the same command resumes the search")
        run = read_checked(plan.folder.path)
        score[:] = [_score_of(run, arguments)]
        n_scenes = len(run.scenes)
        return numbers_of(run, *score[0], cells)

    found = find_tolerances(evaluate, list(target_of), corruptions, arguments.share)
    tables = tolerance_tables(found, *score[0], arguments.share, n_scenes)
    output.answer_tables(arguments, _tolerances_json(found), tables)
    return EXIT_DONE


def _tolerances_json(found: Sequence[Tolerance]) -> list[dict[str, Any]]:
    return [{**vars(one), "corruption": one.corruption.address} for one in found]


def _score_of(run: FinishedRun, arguments: argparse.Namespace) -> tuple[str, str]:
    """The protocol and metric of the score; ``ConfigError`` if the run does not have them."""
    protocol = str(arguments.protocol or next(iter(run.protocols), ""))
    if protocol not in run.protocols:
        raise ConfigError(f"{run.name}: not scored under {protocol}; it has {', '.join(run.protocols) or 'no scores'}")
    headline = run.rules(protocol).headline
    metric = str(arguments.metric or headline[0])
    if metric not in headline:
        raise ConfigError(f"--metric {metric}: {protocol} has {', '.join(headline)}")
    return protocol, metric
