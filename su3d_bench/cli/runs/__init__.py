"""``su3d-bench runs``: which run folders there are, what is in one, and how one goes; a module a sub-verb."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from su3d_bench.cli import export as runs_export
from su3d_bench.cli import refine as runs_refine
from su3d_bench.cli.runs import list as runs_list
from su3d_bench.cli.runs import remove as runs_remove
from su3d_bench.cli.runs import show as runs_show
from su3d_bench.cli.shared.flags import add_modules

# Modules with ``NAME`` and ``add_parser(actions)``, imported for --help too, so with nothing heavy at their top.
SUB_VERBS: tuple[ModuleType, ...] = (runs_list, runs_show, runs_remove, runs_refine, runs_export)


def add_parser(verbs: Any) -> None:
    add_modules(
        verbs,
        "runs",
        "List, show, remove, refine and export what runs leave.",
        SUB_VERBS,
        ("su3d-bench runs list", "su3d-bench runs show runs/demo"),
        lists=True,
    )
