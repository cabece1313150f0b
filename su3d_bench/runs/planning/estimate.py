"""How long a plan will take, from the timings of earlier runs beside it."""

from __future__ import annotations

import glob
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.runs.job import SceneJob, stride_of
from su3d_bench.runs.parts import Part, build_dataset, build_method
from su3d_bench.runs.planning.held import kept_jobs
from su3d_bench.runs.planning.plan import Plan
from su3d_bench.store.records import read_updates

# Where no earlier run says better: an update of opensu3d under the embedded profile at 640x480, and reading, scoring
# and drawing one room under two protocols, both on two cores of a 2020s server.
GUESSED_UPDATE_S = 0.5
GUESSED_SCENE_S = 15.0
N_RECENT = 8


@dataclass(frozen=True)
class JobEstimate:
    """What one scene under one method will take; ``remark`` says why where its frames cannot be read."""

    scene: str
    method: str
    n_updates: int
    seconds: float
    is_measured: bool
    is_done: bool
    remark: str | None = None


def estimate(plan: Plan) -> list[JobEstimate]:
    """One estimate a scene and method, in the order of the plan; reads no frame."""
    runs = plan.folder.path.parent
    update_s = {part.name: recent_update_s(runs, part.name) for part in plan.jobs[0].methods}
    roots = {job.dataset: job.data_root for job in plan.jobs}
    datasets = {part: build_dataset(part, root) for part, root in roots.items()}
    needs_frames = {part: bool(build_method(part).needs.frames) for part in plan.jobs[0].methods}
    kept = kept_jobs(plan.folder, plan.jobs) if plan.into == "replace" else None
    return [
        _of_job(plan, job, part, update_s[part.name], datasets[job.dataset] if needs_frames[part] else None, kept)
        for job in plan.jobs
        for part in job.methods
    ]


def _of_job(
    plan: Plan, job: SceneJob, part: Part, measured: float | None, dataset: Any, kept: Collection[Path] | None
) -> JobEstimate:
    """``measured``: seconds an update; ``dataset`` None where the method looks at no frame.

    ``kept``: the folders of jobs that stay where the plan replaces a run.
    """
    folder = plan.folder.job(job.scene, part.name)
    is_done = {"predict", "score"} <= set(folder.seals()) and (kept is None or folder.path in kept)
    n_updates, remark = 0, None
    if dataset is not None:
        try:
            n_frames = len(dataset.frames(job.scene_name, stride_of(job.stride, part.options)))
            n_updates = min(n_frames, job.limit or n_frames)
        except DataError as error:
            remark = str(error)
    seconds = GUESSED_SCENE_S + n_updates * (GUESSED_UPDATE_S if measured is None else measured)
    return JobEstimate(job.scene, part.name, n_updates, seconds, measured is not None, is_done, remark)


def recent_update_s(runs: Path, method: str) -> float | None:
    """Mean seconds an update in the latest runs below ``runs``, damaged tables aside; None where there is none."""
    files = [path for path in runs.glob(f"*/scenes/*/{glob.escape(method)}/updates.csv") if path.is_file()]
    newest = sorted(files, key=lambda path: path.stat().st_mtime)[-N_RECENT:]
    totals = [ms for path in newest for ms in _totals(path)]
    return sum(totals) / len(totals) / 1e3 if totals else None


def _totals(path: Path) -> list[float]:
    try:
        totals: list[float] = read_updates(path, path.name)["total_ms"].tolist()
    except (OSError, DataError, KeyError):
        return []
    return totals
