"""The tables of a plan, from the value of its JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from su3d_bench.core.errors import counted
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, bracketed, signed, text_table
from su3d_bench.reports.tables.model import few_scenes


def plan_tables(plan: Mapping[str, Any]) -> list[Table | Prose]:
    """One table a protocol, a row a metric and number of seeds; numbers are percentage points, or scenes."""
    n_seeds = len(plan["seeds"])
    seeds = "seed " + ", ".join(map(str, plan["seeds"]))
    title = f"{plan['left']} (A), {plan['right']} (B): {counted(len(plan['scenes']), 'scene')}, {seeds}"
    tables = [_protocol_table(name, metrics, title) for name, metrics in plan["protocols"].items()]
    notes = [
        f"scenes that find a true difference of so many points with a power of {100 * plan['power']:g} %, by a "
        "two-sided paired test at 5 %; at least 6, of which a sign-flip test can have a p below 0.05",
        f"[..] behind it: at the ends of the 95 % interval of the variance, which {len(plan['scenes'])} scenes leave "
        f"wide; {NOT_MEASURED}: no number of scenes up to 100,000, under so many seeds",
        "SD: standard deviation of the difference B - A over scenes, over seeds, and of what is left; in percentage "
        "points",
    ]
    if any(one["variance"] is None for metrics in plan["protocols"].values() for one in metrics.values()):
        notes.append("no SD: the difference is the same in every scene and run, or rests on a single scene")
    if n_seeds < 2:
        notes.append("one seed: how much seeds move the difference is not known; name runs of other seeds too")
    if n_seeds == 2:
        notes.append("two seeds: no interval, for of so few it would hold the truth too seldom; name a run of a third")
    notes += plan["remarks"]
    notes += [line for line in (few_scenes(len(plan["scenes"])),) if line]
    return [*tables, Prose(tuple(notes), is_list=True)]


def _protocol_table(protocol: str, metrics: Mapping[str, Any], title: str) -> Table:
    asked = list(dict.fromkeys(need["points"] for plan in metrics.values() for need in plan["needs"]))
    header = ["metric", "B - A", "SD of scenes", "of seeds", "of what is left", "seeds"]
    rows = [[*header, *(f"{points:g} {'point' if points == 1 else 'points'}" for points in asked)]]
    for name, plan in metrics.items():
        variance = plan["variance"]
        difference = f"{signed(plan['difference'])} {bracketed(plan['interval'], signed)}".rstrip()
        is_one_seed = variance is None or variance["of_seeds"] is None
        known = ("of_scenes", "", "") if is_one_seed else ("of_scenes", "of_seeds", "of_rest")
        parts = [_deviation(variance and variance.get(key)) for key in known]
        seeds = list(dict.fromkeys(need["n_seeds"] for need in plan["needs"]))
        for n_seeds in seeds:
            needs = [_need(need) for need in plan["needs"] if need["n_seeds"] == n_seeds]
            first = [name, difference, *parts] if n_seeds == seeds[0] else [""] * 5
            rows.append([*first, str(n_seeds), *needs])
        if not seeds:
            rows.append([name, difference, *parts, *[NOT_MEASURED] * (1 + len(asked))])
    return text_table(protocol, rows, heading=protocol, caption=f": {title}")


def _deviation(variance: float | None) -> str:
    return NOT_MEASURED if variance is None else f"{100 * variance**0.5:.1f}"


def _need(need: Mapping[str, Any]) -> str:
    low, high = (NOT_MEASURED if need[end] is None else str(need[end]) for end in ("low", "high"))
    return NOT_MEASURED if need["n_scenes"] is None else f"{need['n_scenes']} [{low}, {high}]"
