"""``su3d-bench report leaderboard``: runs of many people as one ranking."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_or_write, remark
from su3d_bench.cli.shared.flags import add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE, counted

NAME = "leaderboard"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Rank the runs below a folder that agree in protocol, data, counts and labels (one label or the top k).",
        (
            "su3d-bench report leaderboard runs",
            "su3d-bench report leaderboard submissions --protocols rooms-instance --format html --out board.html",
        ),
        call,
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="a folder with runs anywhere below it")
    parser.add_argument("--protocols", nargs="+", default=[], metavar="PROTOCOL", help="only these (default: all)")
    parser.add_argument("--intervals", action="store_true", help="show 95 %% intervals: over scenes, and of ranks")
    add_table_format(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="write there instead of printing")


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.leaderboard import leaderboard, tables

    board = leaderboard(arguments.folder, arguments.protocols, with_ranks=arguments.intervals)
    parts = tables(board, intervals=arguments.intervals)
    answer_or_write(arguments, asdict(board), parts)
    entries = f"{counted(sum(map(len, board.boards)), 'entry')} in {counted(len(board.boards), 'ranking')}"
    remark(f"{entries}, {len(board.refused)} left out", quiet=arguments.quiet)
    return EXIT_DONE
