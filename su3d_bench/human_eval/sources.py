"""Sources of sheets: maps, frames and ground truth of a finished run, or the ground truth of scenes alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from copy import copy
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from su3d_bench.core import errors
from su3d_bench.core.errors import ConfigError, GroundTruthMissing, printable
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import Frame, GroundTruth
from su3d_bench.metrics.compatibility import TruthFacts, truth_incompatibility
from su3d_bench.metrics.instance.score import CoveredObjects, covered_objects
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import RefinedNames
from su3d_bench.questions.refining import refined_names
from su3d_bench.questions.scene_map import SceneMap, map_of
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.store.predictions import read_prediction

MAX_FRAMES = 32  # frames per scene among which the best view of an object is searched


def chosen_of(run: FinishedRun, what: str, wanted: Sequence[str], known: tuple[str, ...]) -> tuple[str, ...]:
    """The ``wanted`` names, which the run must have; all by default."""
    for name in wanted:
        if name not in known:
            hint = errors.suggest(name, known, "it has")
            raise ConfigError(f"{run.name}: has no {what} '{printable(name, 80)}'{hint}")
    return tuple(dict.fromkeys(wanted)) or known


class RunSource:
    """The maps of a run and the data that they were made from; other data are rejected."""

    def __init__(self, run: FinishedRun, methods: Sequence[str] = (), scenes: Sequence[str] = ()) -> None:
        self.run = run
        self.methods = chosen_of(run, "method", methods, run.methods)
        self.scenes = chosen_of(run, "scene", scenes, run.scenes)
        self.prediction = lru_cache(maxsize=len(self.methods))(self._prediction)
        self._covered: dict[tuple[str, str, bytes], CoveredObjects] = {}
        self._truths = lru_cache(maxsize=2)(self._read_truth)
        self._frames_at = lru_cache(maxsize=len(self.methods))(self._read_frames)

    @property
    def opener(self) -> Callable[[], RunSource]:
        """Open the same run in another process."""
        return partial(_opened, self.run.folder.path, self.methods)

    def of_methods(self, methods: Sequence[str]) -> RunSource:
        """The same run with only these of its methods; data already read are shared."""
        other = copy(self)
        other.methods = tuple(methods)
        return other

    def has_instances(self, scene: str, method: str) -> bool:
        """Whether the map of a scene has instances, so that labels, masks and answers about them can be judged."""
        return isinstance(self.prediction(scene, method), Instances)

    def has_features(self, scene: str, method: str) -> bool:
        """Whether the map of a scene can be queried by text: it has features of instances or of points."""
        prediction = self.prediction(scene, method)
        if isinstance(prediction, Instances):
            return prediction.features is not None
        return isinstance(prediction, DenseFeatures)

    def instances(self, scene: str, method: str) -> Instances:
        """The map of a scene; a ``PredictionError`` if it has no instances."""
        prediction = self.prediction(scene, method)
        if not isinstance(prediction, Instances):
            raise errors.PredictionError(
                f"{printable(str(self.run.folder.job(scene, method).prediction), 200)}: has no instances to "
                f"judge; exclude {printable(method, 80)} with --methods"
            )
        return prediction

    def _prediction(self, scene: str, method: str) -> Prediction:
        job = self.run.folder.job(scene, method)
        if not job.prediction.is_file():
            raise errors.StoreError(
                f"{self.run.name}: has no map of {printable(scene, 100)} by {printable(method, 80)}; run it, or "
                "exclude it with --methods or --scenes"
            )
        return read_prediction(job.prediction)

    def refined(self, scene: str, method: str) -> RefinedNames | None:
        """Labels n' of the map's instances; None if not computed."""
        return refined_names(self.run.folder.job(scene, method), self.instances(scene, method))

    def scene_map(self, scene: str, method: str) -> SceneMap:
        """The map for answering questions, under labels n' and without the instances they exclude, if it has them."""
        return map_of(self.instances(scene, method), self.refined(scene, method))

    def frames(self, scene: str) -> tuple[Frame, ...]:
        """Some of the frames from which the maps were made, spread over the scene, and equal for all methods."""
        n = len(self.run.dataset(scene).frames(scene.partition("/")[2], 1))
        maps = (self.prediction(scene, method) for method in self.methods)
        views = [a_map.views[:, 0] for a_map in maps if isinstance(a_map, Instances)]
        of_views = np.unique(np.concatenate([np.zeros(0, np.int32), *views]))
        indices = of_views[(of_views >= 0) & (of_views < n)] if len(of_views) else np.arange(n)
        chosen = np.unique(np.linspace(0, len(indices) - 1, min(MAX_FRAMES, len(indices))).astype(np.int64))
        return self._frames_at(scene, tuple(int(indices[k]) for k in chosen))

    def _read_frames(self, scene: str, indices: tuple[int, ...]) -> tuple[Frame, ...]:
        frames = self.run.dataset(scene).frames(scene.partition("/")[2], 1)
        return tuple(frames[index] for index in indices)

    def rules(self, scene: str, kind: str) -> ProtocolRules | None:
        """The first rules that can judge a scene automatically; None if there are none."""
        name = scene.partition("/")[0]
        known = protocol_names()
        own = [self.run.rules(protocol) for protocol in self.run.protocols if protocol not in known]
        for rules in (*own, *map(load_protocol, known)):
            is_meant = rules.kind == kind and (name in rules.datasets or rules in own)
            if is_meant and truth_incompatibility(rules, TruthFacts.of_dataset(self.run.dataset(scene))) is None:
                return rules
        return None

    def truth(self, scene: str, rules: ProtocolRules | None) -> GroundTruth | None:
        """The ground truth required by ``rules``; None if unavailable."""
        return None if rules is None else self._truths(scene, rules.ground_truth)

    def _read_truth(self, scene: str, variant: str) -> GroundTruth | None:
        try:
            truth: GroundTruth = self.run.dataset(scene).ground_truth(scene.partition("/")[2], variant)
        except GroundTruthMissing:
            return None
        return truth

    def covered(self, scene: str, rules: ProtocolRules | None, instances: Instances) -> CoveredObjects | None:
        """The ground truth covered by each instance, computed once for equal masks; None without ground truth."""
        truth = self.truth(scene, rules)
        if rules is None or truth is None:
            return None
        key = (scene, rules.name, mask_digest(instances, range(len(instances))))
        if key not in self._covered:
            self._covered = {old: covered for old, covered in self._covered.items() if old[0] == scene}
            self._covered[key] = covered_objects(rules.transfer, truth, instances)
        return self._covered[key]


def _opened(run: Path, methods: Sequence[str]) -> RunSource:
    return RunSource(read_run(run), methods)


def mask_digest(instances: Instances, rows: Sequence[int]) -> bytes:
    """A key of the instances' points, so that equal masks of several maps are recognised."""
    total = hashlib.sha256()
    for row in rows:
        total.update(np.ascontiguousarray(instances.points[instances.mask(row)]).tobytes())
        total.update(b"|")
    return total.digest()
