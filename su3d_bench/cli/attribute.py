"""``su3d-bench report attribution``: where a run loses its points."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_tables, remark, show
from su3d_bench.cli.shared.flags import add_protocols, add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        "attribution",
        "Show where a run loses its points: the gain when each kind of error alone is corrected.",
        (
            "su3d-bench report attribution runs/my-run --out errors.png",
            "su3d-bench report attribution runs/my-run --protocols rooms-instance --oracle runs/my-oracle-run --json",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    parser.add_argument("--method", help="whose predictions (default: the run's only method)")
    add_protocols(parser, "under these protocols alone (default: all of kind instance or semantic)")
    parser.add_argument(
        "--oracle", type=Path, metavar="RUN", help="the same run with --profile oracle: what perfect 2D masks give"
    )
    parser.add_argument("--out", type=Path, metavar="PNG", help="draw the plot to this file")
    add_table_format(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.attribution import attribute
    from su3d_bench.reports.tables.attribution import attribution_tables

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
