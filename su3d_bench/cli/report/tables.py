"""``su3d-bench report tables``: the paper's tables and any other selection, from finished runs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer_or_write
from su3d_bench.cli.shared.flags import add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE

if TYPE_CHECKING:
    from su3d_bench.formats.tables.table import Table

NAME = "tables"
PAPER_TABLES = ("I", "II", "III", "IV", "V", "reasoning")


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Make tables for a paper from runs: those of OpenSU3D's paper by number, or one for each protocol.",
        (
            "su3d-bench report tables runs/my-run --table II III --format latex --out tables.tex",
            "su3d-bench report tables runs/my-run scores --table IV V --intervals",
        ),
        call,
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="folders of finished runs, or of what sheets score wrote"
    )
    add_table_format(parser)
    parser.add_argument(
        "--table",
        nargs="+",
        choices=PAPER_TABLES,
        default=[],
        help="of the paper, or its reasoning scores (default: none)",
    )
    for name, what in (
        ("methods", "these rows, in this order, alone (default: all)"),
        ("datasets", "scenes of these alone (default: all)"),
        ("protocols", "under these alone (default: all)"),
        ("metrics", "these columns (default: the headline ones)"),
    ):
        parser.add_argument(f"--{name}", nargs="+", default=[], metavar=name[:-1].upper(), help=what)
    parser.add_argument("--intervals", action="store_true", help="show the 95 %% interval over scenes")
    parser.add_argument("--truth-scores", action="store_true", help="show what the truth itself scores")
    parser.add_argument(
        "--scenes-count", action="store_true", help="show the number of scenes even where none is missing"
    )
    parser.add_argument(
        "--significant", action="store_true", help="mark the best only where it differs from the second (p < 0.05)"
    )
    parser.add_argument(
        "--published",
        action=argparse.BooleanOptionalAction,
        help="show what papers report beneath (default: with --table)",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write there instead of printing")


def call(arguments: argparse.Namespace) -> int:
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
