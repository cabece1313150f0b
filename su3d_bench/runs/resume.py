"""Scenes of a run that need no worker any more: every step is complete under the current key, every file intact."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, lru_cache

from su3d_bench.core.system.signals import is_interrupt
from su3d_bench.core.types import SceneInfo
from su3d_bench.perception.profiles import Perception, PerceptionConfig, resolve_profile
from su3d_bench.runs.job import ConfiguredMethods, JobInputs, MethodOutcome, Part, SceneJob, build_dataset, stride_of
from su3d_bench.runs.poses import silent
from su3d_bench.runs.scene import perception_of
from su3d_bench.store.records import CompletionRecord
from su3d_bench.store.run_folder import JobFolder, RunFolder

SCENE_INDEPENDENT_PROFILES = ("embedded", "paper")  # profiles whose digest does not depend on the scene


class FinishedScenes:
    """Finds the finished scenes of one run by the checks that a worker makes, each of which reads a file once.

    Whatever all scenes share (methods, datasets, perception, their keys) is created once. A scene whose perception has
    its own digest (profiles ``stored`` and ``oracle``) is left to a worker; so is one that requests a GPU, whose
    properties only a process that uses it can read.
    """

    def __init__(self) -> None:
        self._dataset = cache(build_dataset)
        self._data_digest = lru_cache(maxsize=1)(self._read_digest)
        self._methods = ConfiguredMethods()
        self._perceptions: dict[str, Perception | None] = {}  # by the domain of the images

    def outcomes(self, job: SceneJob) -> tuple[MethodOutcome, ...] | None:
        """The outcomes of a scene, the one of the ceiling last; None if a worker is needed, even to report an error."""
        folders = [RunFolder(job.folder).job(job.scene, part.name) for part in job.parts]
        steps = [folder.completion_records() for folder in folders]
        if any("predict" not in completion or "score" not in completion for completion in steps):
            return None
        try:
            with silent():
                outcomes = [self._outcome(job, *each) for each in zip(job.parts, folders, steps, strict=True)]
        except BaseException as error:
            if is_interrupt(error):
                raise
            return None
        return None if None in outcomes else tuple(outcome for outcome in outcomes if outcome is not None)

    def _outcome(
        self, job: SceneJob, part: Part, folder: JobFolder, steps: Mapping[str, CompletionRecord]
    ) -> MethodOutcome | None:
        inputs = self.inputs(job, part)
        if inputs is None:
            return None
        key = inputs.predict_key()
        is_done = folder.is_whole(steps["predict"], key)
        if not is_done or not inputs.is_scored(folder, steps["score"], inputs.score_key(key, folder)):
            return None
        return inputs.outcome(steps["score"].remarks, was_resumed=True)

    def inputs(self, job: SceneJob, part: Part) -> JobInputs | None:
        """The inputs that determine the numbers of a job; None if only a worker can determine them."""
        method, config = self._methods.of(job, part)
        info = self._dataset(job.dataset, job.data_root).info(job.scene_name, stride_of(job, part))
        perception = self._perception(job, info)
        if perception is None:
            return None
        return JobInputs(job, part.name, config, method, info, perception, self._data_digest(job))

    def _read_digest(self, job: SceneJob) -> str:
        return str(self._dataset(job.dataset, job.data_root).digest(job.scene_name))

    def _perception(self, job: SceneJob, info: SceneInfo) -> Perception | None:
        if info.image_domain not in self._perceptions:
            config: PerceptionConfig = PerceptionConfig.model_validate_json(job.perception)
            profile = resolve_profile(job.config.profile, info.image_domain, config)
            is_same = profile in SCENE_INDEPENDENT_PROFILES and config.models.device == "cpu"
            self._perceptions[info.image_domain] = perception_of(job, info) if is_same else None
        return self._perceptions[info.image_domain]
