"""``su3d-bench runs remove``: run folders that are not wanted any more."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError

NAME = "remove"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Remove run folders, once it is known that they hold nothing but a run; asks before it does.",
        ("su3d-bench runs remove runs/demo", "su3d-bench runs remove runs/a runs/b --yes"),
        call,
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--yes", action="store_true", help="do not ask; needed where nobody sits at a terminal")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.run_list import removable, run_entry, size_bytes

    folders = [removable(path) for path in dict.fromkeys(arguments.runs)]  # all of them, before the first goes
    lines = []
    for folder, path in zip(folders, dict.fromkeys(arguments.runs), strict=True):
        entry = run_entry(folder.path, str(path))
        what = f"{', '.join(entry.scenes) or 'no scene'} by {', '.join(entry.methods) or 'no method'}"
        lines.append(f"{entry.name}: {entry.state}, {size_bytes(folder.path) / 1e6:.1f} MB, {what}")
    if not arguments.yes and not _is_agreed(lines):
        answer_either(arguments, {"removed": []}, "nothing was removed")
        return EXIT_DONE
    for folder in folders:
        folder.remove()
    removed = [str(path) for path in dict.fromkeys(arguments.runs)]
    answer_either(arguments, {"removed": removed}, *(f"removed {line}" for line in lines))
    return EXIT_DONE


def _is_agreed(lines: list[str]) -> bool:
    """Whether whoever sits at the terminal wants the runs of ``lines`` gone."""
    from su3d_bench.cli.shared.answers import remark

    if not sys.stdin.isatty():
        raise ConfigError("runs remove: nobody is there to be asked; add --yes to remove without a question")
    for line in lines:
        remark(line)
    remark("remove for good? y or n")
    return sys.stdin.readline().strip().lower() in ("y", "yes")
