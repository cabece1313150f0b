"""Carry out a plan and sum it up: plan -> predict -> score -> ``metrics.json``.

``metrics.json`` holds no time, date or path: two runs of one request give the same bytes, whatever the number of
workers and however often a run was killed and taken up again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from su3d_bench.core.config import KeyPath, write_toml
from su3d_bench.core.digests import code_digest, git_state, package_versions
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import is_file, read_json, remove_file, write_json, write_text
from su3d_bench.core.files.scratch import remove_abandoned
from su3d_bench.core.registry import CEILING_METHOD, DATASETS
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import hardware_line, processor_digest
from su3d_bench.metrics.instance.score import CONSTANT_CONFIDENCE
from su3d_bench.metrics.labels import labels_counted
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import EVERY_SCENE, SceneScore, combine, combined_metrics, plain_json, unpack_scores
from su3d_bench.perception.profiles import PerceptionConfig
from su3d_bench.reports.tables.run import Found, Unscored, not_scored_lines
from su3d_bench.runs.executors.choose import ELSEWHERE, reached, run_units
from su3d_bench.runs.executors.local import SCENE_DONE, Event, Report
from su3d_bench.runs.finished import record_of_rules
from su3d_bench.runs.found import found_in
from su3d_bench.runs.job import MethodOutcome, SceneJob
from su3d_bench.runs.planning.held import differences, kept_jobs, replaced_jobs, sealed
from su3d_bench.runs.planning.plan import Plan
from su3d_bench.runs.planning.poses import judged
from su3d_bench.runs.planning.scenes import cache_root
from su3d_bench.runs.remote.scene import (
    DistantJob,
    failed_distant,
    fetch_results,
    remove_jobs,
    run_distant_scene,
    send_records,
)
from su3d_bench.runs.resume import FinishedScenes
from su3d_bench.runs.scene import failed_outcomes, run_scene
from su3d_bench.store.records import (
    FailureRecord,
    GitRecord,
    MetricsRecord,
    MidwayRecord,
    NumbersRecord,
    ResultRecord,
    RunRecord,
    UnscoredRecord,
    plain,
)
from su3d_bench.store.run_folder import JobFolder

Scores = Mapping[tuple[str, str], SceneScore]
BY_THE_METHOD = "computed by the method"


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

    The records of a run that is finished stay until those of its extension, or of jobs made anew, are there to take
    their place. Before anything is written: ``PosesContradicted`` where the depth of a recording contradicts its poses,
    and an error where the executor does not answer.
    """
    if plan.data is None:  # else each worker looks at the data that it fetches
        plan = replace(plan, jobs=_judged(plan.jobs))
    place = plan.folder.path
    with reached(plan.config, plan.n_workers) as through, plan.folder.locked(), _without_abandoned():
        _refuse_what_came_meanwhile(plan)
        if plan.into == "replace":
            _remove_replaced(plan)
        is_kept = plan.held is not None and plan.held.is_finished  # asked again, for its metrics may be gone by now
        if not is_kept:
            _begin(plan)
        try:
            outcomes = _execute(plan, report, through)
        except BaseException:
            if not is_kept:
                write_json(place / "run.json", plain(record(plan, (), "interrupted")))
                with suppress(StoreError):  # what ended the run says more
                    publish(plan)
            raise
        if plan.store is not None:
            fetch_results(plan.store, place)
        report(Event("", SCENE_DONE, doing="adding up"))
        failed = [(outcome.scene, outcome.method, outcome.error) for outcome in outcomes if outcome.error is not None]
        failures = tuple(each for each in failed if each[1] in plan.methods)
        metrics = plain(summarise(plan, outcomes))
        if not (is_kept and _is_unchanged(plan, outcomes, metrics)):
            if is_kept:
                _begin(plan, is_new=False)
            write_json(place / "metrics.json", metrics)
            write_json(place / "run.json", plain(record(plan, outcomes, "incomplete" if failures else "complete")))
            publish(plan)
    without_score = _without_score(plan, outcomes)
    found = tuple(found_in(plan.folder, without_score))
    return RunResult(plan, metrics, outcomes, failures, _remarks(plan, outcomes, without_score), found)


def _begin(plan: Plan, *, is_new: bool = True) -> None:
    """The records of a run under way: its request, and no metrics where it ``is_new``."""
    place = plan.folder.path
    if is_new:
        remove_file(place / "metrics.json")
    write_text(place / "run.toml", sealed(write_toml(resolved_values(plan))))
    write_json(place / "run.json", plain(record(plan, (), "running")))
    if is_new:
        publish(plan)


def _refuse_what_came_meanwhile(plan: Plan) -> None:
    """A ``StoreError`` where another command has written its request here since this one was planned."""
    file = plan.folder.path / "run.toml"
    planned = None if plan.held is None else plan.held.content
    if is_file(file) and planned != file_bytes(file) and plan.into != "replace":
        raise StoreError(
            f"{plan.store or plan.folder.path}: another run was begun here just now; give the command again"
        )


def _remove_replaced(plan: Plan) -> None:
    """What stands in the folder goes, but the maps that the new request asks for as they are. The records go last but
    the request, so that a command that is killed here begins again where it was."""
    going = replaced_jobs(plan.folder, plan.jobs)
    if not going and (plan.held is None or not differences(plan.held, plan.request)):
        return  # the run that replaced another is taken up again
    for name in ("metrics.json", "ablation.json"):
        remove_file(plan.folder.path / name)
    publish(plan)
    if plan.store is not None:
        remove_jobs(plan.store, plan.folder.path, kept_jobs(plan.folder, plan.jobs))
    for job in going:
        job.remove()


def _is_unchanged(plan: Plan, outcomes: Sequence[MethodOutcome], metrics: Any) -> bool:
    """Whether all was done before, so that the records that stand there, with what they say of the machine that did
    the work, are those of this command too."""
    held = plan.held
    if held is None or not held.is_known or held.record is None or held.record.status != "complete":
        return False
    if differences(held, plan.request) or not all(outcome.was_resumed for outcome in outcomes):
        return False
    try:
        before = read_json(plan.folder.path / "metrics.json")
    except StoreError:  # damaged: it is written anew
        return False
    return bool(_without_order(before) == _without_order(metrics))


def _without_order(value: Any) -> Any:
    """A value of JSON with the items of its lists sorted: the order in which scenes were named is no difference."""
    if isinstance(value, Mapping):
        return {key: _without_order(item) for key, item in value.items()}
    return sorted(map(_without_order, value), key=repr) if isinstance(value, list | tuple) else value


@contextmanager
def _without_abandoned() -> Iterator[None]:
    """Temporary folders go that a killed run has left, and those of workers that are killed in the block."""
    remove_abandoned()
    try:
        yield
    finally:
        remove_abandoned()


def _judged(jobs: Sequence[SceneJob]) -> tuple[SceneJob, ...]:
    """The jobs, judged where the program itself reads the data: a reader of somebody else's may end the process that it
    runs in, so that the scene's worker looks at these."""
    known = {job.scene: job for job in judged([job for job in jobs if job.dataset.target in DATASETS])}
    return tuple(known.get(job.scene, job) for job in jobs)


def publish(plan: Plan) -> None:
    """Bring the records of a run in a store up to those of its folder here; nothing to do for a run in a folder."""
    if plan.store is not None:
        send_records(plan.store, plan.folder.path)


def _without_score(plan: Plan, outcomes: Sequence[MethodOutcome]) -> list[tuple[str, str]]:
    """(scene, method) of what did not fail and that no protocol scored."""
    n_protocols = {job.scene: len(job.protocols) for job in plan.jobs}
    return [
        (outcome.scene, outcome.method)
        for outcome in outcomes
        if outcome.method in plan.methods
        and outcome.error is None
        and len(outcome.unscored) == n_protocols[outcome.scene]
    ]


def _remarks(
    plan: Plan, outcomes: Sequence[MethodOutcome], without_score: Sequence[tuple[str, str]]
) -> tuple[str, ...]:
    """What is worth saying of scenes that did not fail: warnings, protocols left out, ceilings that are missing."""
    failed = {outcome.scene for outcome in outcomes if outcome.error is not None and outcome.method in plan.methods}
    lines = [line for outcome in outcomes for line in outcome.warnings]
    reasons = [Unscored(one.scene, one.method, *pair) for one in outcomes for pair in one.unscored]
    lines += not_scored_lines(reasons)
    # A table says the caveat beneath it; what no protocol scores has no table.
    has_table = {(one.method, one.caveat) for one in outcomes if (one.scene, one.method) not in without_score}
    caveats: dict[str, dict[str, None]] = {}
    for outcome in outcomes:
        if outcome.caveat and outcome.error is None and (outcome.method, outcome.caveat) not in has_table:
            caveats.setdefault(outcome.caveat, {})[outcome.method] = None
    lines += [f"{', '.join(methods)}: {caveat}" for caveat, methods in caveats.items()]
    reported = {(reason.scene, reason.why) for reason in reasons}
    for outcome in outcomes:
        if outcome.error is not None and outcome.scene not in failed and (outcome.scene, outcome.error) not in reported:
            lines.append(f"{outcome.scene}: no score of the truth: {outcome.error}")
    return tuple(dict.fromkeys(lines))


def _execute(plan: Plan, report: Report, through: Any) -> tuple[MethodOutcome, ...]:
    """``through``: what the executor works through, as ``reached`` gave it."""
    config, folder = plan.config, plan.folder.path
    start = partial(run_units, report=report, config=config, n_workers=plan.n_workers, folder=folder, through=through)
    by_scene: dict[str, tuple[MethodOutcome, ...]] = {}

    def note(outcomes: tuple[MethodOutcome, ...]) -> None:
        by_scene[outcomes[0].scene] = outcomes
        report(Event(outcomes[0].scene, SCENE_DONE, len(by_scene), len(plan.jobs)))

    finished: Iterator[tuple[MethodOutcome, ...]]
    if plan.config.executor in ELSEWHERE or plan.store is not None or plan.data is not None:
        finished = start(run_distant_scene, _distant(plan), lost=failed_distant)
    else:
        known = FinishedScenes()
        for job in plan.jobs:
            if (outcomes := known.outcomes(job)) is not None:
                note(outcomes)
        left = [job for job in plan.jobs if job.scene not in by_scene]
        finished = start(run_scene, left, lost=failed_outcomes)
    for outcomes in finished:
        note(outcomes)
    return tuple(outcome for job in plan.jobs for outcome in by_scene[job.scene])


def _distant(plan: Plan) -> list[DistantJob]:
    own = DistantJob(
        plan.jobs[0],
        Path.cwd(),
        plan.store,
        None if plan.data is None else plan.data.url,
        cache_root=cache_root() if "SU3D_CACHE" in os.environ or plan.config.executor not in ELSEWHERE else None,
    )
    files = {} if plan.data is None else plan.data.files
    jobs = [replace(job, folder=job.folder.absolute()) for job in plan.jobs]
    return [replace(own, job=job, files=files.get(job.scene, {})) for job in jobs]


def resolved_values(plan: Plan) -> list[tuple[KeyPath, Any, str]]:
    """Every value of the run with where it came from, parts in the order of the run."""
    return [(path, value, plan.settings.source(path)) for path, value in plan.values]


def summarise(plan: Plan, outcomes: Sequence[MethodOutcome]) -> MetricsRecord:
    """One result a method and protocol, with ceiling and the scenes that are missing.

    The counts of one method and of the ceiling are in memory at a time.
    """
    by_method: dict[str, list[MethodOutcome]] = {}
    for outcome in outcomes:
        by_method.setdefault(outcome.method, []).append(outcome)
    perfect = _read_scores(plan, by_method.get(CEILING_METHOD, ()), attrgetter("counts"))
    rules = {rule.name: rule for rule in _rules(plan)}

    @cache
    def ceiling(protocol: str, scenes: tuple[str, ...]) -> Any:
        return _metrics_over(scenes, rules[protocol], perfect)

    results = {}
    for method in plan.methods:
        mine = by_method.get(method, ())
        scores = perfect if method == CEILING_METHOD else _read_scores(plan, mine, attrgetter("counts"))
        early = {
            share: _read_scores(plan, mine, partial(JobFolder.anytime_counts, share=share))
            for share in sorted(set(plan.config.anytime))
        }
        for rule in rules.values():
            result = _result(plan, method, rule, mine, scores, early)
            scored = tuple(result.result.scenes) if result.result else ()
            results[rule.name, method] = replace(result, ceiling=ceiling(rule.name, scored))
    return MetricsRecord(
        is_partial=plan.is_partial,
        limit=plan.config.limit,
        seed=plan.config.seed,
        scenes=tuple(job.scene for job in plan.jobs),
        results=tuple(results[name, method] for name in rules for method in plan.methods),
    )


def _rules(plan: Plan) -> list[ProtocolRules]:
    return [load_protocol(name) for name in dict.fromkeys(name for job in plan.jobs for name in job.protocols)]


def _read_scores(plan: Plan, outcomes: Sequence[MethodOutcome], file_of: Callable[[JobFolder], Path]) -> Scores:
    """(protocol, scene) -> counts, from the files of the outcomes that did not fail and have one."""
    scores: dict[tuple[str, str], SceneScore] = {}
    for outcome in outcomes:
        file = file_of(plan.folder.job(outcome.scene, outcome.method))
        if outcome.error is None and file.is_file():
            scores |= {(name, outcome.scene): score for name, score in unpack_scores(file_bytes(file)).items()}
    return scores


def _metrics_over(scenes: Sequence[str], rules: ProtocolRules, scores: Scores) -> Any:
    """The metrics over ``scenes``; None where there is none, or one has no score."""
    of_scenes = {scene: scores[rules.name, scene] for scene in scenes if (rules.name, scene) in scores}
    return plain_json(combined_metrics(rules, of_scenes)) if of_scenes and len(of_scenes) == len(scenes) else None


def _result(
    plan: Plan,
    method: str,
    rules: ProtocolRules,
    outcomes: Sequence[MethodOutcome],
    scores: Scores,
    early: Mapping[float, Scores],
) -> ResultRecord:
    """The result without its ceiling; the maps midway count where all scenes of the final one are scored."""
    planned = {job.scene: job for job in plan.jobs if rules.name in _protocol_names(job)}
    mine = {outcome.scene: outcome for outcome in outcomes if outcome.scene in planned}
    scored = {scene: scores[rules.name, scene] for scene in planned if (rules.name, scene) in scores}
    failed = {scene: mine[scene].error for scene in planned if mine[scene].error is not None}
    scenes = [scene for protocol, scene in scores if protocol == rules.name]
    doubts = tuple(line for scene in sorted(scored) for line in mine[scene].doubts)
    numbers = NumbersRecord(**combine(rules, scored).to_json()) if scored else None
    if numbers is not None:
        numbers = replace(numbers, warnings=(*numbers.warnings, *doubts))
    encoder = _join(outcome.encoder for outcome in mine.values() if outcome.profile is not None)
    midway = [(share, _metrics_over(scenes, rules, counts)) for share, counts in early.items()]
    return ResultRecord(
        method=method,
        protocol=rules.name,
        version=rules.version,
        kind=rules.kind,
        headline=rules.headline,
        profile=_join(outcome.profile for outcome in mine.values()),
        caveat=_join((outcome.caveat for outcome in mine.values()), "; "),
        encoder=encoder,
        encoder_digest=_join(outcome.encoder_digest for outcome in mine.values()),
        n_planned=len(planned),
        failed=tuple(failed),
        unscored=tuple(scene for scene in planned if scene not in scored and scene not in failed),
        ceiling=None,
        result=numbers,
        anytime=tuple(MidwayRecord(share, metrics) for share, metrics in midway if metrics) if early else None,
        confidences=None if numbers is None else confidences_of(rules, numbers),
        labels=None if numbers is None else labels_counted(rules, by_features=encoder is not None),
    )


def confidences_of(rules: ProtocolRules, numbers: NumbersRecord) -> str | None:
    """What ranks the predictions of an average precision; None where the protocol forms none."""
    if rules.confidence is None:
        return None
    if rules.confidence != "prediction":
        what = "1 for every instance" if rules.confidence == "ones" else "similarity to the query"
        return f"{what}, by the protocol"
    said = {warning.partition(": ")[0] for warning in numbers.warnings if CONSTANT_CONFIDENCE in warning}
    are_equal = EVERY_SCENE in said or said >= {scene for scene, n in numbers.n_predictions.items() if n > 1}
    return "the same for all instances of a scene" if are_equal else BY_THE_METHOD


def _protocol_names(job: SceneJob) -> list[str]:
    return [load_protocol(name).name for name in job.protocols]


def _join(texts: Iterable[str | None], separator: str = ", ") -> str | None:
    """Each text once; None where there is none."""
    return separator.join(dict.fromkeys(text for text in texts if text)) or None


def _model_files(plan: Plan, outcomes: Sequence[MethodOutcome]) -> dict[str, dict[str, str]]:
    """SHA-256 of every weight file of the profiles that the run used, by model and file name."""
    from su3d_bench.perception.models.catalogue import PROFILE_MODELS
    from su3d_bench.perception.models.inspection import models_record

    used = [profile for outcome in outcomes for profile in (outcome.profile or "").split(", ")]
    names = [name for profile in dict.fromkeys(used) for name in PROFILE_MODELS.get(profile, ())]
    return models_record(names, PerceptionConfig.model_validate_json(plan.jobs[0].perception).models) if names else {}


def record(plan: Plan, outcomes: Sequence[MethodOutcome], status: str) -> RunRecord:
    """Where the numbers come from."""
    git = git_state()
    return RunRecord(
        status=status,
        is_partial=plan.is_partial,
        code=code_digest(),
        git=None if git is None else GitRecord(**git),
        packages=package_versions(),
        hardware=hardware_line(),
        processor=processor_digest(),
        n_workers=plan.n_workers,
        seed=plan.config.seed,
        profile=_join(outcome.profile for outcome in outcomes) or plan.config.profile,
        models=_model_files(plan, outcomes),
        encoder=_join(outcome.encoder for outcome in outcomes),
        encoder_digest=_join(outcome.encoder_digest for outcome in outcomes),
        data_digests={outcome.scene: outcome.data_digest for outcome in outcomes if outcome.data_digest is not None},
        protocols=tuple(map(record_of_rules, _rules(plan))),
        methods=plan.methods,
        scenes=tuple(job.scene for job in plan.jobs),
        failed=tuple(
            FailureRecord(outcome.scene, outcome.method, outcome.error)
            for outcome in outcomes
            if outcome.error is not None
        ),
        unscored=tuple(
            UnscoredRecord(outcome.scene, outcome.method, *pair) for outcome in outcomes for pair in outcome.unscored
        ),
        warnings=tuple(dict.fromkeys(line for outcome in outcomes for line in outcome.warnings)),
    )
