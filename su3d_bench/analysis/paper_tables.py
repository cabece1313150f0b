"""The tables of OpenSU3D's paper by their numbers, from the results of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from su3d_bench.analysis.tables import is_scores
from su3d_bench.formats.tables.table import Table
from su3d_bench.reports.tables.ablation import ablation_table
from su3d_bench.reports.tables.judged import JUDGED, judged_table
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.papers.paper import Shown, paper_table
from su3d_bench.reports.tables.papers.published import PaperTable
from su3d_bench.runs.ablation import read_rows


def numbered_tables(
    numbers: Sequence[PaperTable],
    measured: Sequence[Measured],
    runs: Sequence[Path],
    shown: Shown,
    *,
    with_published: bool,
) -> list[Table]:
    """A table or more for each of ``numbers``; ``runs`` are those of ``measured``, among them the sweep of Table I."""
    tables: list[Table] = []
    for number in numbers:
        if number == "I":
            sweep = [row for run in runs if not is_scores(run) for row in read_rows(run)]
            tables.append(ablation_table(measured, sweep, shown, with_published=with_published))
        elif number in JUDGED:
            tables.append(judged_table(number, measured, shown, with_published=with_published))
        else:
            tables += paper_table(number, measured, shown, with_published=with_published)
    return tables
