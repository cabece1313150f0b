"""The ground truth of scenes as a map of which pictures are drawn, with what the questions on it are made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.config import read_assignments
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Frame, GroundTruth
from su3d_bench.questions.sight import instance_rows, looked_at
from su3d_bench.questions.truths import fullest_truth
from su3d_bench.runs.finished import read_run
from su3d_bench.runs.job import build_dataset, part_of
from su3d_bench.runs.scenes import data_root, dataset_targets, expand_scenes
from su3d_bench.sheets.making.run_source import chosen_of


class TruthSource:
    """The truth of ``scenes`` (``<dataset>/<scene>``); ``run`` and ``run_digest`` are empty where no run names them."""

    def __init__(
        self,
        scenes: Sequence[str],
        dataset_of: Callable[[str], Any],
        opener: Callable[[], TruthSource],
        run: str = "",
        run_digest: str = "",
    ) -> None:
        self.scenes, self.dataset, self.opener = tuple(scenes), dataset_of, opener
        self.run, self.run_digest = run, run_digest
        self.truth = lru_cache(maxsize=1)(self._truth)
        self._map_of = lru_cache(maxsize=1)(self._map)
        self._frames_of = lru_cache(maxsize=1)(self._frames)

    def instances(self, scene: str, method: str = "") -> Instances:
        """Every instance of the truth, whatever the method."""
        return self._map_of(scene)

    def frames(self, scene: str) -> tuple[Frame, ...]:
        """Those in which it was looked up what can be asked about."""
        return self._frames_of(scene)

    def _truth(self, scene: str) -> GroundTruth:
        return fullest_truth(self.dataset(scene), scene.partition("/")[2])

    def _map(self, scene: str) -> Instances:
        truth = self.truth(scene)
        rows_of = dict(instance_rows(truth, 1))
        classes = [int(np.bincount(truth.semantic[rows].clip(min=0)).argmax()) for rows in rows_of.values()]
        names = tuple(truth.labels.name_of(class_id) if class_id else "" for class_id in classes)
        return Instances.of(truth.points, list(rows_of.values()), names=names, ids=list(rows_of))

    def _frames(self, scene: str) -> tuple[Frame, ...]:
        dataset, name = self.dataset(scene), scene.partition("/")[2]
        return tuple(looked_at(dataset, name))


def truth_of_run(folder: Path, scenes: Sequence[str] = ()) -> TruthSource:
    """That of these scenes of a run, of all without any; other data than the run's are refused."""
    run = read_run(folder)
    chosen = chosen_of(run, "scene", scenes, run.scenes)
    return TruthSource(chosen, run.dataset, partial(truth_of_run, folder, chosen), run.name, run.record.code)


def truth_of_addresses(addresses: Sequence[str]) -> TruthSource:
    """That of every scene that an address or a pattern names."""
    settings = read_assignments((), (), ())
    parts = {target: part_of("dataset", target, settings) for target in dataset_targets(addresses)}
    chosen, _ = expand_scenes(addresses, parts)
    datasets = {part.name: build_dataset(part, data_root()) for part in parts.values()}
    return TruthSource(
        [f"{parts[target].name}/{scene}" for target, scene in chosen],
        lambda scene: datasets[scene.partition("/")[0]],
        partial(truth_of_addresses, [f"{target}/{scene}" for target, scene in chosen]),
    )
