"""``su3d-bench report``: tables and pages made from finished runs; one module a sub-verb."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from su3d_bench.cli import attribute as report_attribution
from su3d_bench.cli import plan as report_power
from su3d_bench.cli.report import bundle as report_bundle
from su3d_bench.cli.report import html as report_html
from su3d_bench.cli.report import leaderboard as report_leaderboard
from su3d_bench.cli.report import rerun as report_rerun
from su3d_bench.cli.report import samples as report_samples
from su3d_bench.cli.report import tables as report_tables
from su3d_bench.cli.report import timing as report_timing
from su3d_bench.cli.report import verify as report_verify
from su3d_bench.cli.shared.flags import add_modules

# Modules with ``NAME`` and ``add_parser(actions)``, imported for --help too, so with nothing heavy at their top.
SUB_VERBS: tuple[ModuleType, ...] = (
    report_tables,
    report_timing,
    report_html,
    report_samples,
    report_rerun,
    report_leaderboard,
    report_attribution,
    report_power,
    report_bundle,
    report_verify,
)


def add_parser(verbs: Any) -> None:
    add_modules(
        verbs,
        "report",
        "Make tables, pages and archives from finished runs, and check a paper against them.",
        SUB_VERBS,
        (
            "su3d-bench report tables runs/my-run --format latex --table II",
            "su3d-bench report verify paper.tex",
        ),
    )
