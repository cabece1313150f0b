"""What the user reads before and after a run: the estimated time, the pictures, and commands to run next."""

from __future__ import annotations

import glob
import math
import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import DataError, Su3dError
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.registry import CEILING_METHOD, MARK
from su3d_bench.runs.job import build_dataset, build_method, stride_of
from su3d_bench.runs.plan import Plan
from su3d_bench.runs.real_time import is_measured
from su3d_bench.runs.runner import RunResult
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.records import read_updates

# Seconds on two cores of a 2020s server: reading a scene of 40 frames; scoring under two protocols, and drawing, each
# method; and, if there is no earlier run to measure, an update of opensu3d under the embedded profile at 640x480.
SCENE_S, SCORING_S, DRAWING_S = 10.0, 1.5, 2.0
GUESSED_UPDATE_S = 0.3
N_RECENT = 8


@dataclass(frozen=True)
class JobEstimate:
    """The estimated time of one scene under one method; ``remark`` is the reason if its frames cannot be read."""

    scene: str
    method: str
    n_updates: int
    seconds: float
    is_measured: bool
    is_done: bool
    remark: str | None = None


def estimate(plan: Plan) -> list[JobEstimate]:
    """One estimate per scene and method, in the order of the plan; reads no frame."""
    methods, runs = plan.jobs[0].methods, plan.folder.path.parent
    update_s = {part: recent_update_s(runs, part.name.partition(MARK)[0]) for part in methods}
    needs_frames = {part for part in methods if build_method(part).needs.frames}
    datasets = {part: build_dataset(part, root) for part, root in {(job.dataset, job.data_root) for job in plan.jobs}}
    going = {job.path for job in plan.removes}
    rows = []
    for job, part in ((each, part) for each in plan.jobs for part in each.methods):
        folder = plan.folder.job(job.scene, part.name)
        is_done = {"predict", "score"} <= set(folder.completion_records()) and folder.path not in going
        n_updates, remark = 0, None
        if part in needs_frames:
            try:
                n_frames = len(datasets[job.dataset].frames(job.scene_name, stride_of(job, part)))
                n_updates = min(n_frames, job.config.limit or n_frames)
            except DataError as error:
                remark = str(error)
        measured = update_s[part]
        each_s = GUESSED_UPDATE_S if measured is None else measured
        if job.config.realtime:  # a busy method processes what fits into the recording's duration
            n_updates = min(n_updates, math.ceil(n_updates / job.config.realtime / max(each_s, 1e-9)))
        around_s = SCORING_S + DRAWING_S * job.config.pictures + SCENE_S * (part is job.methods[0])
        seconds = around_s + (1 + is_measured(job.config)) * n_updates * each_s
        rows.append(JobEstimate(job.scene, part.name, n_updates, seconds, measured is not None, is_done, remark))
    return rows


def recent_update_s(runs: Path, method: str) -> float | None:
    """Mean seconds per update in the latest runs below ``runs``, ignoring damaged tables; None if there are none."""
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


THINGS_FIRST = ("instance", "boxes")  # kinds of protocols that score no walls and floors


def pictures_of(result: RunResult) -> list[Path]:
    """The pictures of the run's maps, grouped by scene and method."""
    jobs = [result.plan.folder.job(outcome.scene, outcome.method) for outcome in result.outcomes]
    return [path for job in jobs for path in sorted(job.pictures.glob("*.png"))]


def next_commands(result: RunResult) -> list[str]:
    """Commands to run next, each of which works on this run; empty if it is incomplete."""
    if not result.is_complete:
        return []
    run = str(result.plan.folder.path)
    commands = [["report", "html", run, "--out", f"{run}.html" if result.plan.folder.path.name else "../page.html"]]
    with suppress(Su3dError):  # an unreadable map is reported by the command that reads it
        commands += _query(result, run)
    commands += _numbers(result, run)
    return [shlex.join(["su3d-bench", *words]) for words in commands]


def _query(result: RunResult, run: str) -> list[list[str]]:
    """A text query with a class name, for a map with features."""
    for outcome in result.outcomes:
        job = result.plan.folder.job(outcome.scene, outcome.method)
        is_map = outcome.method in result.plan.methods and outcome.method != CEILING_METHOD and is_file(job.prediction)
        features = read_prediction(job.prediction).features if is_map else None
        name = None if features is None or not features.size else _best_class(result, outcome.method)
        if name is not None:
            method = [] if outcome.method == "opensu3d" else ["--method", outcome.method]
            return [["query", "text", outcome.scene, name, "--run", run, *method]]
    return []


def _best_class(result: RunResult, method: str) -> str | None:
    """The class on which ``method`` scores best, under the first protocol with values per class."""
    rows = [row for row in result.metrics["results"] if row["method"] == method and row["result"] is not None]
    for row in sorted(rows, key=lambda row: (row["kind"] not in THINGS_FIRST, row["protocol"])):
        first = {name: next(iter(values.values()), None) for name, values in row["result"]["per_class"].items()}
        if known := {name: value for name, value in first.items() if value is not None}:
            return str(max(known, key=known.__getitem__))
    return None


def _numbers(result: RunResult, run: str) -> list[list[str]]:
    """Compare two methods, or learn a reference from the only one; empty if nothing was scored."""
    scored: dict[str, list[str]] = {}
    for row in result.metrics["results"]:
        if row["result"] is not None:
            scored.setdefault(row["protocol"], []).append(row["method"])
    methods = max(scored.values(), key=len, default=[])
    if len(methods) > 1:
        return [["compare", f"{run}:{methods[0]}", f"{run}:{methods[1]}"]]
    return [["check", "--build-from", run, "--out", "reference.json"]] if methods else []
