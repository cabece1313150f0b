"""``su3d-bench compare``: what one run changes over another, and how sure that is."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.shared.answers import answer_tables
from su3d_bench.cli.shared.flags import add_protocols, add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "compare",
        "Compare two runs over their common scenes: exact test, and differences with interval.",
        (
            "su3d-bench compare runs/before runs/after --per-class",
            "su3d-bench compare runs/old-0,runs/old-1 runs/new-0,runs/new-1 --protocols rooms-instance --json",
        ),
        call,
    )
    parser.add_argument("left", metavar="A", help="the folder of a run, or FOLDER:METHOD; FOLDER,FOLDER: several seeds")
    parser.add_argument("right", metavar="B", help="the run that is held against it; differences are B - A")
    parser.add_argument("--method", help="compare this method alone (default: all of the same name)")
    add_protocols(parser, "under these protocols alone (default: all that scored both)")
    parser.add_argument("--per-class", action="store_true", help="each class too")
    add_table_format(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.comparison import compare
    from su3d_bench.reports.tables.comparison import comparison_tables

    comparison = compare(
        arguments.left,
        arguments.right,
        method=arguments.method,
        protocols=arguments.protocols,
        per_class=arguments.per_class,
    ).to_json()
    answer_tables(arguments, comparison, comparison_tables(comparison))
    return EXIT_DONE
