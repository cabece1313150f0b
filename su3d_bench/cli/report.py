"""``su3d-bench report``: tables and plots of finished runs; pages and archives are in ``report_files``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import output, report_files
from su3d_bench.cli.options import Verbs, add_group, add_verb, index, output_path, positive, searched_folder
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, counted

if TYPE_CHECKING:
    from su3d_bench.formats.tables.table import Table

PAPER_TABLES = ("I", "II", "III", "IV", "V", "reasoning")


def add_parser(verbs: Verbs) -> None:
    """Create tables, pages and archives from finished runs, and verify published tables.

    su3d-bench report tables runs/my-run --format latex --tables II
    su3d-bench report verify paper.tex
    """
    actions = add_group(verbs, "report", add_parser)
    _add_tables(actions)
    _add_timing(actions)
    _add_identity(actions)
    _add_changes(actions)
    report_files.add_pages(actions)
    _add_instances(actions)
    _add_leaderboard(actions)
    _add_attribution(actions)
    _add_power(actions)
    report_files.add_archives(actions)


def _add_tables(verbs: Verbs) -> None:
    parser = add_verb(verbs, "tables", call_tables)
    parser.option("runs RUN...", "run folders, or folders written by sheets score")
    parser.shared("--format")
    tables = f"tables of the paper ({', '.join(PAPER_TABLES)}; default: none)"
    parser.option("--tables TABLE...", tables, choices=PAPER_TABLES, default=[])
    for name, what in (
        ("methods", "methods to use (in this order; default: all)"),
        ("datasets", "datasets to use (default: all)"),
        ("protocols", "protocols to use (default: all)"),
        ("metrics", "metrics to use (default: the headline metrics)"),
    ):
        parser.option(f"--{name} {name[:-1].upper()}...", what, default=[])
    parser.option("--intervals", "show 95 % confidence intervals (over scenes)")
    parser.option("--ceiling", "show the ground-truth ceiling")
    parser.option("--scenes-count", "always show the number of scenes")
    parser.option("--significant", "mark the best only if significantly better (p < 0.05)")
    parser.option(
        "--published", "show published results (default: with --tables)", action=argparse.BooleanOptionalAction
    )
    parser.option("--out FILE", "file to write (default: print)", type=output_path)


def call_tables(arguments: argparse.Namespace) -> None:
    """Create tables from runs: tables of the OpenSU3D paper, or one per protocol.

    su3d-bench report tables runs/my-run --tables II III --format latex --out tables.tex
    su3d-bench report tables runs/my-run scores --tables IV V --intervals
    """
    tables = _tables(arguments)
    output.answer_or_write(arguments, list(map(asdict, tables)), tables)


def _tables(arguments: argparse.Namespace) -> list[Table]:
    from su3d_bench.analysis.tables import check_scored, choose, found_tables, measured_results, numbered_tables
    from su3d_bench.reports.tables.paper import Shown, selection_tables

    shown = Shown(
        metrics=tuple(arguments.metrics),
        intervals=arguments.intervals,
        ceilings=arguments.ceiling,
        scenes_count=arguments.scenes_count,
        only_significant=arguments.significant,
    )
    with_published = bool(arguments.tables) if arguments.published is None else arguments.published
    every = measured_results(arguments.runs)
    is_selection = bool(arguments.tables or arguments.protocols or arguments.metrics)
    found = [] if is_selection else found_tables(arguments.runs, arguments.methods, arguments.datasets)
    if not found:
        check_scored(every, arguments.runs)
    elif not any(row.per_scene for row in every):
        return found
    measured = choose(every, arguments.methods, arguments.protocols, arguments.datasets)
    if not arguments.tables:
        return [*selection_tables(measured, shown, with_published=with_published), *found]
    return numbered_tables(
        tuple(dict.fromkeys(arguments.tables)), measured, arguments.runs, shown, with_published=with_published
    )


def _add_timing(verbs: Verbs) -> None:
    parser = add_verb(verbs, "timing", call_timing)
    parser.shared("runs")
    parser.shared("--methods")
    parser.option("--warm-up N", "first updates of a scene to exclude as warm-up (default: 3)", type=index, default=3)
    parser.option("--camera-rate HZ", "frame rate, for the real-time factor (default: 30)", type=positive, default=30.0)
    parser.option("--out DIR", "folder for tables (.md, .csv and .tex) and plots", type=output_path)
    parser.shared("--width", "--format")


def call_timing(arguments: argparse.Namespace) -> None:
    """Report the time per update and stage, whether it grows with the map, and cost against quality.

    su3d-bench report timing runs/demo
    su3d-bench report timing runs/a runs/b --out timing --camera-rate 20
    """
    from su3d_bench.analysis.costs import cost_rows
    from su3d_bench.analysis.tables import anytime_points
    from su3d_bench.core.files.atomic import make_folder, write_text
    from su3d_bench.formats.tables.table import csv_lines
    from su3d_bench.metrics.costs import summarise
    from su3d_bench.reports.pictures.plots import draw_timing
    from su3d_bench.reports.tables.costs import cost_tables, cost_values
    from su3d_bench.reports.tables.formats import markdown
    from su3d_bench.reports.tables.latex import latex
    from su3d_bench.reports.tables.timing import csv_text, methods_csv, timing_tables
    from su3d_bench.runs.finished import read_update_times
    from su3d_bench.runs.verify import read_checked

    runs = [read_checked(path) for path in arguments.runs]
    jobs = [(run, method) for run in runs for method in arguments.methods or run.methods]
    timed = {(run.name, method): read_update_times(run, method) for run, method in jobs}
    times = [each for each in timed.values() if each]
    if not times:
        are_elsewhere = any(run.external for run in runs)
        why = "imported predictions have no timings" if are_elsewhere else "their methods process no frames"
        raise ConfigError(f"no timings in these runs: {why}")
    summaries = [summarise(each, arguments.warm_up) for each in times]
    anytime = [point for each in times for point in anytime_points(runs, each)]
    hardware = {run.name: run.hardware for run in runs}
    rows = cost_rows(runs, timed)
    of_costs, costs = cost_tables(rows), cost_values(rows)
    tables = timing_tables(summaries, anytime, hardware, arguments.camera_rate, list(chain(*times))) + of_costs
    value: dict[str, Any] = {"hardware": hardware, "methods": list(map(asdict, summaries)), "cost_quality": costs}
    if clocked := [one for one in chain(*times) if one.realtime is not None]:
        value["real_time"] = [{"scene": one.scene, "method": one.method, **vars(one.realtime)} for one in clocked]
    output.answer_tables(arguments, value, tables)
    if arguments.out is None:
        return
    output.show()  # the plots are slower than the tables
    make_folder(arguments.out)
    write_text(arguments.out / "timing.md", markdown(tables))
    write_text(arguments.out / "timing.csv", csv_text(summaries, hardware))
    write_text(arguments.out / "methods.csv", methods_csv(summaries, hardware, arguments.camera_rate))
    write_text(arguments.out / "costs.csv", csv_lines([*costs[:1], *(one.values() for one in costs)]))
    write_text(arguments.out / "costs.tex", latex(of_costs))
    pictures = draw_timing(times, anytime, rows, arguments.warm_up, arguments.out, arguments.width)
    files = [arguments.out / name for name in ("timing.md", "timing.csv", "methods.csv", "costs.csv", "costs.tex")]
    remark(*(f"wrote {path}" for path in (*files, *pictures)), quiet=arguments.quiet)


def _add_identity(verbs: Verbs) -> None:
    parser = add_verb(verbs, "identity", call_identity, data=True)
    parser.shared("run", "--methods", "--protocols", "--format")


def call_identity(arguments: argparse.Namespace) -> None:
    """Report whether instances keep their ids over time: HOTA, OWTA, IDF1 and STQ.

    su3d-bench run --scenes homes/tuning0 --methods opensu3d --anytime-every 4 --out runs/over-time
    su3d-bench report identity runs/over-time
    """
    from su3d_bench.analysis.identity import identities, identity_table
    from su3d_bench.runs.verify import read_checked

    run = read_checked(arguments.run)
    with output.progress(len(run.scenes), is_quiet=arguments.quiet) as report:
        found = identities(run, arguments.methods, arguments.protocols, report)
    output.answer_tables(arguments, {"methods": list(map(asdict, found))}, [identity_table(found)])


def _add_changes(verbs: Verbs) -> None:
    parser = add_verb(verbs, "changes", call_changes, data=True)
    parser.shared("run", "--methods", "--protocols", "--format")


def call_changes(arguments: argparse.Namespace) -> None:
    """Report how maps follow objects that move, vanish or appear: ghosts, times, Khronos' measures, t-AP.

    su3d-bench run --scenes homes-changing/test0 --methods opensu3d --anytime-every 8 --out runs/changing
    su3d-bench report changes runs/changing
    """
    from su3d_bench.analysis.changes import changes, changes_table
    from su3d_bench.runs.verify import read_checked

    run = read_checked(arguments.run)
    with output.progress(len(run.scenes), is_quiet=arguments.quiet) as report:
        found = changes(run, arguments.methods, arguments.protocols, report)
    output.answer_tables(arguments, {"methods": list(map(asdict, found))}, [changes_table(found)])


def _add_instances(verbs: Verbs) -> None:
    parser = add_verb(verbs, "instances", call_instances, data=True)
    parser.shared("runs", nargs="*")
    parser.shared("--methods", "--protocols", "--scenes")
    parser.option("--out FILE", ".csv file to write (default: print CSV)", type=output_path)
    parser.option("--describe-columns", "describe the columns and exit")
    parser.set_defaults(table_format=None)


def call_instances(arguments: argparse.Namespace) -> None:
    """List every predicted and ground-truth instance: class, confidence, best IoU, error type, box.

    su3d-bench report instances runs/my-run --out instances.csv
    su3d-bench report instances runs/a runs/b --methods opensu3d --out instances.csv
    """
    from su3d_bench.analysis.instances import Selection, instance_rows
    from su3d_bench.core.files.atomic import make_folder, write_text
    from su3d_bench.reports.tables.instances import COLUMNS, columns_table, csv_of
    from su3d_bench.runs.finished import read_run

    if arguments.describe_columns == bool(arguments.runs):
        raise ConfigError("report instances: give a run folder, such as runs/my-run, or --describe-columns")
    if arguments.describe_columns:
        output.answer_tables(arguments, [asdict(column) for column in COLUMNS], [columns_table()])
        return
    out = arguments.out
    chosen = Selection(tuple(arguments.methods), tuple(arguments.protocols), tuple(arguments.scenes))
    n_scenes = sum(len(chosen.scenes or read_run(run).scenes) for run in arguments.runs)
    with output.progress(n_scenes, is_quiet=arguments.quiet) as report:
        found = instance_rows(arguments.runs, chosen, report)
    remark(*found.remarks, quiet=arguments.quiet)
    if out is not None:
        make_folder(out.parent)
        write_text(out, csv_of(found.rows))
    if output.answer_json(arguments, [asdict(row) for row in found.rows]):
        return
    if out is None:
        output.answer_document(csv_of(found.rows))
    else:
        n_predicted = sum(row.kind == "predicted" for row in found.rows)
        n_true = len(found.rows) - n_predicted
        output.answer(f"{out}: {counted(n_predicted, 'predicted instance')}, {n_true} ground-truth")


def _add_leaderboard(verbs: Verbs) -> None:
    parser = add_verb(verbs, "leaderboard", call_leaderboard)
    parser.option("folder DIR", "folder to search for runs", type=searched_folder)
    parser.shared("--protocols")
    parser.option("--intervals", "show 95 % confidence intervals (of scores and ranks)")
    parser.shared("--format")
    parser.option("--out FILE", "file to write (default: print)", type=output_path)


def call_leaderboard(arguments: argparse.Namespace) -> None:
    """Rank all comparable runs in a folder.

    su3d-bench report leaderboard runs
    su3d-bench report leaderboard submissions --protocols homes-instance --format html --out board.html
    """
    from su3d_bench.analysis.leaderboard import leaderboard, tables

    board = leaderboard(arguments.folder, arguments.protocols, with_ranks=arguments.intervals)
    parts = tables(board, intervals=arguments.intervals)
    output.answer_or_write(arguments, asdict(board), parts)
    entries = f"{counted(sum(map(len, board.boards)), 'entry')} in {counted(len(board.boards), 'ranking')}"
    remark(f"{entries}, {len(board.refused)} excluded", quiet=arguments.quiet)


def _add_attribution(verbs: Verbs) -> None:
    parser = add_verb(verbs, "attribution", call_attribution, data=True)
    parser.shared("run")
    parser.option("--method METHOD", "method to use (default: the only one of the run)")
    parser.shared("--protocols")
    parser.option("--oracle RUN", "also show the gain from perfect 2D masks: the same run with --profile oracle")
    parser.option("--out FIGURE", ".pdf, .png or .svg plot to write")
    parser.shared("--width", "--format")


def call_attribution(arguments: argparse.Namespace) -> None:
    """Show the gain in each metric if all errors of one type were corrected.

    su3d-bench report attribution runs/my-run --out errors.png
    su3d-bench report attribution runs/my-run --protocols homes-instance --oracle runs/my-oracle-run --json
    """
    from su3d_bench.analysis.attribution import attribute
    from su3d_bench.reports.tables.instances import attribution_tables

    chosen = {name: getattr(arguments, name) for name in ("method", "protocols", "oracle")}
    attribution = attribute(arguments.run, **chosen).to_json()
    output.answer_tables(arguments, attribution, attribution_tables(attribution))
    if arguments.out is not None:
        from su3d_bench.reports.pictures.plots import draw_attribution

        output.show()  # the plot is slower than the answer
        draw_attribution(attribution, arguments.out, arguments.width)
        remark(f"plot: {arguments.out}", quiet=arguments.quiet)


def _add_power(verbs: Verbs) -> None:
    parser = add_verb(verbs, "power", call_power)
    parser.option("runs RUN...", "finished run, and others that differ only in --seed")
    parser.shared("--methods", help="methods to use (two; default: the only two)", nargs=2, default=())
    parser.option(
        "--points N...",
        "differences to detect, in percentage points (default: 1 2 5)",
        type=float,
        default=[1.0, 2.0, 5.0],
    )
    parser.option("--power P", "statistical power (default: 0.8)", type=float, default=0.8)
    parser.shared("--protocols", "--format")


def call_power(arguments: argparse.Namespace) -> None:
    """Power analysis: scenes and seeds needed to detect a difference between two methods.

    su3d-bench report power runs/my-run --methods opensu3d conceptgraphs --points 1 2 5
    su3d-bench report power runs/seed-0 runs/seed-1 runs/seed-2 --protocols homes-instance --json
    """
    from su3d_bench.analysis.comparison import plan
    from su3d_bench.reports.tables.comparison import plan_tables

    chosen = {name: getattr(arguments, name) for name in ("points", "protocols", "power")}
    made = plan(arguments.runs, arguments.methods, **chosen).to_json()
    output.answer_tables(arguments, made, plan_tables(made))
