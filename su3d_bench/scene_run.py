"""One scene under all methods of a run: predict, score, draw; the unit of work that executors run.

The ground truth stays here: methods get frames and detections alone, except a method that asks for the truth by
having ``receive_truth`` (the oracle, from which ceilings come).
"""

from __future__ import annotations

import json
import logging
import math
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from su3d_bench import registry
from su3d_bench.config import flatten
from su3d_bench.digests import NUMERIC_PACKAGES, code_digest, digest_json, package_versions
from su3d_bench.errors import GroundTruthMissing, StoreError, Su3dError
from su3d_bench.executors import Report
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception, resolve_profile
from su3d_bench.protocols import SHARE_KINDS, ProtocolRules, load_protocol
from su3d_bench.questions.refined import refined_digest, refined_names
from su3d_bench.questions.truths import question_truth
from su3d_bench.read_ahead import N_AHEAD, ReadAhead
from su3d_bench.reports.pictures import draw_scene
from su3d_bench.scene_feeding import Feeding
from su3d_bench.scene_log import SceneLog
from su3d_bench.scene_tools import FirstFrames, surface_of, true_proposals
from su3d_bench.scoring import SceneScore, Truth, pack_scores, score_scene, why_not_scorable
from su3d_bench.store import JobFolder, RunFolder, read_prediction, write_bytes, write_text
from su3d_bench.timing import device_memory_bytes, peak_memory_bytes, start_memory_watch
from su3d_bench.types import (
    Frame,
    GroundTruth,
    InstanceMesh,
    Method,
    Prediction,
    Proposals,
    SceneInfo,
    SceneTools,
)

CEILING_METHOD = "oracle"
# Settings of perception that move no number, or whose part that does is in perception's digest.
MOVES_NO_NUMBER = ("perception.cache", "perception.models.folder", "perception.models.paths", "perception.language.")
LAYOUTS_OF_ROOMS = ("replica", "scannet", "tum")  # in which `datasets make rooms` writes files
TRUE_PROPOSALS_CAVEAT = "proposals from the ground truth; a ceiling, not a result"
NAMED_KINDS = ("annotation", "reasoning")  # labels n' of a file beside the map move their numbers
FIELDS_KNOWN_LATER = ("data", "profile", "perception")


@dataclass(frozen=True)
class Part:
    """A dataset or method of the run: its registry target, its own name, its resolved options as JSON."""

    target: str
    name: str
    options: str


@dataclass(frozen=True)
class SceneJob:
    """Everything that a worker needs to know of one scene; ``index`` counts the scenes of the run."""

    scene: str
    dataset: Part
    methods: tuple[Part, ...]
    ceiling: Part | None
    protocols: tuple[str, ...]
    profile: str
    perception: str
    stride: int
    seed: int
    limit: int
    pictures: bool
    anytime: tuple[float, ...]
    folder: Path
    data_root: Path
    cache_root: Path
    index: int = 0
    is_offline: bool = False

    @property
    def scene_name(self) -> str:
        """The scene as its dataset calls it."""
        return self.scene.removeprefix(f"{self.dataset.name}/")


@dataclass(frozen=True)
class MethodOutcome:
    """What became of one scene under one method; ``error`` is a line, ``unscored`` pairs a protocol and a reason.

    ``warnings`` are what the library said of the data on the way.
    """

    scene: str
    method: str
    error: str | None = None
    profile: str | None = None
    caveat: str | None = None
    encoder: str | None = None
    encoder_digest: str | None = None
    data_digest: str | None = None
    was_resumed: bool = False
    unscored: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()


def caveat_of(method: Method, perception: Perception, scene: SceneInfo) -> str | None:
    """What must be said beside every number: where the scenes, the masks, or the method's own proposals come from."""
    own = TRUE_PROPOSALS_CAVEAT if method.needs.true_proposals else getattr(method, "caveat", None)
    is_seen_by_profile = method.needs.frames and not getattr(method, "has_own_perception", False)
    is_made = scene.image_domain == "rendered-rooms" and scene.dataset in LAYOUTS_OF_ROOMS
    made = f"made rooms in the layout of {scene.dataset}, not its scenes" if is_made else None
    parts = [made, perception.caveat if is_seen_by_profile else None, own]
    return "; ".join(part for part in parts if part) or None


def stride_of(job_stride: int, options: str) -> int:
    """Frames between updates: the run's where it is set, else the method's own, else 1."""
    return job_stride or int(json.loads(options).get("stride", 1))


def config_key(job: SceneJob, part: Part, method: Method) -> dict[str, str]:
    """What of a prediction's key is known before any data is read, the most telling fields first."""
    key = {"dataset": job.dataset.name, "method": part.name, "seed": str(job.seed)}
    sections = [(f"method.{part.name}", part.options), (f"dataset.{job.dataset.name}", job.dataset.options)]
    if method.needs.frames:
        key |= {"stride": str(stride_of(job.stride, part.options)), "limit": str(job.limit or "none")}
        if job.anytime:
            key["anytime"] = str(job.anytime)
        sections.append(("perception", job.perception))
    for prefix, options in sections:
        for path, value in flatten(json.loads(options)):
            key[".".join((prefix, *path))] = json.dumps(value, ensure_ascii=False)
    key = {name: text for name, text in key.items() if not name.startswith(MOVES_NO_NUMBER)}
    if hasattr(method, "inputs"):
        key |= {f"input.{name}": digest for name, digest in method.inputs.items()}
    return (
        key
        | {f"packages.{name}": text for name, text in package_versions(NUMERIC_PACKAGES).items()}
        | {"code": code_digest()}
    )


def run_scene(job: SceneJob, report: Report) -> tuple[MethodOutcome, ...]:
    """Outcomes of all methods on one scene, that of the ceiling last; a method that fails leaves the others alone."""
    scene = _Scene(job, report)
    parts = job.methods if job.ceiling is None else (*job.methods, job.ceiling)
    return tuple(_guarded(scene, part) for part in parts)


def failed_outcomes(job: SceneJob, reason: str) -> tuple[MethodOutcome, ...]:
    """The outcome of a scene whose worker died; what its methods finished before stays and is resumed next time."""
    line = f"{job.scene}: {reason}"
    for part in job.methods:
        folder = RunFolder(job.folder).job(job.scene, part.name)
        folder.prepare()
        if "score" not in folder.seals():
            write_text(folder.log, f"failed: {line}\n")
    return tuple(MethodOutcome(job.scene, part.name, error=line) for part in job.methods)


def _guarded(scene: _Scene, part: Part) -> MethodOutcome:
    """The one place where a scene's failure, of whatever kind, becomes a record instead of the end of the sweep."""
    job = scene.job
    folder = RunFolder(job.folder).job(job.scene, part.name)
    folder.prepare()
    log = SceneLog()
    package = logging.getLogger("su3d_bench")
    package.addHandler(log)
    try:
        outcome = scene.run(part, folder, log)
    except StoreError:
        raise
    except Exception as error:  # noqa: BLE001 - a plug-in may raise anything; the traceback goes to the scene's log
        line = error_line(error)
        line = line if line.startswith(job.scene) else f"{job.scene}: {line}"
        log.lines.append("".join(traceback.format_exception(error)) + f"failed: {line}")
        outcome = MethodOutcome(job.scene, part.name, error=line)
    finally:
        package.removeHandler(log)
    if outcome.error is not None:
        write_text(folder.log, log.text())
    return outcome


def error_line(error: Exception) -> str:
    """One line for any error; one that is not ours says its type."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"out of memory ({text or 'no details'}); try fewer --jobs, or a machine with more"
    return text if isinstance(error, Su3dError) else f"{type(error).__name__}: {text}"


class _Scene:
    """One scene with what its methods share: the dataset, the truth."""

    def __init__(self, job: SceneJob, report: Report) -> None:
        self.job = job
        self.report = report
        self._truths: dict[str, GroundTruth] = {}

    @cached_property
    def dataset(self) -> Any:
        return build_dataset(self.job.dataset, self.job.data_root)

    @cached_property
    def data_digest(self) -> str:
        digest: str = self.dataset.digest(self.job.scene_name)
        return digest

    @cached_property
    def mesh(self) -> InstanceMesh:
        mesh: InstanceMesh = self.dataset.instance_mesh(self.job.scene_name)
        return mesh

    def truth(self, variant: str) -> GroundTruth:
        if variant not in self._truths:
            self._truths[variant] = self.dataset.ground_truth(self.job.scene_name, variant)
        return self._truths[variant]

    def perception(self, info: SceneInfo) -> Perception:
        config: PerceptionConfig = PerceptionConfig.model_validate_json(self.job.perception)
        profile = resolve_profile(self.job.profile, info.image_domain, config)
        mesh = self.mesh if profile == "oracle" else None
        return build_perception(
            profile,
            config,
            scene=info,
            cache_root=self.job.cache_root,
            mesh=mesh,
            job_index=self.job.index,
            replies=self.job.folder / "language",
            is_offline=self.job.is_offline,
        )

    def run(self, part: Part, folder: JobFolder, log: SceneLog) -> MethodOutcome:
        """Predict and score one method, each step only where its seal is missing or broken."""
        method = build_method(part)
        info = self.dataset.info(self.job.scene_name, stride_of(self.job.stride, part.options))
        info = replace(info, seed=self.job.seed)
        perception = self.perception(info)
        key = config_key(self.job, part, method) | {"data": self.data_digest}
        if method.needs.frames:
            key |= {"profile": perception.profile, "perception": perception.digest}
        refuse_other_run(folder, key)
        was_resumed = folder.is_done("predict", key)
        if was_resumed:
            log.recall(folder.remarks("predict"))
        else:
            self._predict(method, info, perception, folder, key, log)
        score_key = {"predict": digest_json(key), "encoder": perception.encoder.digest}
        score_key |= {"pictures": str(self.job.pictures)}
        score_key |= {f"protocol.{name}": load_protocol(name).digest for name in self.job.protocols}
        if any(load_protocol(name).kind in NAMED_KINDS for name in self.job.protocols):
            score_key |= refined_digest(folder)
        if not folder.is_done("score", score_key):
            self._score(part, perception, folder, score_key, log)
            was_resumed = False
        return MethodOutcome(
            self.job.scene,
            part.name,
            profile=perception.profile if method.needs.frames else None,
            caveat=caveat_of(method, perception, info),
            encoder=perception.encoder.name,
            encoder_digest=perception.encoder.digest,
            data_digest=self.data_digest,
            was_resumed=was_resumed,
            unscored=tuple(folder.remarks("score")["unscored"].items()),
            warnings=tuple(folder.remarks("score")["warnings"]),
        )

    def _predict(
        self,
        method: Method,
        info: SceneInfo,
        perception: Perception,
        folder: JobFolder,
        key: Mapping[str, str],
        log: SceneLog,
    ) -> None:
        frames: Sequence[Frame] = ()
        n = 0
        if method.needs.frames:
            frames = self.dataset.frames(self.job.scene_name, info.stride)
            n = min(len(frames), self.job.limit or len(frames))
        if hasattr(method, "receive_tools"):
            method.receive_tools(self._tools(method, perception, frames, n))
        if hasattr(method, "receive_truth"):
            if not self.dataset.variants:
                raise GroundTruthMissing(f"{self.job.scene}: {method.name} needs ground truth, the dataset has none")
            method.receive_truth(self.truth(self.dataset.variants[0]))
        start_memory_watch()
        feeding = Feeding(self.job.scene, method, perception, self.report)
        shares = self.job.anytime if method.needs.frames else ()
        with ReadAhead(frames, n, n_ahead=0 if getattr(self.dataset, "renders_frames", False) else N_AHEAD) as ahead:
            method.start(info)
            for share in shares:
                feeding.up_to(math.ceil(share * n), ahead, n)
                feeding.write_map(folder.anytime(share))
            feeding.up_to(n, ahead, n)
        feeding.write_map(folder.prediction)
        if hasattr(method, "close"):
            method.close()
        write_text(folder.updates, feeding.csv_text())
        files = [folder.prediction, folder.updates, *map(folder.anytime, shares)]
        costs = {
            "maps": feeding.maps,
            "calibration_ms": feeding.calibration_ms,
            "peak_rss_bytes": peak_memory_bytes(),
            "device_bytes": device_memory_bytes(),
        }
        folder.seal("predict", key, files, {"costs": costs} | log.remarks())

    def _tools(self, method: Method, perception: Perception, frames: Sequence[Frame], n: int) -> SceneTools:
        return SceneTools(
            frames=FirstFrames(frames, n),
            regions=perception.regions(),
            surface=partial(surface_of, self.dataset, self.job.scene_name),
            true_proposals=self._true_proposals if method.needs.true_proposals else None,
        )

    def _true_proposals(self) -> Proposals:
        if not self.dataset.variants:
            raise GroundTruthMissing(f"{self.job.scene}: proposals 'oracle' need ground truth, the dataset has none")
        return true_proposals(self.truth(self.dataset.variants[0]))

    def _score(
        self, part: Part, perception: Perception, folder: JobFolder, key: Mapping[str, str], log: SceneLog
    ) -> None:
        """Score under every protocol that has a truth here, draw the map, and seal; reasons for the others go along."""
        prediction = read_prediction(folder.prediction)
        scores, unscored = self._scores(part, perception, prediction, folder)
        files = [folder.counts]
        write_bytes(folder.counts, pack_scores(scores))
        for share in self.job.anytime if build_method(part).needs.frames else ():
            early, _ = self._scores(part, perception, read_prediction(folder.anytime(share)), None)
            write_bytes(folder.anytime_counts(share), pack_scores(early))
            files.append(folder.anytime_counts(share))
        if self.job.pictures:
            truth_to_draw = next(iter(self._truths.values()), None)
            files += draw_scene(prediction, truth_to_draw, folder.pictures, f"{self.job.scene}, {part.name}")
        write_text(folder.log, log.text("done"))
        remarks = {"unscored": unscored, "warnings": list(dict.fromkeys(log.warnings))}
        folder.seal("score", key, [*files, folder.log], remarks)

    def _scores(
        self, part: Part, perception: Perception, prediction: Prediction, refined_in: JobFolder | None
    ) -> tuple[dict[str, SceneScore], dict[str, str]]:
        """The scores under every protocol that can score the map, and why the others cannot."""
        scores: dict[str, SceneScore] = {}
        unscored: dict[str, str] = {}
        for rules in map(load_protocol, self.job.protocols):
            try:
                truth = self.truth(rules.ground_truth)
            except GroundTruthMissing as error:
                unscored[rules.name] = error_line(error)
                continue
            if (reason := why_not_scorable(rules, prediction)) is not None:
                unscored[rules.name] = reason
                continue
            told = self._prediction_in_words_of(truth, part, prediction)
            asked = self._truth_of(rules, truth, refined_in)
            scores[rules.name] = score_scene(rules, asked, told, perception.encoder)
        return scores, unscored

    def _truth_of(self, rules: ProtocolRules, truth: GroundTruth, refined_in: JobFolder | None) -> Truth:
        if rules.kind not in SHARE_KINDS:
            return truth
        refine = None if refined_in is None else partial(refined_names, refined_in)
        return question_truth(rules, self.dataset, self.job.scene_name, truth, refine)

    def _prediction_in_words_of(self, truth: GroundTruth, part: Part, prediction: Prediction) -> Prediction:
        """``prediction``; that of a method that was told the truth is told anew where ``truth`` names its classes
        otherwise than the truth that it was told: ScanNet has two sets of labels."""
        method = build_method(part)
        if not hasattr(method, "receive_truth") or truth.labels == self.truth(self.dataset.variants[0]).labels:
            return prediction
        method.receive_truth(truth)
        told: Prediction = method.finish()
        return told


def refuse_other_run(folder: JobFolder, key: Mapping[str, str], known_later: Sequence[str] = ()) -> None:
    """A ``StoreError`` where ``folder`` was sealed under another key, fields in ``known_later`` aside."""
    if changed := folder.changed_field("predict", key, known_later=known_later):
        raise StoreError(
            f"{folder.path}: holds another run ({changed}); choose another folder with --out or delete this one"
        )


def build_dataset(part: Part, data_root: Path) -> Any:
    """The dataset of ``part``, reading below ``data_root``."""
    dataset_class = registry.load("dataset", part.target)
    return dataset_class(data_root, dataset_class.Options.model_validate_json(part.options))


def build_method(part: Part) -> Any:
    """A fresh method of ``part``."""
    method_class = registry.load("method", part.target)
    return method_class(method_class.Config.model_validate_json(part.options))
