"""``su3d-bench report verify``: whether the cells of a paper, or a bundle's numbers, still are what their runs give."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, counted

NAME = "verify"
BUNDLE = ".zip"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Recompute the cells of LaTeX tables from their runs, or score a bundle anew; exit code 1 where one differs.",
        ("su3d-bench report verify paper.tex", "su3d-bench report verify reproduced/opensu3d/bundle.zip --json"),
        call,
    )
    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="LaTeX by report tables, or around it; or bundle.zip of reproduce",
    )
    parser.add_argument(
        "--root", type=Path, metavar="DIR", help="where the runs' folders are (default: here, then beside the file)"
    )


def call(arguments: argparse.Namespace) -> int:
    bundles = [file for file in arguments.files if file.suffix.lower() == BUNDLE]
    if bundles and len(bundles) < len(arguments.files):
        raise ConfigError("report verify: bundles and LaTeX are verified apart; name the one or the other")
    return _verify_bundles(bundles, arguments) if bundles else _verify_papers(arguments)


def _verify_bundles(bundles: list[Path], arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.verifying import verify_bundle

    if arguments.root is not None:
        raise ConfigError("--root: a bundle brings its runs; leave it out")
    found = [verify_bundle(bundle) for bundle in bundles]
    lines = []
    for one in found:
        lines += [f"{one.bundle}: {fault}" for fault in one.faults]
        how = "to the last bit" if one.is_to_the_bit else "integers the same, values within 1e-9"
        said = f"differs: {counted(len(one.faults), 'fault')}" if one.faults else f"holds, {how}"
        counts = (counted(one.n_files, "file"), counted(one.n_scores, "score"), counted(one.n_cells, "cell"))
        looked_at = "{}, {} made anew, {}".format(*counts)
        lines.append(f"{one.bundle}: {looked_at}; {said}")
    answer_either(arguments, {"bundles": [asdict(one) for one in found]}, *lines)
    return EXIT_CHECK_FAILED if any(one.faults for one in found) else EXIT_DONE


def _verify_papers(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.tables import check_paper

    checks = [check for file in arguments.files for check in check_paper(file, arguments.root)]
    differing = [check for check in checks if check.fault is not None]
    value = {"n_cells": len(checks), "n_differing": len(differing), "differing": [*map(asdict, differing)]}
    lines = [f"{check.file}:{check.line}: {check.fault}" for check in differing]
    lines.append(f"{counted(len(checks), 'cell')} checked, {len(differing)} differ")
    answer_either(arguments, value, *lines)
    return EXIT_CHECK_FAILED if differing else EXIT_DONE
