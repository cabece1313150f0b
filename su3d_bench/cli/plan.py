"""``su3d-bench report power``: how many scenes and seeds show a difference."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_tables
from su3d_bench.cli.shared.flags import add_protocols, add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        "power",
        "Tell how many scenes and seeds show a difference of so many points between two methods.",
        (
            "su3d-bench report power runs/my-run --methods opensu3d conceptgraphs --points 1 2 5",
            "su3d-bench report power runs/seed-0 runs/seed-1 runs/seed-2 --protocols rooms-instance --json",
        ),
        call,
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="a finished run, and others that differ in --seed alone"
    )
    parser.add_argument("--methods", nargs=2, default=(), metavar=("A", "B"), help="whose (default: the only two)")
    parser.add_argument(
        "--points",
        nargs="+",
        type=float,
        default=[1.0, 2.0, 5.0],
        metavar="N",
        help="differences to be found, in percentage points (default: 1 2 5)",
    )
    parser.add_argument("--power", type=float, default=0.8, metavar="P", help="to find it (default: 0.8)")
    add_protocols(parser, "under these protocols alone (default: all that scored both)")
    add_table_format(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.planning import plan
    from su3d_bench.reports.tables.planning import plan_tables

    made = plan(
        arguments.runs,
        arguments.methods,
        points=arguments.points,
        protocols=arguments.protocols,
        power=arguments.power,
    ).to_json()
    answer_tables(arguments, made, plan_tables(made))
    return EXIT_DONE
