"""The summary of a run: its numbers, its record, remarks on it, and the contents of maps that no protocol scores.

A summary contains no time, date or path: two runs of one request give the same bytes, whatever the number of workers
and however often a run was killed and resumed.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.digests import code_digest, git_state, package_versions
from su3d_bench.core.errors import printable
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import hardware_line, processor_digest
from su3d_bench.metrics.compatibility import labels_counted
from su3d_bench.metrics.instance.score import CONSTANT_CONFIDENCE
from su3d_bench.metrics.metric import SceneScore, n_predictions
from su3d_bench.metrics.protocols.loading import load_protocol, more_protocols_line
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import EVERY_SCENE, combine, combined_metrics, plain_json, unpack_scores
from su3d_bench.metrics.seen import area_under, reason_against
from su3d_bench.perception.profiles import PerceptionConfig
from su3d_bench.reports.tables.run import Found, not_scored_lines
from su3d_bench.runs.finished import FinishedRun, record_of_rules
from su3d_bench.runs.job import MethodOutcome
from su3d_bench.runs.plan import Plan, usual_protocols
from su3d_bench.store import records
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import Curve, JobFolder, RunFolder

Scores = Mapping[tuple[str, str], SceneScore]
Outcomes = Sequence[MethodOutcome]
Points = Sequence[tuple[float, float | None]]  # share of the updates, and the point of ``JobFolder.curve_counts``
COMPUTED_BY_METHOD = "computed by the method"


def summarise(plan: Plan, outcomes: Outcomes) -> records.MetricsRecord:
    """One result per method and protocol, with the ceiling and the scenes that are missing.

    Only the counts of one method and of the ceiling are in memory at a time.
    """
    by_method: dict[str, list[MethodOutcome]] = {}
    for outcome in outcomes:
        by_method.setdefault(outcome.method, []).append(outcome)
    perfect = _read_scores(plan, by_method.get(CEILING_METHOD, ()), attrgetter("counts"))
    rules = {rule.name: rule for rule in plan.rules}

    @cache
    def ceiling(protocol: str, scenes: tuple[str, ...]) -> Any:
        return _metrics_over(scenes, rules[protocol], perfect)

    results = {}
    for method in plan.methods:
        mine = by_method.get(method, ())
        scores = perfect if method == CEILING_METHOD else _read_scores(plan, mine, attrgetter("counts"))
        points: dict[Curve, Points] = {}
        if plan.config.anytime_text:
            points["anytime"] = _points(plan, mine, "n_updates")
        if plan.config.seen_so_far:
            points["seen"] = [*_points(plan, mine, "n_seen"), (1.0, None)]
        scores_at = cache(partial(_scores_at, plan, mine))
        for rule in rules.values():
            result = _result(plan, method, rule, mine, scores)
            scored = tuple(result.result.scenes) if result.result else ()
            result = replace(result, ceiling=ceiling(rule.name, scored))
            metrics_at = partial(_metrics_at, scores_at, rule, scored)
            results[rule.name, method] = with_curves(result, points, metrics_at)
    return records.MetricsRecord(
        is_partial=plan.is_partial,
        limit=plan.config.limit,
        seed=plan.config.seed,
        scenes=tuple(job.scene for job in plan.jobs),
        results=tuple(results[name, method] for name in rules for method in plan.methods),
    )


def _read_scores(plan: Plan, outcomes: Outcomes, file_of: Callable[[JobFolder], Path]) -> Scores:
    """(protocol, scene) -> counts, from the files of the outcomes that did not fail and have one."""
    scores: dict[tuple[str, str], SceneScore] = {}
    for outcome in outcomes:
        file = file_of(plan.folder.job(outcome.scene, outcome.method))
        if outcome.error is None and file.is_file():
            scores |= {(name, outcome.scene): score for name, score in unpack_scores(file_bytes(file)).items()}
    return scores


def _metrics_over(scenes: Sequence[str], rules: ProtocolRules, scores: Scores) -> Any:
    """The metrics over ``scenes``; None if there are no scenes, or one has no score."""
    of_scenes = {scene: scores[rules.name, scene] for scene in scenes if (rules.name, scene) in scores}
    return plain_json(combined_metrics(rules, of_scenes)) if of_scenes and len(of_scenes) == len(scenes) else None


def _points(plan: Plan, outcomes: Outcomes, n_of_scene: str) -> Points:
    """The intermediate maps of the scene with most updates, whose number the remarks on its scores have."""
    folders = [plan.folder.job(outcome.scene, outcome.method) for outcome in outcomes if outcome.error is None]
    n = max((int(folder.remarks("score").get(n_of_scene, 0)) for folder in folders), default=0)
    return [(point if point < 1 else point / n, point) for point in plan.config.anytime_points(n)]


def _scores_at(plan: Plan, outcomes: Outcomes, curve: Curve, point: float | None) -> Scores:
    return _read_scores(plan, outcomes, partial(JobFolder.reached_counts, curve=curve, point=point))


def _metrics_at(
    scores_at: Callable[[Curve, float | None], Scores], rules: ProtocolRules, scenes: Sequence[str],
    curve: Curve, point: float | None,
) -> Any:  # fmt: skip
    return _metrics_over(scenes, rules, scores_at(curve, point))


def with_curves(
    result: records.ResultRecord, points: Mapping[Curve, Points], metrics_at: Callable[[Curve, float | None], Any]
) -> records.ResultRecord:
    """``result`` with the curves of ``points`` and the areas under them; points of which ``metrics_at`` has no metrics
    are omitted, as when a scene is not scored."""
    of_curve = {
        curve: [(share, found, int(point or 0), point) for share, point in of if (found := metrics_at(curve, point))]
        for curve, of in points.items()
    }
    anytime = tuple(records.MidwayRecord(*row[:3]) for row in of_curve.get("anytime", ()))
    seen = tuple(records.SeenRecord(*row[:3], metrics_at("ceiling", row[3])) for row in of_curve.get("seen", ()))
    lines: dict[str, list[tuple[float, records.Values]]] = {}
    if anytime and result.result is not None:
        lines["anytime"] = [*((point.share, point.metrics) for point in anytime), (1.0, result.result.metrics)]
    if len(seen) > 1:
        lines["seen"] = [(point.share, point.metrics) for point in seen]
        lines["ceiling"] = [(point.share, point.ceiling or {}) for point in seen]
    areas = {
        curve: {name: area_under([(share, values.get(name)) for share, values in line]) for name in result.headline}
        for curve, line in lines.items()
    }
    return replace(
        result,
        anytime=anytime if "anytime" in points else None,
        seen=seen if "seen" in points else None,
        areas=areas or None,
    )


def _result(plan: Plan, method: str, rules: ProtocolRules, outcomes: Outcomes, scores: Scores) -> records.ResultRecord:
    """The result without its ceiling and curves."""
    planned = dict.fromkeys(
        job.scene for job in plan.jobs if any(load_protocol(name).name == rules.name for name in job.protocols)
    )
    mine = {outcome.scene: outcome for outcome in outcomes if outcome.scene in planned}
    scored = {scene: scores[rules.name, scene] for scene in planned if (rules.name, scene) in scores}
    failed = {scene: mine[scene].error for scene in planned if mine[scene].error is not None}
    doubts = tuple(line for scene in sorted(scored) for line in mine[scene].doubts)
    numbers = records.NumbersRecord(**combine(rules, scored).to_json()) if scored else None
    if numbers is not None:
        numbers = replace(numbers, warnings=(*numbers.warnings, *doubts))
    encoder = _join(outcome.encoder for outcome in mine.values() if outcome.profile is not None)
    return records.ResultRecord(
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
        confidences=None if numbers is None else confidences_of(rules, numbers),
        labels=None if numbers is None else labels_counted(rules, by_features=encoder is not None),
    )


def confidences_of(rules: ProtocolRules, numbers: records.NumbersRecord) -> str | None:
    """What ranks the predictions for average precision; None if the protocol does not compute it."""
    if rules.confidence is None:
        return None
    if rules.confidence != "prediction":
        what = "1 for every instance" if rules.confidence == "ones" else "similarity to the query"
        return f"{what}, by the protocol"
    named = {warning.partition(": ")[0] for warning in numbers.warnings if CONSTANT_CONFIDENCE in warning}
    are_equal = EVERY_SCENE in named or named >= {scene for scene, n in numbers.n_predictions.items() if n > 1}
    return "constant within each scene" if are_equal else COMPUTED_BY_METHOD


def _join(texts: Iterable[str | None], separator: str = ", ") -> str | None:
    """Each text once, joined; None if there is none."""
    return separator.join(dict.fromkeys(text for text in texts if text)) or None


def _model_files(plan: Plan, outcomes: Outcomes) -> dict[str, dict[str, str]]:
    """SHA-256 of every weight file of the profiles that the run used, by model and file name."""
    from su3d_bench.perception.models.catalogue import PROFILE_MODELS
    from su3d_bench.perception.models.loading import models_record

    used = [profile for outcome in outcomes for profile in (outcome.profile or "").split(", ")]
    names = [name for profile in dict.fromkeys(used) for name in PROFILE_MODELS.get(profile, ())]
    return models_record(names, PerceptionConfig.model_validate_json(plan.jobs[0].perception).models) if names else {}


def record(plan: Plan, outcomes: Outcomes, status: str) -> records.RunRecord:
    """The record of where the numbers come from."""
    git = git_state()
    return records.RunRecord(
        status=status,
        is_partial=plan.is_partial,
        code=code_digest(),
        git=None if git is None else records.GitRecord(**git),
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
        protocols=tuple(map(record_of_rules, plan.rules)),
        methods=plan.methods,
        scenes=tuple(job.scene for job in plan.jobs),
        failed=tuple(
            records.FailureRecord(one.scene, one.method, one.error) for one in outcomes if one.error is not None
        ),
        unscored=_unscored(outcomes),
        warnings=tuple(dict.fromkeys(line for outcome in outcomes for line in outcome.warnings)),
    )


def _unscored(outcomes: Outcomes) -> tuple[records.UnscoredRecord, ...]:
    return tuple(records.UnscoredRecord(one.scene, one.method, *pair) for one in outcomes for pair in one.unscored)


# ---- remarks


def remarks_of(plan: Plan, outcomes: Outcomes, without_score: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Remarks on scenes that did not fail: warnings, protocols that could not score them, missing ceilings."""
    failed = {outcome.scene for outcome in outcomes if outcome.error is not None and outcome.method in plan.methods}
    lines = [line for outcome in outcomes for line in outcome.warnings]
    unscored = _unscored(outcomes)
    lines += not_scored_lines(unscored)
    if plan.config.seen_so_far:
        reasons = {rules.name: reason_against(rules) for rules in plan.rules}
        lines += [f"{name}: not scored against what was seen: {reason}" for name, reason in reasons.items() if reason]
    # A table shows its caveat below it; scenes that no protocol scores have no table.
    has_table = {(one.method, one.caveat) for one in outcomes if (one.scene, one.method) not in without_score}
    caveats: dict[str, dict[str, None]] = {}
    for outcome in outcomes:
        if outcome.caveat and outcome.error is None and (outcome.method, outcome.caveat) not in has_table:
            caveats.setdefault(outcome.caveat, {})[outcome.method] = None
    lines += [f"{', '.join(methods)}: {caveat}" for caveat, methods in caveats.items()]
    reported = {(one.scene, one.reason) for one in unscored}
    for outcome in outcomes:
        if outcome.error is not None and outcome.scene not in failed and (outcome.scene, outcome.error) not in reported:
            lines.append(f"{outcome.scene}: no ground-truth ceiling: {outcome.error}")
    usual = {name for job in plan.jobs for name in usual_protocols(job.dataset.target)}
    if not plan.config.protocols and (more := usual - {rules.name for rules in plan.rules}):
        how = f"su3d-bench run --extend --all-protocols --out {shlex.quote(str(plan.folder.path))}"
        lines.append(more_protocols_line(more, how))
    return tuple(dict.fromkeys(lines))


def outcomes_without_score(plan: Plan, outcomes: Outcomes) -> list[tuple[str, str]]:
    """(scene, method) of every job that did not fail but that no protocol scored."""
    n_protocols = {job.scene: len(job.protocols) for job in plan.jobs}
    return [
        (outcome.scene, outcome.method)
        for outcome in outcomes
        if outcome.method in plan.methods
        and outcome.error is None
        and len(outcome.unscored) == n_protocols[outcome.scene]
    ]


# ---- maps that no protocol scores


MAX_NAME_CHARACTERS = 60  # characters


def found_in(folder: RunFolder, jobs: Iterable[tuple[str, str]]) -> Iterator[Found]:
    """The contents of the maps of ``jobs`` (scene, method), of those whose map is here."""
    for scene, method in jobs:
        job = folder.job(scene, method)
        if is_file(job.prediction):
            where = f"{printable(scene, 120)}: {job.updates.name}"
            columns = records.read_updates(job.updates, where) if is_file(job.updates) else {}
            times = columns.get("total_ms", np.zeros(0))
            prediction = read_prediction(job.prediction)
            objects = prediction if isinstance(prediction, Instances) else None
            n_instances = None if isinstance(prediction, DenseFeatures) else n_predictions(prediction)
            yield Found(
                scene=printable(scene, 200),
                method=printable(method, 200),
                n_points=len(prediction.points),
                n_instances=n_instances,
                names=() if objects is None else _names(objects),
                extents_m=None if objects is None or not n_instances else _extents_m(objects),
                n_updates=len(times),
                update_ms=float(np.median(times)) if len(times) else None,
            )


def without_score(run: FinishedRun) -> list[tuple[str, str]]:
    """(scene, method) of every job that did not fail but that no protocol scored."""
    known = {(failure.scene, failure.method) for failure in run.record.failed}
    for (method, _), result in run.results.items():
        known |= {(scene, method) for scene in (result.result.scenes if result.result is not None else ())}
    return [(scene, method) for scene in run.scenes for method in run.methods if (scene, method) not in known]


def _names(prediction: Instances) -> tuple[tuple[str, int], ...]:
    labels = prediction.labels or ("",) * len(prediction)
    names = (
        printable(label or name, MAX_NAME_CHARACTERS) for label, name in zip(labels, prediction.names, strict=True)
    )
    return tuple(Counter(names).most_common())


def _extents_m(prediction: Instances) -> tuple[float, float, float]:
    longest = np.sort(np.ptp(prediction.boxes, axis=1).max(axis=1).astype(np.float64))
    return float(longest[0]), float(np.median(longest)), float(longest[-1])
