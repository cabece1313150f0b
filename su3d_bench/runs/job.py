"""The input and output of a worker: one scene's job, its outcomes, and the keys under which they are cached."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import RunConfig, Settings, flatten, resolve
from su3d_bench.core.digests import NUMERIC_PACKAGES, code_digest, digest_json, package_versions
from su3d_bench.core.errors import StoreError
from su3d_bench.core.interfaces import Method, UsesGroundTruth
from su3d_bench.core.maps import Prediction
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.types import GroundTruth, LabelSet, SceneInfo
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import Truth
from su3d_bench.metrics.semantic.panoptic import visible_truth
from su3d_bench.numerics.visibility import SEEN_M
from su3d_bench.perception.profiles import Perception, PerceptionConfig
from su3d_bench.questions.refining import refined_digest
from su3d_bench.questions.solver import answers_digest
from su3d_bench.runs.plugins import attribute_of, checked_dataset, checked_method, made, settings_model
from su3d_bench.runs.real_time import clock_key
from su3d_bench.store.records import CompletionRecord
from su3d_bench.store.run_folder import JobFolder


@dataclass(frozen=True)
class Part:
    """A dataset or method of the run: its registry target, its own name, its resolved options as JSON.

    ``corruption``: the conditions under which a method runs, for ``corruptions.apply.parse_conditions``.
    """

    target: str
    name: str
    options: str
    corruption: str = ""


def options_model(kind: str, target: str) -> Any:
    """The model of the options of a dataset, or of the settings of a method."""
    return settings_model(registry.load(kind, target), "Config" if kind == "method" else "Options")


def part_of(kind: str, target: str, settings: Settings) -> Part:
    """The dataset or method at ``target`` with its ``settings``."""
    name = str(registry.load(kind, target).name)
    return Part(target, name, resolve(settings, (kind, name), options_model(kind, target)).model_dump_json())


def build_dataset(part: Part, data_root: Path) -> Any:
    """The dataset of ``part``, reading below ``data_root``."""
    dataset_class = registry.load("dataset", part.target)
    return checked_dataset(made(dataset_class, data_root, dataset_class.Options.model_validate_json(part.options)))


def build_method(part: Part) -> Any:
    """A fresh method of ``part``."""
    method_class = registry.load("method", part.target)
    return checked_method(made(method_class, method_class.Config.model_validate_json(part.options)))


def with_visible_truth(
    part: Part, rules: ProtocolRules, truth: Truth, prediction: Prediction, first: Callable[[], LabelSet] | None
) -> Prediction:
    """``prediction``, a map of the method ``part``; computed again for a method that uses ground truth if ``rules``
    need a different one.

    This is the case if ``truth`` names its classes differently from the ``first`` ground truth of the dataset, which
    the map was made from, if ``first`` is None, or if stuff without instances counts. Of OpenLex3D's labels it gets the
    first synonyms.
    """
    method = build_method(part)
    if isinstance(truth, OpenLexTruth):
        truth = truth.by_first_synonym()
    if not isinstance(method, UsesGroundTruth) or not isinstance(truth, GroundTruth):
        return prediction
    visible = visible_truth(rules, truth)
    if first is not None and visible is truth and truth.labels == first():
        return prediction
    method.receive_ground_truth(visible)
    recomputed: Prediction = method.finish()
    return recomputed


# Perception settings that do not affect numbers, or whose effect is already in perception's digest.
NOT_IN_KEY = ("perception.cache", "perception.models.folder", "perception.models.paths", "perception.language.")
GENERATED_SCENES = "generated scenes in the layout of"  # prefix of their caveat
REPLACE_HINT = "--replace overwrites it, or choose another folder with --out"
FIELDS_KNOWN_LATER = ("data", "profile", "perception", "packages.torch", "packages.transformers")


@dataclass(frozen=True)
class SceneJob:
    """Everything that a worker needs to know about one scene; ``index`` counts the scenes of the run.

    ``config`` is the run's, ``perception`` the perception settings as JSON. ``replaces``: a map made from different
    inputs is computed again instead of rejected. ``doubts``: warnings about its poses, None if the process that created
    the job could not read its data.
    """

    scene: str
    dataset: Part
    methods: tuple[Part, ...]
    ceiling: Part | None
    protocols: tuple[str, ...]
    config: RunConfig
    perception: str
    folder: Path
    data_root: Path
    cache_root: Path
    index: int = 0
    replaces: bool = False
    doubts: tuple[str, ...] | None = None

    @property
    def parts(self) -> tuple[Part, ...]:
        """All methods, the one of the ceiling last."""
        return self.methods if self.ceiling is None else (*self.methods, self.ceiling)

    @property
    def scene_name(self) -> str:
        """The name of the scene within its dataset."""
        return self.scene.removeprefix(f"{self.dataset.name}/")


@dataclass(frozen=True)
class MethodOutcome:
    """The outcome of one scene under one method; ``error`` is one line, ``unscored`` pairs a protocol and a reason.

    ``warnings`` are messages about the data, ``doubts`` those that are shown with every number.
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
    doubts: tuple[str, ...] = ()


def stride_of(job: SceneJob, part: Part) -> int:
    """Frames between updates, or between arrivals in real time: the run's if set, otherwise the method's own or 1."""
    return job.config.stride or (1 if job.config.realtime else int(json.loads(part.options).get("stride", 1)))


def settings_key(sections: Iterable[tuple[str, str]], method: Method) -> dict[str, str]:
    """The settings that can change a number, of sections with a prefix and JSON, and the inputs of ``method``."""
    leaves = [((prefix, *path), value) for prefix, text in sections for path, value in flatten(json.loads(text))]
    key = {".".join(path): json.dumps(value, ensure_ascii=False) for path, value in leaves}
    key = {name: text for name, text in key.items() if not name.startswith(NOT_IN_KEY)}
    return key | {f"input.{name}": digest for name, digest in attribute_of(method, "inputs", {}).items()}


def config_key(job: SceneJob, part: Part, method: Method) -> dict[str, str]:
    """The part of a prediction's key that is known before any data is read, the most informative fields first."""
    key = {"dataset": job.dataset.name, "method": part.name, "seed": str(job.config.seed)}
    sections = [(f"method.{part.name}", part.options), (f"dataset.{job.dataset.name}", job.dataset.options)]
    if method.needs.frames:
        key |= {"stride": str(stride_of(job, part)), "limit": str(job.config.limit or "none")}
        if job.config.anytime_text:
            key["anytime"] = job.config.anytime_text
        key |= clock_key(job.config, job.scene, part.name)
        sections.append(("perception", job.perception))
    key |= settings_key(sections, method)
    for kind, target in (("method", part.target), ("dataset", job.dataset.target)):
        if digest := registry.code_key(target):
            key[f"code.{kind}"] = digest
    return (
        key
        | {f"packages.{name}": text for name, text in package_versions(NUMERIC_PACKAGES).items()}
        | {"code": code_digest()}
    )


class ConfiguredMethods:
    """Methods and the part of the keys of their predictions that is known before any data is read, computed once per
    dataset, or per scene if schedules are replayed."""

    def __init__(self) -> None:
        self._known: dict[tuple[Part, Part, str], tuple[Any, dict[str, str]]] = {}

    def of(self, job: SceneJob, part: Part) -> tuple[Any, dict[str, str]]:
        """The method of ``part`` and its ``config_key``."""
        place = job.dataset, part, "" if job.config.schedule is None else job.scene
        if place not in self._known:
            method = build_method(part)
            self._known[place] = method, config_key(job, part, method)
        return self._known[place]


def check_same_run(folder: JobFolder, key: Mapping[str, str], *, is_early: bool = False) -> None:
    """A ``StoreError`` if ``folder`` was completed under another key; ``is_early`` ignores fields known only later."""
    if changed := folder.changed_field("predict", key, known_later=FIELDS_KNOWN_LATER if is_early else ()):
        raise StoreError(f"{folder.path}: contains a different run ({changed}); {REPLACE_HINT}")


TRUE_PROPOSALS_CAVEAT = "proposals from the ground truth; a ceiling, not a result"
TRUTH_CAVEAT = "uses the ground truth; a ceiling, not a result"
DEVICE, CPU = "perception.models.device", '"cpu"'
TORCH_PACKAGES = ("torch", "transformers")  # used in addition to the packages in every key


@dataclass(frozen=True)
class JobInputs:
    """One scene under one method, with its data and perception known; ``config`` is the result of ``config_key``."""

    job: SceneJob
    name: str
    config: Mapping[str, str]
    method: Method
    info: SceneInfo
    perception: Perception
    data_digest: str

    def predict_key(self) -> dict[str, str]:
        """The key of the prediction."""
        key = {**self.config, "data": self.data_digest}
        if self.method.needs.frames:
            key |= {"profile": self.perception.profile, "perception": self.perception.digest}
            if self.perception.profile == "paper" or self.config.get(DEVICE, CPU) != CPU:
                key |= {f"packages.{name}": text for name, text in package_versions(TORCH_PACKAGES).items()}
        return key

    def score_key(self, predict_key: Mapping[str, str], folder: JobFolder) -> dict[str, str]:
        """The key of the scores and pictures of that prediction."""
        rules = {name: load_protocol(name) for name in self.job.protocols}
        key = {"predict": digest_json(predict_key), "encoder": self.perception.encoder.digest}
        key |= {"pictures": str(self.job.config.pictures)}
        key |= {f"protocol.{name}": protocol.digest for name, protocol in rules.items()}
        if self.job.config.seen_so_far:
            of_frames = f"limit {self.job.config.limit}, stride {self.info.stride}"
            key["seen"] = f"{self.job.config.anytime_text}, {of_frames}, within {SEEN_M:g} m"
        if self.job.config.question_solver == "llm" and any(one.answers is not None for one in rules.values()):
            key["solver"] = answers_digest(PerceptionConfig.model_validate_json(self.job.perception).language)
        return key | refined_digest(folder) if any(protocol.uses_names for protocol in rules.values()) else key

    def is_scored(self, folder: JobFolder, completion: CompletionRecord | None, key: Mapping[str, str]) -> bool:
        """Whether ``completion`` records scores under ``key``; pictures that are not requested now do no harm."""
        if completion is not None and not self.job.config.pictures and completion.key.get("pictures") == str(True):
            key = {**key, "pictures": str(True)}
        return folder.is_whole(completion, key)

    def outcome(self, remarks: Mapping[str, Any], *, was_resumed: bool) -> MethodOutcome:
        """The outcome once both steps are complete; ``remarks`` are stored with the completion record of the scores."""
        return MethodOutcome(
            self.job.scene,
            self.name,
            profile=self.perception.profile if self.method.needs.frames else None,
            caveat=remarks["caveat"],
            encoder=self.perception.encoder.name,
            encoder_digest=self.perception.encoder.digest,
            data_digest=self.data_digest,
            was_resumed=was_resumed,
            unscored=tuple(remarks["unscored"].items()),
            warnings=tuple(remarks["warnings"]),
            doubts=tuple(remarks["doubts"]),
        )


def caveat_of(method: Method, perception: Perception, scene: SceneInfo, clock: str | None = None) -> str | None:
    """The note shown with every number: where the scenes, the masks, or the method's own proposals come from, and the
    ``clock`` of a real-time run."""
    own = attribute_of(method, "caveat", None)
    if method.needs.true_proposals:
        own = TRUE_PROPOSALS_CAVEAT
    elif isinstance(method, UsesGroundTruth) and method.name != CEILING_METHOD:
        own = TRUTH_CAVEAT
    dataset = registry.load("dataset", scene.dataset) if scene.dataset in registry.DATASETS else None
    is_made = scene.image_domain == "rendered-rooms" and getattr(dataset, "reads_made_rooms", False)
    made = f"{GENERATED_SCENES} {scene.dataset}, not its scenes" if is_made else None
    parts = [made, perception.caveat if sees_profile(method) else None, own, clock]
    return "; ".join(part for part in parts if part) or None


def sees_profile(method: Method) -> bool:
    """Whether the method gets its masks and names from the perception of the run."""
    return method.needs.frames and not getattr(method, "has_own_perception", False)
