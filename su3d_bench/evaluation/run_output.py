"""External predictions as a run folder: what ``run`` writes, except what only a method itself can report.

The counts are those of the evaluation, so every number of the run equals the evaluation's to the last bit.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from su3d_bench.core.config import write_toml
from su3d_bench.core.digests import code_digest, digest_file, digest_json, git_state, package_versions
from su3d_bench.core.errors import ConfigError, StoreError, printable, shown
from su3d_bench.core.files import atomic
from su3d_bench.core.files.locks import publish, unfinished_folder
from su3d_bench.core.maps import Instances
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.system.timing import hardware_line, processor_digest
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.ground_truth import SceneTruths
from su3d_bench.evaluation.result import Evaluation, ProtocolEvaluation, Request
from su3d_bench.evaluation.scoring import map_of, on_vertices, vertices_for
from su3d_bench.metrics.compatibility import needs_map
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import ALL_PROTOCOLS
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import EVERY_SCENE, combine, pack_scores, plain_json
from su3d_bench.predictions.base import Content
from su3d_bench.predictions.formats import Source
from su3d_bench.predictions.run_predictions import write_content
from su3d_bench.runs.existing import with_end_marker
from su3d_bench.runs.finished import external
from su3d_bench.runs.plan import check_folder_name
from su3d_bench.runs.summary import COMPUTED_BY_METHOD, confidences_of
from su3d_bench.store import records
from su3d_bench.store.run_folder import RunFolder

FILE_CONFIDENCES = "those in the files"
OVERRIDDEN_CONFIDENCES = "those in the files, although the protocol sets 1 for every mask"
_SCENE_AND_SENTENCE = re.compile(r"([^:]*): (.*)", re.DOTALL)


@dataclass(frozen=True)
class EvaluatedRun:
    """Evaluations by method, and as a run. ``existed``: the folder already had them and was not changed."""

    evaluations: Mapping[str, Evaluation]
    metrics: records.MetricsRecord
    existed: bool = False


Progress = Callable[[str, int, int], None]  # the scene, the number of scenes done and of all, for one method


@dataclass
class _Kept:
    """The state of one method's predictions; the maps go to ``folder``, if there is one."""

    method: str
    request: Request
    folder: RunFolder | None
    progress: Progress
    files: dict[str, Mapping[str, str]] = field(default_factory=dict)
    n_done: int = 0

    def begin(self, truths: SceneTruths, sources: Sequence[Source], *, counts_file_confidences: bool) -> None:
        self.truths = truths
        self.formats = tuple(dict.fromkeys(source.reader.name for source in sources))
        self.confidences = "file" if counts_file_confidences else "protocol"

    def keep(self, scene: str, content: Content, files: Iterable[Path], rules: Sequence[ProtocolRules]) -> None:
        self.n_done += 1
        self.progress(scene, self.n_done, len(self.truths.scenes))
        if self.folder is None:
            return
        address = self.truths.address(scene)
        self.files[address] = {str(file): digest_file(file) for file in files}
        self._write(address, self._shown(scene, content, rules))

    def _shown(self, scene: str, content: Content, rules: Sequence[ProtocolRules]) -> Content:
        """The map as scored: on the ground-truth points, with the names of the first protocol with classes."""
        for each in sorted(rules, key=lambda one: (needs_map(one), one.class_agnostic is not None or not one.classes)):
            points = vertices_for(each, self.truths, scene, content)
            if points is not None:
                return on_vertices(content, points, each)
            truth = self.truths.of_scene(each, scene)
            if isinstance(truth, GroundTruth):
                return map_of(content, truth.points, each)
        return content

    def record_no_score(self, address: str) -> None:
        """Record that this method has no score for a scene of another method."""
        self._write(address, Instances.of(np.zeros((0, 3), np.float32), [], labels=()))
        self.files[address] = {}

    def _write(self, address: str, content: Content) -> None:
        assert self.folder is not None
        job = self.folder.job(address, self.method)
        job.prepare()
        write_content(job.prediction, content)
        atomic.write_text(job.updates, records.updates_text([]))

    @property
    def record(self) -> records.PredictionsRecord:
        texts = self.request.text_features
        return records.PredictionsRecord(
            method=self.method,
            formats=self.formats,
            paths=tuple(str(path) for path in self.request.predictions),
            files=dict(sorted(self.files.items())),
            confidences=self.confidences,
            texts=None if texts is None else (str(texts), digest_file(texts)),
        )


def evaluate_methods(
    requests: Mapping[str, Request], out: Path | None = None, progress: Progress = lambda scene, n_done, n_all: None
) -> EvaluatedRun:
    """The numbers of each method's predictions, written as one run to ``out`` if given.

    A folder with the same evaluation is not changed; ``StoreError`` if it contains another evaluation or anything else.
    """
    for method in requests:
        check_method_name(method)
    if out is None:
        kept = [_Kept(method, request, None, progress) for method, request in requests.items()]
        return _evaluated(kept)
    _check_same_runs(out)
    place = out.absolute()
    atomic.make_folder(place.parent)
    try:
        with unfinished_folder(place) as filled:
            folder = RunFolder(filled)
            kept = [_Kept(method, request, folder, progress) for method, request in requests.items()]
            run = _evaluated(kept)
            record = _write(kept, run, folder)
            if atomic.is_file(out / "run.json"):
                _check_same_evaluation(out, record, run.metrics)
                return replace(run, existed=True)
            publish(filled, place)
    except OSError as error:
        raise atomic.write_error(out, error) from error
    return run


def check_method_name(name: str) -> None:
    """``ConfigError`` if predictions cannot have this name."""
    check_folder_name("--name", name)
    if name == CEILING_METHOD:
        raise ConfigError(f"--name: '{name}' is reserved for the ground-truth ceiling; choose another name")


def _evaluated(kept: Sequence[_Kept]) -> EvaluatedRun:
    evaluations = {one.method: evaluate(one.request, one) for one in kept}
    scored = {tuple(found.rules.name for found in one.protocols) for one in evaluations.values()}
    if len(scored) > 1 and not kept[0].request.protocols:  # the headline protocol does not fit every method
        for one in kept:
            one.request = replace(one.request, protocols=(ALL_PROTOCOLS,))
        return _evaluated(kept)
    return EvaluatedRun(evaluations, _metrics(kept, evaluations))


def _check_same_runs(out: Path) -> None:
    """``StoreError``, before anything is scored, if ``out`` contains something that no evaluation wrote."""
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise StoreError(f"{shown(out)}: is not a folder; choose another with --out")
    RunFolder(out).check_is_run_folder()
    if (
        atomic.is_file(out / "run.json")
        and not records.read_record(records.RunRecord, out / "run.json", shown(out)).predictions
    ):
        raise StoreError(
            f"{shown(out)}: contains a run that is not an evaluation of external predictions; choose another with --out"
        )


def _check_same_evaluation(out: Path, record: records.RunRecord, metrics: records.MetricsRecord) -> None:
    """``StoreError`` if the evaluation in ``out`` is not the one of ``record``; the message states the difference."""
    there = records.read_record(records.RunRecord, out / "run.json", shown(out))
    pairs = {what: (of(there), of(record)) for what, of in _IDENTITY.items()}
    other = next((what for what, (before, now) in pairs.items() if before != now), None)
    if other is None and atomic.read_json(out / "metrics.json") != json.loads(atomic.json_text(records.plain(metrics))):
        other = "numbers, though of the same files" if there.code == record.code else "numbers of another version"
    if other is not None:
        raise StoreError(
            f"{shown(out)}: contains a different evaluation (other {other}); choose another --out, or remove the folder"
        )


def _without_paths(record: records.RunRecord) -> list[object]:
    """The predictions of a run by content, regardless of their paths."""
    return [
        [one.formats, one.confidences, one.texts and one.texts[1]]
        + [(scene, sorted(digests.values())) for scene, digests in one.files.items()]
        for one in record.predictions
    ]


_IDENTITY: dict[str, Callable[[records.RunRecord], object]] = {
    "methods": lambda record: record.methods,
    "scenes": lambda record: record.scenes,
    "ground truth": lambda record: (dict(record.data_digests), _truth_key(record.ground_truth)),
    "protocols": lambda record: record.protocols,
    "predictions": _without_paths,
}


def _truth_key(truth: records.TruthRecord | None) -> object:
    return truth and (truth.dataset, truth.values, truth.queries)


# ---- numbers


def _metrics(kept: Sequence[_Kept], evaluations: Mapping[str, Evaluation]) -> records.MetricsRecord:
    rules = {protocol.rules.name: protocol.rules for one in evaluations.values() for protocol in one.protocols}
    results = tuple(_result(one, evaluations[one.method], each) for each in rules.values() for one in kept)
    return records.MetricsRecord(limit=0, scenes=_scenes(kept, evaluations), results=results)


def _scenes(kept: Sequence[_Kept], evaluations: Mapping[str, Evaluation]) -> tuple[str, ...]:
    """The scenes for which any method has a score, in the order of the ground truth."""
    scored = {scene for one in evaluations.values() for protocol in one.protocols for scene in protocol.scores}
    truths = kept[0].truths
    return tuple(truths.address(scene) for scene in _names(kept) if scene in scored)


def _result(kept: _Kept, evaluation: Evaluation, rules: ProtocolRules) -> records.ResultRecord:
    found = next((one for one in evaluation.protocols if one.rules.name == rules.name), None)
    scenes = kept.truths.scenes
    scores = {} if found is None else found.scores
    encoder, digest = (None, None) if found is None or found.encoder is None else found.encoder
    return records.ResultRecord(
        method=kept.method,
        protocol=rules.name,
        version=rules.version,
        kind=rules.kind,
        headline=rules.headline,
        profile=None,
        caveat=external(kept.formats),
        encoder=encoder,
        encoder_digest=digest,
        n_planned=len(scenes),
        failed=(),
        unscored=tuple(kept.truths.address(scene) for scene in scenes if scene not in scores),
        ceiling=None if found is None or found.ceiling is None else plain_json(found.ceiling),
        result=None if found is None else _numbers(kept, found),
        confidences=None if found is None else _confidences(kept, found),
        labels=None if found is None else found.labels,
    )


def _addressed(kept: _Kept, scores: Mapping[str, SceneScore]) -> dict[str, SceneScore]:
    return {kept.truths.address(scene): score for scene, score in scores.items()}


def _numbers(kept: _Kept, found: ProtocolEvaluation) -> records.NumbersRecord:
    numbers = combine(found.rules, _addressed(kept, found.scores)).to_json()
    if found.coverage is None:
        numbers["coverage"] = {}
    return records.NumbersRecord(**numbers | {"warnings": tuple(_warning(kept, line) for line in found.warnings)})


def _warning(kept: _Kept, line: str) -> str:
    """A warning with the address of its scene as prefix, or that of every scene."""
    parts = _SCENE_AND_SENTENCE.fullmatch(line)
    if parts is None or (parts[1] not in kept.truths.scenes and parts[1] != EVERY_SCENE):
        return f"{EVERY_SCENE}: {line}"
    return line if parts[1] == EVERY_SCENE else f"{kept.truths.address(parts[1])}: {parts[2]}"


def _confidences(kept: _Kept, found: ProtocolEvaluation) -> str | None:
    if kept.confidences == "file" and found.with_ones is not None:
        return OVERRIDDEN_CONFIDENCES
    stated = confidences_of(found.rules, records.NumbersRecord(**found.result.to_json()))
    return FILE_CONFIDENCES if stated == COMPUTED_BY_METHOD else stated


# ---- files


def _write(kept: Sequence[_Kept], run: EvaluatedRun, folder: RunFolder) -> records.RunRecord:
    """Write everything except the maps, which already exist; return the record of the run."""
    record = _record(kept, run)
    for one in kept:
        for address in record.scenes:
            if address not in one.files:
                one.record_no_score(address)
            _mark_complete(one, run.evaluations[one.method], address, record, folder)
    record = replace(record, predictions=tuple(one.record for one in kept))
    _write_ceilings(kept, run.evaluations, folder)
    atomic.write_text(folder.path / "run.toml", with_end_marker(write_toml(_settings(kept, record))))
    atomic.write_json(folder.path / "metrics.json", records.plain(run.metrics))
    atomic.write_json(folder.path / "run.json", records.plain(record))
    return record


def _mark_complete(
    kept: _Kept, evaluation: Evaluation, address: str, record: records.RunRecord, folder: RunFolder
) -> None:
    job = folder.job(address, kept.method)
    scores = {
        one.rules.name: score
        for one in evaluation.protocols
        for scene, score in one.scores.items()
        if kept.truths.address(scene) == address
    }
    atomic.write_bytes(job.counts, pack_scores(scores))
    unscored = {
        each.protocol: each.reason for each in record.unscored if (each.scene, each.method) == (address, kept.method)
    }
    atomic.write_text(job.log, "".join(f"{line}\n" for line in (external(kept.formats), "done")))
    key = {"data": record.data_digests[address], "method": kept.method, "predictions": digest_json(kept.files[address])}
    job.mark_complete("predict", key, [job.prediction, job.updates])
    job.mark_complete(
        "score",
        {"predict": digest_json(key)} | {f"protocol.{each.name}": each.digest for each in record.protocols},
        [job.counts, job.log],
        {"unscored": unscored, "warnings": [], "doubts": []},
    )


def _write_ceilings(kept: Sequence[_Kept], evaluations: Mapping[str, Evaluation], folder: RunFolder) -> None:
    """Write the scores of the ground truth as the counts of the ceiling method."""
    ceilings: dict[str, dict[str, SceneScore]] = {}
    for one in kept:
        for found in evaluations[one.method].protocols:
            for address, score in _addressed(one, found.ceilings).items():
                ceilings.setdefault(address, {})[found.rules.name] = score
    for address, scores in ceilings.items():
        job = folder.job(address, CEILING_METHOD)
        job.prepare()
        atomic.write_bytes(job.counts, pack_scores(scores))


def _record(kept: Sequence[_Kept], run: EvaluatedRun) -> records.RunRecord:
    git = git_state()
    truths = kept[0].truths
    rules = {found.rules.name: found.rules for one in run.evaluations.values() for found in one.protocols}
    encoders = list(dict.fromkeys(
        found.encoder for one in run.evaluations.values() for found in one.protocols if found.encoder is not None
    ))  # fmt: skip
    scenes = run.metrics.scenes
    digests = {truths.address(scene): truths.digest(scene) for scene in _names(kept) if truths.address(scene) in scenes}
    return records.RunRecord(
        status="complete",
        is_partial=False,
        code=code_digest(),
        git=None if git is None else records.GitRecord(**git),
        packages=package_versions(),
        hardware=hardware_line(),
        processor=processor_digest(),
        profile=None,
        encoder=", ".join(name for name, _ in encoders) or None,
        encoder_digest=", ".join(digest for _, digest in encoders) or None,
        data_digests=digests,
        protocols=tuple(records.ProtocolRecord(each.name, each.version, each.digest) for each in rules.values()),
        methods=tuple(one.method for one in kept),
        scenes=scenes,
        unscored=tuple(_unscored(kept, run, list(rules))),
        warnings=tuple(dict.fromkeys(line for one in run.evaluations.values() for line in one.remarks)),
        predictions=tuple(one.record for one in kept),
        ground_truth=truths.record,
    )


def _names(kept: Sequence[_Kept]) -> list[str]:
    return list(dict.fromkeys(scene for one in kept for scene in one.truths.scenes))


def _unscored(kept: Sequence[_Kept], run: EvaluatedRun, protocols: Sequence[str]) -> Iterable[records.UnscoredRecord]:
    """Why scenes of the run have no score for a method and protocol."""
    for one in kept:
        evaluation = run.evaluations[one.method]
        found = {each.rules.name: each for each in evaluation.protocols}
        for name in protocols:
            scores = found[name].scores if name in found else {}
            for scene in _names(kept):
                address = one.truths.address(scene)
                if address in run.metrics.scenes and scene not in scores:
                    yield records.UnscoredRecord(
                        address, one.method, name, _missing_reason(evaluation, found.get(name), name, scene)
                    )


def _missing_reason(evaluation: Evaluation, found: ProtocolEvaluation | None, protocol: str, scene: str) -> str:
    if found is None:
        return printable(evaluation.not_scored.get(protocol, "is not scored"))
    return printable(found.unscored.get(scene, "has no prediction, and is skipped as in the original evaluator"))


def _settings(kept: Sequence[_Kept], record: records.RunRecord) -> list[tuple[tuple[str, ...], object, str]]:
    """The settings of the request that a run records."""
    request, target = kept[0].request, kept[0].truths.target
    name = record.scenes[0].partition("/")[0]
    scenes = [f"{target}/{address.removeprefix(f'{name}/')}" for address in record.scenes]
    leaves: list[tuple[tuple[str, ...], object, str]] = [
        (("scenes",), scenes, "evaluate"),
        (("methods",), list(record.methods), "--name" if len(kept) > 1 else "evaluate"),
        (("protocols",), list(request.protocols) or [each.name for each in record.protocols], "evaluate"),
    ]
    leaves += [(("method", one.method, "confidences"), one.confidences, "evaluate") for one in kept]
    return leaves
