"""A short run that measures what updates and scenes cost on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from su3d_bench.core.files.scratch import TemporaryFolder
from su3d_bench.reproducing.asked import AskedRun, carry_out, plan_of
from su3d_bench.reproducing.costs import NAME, Stopwatch, UnitCost, clock_of, measured_costs, measured_here, write_costs
from su3d_bench.runs.executors import Report
from su3d_bench.store.run_folder import RunFolder

N_UPDATES = 4  # of each method in the probe: the first is dearer, as that of a run is


def probe(runs: Sequence[AskedRun], out: Path, report: Report | None = None) -> Path:
    """Run the first scene of each of ``runs`` for ``N_UPDATES`` with an empty cache, and leave the prices in ``out``.

    The maps of the probe are thrown away.
    """
    costs: list[UnitCost] = []
    for run in runs:
        costs += _probed(run, report)
    first = {(one.method, one.profile, one.device): one for one in reversed(costs)}
    place = out / NAME
    write_costs(place, measured_here(list(first.values())))
    return place


def _probed(run: AskedRun, report: Report | None) -> tuple[UnitCost, ...]:
    values = dict(run.values) | {"limit": N_UPDATES, "jobs": 1, "executor": "inline"}
    with TemporaryFolder("su3d-probe-") as folder, _cache(folder / "cache"):
        short = replace(run, values=values)
        whole = plan_of(short, folder)
        plan = replace(whole, jobs=whole.jobs[:1])
        watch = Stopwatch(clock_of(run.device or "cpu"), report)
        result = carry_out(replace(short, rows=()), plan, watch)
        jobs = [(one.scene, one.method, run.profile) for one in result.outcomes if one.method in plan.methods]
        failed = {(scene, method) for scene, method, _ in result.failures}
        done = [job for job in jobs if job[:2] not in failed]
        if not done:
            return ()
        return measured_costs(
            watch, RunFolder(plan.folder.path), done, run.device or "cpu", _bytes_below(folder / "cache")
        )


def _bytes_below(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@contextmanager
def _cache(folder: Path) -> Iterator[None]:
    """The perception cache in ``folder`` for the time of the block."""
    with environment(SU3D_CACHE=str(folder)):
        yield


@contextmanager
def environment(**values: str) -> Iterator[None]:
    """Variables of the environment, which the workers inherit, for the time of the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
