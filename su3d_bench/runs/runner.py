"""Carry out a plan in five steps: prepare the folder, write the request, execute, collect and combine, write results.

``metrics.json`` contains no time, date or path: two runs of one request give the same bytes, whatever the number of
workers and however often a run was killed and resumed.

A plan states what happens to the run in its folder (``plan.start``): there is no finished run and this run's records
*begin*; a finished run of the same request, or of a part of it, is *kept* until records with more overwrite it; or it
is *replaced*, except for the maps that the new request has too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from su3d_bench.core.config import KeyPath, write_toml
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import is_file, read_json, remove_abandoned, remove_file, write_json, write_text
from su3d_bench.core.system.files import file_bytes
from su3d_bench.reports.tables.run import Found
from su3d_bench.runs.clusters import RunUnits, executor_for
from su3d_bench.runs.executors import SCENE_DONE, Event, Report
from su3d_bench.runs.existing import differences, with_end_marker
from su3d_bench.runs.job import MethodOutcome
from su3d_bench.runs.plan import Plan
from su3d_bench.runs.poses import judged_where_read_here
from su3d_bench.runs.resume import FinishedScenes
from su3d_bench.runs.scene import failed_outcomes, run_scene
from su3d_bench.runs.summary import found_in, outcomes_without_score, record, remarks_of, summarise
from su3d_bench.store.records import plain


@dataclass(frozen=True)
class RunResult:
    """A finished run: ``metrics`` as in ``metrics.json``; ``failures`` are (scene, method, line), ``remarks`` lines.

    ``found``: the maps that no protocol scored.
    """

    plan: Plan
    metrics: dict[str, Any]
    outcomes: tuple[MethodOutcome, ...]
    failures: tuple[tuple[str, str, str], ...]
    remarks: tuple[str, ...]
    found: tuple[Found, ...] = ()

    @property
    def is_complete(self) -> bool:
        return not self.failures


def run_plan(plan: Plan, report: Report) -> RunResult:
    """Do every job of ``plan`` that is not done yet and write the run's records.

    Raises ``PosesContradicted`` if the depth of a recording contradicts its poses, and an error if the executor does
    not answer, both before anything is written.
    """
    plan = replace(plan, jobs=judged_where_read_here(plan.jobs))
    with executor_for(plan.config, plan.n_workers, plan.folder.path, report) as run, _prepared(plan):
        if plan.start != "kept":
            _write_request(plan)
        outcomes = _execute(plan, report, run)
        report(Event("", SCENE_DONE, activity="adding up"))
        metrics = plain(summarise(plan, outcomes))
        if not _is_unchanged(plan, outcomes, metrics):
            _write_results(plan, outcomes, metrics)
    unscored = outcomes_without_score(plan, outcomes)
    remarks = remarks_of(plan, outcomes, unscored)
    found = tuple(found_in(plan.folder, unscored))
    return RunResult(plan, metrics, outcomes, _failures(plan, outcomes), remarks, found)


# ---- 1: prepare the run folder


@contextmanager
def _prepared(plan: Plan) -> Iterator[None]:
    """The run folder, locked against other runs, without the files that the plan replaces.

    Temporary folders left by a killed run, or by workers killed in the block, are removed.
    """
    with plan.folder.locked():
        remove_abandoned()
        try:
            if plan.start == "replaced":
                _remove_replaced(plan)
            else:
                _check_still_empty(plan)
            yield
        finally:
            remove_abandoned()


def _check_still_empty(plan: Plan) -> None:
    """A ``StoreError`` if another command has written its request here since this one was planned."""
    file = plan.folder.path / "run.toml"
    planned = None if plan.existing is None else plan.existing.content
    if is_file(file) and planned != file_bytes(file):
        raise StoreError(f"{plan.folder.path}: another run just started in this folder; run the command again")


def _remove_replaced(plan: Plan) -> None:
    """Remove the results of the run except the maps that the new request needs unchanged. The old request is kept, so
    that a command killed here continues where it stopped."""
    for name in ("metrics.json", "ablation.json"):
        remove_file(plan.folder.path / name)
    for job in plan.removes:
        job.remove()


# ---- 2: write the request


def _write_request(plan: Plan) -> None:
    """Write the records of a run in progress: its request, and no metrics."""
    remove_file(plan.folder.path / "metrics.json")
    _write_request_records(plan)


def _write_request_records(plan: Plan) -> None:
    write_text(plan.folder.path / "run.toml", with_end_marker(write_toml(resolved_values(plan))))
    write_json(plan.folder.path / "run.json", plain(record(plan, (), "running")))


def resolved_values(plan: Plan) -> list[tuple[KeyPath, Any, str]]:
    """Every value of the run with its source, parts in the order of the run."""
    return [(path, value, plan.settings.source(path)) for path, value in plan.values]


# ---- 3: execute the jobs


def _execute(plan: Plan, report: Report, run: RunUnits) -> tuple[MethodOutcome, ...]:
    """The outcomes of all scenes, in the order of the plan; ``run`` is the executor.

    An error or interrupt is recorded in the folder, so that it shows that the run can be resumed.
    """
    by_scene = {}
    try:
        for n, outcomes in enumerate(_finished_scenes(plan, run), 1):
            report(Event(outcomes[0].scene, SCENE_DONE, n, len(plan.jobs)))
            by_scene[outcomes[0].scene] = outcomes
    except BaseException:
        if plan.start != "kept":
            write_json(plan.folder.path / "run.json", plain(record(plan, (), "interrupted")))
        raise
    return tuple(outcome for job in plan.jobs for outcome in by_scene[job.scene])


def _finished_scenes(plan: Plan, run: RunUnits) -> Iterator[tuple[MethodOutcome, ...]]:
    """The outcomes of each scene as it finishes; first those that need no worker."""
    known, left = FinishedScenes(), []
    for job in plan.jobs:
        outcomes = known.outcomes(job)
        if outcomes is None:
            left.append(job)
        else:
            yield outcomes
    if not plan.config.memory:
        yield from run(run_scene, left, lost=failed_outcomes)
        return
    # A method that exceeds its memory may take its process with it, so that each has one of its own.
    units = [replace(job, methods=(part,), ceiling=None) for job in left for part in job.parts]
    parts = {job.scene: [part.name for part in job.parts] for job in left}
    done: dict[tuple[str, str], MethodOutcome] = {}
    for (outcome,) in run(run_scene, units, lost=failed_outcomes):
        done[outcome.scene, outcome.method] = outcome
        found = [done.get((outcome.scene, name)) for name in parts[outcome.scene]]
        if None not in found:
            yield tuple(outcome for outcome in found if outcome is not None)


# ---- 4: collect and combine (``summarise``), and 5: write the results


def _failures(plan: Plan, outcomes: Sequence[MethodOutcome]) -> tuple[tuple[str, str, str], ...]:
    """(scene, method, line) of every failure, except those of the ceiling."""
    failed = [(outcome.scene, outcome.method, outcome.error) for outcome in outcomes if outcome.error is not None]
    return tuple(each for each in failed if each[1] in plan.methods)


def _write_results(plan: Plan, outcomes: Sequence[MethodOutcome], metrics: Mapping[str, Any]) -> None:
    if plan.start == "kept":
        _write_request_records(plan)
    status = "incomplete" if _failures(plan, outcomes) else "complete"
    write_json(plan.folder.path / "metrics.json", metrics)
    write_json(plan.folder.path / "run.json", plain(record(plan, outcomes, status)))


def _is_unchanged(plan: Plan, outcomes: Sequence[MethodOutcome], metrics: Mapping[str, Any]) -> bool:
    """Whether all was done before, so that the existing records, including the machine that did the work, hold for
    this command too."""
    existing = plan.existing
    if plan.start != "kept" or existing is None or existing.record is None or existing.record.status != "complete":
        return False
    if any(differences(existing, plan.request)) or not all(outcome.was_resumed for outcome in outcomes):
        return False
    try:
        before = read_json(plan.folder.path / "metrics.json")
    except StoreError:  # damaged: it is written again
        return False
    return bool(_without_order(before) == _without_order(metrics))


def _without_order(value: Any) -> Any:
    """A JSON value with the items of its lists sorted, because the order in which scenes were named does not matter."""
    if isinstance(value, Mapping):
        return {key: _without_order(item) for key, item in value.items()}
    return sorted(map(_without_order, value), key=repr) if isinstance(value, list | tuple) else value
