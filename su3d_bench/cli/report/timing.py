"""``su3d-bench report timing``: what an update costs, stage by stage, and whether it grows with the map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer_tables, remark, show
from su3d_bench.cli.shared.flags import add_table_format, add_verb

if TYPE_CHECKING:
    from su3d_bench.metrics.costs import UpdateTimes

NAME = "timing"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Say what an update costs, stage by stage, and whether it grows with the map.",
        ("su3d-bench report timing runs/demo", "su3d-bench report timing runs/a runs/b --out timing --camera-rate 20"),
        call,
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of finished runs")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="only these (default: all that look at frames)")
    parser.add_argument(
        "--warm-up", type=int, default=3, metavar="N", help="first updates of a scene that stand apart (default: 3)"
    )
    parser.add_argument(
        "--camera-rate", type=float, default=30.0, metavar="HZ", help="frames a second of the camera (default: 30)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write timing.md, timing.csv, methods.csv and the plots there"
    )
    add_table_format(parser)


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.tables import anytime_points
    from su3d_bench.core.errors import ConfigError
    from su3d_bench.metrics.costs import summarise
    from su3d_bench.reports.tables.formats import markdown
    from su3d_bench.reports.tables.timing import csv_text, methods_csv, timing_tables
    from su3d_bench.runs.finished import read_run, read_update_times

    if arguments.warm_up < 0 or not arguments.camera_rate > 0:
        raise ConfigError("--warm-up is a count from 0, --camera-rate a number above 0")
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
