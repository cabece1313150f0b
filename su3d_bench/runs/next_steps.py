"""What a person looks at and types after a run: its pictures, and commands that are true for it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from su3d_bench.core.errors import Su3dError
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.system.files import file_bytes
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, unpack_scores
from su3d_bench.runs.runner import RunResult
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import JobFolder

THINGS_FIRST = ("instance", "boxes")  # kinds of protocols that score no walls and floors


def pictures_of(result: RunResult) -> list[Path]:
    """The pictures of the run's maps, those of each scene and method together."""
    jobs = [result.plan.folder.job(outcome.scene, outcome.method) for outcome in result.outcomes]
    return [path for job in jobs for path in sorted(job.pictures.glob("*.png"))]


def next_commands(result: RunResult) -> list[str]:
    """Commands for what comes next, each of which works on this run; none for one that is not complete or lies in a
    store."""
    if not result.is_complete or result.plan.store is not None:
        return []
    run = str(result.plan.folder.path)
    commands = [["report", "html", run, "--out", f"{run}/page.html"]]
    with suppress(Su3dError):  # a map that nobody can read is told by what reads it
        commands += _query(result, run)
    commands += _numbers(result, run)
    return [shlex.join(["su3d-bench", *words]) for words in commands]


def _query(result: RunResult, run: str) -> list[list[str]]:
    """A text that means a class of a scene, asked of a map with features."""
    for outcome in result.outcomes:
        job = result.plan.folder.job(outcome.scene, outcome.method)
        is_map = outcome.method in result.plan.methods and outcome.method != CEILING_METHOD and is_file(job.prediction)
        features = read_prediction(job.prediction).features if is_map else None
        if features is None or not features.size:
            continue
        known = sorted(_classes(result, job, outcome.scene), key=lambda pair: -pair[1])
        if known:
            method = [] if outcome.method == "opensu3d" else ["--method", outcome.method]
            return [["query", outcome.scene, known[0][0], "--run", run, *method]]
    return []


def _classes(result: RunResult, job: JobFolder, scene: str) -> Iterator[tuple[str, float]]:
    """The classes that the scene has, each with what the map scores on it, of the first protocol that tells classes."""
    scores = unpack_scores(file_bytes(job.counts))
    asked = dict.fromkeys(name for scene_job in result.plan.jobs for name in scene_job.protocols)
    rules = {rules.name: rules for rules in map(load_protocol, asked)}
    for name in sorted(scores, key=lambda name: rules[name].kind not in THINGS_FIRST):
        rows: Mapping[str, Mapping[str, float]]
        rows = combine(rules[name], {scene: scores[name]}, with_intervals=False).per_class
        values = {cls: next(iter(row.values()), math.nan) for cls, row in rows.items()}
        if any(math.isfinite(value) for value in values.values()):
            yield from ((cls, value) for cls, value in values.items() if math.isfinite(value))
            return


def _numbers(result: RunResult, run: str) -> list[list[str]]:
    """Two methods side by side, or the one as what later runs are held against; nothing without a number."""
    scored: dict[str, list[str]] = {}
    for row in result.metrics["results"]:
        if row["result"] is not None:
            scored.setdefault(row["protocol"], []).append(row["method"])
    methods = max(scored.values(), key=len, default=[])
    if len(methods) > 1:
        return [["compare", f"{run}:{methods[0]}", f"{run}:{methods[1]}"]]
    return [["check", "--learn", run, "--out", "reference.json"]] if methods else []
