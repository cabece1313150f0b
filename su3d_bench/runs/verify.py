"""Whether the records of a run follow from its counts and agree with each other, its request and its jobs.

Whatever shows or compares numbers of a finished run opens it with ``read_checked``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import flatten, resolve
from su3d_bench.core.digests import digest_file, digest_json
from su3d_bench.core.errors import StoreError, Su3dError, printable
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.interfaces import UsesGroundTruth
from su3d_bench.core.registry import CEILING_METHOD, base_name
from su3d_bench.metrics.compatibility import labels_counted
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, combined_metrics, pack_scores, plain_json
from su3d_bench.perception.oracle import OraclePerception
from su3d_bench.predictions.run_predictions import read_stored
from su3d_bench.reports.tables.model import is_ceiling
from su3d_bench.runs.existing import existing_run
from su3d_bench.runs.finished import FinishedRun, read_run, read_update_times
from su3d_bench.runs.job import Part, build_method, options_model, sees_profile
from su3d_bench.runs.summary import Points, confidences_of, with_curves
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.records import ROUNDING, CompletionRecord, NumbersRecord, ResultRecord, plain
from su3d_bench.store.run_folder import Curve, JobFolder

# Values in metrics.json that must follow from the counts. Intervals and warnings may change without a new version of
# the protocol: those of the counts are shown.
CHECKED_FIELDS = ("metrics", "pooled", "scene_mean", "per_scene", "per_class", "groups", "coverage", "n_predictions")
MAX_FAULTS = 50  # of a run; records can name millions of scenes and methods without files
SAME_COUNTS_CAVEAT = "its counts are those of the ground truth: a ceiling, not a result"
Fault = tuple[str, str]  # where (``METHOD / PROTOCOL``, ``METHOD / scene SCENE`` or a file) and what is wrong
Jobs = dict[tuple[str, str], Mapping[str, CompletionRecord]]  # (scene, method) -> completion records
Scores = Mapping[str, Mapping[str, SceneScore]]  # protocol -> scene -> counts


def read_checked(path: Path) -> FinishedRun:
    """The run at ``path`` with the numbers of its counts; ``StoreError`` with the first fault of its records."""
    run, faults = examine(read_run(path))
    for where, fault in faults:
        raise StoreError(f"{run.name}: {where}: {fault}{'' if ';' in fault else '; run its command again'}")
    return run


def examine(run: FinishedRun, *, with_maps: bool = False) -> tuple[FinishedRun, tuple[Fault, ...]]:
    """``run`` with the numbers of its counts, and at most ``MAX_FAULTS`` faults; ``with_maps``: maps are read too."""
    results = dict(run.results)
    faults = islice(_faults(run, results, with_maps), MAX_FAULTS)
    shown = tuple((printable(where, 200), printable(fault, 300)) for where, fault in faults)
    return replace(run, results=results), shown


def _faults(run: FinishedRun, results: dict[tuple[str, str], ResultRecord], with_maps: bool) -> Iterator[Fault]:
    """The faults of ``run``; its ``results`` are replaced by those of its counts."""
    yield from _record_faults(run)
    jobs: Jobs = {}
    settings = {".".join(path): value for path, value in run.settings.items()}
    failed = {(failure.scene, failure.method) for failure in run.record.failed}
    own = [one.result for one in run.results.values() if one.result is not None and one.method not in run.external]
    scored = {scene for result in own for scene in result.scenes}  # the ceiling's counts exist, too
    for method in dict.fromkeys((*run.methods, CEILING_METHOD)):
        for scene in run.scenes:
            if (scene, method) not in failed and (method in run.methods or scene in scored):
                jobs[scene, method] = steps = run.folder.job(scene, method).completion_records()
                for fault in _job_faults(run, scene, method, steps, settings, with_maps):
                    yield f"{method} / scene {scene}", fault
    ceiling = cache(partial(run.scores, CEILING_METHOD))
    for method in run.methods:
        try:
            scores, perfect = run.scores(method), ceiling()
            read_update_times(run, method)
        except Su3dError as error:
            yield method, str(error)
            continue
        for protocol in run.protocols:
            where, record = f"{method} / {protocol}", run.results.get((method, protocol))
            if record is None:
                yield where, "has no result in metrics.json"
                continue
            yield from ((where, f"metrics.json: {fault}") for fault in _wrong_claims(run, record, jobs))
            try:
                results[method, protocol], contradicts = _recomputed(run, record, scores, perfect)
            except Su3dError as error:
                contradicts = str(error)
            if contradicts is not None:
                yield where, contradicts


def _record_faults(run: FinishedRun) -> Iterator[Fault]:
    """Contradictions between run.json, metrics.json and run.toml."""
    record, metrics, asked = run.record, run.metrics, run.settings
    status = "incomplete" if any(failure.method in run.methods for failure in record.failed) else "complete"
    told: dict[str, tuple[object, ...]] = {
        "scenes": (record.scenes, metrics.scenes or record.scenes),
        "limit": (metrics.limit, asked.get(("limit",), 0)),
        "is_partial": (record.is_partial, metrics.is_partial, metrics.limit > 0),
        "seed": (record.seed or 0, metrics.seed, asked.get(("seed",), 0)),
        "status": (record.status, status),
    }
    for what, values in told.items():
        if len(set(values)) > 1:
            yield "run.json", f"{what} is {' and '.join(printable(str(value), 60) for value in values)} in the records"
    existing = existing_run(run.folder.path)
    if existing is None or not existing.is_known:
        yield "run.toml", "is not the file that the run wrote"


def _job_faults(
    run: FinishedRun, scene: str, method: str, steps: Mapping[str, CompletionRecord], settings: Mapping[str, Any],
    with_maps: bool,
) -> Iterator[str]:  # fmt: skip
    """Files of a job that are not those that the run wrote, and its inputs that the records of the run contradict.

    ``settings``: the run's, by their names in keys.
    """
    job, record = run.folder.job(scene, method), run.record
    files = {name: digest for step in steps.values() for name, digest in step.files.items()}
    maps = (job.prediction.name, features_beside(job.prediction).name)
    yield from (
        f"done.json does not list {name}" for name in (maps[0], "updates.csv", "counts.npz") if name not in files
    )
    for name, digest in files.items():
        if name.endswith("counts.npz") or name == "updates.csv" or (with_maps and name in maps):
            if not is_file(job.path / name) or (job.path / name).is_symlink():
                yield f"{name} is missing"
            elif digest_file(job.path / name) != digest:
                yield f"{name} is not the file that the run wrote"
    if with_maps and is_file(job.prediction):
        try:
            read_stored(job.prediction)
        except Su3dError as error:
            yield f"contains no map: {error}"
    if not {"predict", "score"} <= steps.keys():
        return
    key, score, asked = steps["predict"].key, steps["score"].key, run.settings.get(("profile",), "auto")
    stated = {"method": method, "data": record.data_digests.get(scene, "not stated"), "code": record.code}
    stated |= {"seed": str(record.seed or 0), "limit": str(run.limit or "none")}
    stated |= {"profile": str(asked if asked != "auto" else "embedded or paper")}
    stated |= {f"packages.{name}": version for name, version in record.packages.items()}
    if method in run.external:
        stated["predictions"] = digest_json(run.external[method].files.get(scene, {}))
    for name, text in key.items():
        if name.startswith(("method.", "dataset.", "perception.")) and method in run.methods:
            stated[name] = json.dumps(settings.get(name), ensure_ascii=False)
        if name in stated and text != stated[name] and text not in stated[name].split(" or "):
            yield f"done.json: {name} is {printable(text, 60)}, the run says {printable(stated[name], 60)}"
    if score.get("predict") != digest_json(dict(key)):
        yield "done.json: the counts are those of another map"
    own = [one for one in run.results.values() if one.method == method and method not in run.external]
    results = [one for one in own if one.result is not None and scene in one.result.scenes]
    known = [(record.profile, record.encoder_digest), *((one.profile, one.encoder_digest) for one in results)]
    for names in known:
        for used, claimed in zip((key.get("profile"), score.get("encoder")), names, strict=True):
            if used is not None and used not in (claimed or "").split(", "):
                yield f"done.json: the profile or encoder is {used}, the records have {claimed}"
    for one in results:
        if (steps["score"].remarks.get("caveat") or "") not in (one.caveat or ""):
            yield f"metrics.json: the caveat '{steps['score'].remarks['caveat']}' is missing under {one.protocol}"
        if run.protocols[one.protocol].digest not in score.values():
            yield f"the rules of {one.protocol} in run.json are not those that scored it"


def _wrong_claims(run: FinishedRun, record: ResultRecord, jobs: Jobs) -> Iterator[str]:
    """What a result states about its scenes and its method that run.json or the jobs contradict."""
    n_scored, method = 0 if record.result is None else len(record.result.scenes), record.method
    if record.n_planned != n_scored + len(record.failed) + len(record.unscored):
        yield f"n_planned is {record.n_planned}, but {n_scored + len(record.unscored)} scenes did not fail"
    if method in run.external or is_ceiling(method, record.caveat):
        return
    if (record.encoder is None) != (record.profile is None):
        yield f"encoder is {record.encoder}, but profile is {record.profile}"
    found = [[jobs.get((scene, one), {}).get("predict") for one in (method, CEILING_METHOD)] for scene in run.scenes]
    maps = [[step and step.files.get("prediction.npz") for step in pair] for pair in found]
    if all(own is not None and own == truth for own, truth in maps):
        yield "its maps are the ground truth (same digests as those of the oracle)"
    if _uses_truth(run, method, record.profile or ""):
        yield f"caveat is {record.caveat}, but the method used ground truth"


def _uses_truth(run: FinishedRun, method: str, profiles: str) -> bool:
    """Whether ground truth reached a built-in method; False for others, whose code is not loaded to find out."""
    base = base_name(method)
    with suppress(Su3dError):  # its weights or its program may be missing here
        options = resolve(run.data.settings, ("method", method), options_model("method", base)).model_dump_json()
        made = build_method(Part(base, method, options)) if base in registry.METHODS else None
        is_given = isinstance(made, UsesGroundTruth) or (made is not None and made.needs.true_proposals)
        return is_given or (made is not None and OraclePerception.profile in profiles and sees_profile(made))
    return False


# ---- numbers


def _recomputed(
    run: FinishedRun, record: ResultRecord, scores: Scores, perfect: Scores
) -> tuple[ResultRecord, str | None]:
    """A result with the numbers of the counts, and the first value of ``record`` that contradicts them."""
    protocol, stated = record.protocol, record.result
    counts = {scene: one for scene, one in scores.get(protocol, {}).items() if scene not in record.failed}
    if stated is None:
        return record, f"metrics.json has no numbers, the counts have {len(counts)} scenes" if counts else None
    rules, is_elsewhere = run.rules(protocol, to_the_letter=True), record.method in run.external
    numbers = NumbersRecord(**combine(rules, counts).to_json())
    truths = {scene: perfect.get(protocol, {}).get(scene) for scene in counts}
    written = plain(stated) | {"ceiling": record.ceiling or {}} | _curve_values(record)

    def metrics_at(curve: Curve, point: float | None) -> dict[str, float | None]:
        at_point = run.scores(record.method, partial(JobFolder.reached_counts, curve=curve, point=point))
        return _metrics(rules, {scene: at_point.get(protocol, {}).get(scene) for scene in counts})

    points: dict[Curve, Points] = {
        "anytime": [(one.share, one.n_updates or one.share) for one in record.anytime or ()],
        "seen": [(one.share, None if one.share == 1 else one.n_updates or one.share) for one in record.seen or ()],
    }
    curves = _curve_values(with_curves(replace(record, result=numbers), points, metrics_at))
    known = plain(numbers) | {"ceiling": _metrics(rules, truths)} | curves
    fault = contradiction(written, known)
    if (stated.n_scenes, set(stated.scenes), record.version) != (len(counts), set(counts), rules.version):
        fault = f"it has {stated.n_scenes} scenes of version {record.version}, the counts {len(counts)}"
    warnings = tuple(dict.fromkeys((*stated.warnings, *numbers.warnings)))
    numbers = replace(numbers, warnings=warnings, coverage=stated.coverage if is_elsewhere else numbers.coverage)
    recomputed = replace(record, kind=rules.kind, headline=rules.headline, ceiling=known["ceiling"] or None)
    recomputed = replace(recomputed, result=numbers)
    if is_elsewhere and _bare(counts) == _bare({scene: one for scene, one in truths.items() if one is not None}):
        recomputed = replace(recomputed, caveat=f"{record.caveat}; {SAME_COUNTS_CAVEAT}")
    if not is_elsewhere or record.labels is None:
        labels = labels_counted(rules, by_features=record.encoder is not None)
        recomputed = replace(recomputed, confidences=confidences_of(rules, numbers), labels=labels)
    return recomputed, fault and f"metrics.json does not follow from the counts: {fault}"


def _bare(counts: Mapping[str, SceneScore]) -> bytes:
    """The counts without warnings, to compare."""
    return pack_scores({scene: replace(one, warnings=()) for scene, one in counts.items()})


def _curve_values(record: ResultRecord) -> dict[str, Any]:
    """The values of the curves by table, point and metric."""
    return {
        "anytime": {f"{one.share:g}": one.metrics for one in record.anytime or ()},
        "seen": {f"{one.share:g}": {"map": one.metrics, "ceiling": one.ceiling or {}} for one in record.seen or ()},
        "areas": record.areas or {},
    }


def _metrics(rules: ProtocolRules, scores: Mapping[str, SceneScore | None]) -> dict[str, float | None]:
    """The metrics over these scenes; empty if one has no counts."""
    whole = {scene: score for scene, score in scores.items() if score is not None}
    return dict(plain_json(combined_metrics(rules, whole))) if len(whole) == len(scores) else {}


def contradiction(written: Mapping[str, Any], known: Mapping[str, Any]) -> str | None:
    """The first value of ``written`` that differs from ``known``; None if none."""
    for table in (*CHECKED_FIELDS, "ceiling", "anytime", "seen", "areas"):
        values = dict(flatten(known[table]))
        for where, value in flatten(written[table]):
            if where not in values or not _agree(value, values[where]):
                shown = _shown(values[where]) if where in values else "nothing"
                return f"{table}.{'.'.join(where)} is {_shown(value)}, the counts give {shown}"
    return None


def _agree(stated: float | None, known: float | None) -> bool:
    return stated is known if stated is None or known is None else abs(stated - known) <= ROUNDING


def _shown(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.12g}"
