"""Tables of sweeps and tolerances, for every format of ``reports.tables.formats``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from su3d_bench.analysis.comparison import Difference
from su3d_bench.corruptions.model import Corruption
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, bracketed, percent, signed, text_table
from su3d_bench.robustness.measures import CellResult, MethodResult, SweepResult
from su3d_bench.robustness.tolerance import Tolerance
from su3d_bench.runs.finished import FinishedRun

EMBEDDED = "Colour corruptions are those of the embedded models: no model of this run was trained on photographs."


def sweep_tables(result: SweepResult, *, of_embedded: bool) -> list[Table | Prose]:
    """A summary of all methods, and a table of the cells of each."""
    families = list(dict.fromkeys(family for method in result.methods for family in method.families))
    head = ["method", f"clean {result.metric}", *families, "mean", "mCE", "resilience"]
    rows = [head, *(_summary(method, families) for method in result.methods)]
    heading = f"{result.protocol}: {result.metric} under corruptions"
    notes = sweep_notes(result, of_embedded=of_embedded)
    parts: list[Table | Prose] = [text_table("robustness", rows, heading=heading, notes=notes)]
    cells = [_cells_table(method, result.metric) for method in result.methods]
    note = "value in the unit: change in points; * p < 0.05, sign-flip test with Holm's correction over the family"
    return [*parts, *cells[:-1], *(replace(last, notes=(note,)) for last in cells[-1:])]


def is_of_embedded(run: FinishedRun) -> bool:
    """Whether no model of the run was trained on photographs."""
    return run.record.profile in ("embedded", "auto")


def sweep_notes(result: SweepResult, *, of_embedded: bool) -> list[str]:
    """What the columns of the summary mean."""
    return [
        "families: mean change over severities, then over corruptions, in points"
        f"{_interval(len(result.scenes))}; mean: over families",
        f"mCE: error relative to that of {result.baseline}; resilience: share of the clean value that is kept "
        "(Robo3D, Kong et al. 2023). A weak method loses little: read both beside the clean value",
        *([EMBEDDED] if of_embedded else []),
    ]


def _interval(n_scenes: int) -> str:
    return f", with the 95 % interval over {n_scenes} scenes" if n_scenes > 1 else ""


def _summary(method: MethodResult, families: Sequence[str]) -> list[str]:
    changes = [_change(method.families[family]) if family in method.families else NOT_MEASURED for family in families]
    return [
        method.method, percent(method.clean), *changes, _change(method.mean), percent(method.mce),
        percent(method.resilience),
    ]  # fmt: skip


def _change(difference: Difference) -> str:
    return f"{signed(difference.difference)} {bracketed(difference.interval, signed)}".rstrip()


def _cells_table(method: MethodResult, metric: str) -> Table:
    severities = sorted({_severity(one) for one in method.cells})
    of_corruption: dict[str, dict[str, CellResult]] = {}
    for one in method.cells:
        of_corruption.setdefault(one.cell.corruption, {})[_severity(one)] = one
    rows = [["corruption", "unit", *(f"severity {severity}" for severity in severities)]]
    for name, cells in of_corruption.items():
        unit = " + ".join(one.corruption.unit for one in next(iter(cells.values())).cell.conditions)
        rows.append([name, unit, *(_cell(cells.get(severity)) for severity in severities)])
    return text_table(f"robustness-{method.method}", rows, heading=method.method, caption=f": {metric}")


def _severity(one: CellResult) -> str:
    return "+".join(dict.fromkeys(f"{condition.severity:g}" for condition in one.cell.conditions))  # 3 of a pair at 3


def _cell(one: CellResult | None) -> str:
    if one is None:
        return NOT_MEASURED
    p = one.difference.p_of_all
    value = " + ".join(f"{condition.value:.4g}" for condition in one.cell.conditions)
    return f"{value}: {signed(one.difference.difference)}{'*' if p is not None and p < 0.05 else ''}"


def tolerance_tables(
    found: Sequence[Tolerance], protocol: str, metric: str, share: float, n_scenes: int
) -> list[Table | Prose]:
    """The data sheet: one table per family, in it one row per method and one column per corruption."""
    corruptions = {one.corruption.address: one.corruption for one in found}
    of_pair = {(one.method, one.corruption.address): one for one in found}
    families: dict[str, list[Corruption]] = {}
    for corruption in corruptions.values():
        families.setdefault(corruption.family, []).append(corruption)
    caption = (
        f": the largest error at which {100 * share:g} % of the clean {metric} under {protocol} is kept"
        f"{_interval(n_scenes)}; '>': kept at the highest severity"
    )
    tables: list[Table | Prose] = []
    for family, own in families.items():
        rows = [["method", *(f"{one.name}, {one.unit}" for one in own)]]
        rows += [
            [method, *(_tolerated(of_pair[method, one.address]) for one in own)]
            for method in dict.fromkeys(one.method for one in found)
        ]
        heading = f"Tolerated errors of {family}"
        tables.append(text_table(f"tolerance-{family}", rows, heading=heading, caption="" if tables else caption))
    return tables


def _tolerated(one: Tolerance) -> str:
    low_high = "" if one.interval is None else f" [{one.interval[0]:.3g}, {one.interval[1]:.3g}]"
    return f"{'> ' if one.is_beyond else ''}{one.value:.3g}{low_high}"
