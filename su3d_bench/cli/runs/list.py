"""``su3d-bench runs list``: the runs below a folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_tables, remark
from su3d_bench.cli.shared.flags import add_table_format, add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError

NAME = "list"
DEFAULT = Path("runs")


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "List the runs below a folder: when they were written, how far they came, their first numbers.",
        ("su3d-bench runs list", "su3d-bench runs list /shared/runs --json"),
        call,
    )
    parser.add_argument("folder", type=Path, nargs="?", default=DEFAULT, metavar="DIR", help="(default: runs)")
    add_table_format(parser)


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.run_list import list_runs, runs_table

    if not arguments.folder.is_dir() and arguments.folder != DEFAULT:
        raise ConfigError(f"{arguments.folder}: there is no such folder; name one that holds runs")
    entries = list_runs(arguments.folder) if arguments.folder.is_dir() else []
    if not entries:
        remark(f"no run in {arguments.folder}; su3d-bench run rooms/living0 makes one", quiet=arguments.quiet)
    if entries or arguments.json:
        answer_tables(arguments, [asdict(entry) for entry in entries], [runs_table(entries)])
    return EXIT_DONE
