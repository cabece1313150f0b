"""``su3d-bench report``: what is made from finished runs; pages and archives in ``report_files``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import report_files
from su3d_bench.cli.options import Verbs, add_group, add_verb, index, positive
from su3d_bench.cli.output import (
    answer,
    answer_document,
    answer_json,
    answer_or_write,
    answer_tables,
    progress,
    remark,
    show,
)
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted

if TYPE_CHECKING:
    from su3d_bench.formats.tables.table import Table
    from su3d_bench.metrics.costs import UpdateTimes

PAPER_TABLES = ("I", "II", "III", "IV", "V", "reasoning")


def add_parser(verbs: Verbs) -> None:
    """Make tables, pages and archives from finished runs, and check a paper against them.

    su3d-bench report tables runs/my-run --format latex --table II
    su3d-bench report verify paper.tex
    """
    actions = add_group(verbs, "report", add_parser)
    _add_tables(actions)
    _add_timing(actions)
    report_files.add_pages(actions)
    _add_samples(actions)
    _add_leaderboard(actions)
    _add_attribution(actions)
    _add_power(actions)
    report_files.add_archives(actions)


def _add_tables(verbs: Verbs) -> None:
    parser = add_verb(verbs, "tables", call_tables)
    parser.option("runs RUN...", "folders of finished runs, or of what sheets score wrote")
    parser.shared("--format")
    parser.option(
        "--table ...", "of the paper, or its reasoning scores (default: none)", choices=PAPER_TABLES, default=[]
    )
    for name, what in (
        ("methods", "these rows, in this order, alone (default: all)"),
        ("datasets", "scenes of these alone (default: all)"),
        ("protocols", "under these alone (default: all)"),
        ("metrics", "these columns (default: the headline ones)"),
    ):
        parser.option(f"--{name} {name[:-1].upper()}...", what, default=[])
    parser.option("--intervals", "show the 95 %% interval over scenes")
    parser.option("--truth-scores", "show what the truth itself scores")
    parser.option("--scenes-count", "show the number of scenes even where none is missing")
    parser.option("--significant", "mark the best only where it differs from the second (p < 0.05)")
    parser.option(
        "--published", "show what papers report beneath (default: with --table)", action=argparse.BooleanOptionalAction
    )
    parser.option("--out FILE", "write there instead of printing")


def call_tables(arguments: argparse.Namespace) -> int:
    """Make tables for a paper from runs: those of OpenSU3D's paper by number, or one for each protocol.

    su3d-bench report tables runs/my-run --table II III --format latex --out tables.tex
    su3d-bench report tables runs/my-run scores --table IV V --intervals
    """
    tables = _tables(arguments)
    answer_or_write(arguments, list(map(asdict, tables)), tables)
    return EXIT_DONE


def _tables(arguments: argparse.Namespace) -> list[Table]:
    from su3d_bench.analysis.tables import choose, found_tables, measured_results, numbered_tables, refuse_unscored
    from su3d_bench.reports.tables.paper import Shown, selection_tables

    shown = Shown(
        metrics=tuple(arguments.metrics),
        intervals=arguments.intervals,
        ceilings=arguments.truth_scores,
        scenes_count=arguments.scenes_count,
        only_significant=arguments.significant,
    )
    with_published = bool(arguments.table) if arguments.published is None else arguments.published
    every = measured_results(arguments.runs)
    is_selection = bool(arguments.table or arguments.protocols or arguments.metrics)
    found = [] if is_selection else found_tables(arguments.runs, arguments.methods, arguments.datasets)
    if not found:
        refuse_unscored(every, arguments.runs)
    elif not any(row.per_scene for row in every):
        return found
    measured = choose(every, arguments.methods, arguments.protocols, arguments.datasets)
    if not arguments.table:
        return [*selection_tables(measured, shown, with_published=with_published), *found]
    return numbered_tables(
        tuple(dict.fromkeys(arguments.table)), measured, arguments.runs, shown, with_published=with_published
    )


def _add_timing(verbs: Verbs) -> None:
    parser = add_verb(verbs, "timing", call_timing)
    parser.shared("runs")
    parser.shared("--methods")
    parser.option("--warm-up N", "first updates of a scene that stand apart (default: 3)", type=index, default=3)
    parser.option("--camera-rate HZ", "frames a second of the camera (default: 30)", type=positive, default=30.0)
    parser.option("--out DIR", "write timing.md, timing.csv, methods.csv and the plots there")
    parser.shared("--format")


def call_timing(arguments: argparse.Namespace) -> int:
    """Say what an update costs, stage by stage, and whether it grows with the map.

    su3d-bench report timing runs/demo
    su3d-bench report timing runs/a runs/b --out timing --camera-rate 20
    """
    from su3d_bench.analysis.tables import anytime_points
    from su3d_bench.metrics.costs import summarise
    from su3d_bench.reports.tables.formats import markdown
    from su3d_bench.reports.tables.timing import csv_text, methods_csv, timing_tables
    from su3d_bench.runs.finished import read_run, read_update_times

    runs = [read_run(path) for path in arguments.runs]
    timed = [read_update_times(run, method) for run in runs for method in arguments.methods or run.methods]
    times = [each for each in timed if each]
    if not times:
        are_elsewhere = any(run.made_elsewhere for run in runs)
        why = "predictions made elsewhere bring no times" if are_elsewhere else "their methods look at no frame"
        raise ConfigError(f"no update was timed in these runs: {why}")
    summaries = [summarise(each, arguments.warm_up) for each in times]
    anytime = [point for each in times for point in anytime_points(runs, each)]
    hardware = {run.name: run.record.hardware for run in runs}
    tables = timing_tables(summaries, anytime, hardware, arguments.camera_rate)
    value = {"hardware": hardware, "methods": [asdict(summary) for summary in summaries]}
    answer_tables(arguments, value, tables)
    if arguments.out is not None:
        files = {
            "timing.md": markdown(tables),
            "timing.csv": csv_text(summaries, hardware),
            "methods.csv": methods_csv(summaries, hardware, arguments.camera_rate),
        }
        _write(arguments, files, times, anytime)
    return 0


def _write(
    arguments: argparse.Namespace, files: dict[str, str], times: list[list[UpdateTimes]], anytime: list[Any]
) -> None:
    from su3d_bench.core.files.atomic import make_folder, write_text
    from su3d_bench.reports.pictures.plots import draw_timing

    show()  # the plots take longer than the tables
    make_folder(arguments.out)
    for name, text in files.items():
        write_text(arguments.out / name, text)
    pictures = draw_timing(times, anytime, arguments.warm_up, arguments.out)
    for path in (*(arguments.out / name for name in files), *pictures):
        remark(f"wrote {path}", quiet=arguments.quiet)


FORMATS = ("csv", "parquet")


def _add_samples(verbs: Verbs) -> None:
    parser = add_verb(verbs, "samples", call_samples)
    parser.shared("runs", nargs="*")
    parser.shared("--methods", "--protocols", "--scenes")
    parser.option("--format", "of the rows (default: parquet where --out ends so, else csv)", choices=FORMATS)
    parser.option("--out FILE", "write there instead of printing CSV")
    parser.option("--columns", "say what each column holds, and list nothing")
    parser.shared("--table-format")


def call_samples(arguments: argparse.Namespace) -> int:
    """List every instance of runs, predicted and true: class, confidence, best IoU, kind of error, box.

    su3d-bench report samples runs/my-run --out samples.csv
    su3d-bench report samples runs/a runs/b --methods opensu3d --format parquet --out samples.parquet
    """
    from su3d_bench.reports.tables.samples import COLUMNS, columns_table

    if arguments.columns:
        if arguments.runs:
            raise ConfigError("report samples: --columns speaks of no run; leave one of them out")
        answer_tables(arguments, [asdict(column) for column in COLUMNS], [columns_table()])
        return EXIT_DONE
    if not arguments.runs:
        raise ConfigError("report samples: name the folder of a run, such as runs/my-run; or --columns")
    return _list(arguments)


def _list(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.samples import Chosen, samples
    from su3d_bench.core.files.atomic import make_folder, write_bytes
    from su3d_bench.reports.tables.samples import csv_of, parquet_of
    from su3d_bench.runs.finished import read_run

    is_named = arguments.out is not None and arguments.out.suffix == ".parquet"
    form = arguments.format or ("parquet" if is_named else "csv")
    if form == "parquet":
        if arguments.out is None:
            raise ConfigError("--format parquet: is no text; say where with --out samples.parquet")
        parquet_of(())  # before minutes of work: is it installed?
    chosen = Chosen(tuple(arguments.methods), tuple(arguments.protocols), tuple(arguments.scenes))
    n_scenes = sum(len(chosen.scenes or read_run(run).scenes) for run in arguments.runs)
    with progress(n_scenes, is_quiet=arguments.quiet) as report:
        found = samples(arguments.runs, chosen, report)
    for line in found.remarks:
        remark(line, quiet=arguments.quiet)
    if arguments.out is None:
        if not answer_json(arguments, [asdict(row) for row in found.rows]):
            answer_document(csv_of(found.rows))
        return EXIT_DONE
    make_folder(arguments.out.parent)
    write_bytes(arguments.out, parquet_of(found.rows) if form == "parquet" else csv_of(found.rows).encode())
    if not answer_json(arguments, [asdict(row) for row in found.rows]):
        n_predicted = sum(row.kind == "predicted" for row in found.rows)
        n_true = len(found.rows) - n_predicted
        answer(f"{arguments.out}: {counted(n_predicted, 'predicted instance')}, {n_true} true")
    return EXIT_DONE


def _add_leaderboard(verbs: Verbs) -> None:
    parser = add_verb(verbs, "leaderboard", call_leaderboard)
    parser.option("folder DIR", "a folder with runs anywhere below it")
    parser.shared("--protocols")
    parser.option("--intervals", "show 95 %% intervals: over scenes, and of ranks")
    parser.shared("--format")
    parser.option("--out FILE", "write there instead of printing")


def call_leaderboard(arguments: argparse.Namespace) -> int:
    """Rank the runs below a folder that agree in protocol, data, counts and labels (one label or the top k).

    su3d-bench report leaderboard runs
    su3d-bench report leaderboard submissions --protocols rooms-instance --format html --out board.html
    """
    from su3d_bench.analysis.leaderboard import leaderboard, tables

    board = leaderboard(arguments.folder, arguments.protocols, with_ranks=arguments.intervals)
    parts = tables(board, intervals=arguments.intervals)
    answer_or_write(arguments, asdict(board), parts)
    entries = f"{counted(sum(map(len, board.boards)), 'entry')} in {counted(len(board.boards), 'ranking')}"
    remark(f"{entries}, {len(board.refused)} left out", quiet=arguments.quiet)
    return EXIT_DONE


def _add_attribution(verbs: Verbs) -> None:
    parser = add_verb(verbs, "attribution", call_attribution)
    parser.shared("run")
    parser.option("--method METHOD", "whose predictions (default: the run's only method)")
    parser.shared("--protocols")
    parser.option("--oracle RUN", "the same run with --profile oracle: what perfect 2D masks give")
    parser.option("--out PNG", "draw the plot to this file")
    parser.shared("--format")


def call_attribution(arguments: argparse.Namespace) -> int:
    """Show where a run loses its points: the gain when each kind of error alone is corrected.

    su3d-bench report attribution runs/my-run --out errors.png
    su3d-bench report attribution runs/my-run --protocols rooms-instance --oracle runs/my-oracle-run --json
    """
    from su3d_bench.analysis.attribution import attribute
    from su3d_bench.reports.tables.samples import attribution_tables

    attribution = attribute(
        arguments.run,
        method=arguments.method,
        protocols=arguments.protocols,
        oracle=arguments.oracle,
    ).to_json()
    answer_tables(arguments, attribution, attribution_tables(attribution))
    if arguments.out is not None:
        from su3d_bench.reports.pictures.plots import draw_attribution

        show()  # the plot takes longer than the answer
        draw_attribution(attribution, arguments.out)
        remark(f"plot: {arguments.out}", quiet=arguments.quiet)
    return EXIT_DONE


def _add_power(verbs: Verbs) -> None:
    parser = add_verb(verbs, "power", call_power)
    parser.option("runs RUN...", "a finished run, and others that differ in --seed alone")
    parser.option("--methods", "whose (default: the only two)", nargs=2, default=(), metavar=("A", "B"))
    parser.option(
        "--points N...",
        "differences to be found, in percentage points (default: 1 2 5)",
        type=float,
        default=[1.0, 2.0, 5.0],
    )
    parser.option("--power P", "to find it (default: 0.8)", type=float, default=0.8)
    parser.shared("--protocols", "--format")


def call_power(arguments: argparse.Namespace) -> int:
    """Tell how many scenes and seeds show a difference of so many points between two methods.

    su3d-bench report power runs/my-run --methods opensu3d conceptgraphs --points 1 2 5
    su3d-bench report power runs/seed-0 runs/seed-1 runs/seed-2 --protocols rooms-instance --json
    """
    from su3d_bench.analysis.comparison import plan
    from su3d_bench.reports.tables.comparison import plan_tables

    made = plan(
        arguments.runs,
        arguments.methods,
        points=arguments.points,
        protocols=arguments.protocols,
        power=arguments.power,
    ).to_json()
    answer_tables(arguments, made, plan_tables(made))
    return EXIT_DONE
