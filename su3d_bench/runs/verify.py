"""Whether the numbers of a run follow from its own counts, and its files match their recorded digests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from su3d_bench.core.config import flatten
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, Su3dError, printable
from su3d_bench.core.files.atomic import is_file
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import ProtocolResult, combine
from su3d_bench.predictions.run_predictions import read_stored
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.records import ROUNDING, NumbersRecord, plain
from su3d_bench.store.run_folder import JobFolder

# Values in metrics.json that must follow from the counts; how intervals are formed may change without a new version.
CHECKED_FIELDS = ("metrics", "pooled", "scene_mean", "per_scene", "per_class", "groups", "coverage", "n_predictions")


def rules_of_run(run: FinishedRun, protocol: str) -> ProtocolRules:
    """The rules that scored ``run``, with the same digest; a ``ConfigError`` if there are none."""
    if protocol not in run.protocols:
        raise ConfigError("its protocol is not in run.json")
    return run.rules(protocol, to_the_letter=True)


def contradiction(stated: NumbersRecord, counted: ProtocolResult) -> str | None:
    """The first value of ``stated`` that differs from the counts or is missing; None if all follow from the counts."""
    if set(stated.scenes) != set(counted.scenes):
        return f"it has {len(stated.scenes)} scenes, the counts {len(counted.scenes)}"
    record, numbers = plain(stated), counted.to_json()
    for table in CHECKED_FIELDS:
        known = dict(flatten(numbers[table]))
        for where, value in flatten(record[table]):
            if where not in known or not _agree(value, known[where]):
                shown = _shown(known[where]) if where in known else "nothing"
                return f"{table}.{'.'.join(where)} is {_shown(value)}, the counts give {shown}"
    for name in counted.headline:
        of_scenes = {f"per_scene.{scene}": stated.per_scene.get(scene) for scene in stated.scenes}
        rows = {"metrics": stated.metrics, **of_scenes}
        lacking = next((where for where, row in rows.items() if row is None or name not in row), None)
        if lacking is not None:
            return f"{lacking} has no {name}"
    return None


def _agree(stated: float | None, known: float | None) -> bool:
    return stated is known if stated is None or known is None else abs(stated - known) <= ROUNDING


def _shown(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.12g}"


def count_mismatch(run: FinishedRun, method: str, protocol: str, scores: Mapping[str, SceneScore]) -> str | None:
    """Why the numbers of a method under a protocol do not follow from ``scores``, its counts; None if they do."""
    record = run.results.get((method, protocol))
    if record is None or record.result is None:
        return "was not scored"
    try:
        counted = combine(rules_of_run(run, protocol), scores, with_intervals=False)
    except Su3dError as error:
        return str(error)
    fault = contradiction(record.result, counted)
    if fault is None and record.version != counted.version:
        fault = f"version is {record.version}, the counts are of {counted.version}"
    return None if fault is None else f"metrics.json does not follow from the counts: {fault}; run its command again"


def damaged_files(run: FinishedRun) -> Iterator[tuple[str, str]]:
    """Location and fault of every scene and method whose map, counts or times differ from those that the run wrote."""
    for scene in run.scenes:
        for method in run.methods:
            fault = _damage(run.folder.job(scene, method))
            if fault is not None:
                yield f"{printable(method, 80)} / scene {printable(scene, 80)}", fault


def _damage(job: JobFolder) -> str | None:
    completed: dict[str, str] = {}
    for completion in job.completion_records().values():
        completed |= completion.files
    for file in (job.prediction, features_beside(job.prediction), job.updates, job.counts):
        if file.name not in completed:
            if file != features_beside(job.prediction):
                return f"done.json does not list {file.name}"
        elif not is_file(file):
            return f"{file.name} is missing"
        elif digest_file(file) != completed[file.name]:
            return f"{file.name} is not the file that the run wrote"
    try:
        read_stored(job.prediction)
    except Su3dError as error:
        return f"contains no map: {error}"
    return None


def wrong_files(run: FinishedRun) -> Iterator[tuple[str, str]]:
    """Location and fault: files that are not those of the run, numbers that do not follow from its counts."""
    yield from damaged_files(run)
    for method in dict.fromkeys(method for method, _ in run.results):
        try:
            scores = run.scores(method)
        except Su3dError as error:
            yield printable(method, 80), printable(str(error), 300)
            continue
        for (name, protocol), record in run.results.items():
            if name == method and record.result is not None:
                fault = count_mismatch(run, method, protocol, scores.get(protocol, {}))
                if fault is not None:
                    yield f"{printable(method, 80)} / {printable(protocol, 80)}", printable(fault, 300)
