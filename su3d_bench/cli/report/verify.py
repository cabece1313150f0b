"""``su3d-bench report verify``: whether the cells of a paper still are what their runs give."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, counted

NAME = "verify"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Recompute the cells of LaTeX tables from the runs that they name; exit code 1 where one differs.",
        ("su3d-bench report verify paper.tex", "su3d-bench report verify tables/*.tex --root results --json"),
        call,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="TEX", help="LaTeX made by report tables, or around it")
    parser.add_argument(
        "--root", type=Path, metavar="DIR", help="where the runs' folders are (default: here, then beside the file)"
    )


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.tables import check_paper

    checks = [check for file in arguments.files for check in check_paper(file, arguments.root)]
    differing = [check for check in checks if check.fault is not None]
    value = {"n_cells": len(checks), "n_differing": len(differing), "differing": [*map(asdict, differing)]}
    lines = [f"{check.file}:{check.line}: {check.fault}" for check in differing]
    lines.append(f"{counted(len(checks), 'cell')} checked, {len(differing)} differ")
    answer_either(arguments, value, *lines)
    return EXIT_CHECK_FAILED if differing else EXIT_DONE
