"""What a reproduction says: the preflight, and the paper's tables beside what they printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from su3d_bench.core.errors import counted
from su3d_bench.formats.tables.table import Prose, Table, text_table
from su3d_bench.metrics.costs import summarise
from su3d_bench.reports.tables.timing import timing_tables
from su3d_bench.reproducing.asked import methods_of
from su3d_bench.reproducing.differences import Compared, Results, comparison_table, tables_of
from su3d_bench.reproducing.preflight import Need, Preflight
from su3d_bench.reproducing.recipe import Experiment, Recipe
from su3d_bench.runs.finished import read_update_times

WARM_UP, CAMERA_HZ = 3, 30.0  # as `report timing` has them
SCHEMA = 1


def size(n_bytes: float | None) -> str:
    """Bytes as people read them.

    >>> size(2_564_000_000.0), size(1500.0), size(None)
    ('2.56 GB', '0.00 GB', 'unknown')
    """
    return "unknown" if n_bytes is None else f"{n_bytes / 1e9:.2f} GB"


def duration(seconds: float | None) -> str:
    """
    >>> duration(90.0), duration(7300.0), duration(None)
    ('1.5 min', '2.0 h', 'unknown')
    """
    if seconds is None:
        return "unknown"
    return f"{seconds / 60:.1f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


def preflight_tables(known: Preflight) -> list[Table]:
    """What is here and what is not, then the price of each run."""
    rows = [["what", "name", "is here", "bytes", "how to get it"]]
    rows += [[need.kind, need.name, _state(need), _bytes(need), need.how or "-"] for need in known.needs]
    remarks = [f"{need.name}: {need.remark}" for need in known.needs if need.remark and not need.is_here]
    here = text_table("needs", rows, heading="Needed", caption=f": {_said(known)}", notes=remarks)
    prices = [["run", "time", "disk", "memory", "GPU memory"]]
    for one in known.estimates:
        gpu = "-" if not one.device_bytes else size(one.device_bytes)
        prices.append([one.name, duration(one.seconds), size(one.disk_bytes), size(one.memory_bytes), gpu])
    notes = [f"unit costs of {one.name}: measured on {one.where}" for one in known.estimates if not one.unknown]
    notes += [
        f"{one.name}: no unit cost of {', '.join(one.unknown)} was measured under its profile and device; --probe "
        "measures them here"
        for one in known.estimates
        if one.unknown
    ]
    return [
        here,
        text_table("price", prices, heading="Price", caption=f": {_total(known)}", notes=dict.fromkeys(notes)),
    ]


def _state(need: Need) -> str:
    return "yes" if need.is_here else "no" if need.is_required else "no, can do without"


def _bytes(need: Need) -> str:
    return "-" if need.is_here and not need.n_bytes else "unknown" if need.n_bytes is None else f"{need.n_bytes:,.0f}"


def _said(known: Preflight) -> str:
    missing = known.missing
    n_bytes = sum(need.n_bytes or 0.0 for need in missing if need.kind in ("model", "scene"))
    if not missing:
        return "everything that is required is here."
    return f"{counted(len(missing), 'thing')} missing, about {size(n_bytes)} to fetch."


def _total(known: Preflight) -> str:
    hours = known.hours
    return "how long all takes is not known." if hours is None else f"all runs take about {duration(3600 * hours)}."


def summary(known: Preflight) -> Iterator[str]:
    """The preflight in a few lines."""
    yield f"preflight: {_said(known)[:-1]}; {_total(known)}"
    for need in known.needs:
        if not need.is_here:
            yield f"  missing: {need.kind} {need.name}" + (f" ({need.remark})" if need.remark else "")


def result_tables(
    experiments: Sequence[Experiment], cells: Mapping[str, Sequence[Compared]], results: Results
) -> list[Table | Prose]:
    """Of each experiment the paper's own table, and under it reported beside measured; of timing its tables."""
    tables: list[Table | Prose] = []
    for experiment in experiments:
        tables += tables_of(experiment, results)
        if cells.get(experiment.name):
            tables.append(comparison_table(experiment, cells[experiment.name]))
        if experiment.timing:
            tables += _timing(experiment, results.of(experiment))
    return tables


def _timing(experiment: Experiment, results: Results) -> Sequence[Table | Prose]:
    timed = [
        times
        for run in results.runs.values()
        for method in methods_of(experiment)
        if method in run.methods and set(experiment.protocols) & set(run.protocols)
        if (times := read_update_times(run, method))
    ]
    hardware = {run.name: run.record.hardware for run in results.runs.values()}
    return timing_tables([summarise(each, WARM_UP) for each in timed], [], hardware, CAMERA_HZ) if timed else []


def compared_json(recipe: Recipe, cells: Mapping[str, Sequence[Compared]]) -> dict[str, Any]:
    """Every printed cell with what was measured, as it is kept."""
    rows = [
        {**asdict(cell), "difference": cell.difference, "difference_interval": cell.difference_interval}
        for each in cells.values()
        for cell in each
    ]
    return {"schema": SCHEMA, "recipe": recipe.name, "cells": rows}
