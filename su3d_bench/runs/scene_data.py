"""What all methods of a scene share: the dataset, the ground truth, the frames, and when they show what."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core import interfaces
from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import Float64Array, Frame, GroundTruth, InstanceMesh, Int32Array, ObjectBoxes
from su3d_bench.corruptions.apply import CorruptedFrames, SceneCorruption, parse_conditions
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.seen import clouds_of
from su3d_bench.numerics.visibility import first_shown
from su3d_bench.runs import frame_loop
from su3d_bench.runs import job as jobs
from su3d_bench.runs.executors import Event, Report
from su3d_bench.store.run_folder import RunFolder


def poses_of(dataset: Any, scene: str) -> Float64Array:
    """The poses (N, 4, 4) of all frames."""
    if isinstance(dataset, interfaces.ProvidesPoses):
        return dataset.poses(scene)
    return np.stack([frame.camera_to_world for frame in dataset.frames(scene, 1)])


class SceneData:
    """One scene with everything its methods share: the dataset, the ground truth."""

    def __init__(self, job: jobs.SceneJob, report: Report) -> None:
        self.job = job
        self.report = report
        self.truths: dict[str, GroundTruth] = {}
        self.shared: dict[str, Any] = {}
        self._corruptions: dict[str, SceneCorruption] = {}
        self._shown: dict[tuple[int, str], dict[str, list[Int32Array]]] = {}

    @cached_property
    def dataset(self) -> Any:
        return jobs.build_dataset(self.job.dataset, self.job.data_root)

    @cached_property
    def data_digest(self) -> str:
        digest: str = self.dataset.digest(self.job.scene_name)
        return digest

    @cached_property
    def marked(self) -> InstanceMesh | ObjectBoxes:
        """The source of ground-truth masks: the annotated mesh, otherwise the boxes of objects."""
        try:
            mesh: InstanceMesh = self.dataset.instance_mesh(self.job.scene_name)
            return mesh
        except GroundTruthMissing:
            with suppress(GroundTruthMissing):
                if (boxes := self.truth("boxes").boxes) is not None:
                    return boxes
            raise

    @cached_property
    def poses(self) -> Float64Array:
        """The poses (N, 4, 4) of all frames, before any corruption."""
        return poses_of(self.dataset, self.job.scene_name)

    def report_activity(self, part: jobs.Part, activity: str) -> None:
        """Report the current activity while no frame is fed."""
        self.report(Event(self.job.scene, part.name, activity=activity))

    @cached_property
    def is_rendered(self) -> bool:
        return bool(getattr(self.dataset, "renders_frames", False))

    @property
    def opening(self) -> str:
        """The description of opening the scene."""
        return "generating the scene" if self.is_rendered else "reading the scene"

    def truth(self, variant: str) -> GroundTruth:
        if variant not in self.truths:
            self.truths[variant] = self.dataset.ground_truth(self.job.scene_name, variant)
        return self.truths[variant]

    @cached_property
    def first_truth(self) -> GroundTruth:
        """The first available variant, which methods that use ground truth receive."""
        missing = list[GroundTruthMissing]()
        for variant in self.dataset.variants:
            try:
                return self.truth(variant)
            except GroundTruthMissing as error:
                missing.append(error)
        raise missing[0]

    def corruption(self, part: jobs.Part) -> SceneCorruption | None:
        """The corruption of the inputs of ``part``, if there is one."""
        if part.corruption and part.name not in self._corruptions:
            name = self.job.scene_name
            self._corruptions[part.name] = SceneCorruption(
                parse_conditions(part.corruption), self.job.scene, self.job.config.seed,
                self.dataset.frames(name, 1), lambda: self.poses,
            )  # fmt: skip
        return self._corruptions.get(part.name)

    def frames(self, part: jobs.Part) -> frame_loop.ChosenFrames | CorruptedFrames:
        """The frames that a method gets, or in real time those that arrive."""
        frames = self.dataset.frames(self.job.scene_name, jobs.stride_of(self.job, part))
        first = frame_loop.ChosenFrames(frames, range(len(frames))[: self.job.config.limit or None])
        corruption = self.corruption(part)
        return CorruptedFrames(first, corruption) if corruption else first

    def true_proposals(self) -> Proposals:
        """Every annotated instance as a class-agnostic mask; raises ``GroundTruthMissing``."""
        if not self.dataset.variants:
            raise GroundTruthMissing(f"{self.job.scene}: proposals 'oracle' need ground truth, the dataset has none")
        return frame_loop.true_proposals(self.truth(self.dataset.variants[0]))

    def first_shown(self, part: jobs.Part) -> tuple[dict[str, list[Int32Array]], int]:
        """Which frame that a method gets shows each point first, by variant of the ground truth; and their number.

        A corruption changes only which frames these are: they count as they were before it.
        """
        frames, key = self.frames(part), (jobs.stride_of(self.job, part), part.corruption)
        if key not in self._shown:
            clouds = {}
            for rules in map(load_protocol, self.job.protocols):
                with suppress(GroundTruthMissing):
                    clouds[rules.ground_truth] = clouds_of(self.truth(rules.ground_truth))
            places = iter(first_shown([cloud for each in clouds.values() for cloud in each], self.clean_frames(part)))
            self._shown[key] = {variant: [next(places) for _ in each] for variant, each in clouds.items()}
        return self._shown[key], len(frames)

    def clean_frames(self, part: jobs.Part) -> Iterable[Frame]:
        """The frames that a method gets, as they were before any corruption."""
        frames = self.frames(part)
        return frames.clean if isinstance(frames, CorruptedFrames) else frames

    def maps(self, part: jobs.Part) -> list[tuple[Path, int]]:
        """The intermediate maps and the last one of ``part``, each with the number of frames shown until then."""
        n, folder = len(self.frames(part)), RunFolder(self.job.folder).job(self.job.scene, part.name)
        maps = [(folder.anytime(point), n_shown) for point, n_shown in self.job.config.anytime_points(n).items()]
        return [*maps, (folder.prediction, n)]

    def maps_over_time(self, part: jobs.Part, variant: str) -> tuple[list[tuple[Path, int]], GroundTruth, Int32Array]:
        """The maps of ``part``; the ground truth; and for each of its points the place of the first frame that shows
        it."""
        self.report_activity(part, "finding what the frames show")
        shown, _ = self.first_shown(part)
        return self.maps(part), self.truth(variant), shown[variant][0]
