"""What a page reads of the data of one scene: truths and frames, each read once whoever asks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from su3d_bench.core.interfaces import HasSketches
from su3d_bench.core.types import Frame, GroundTruth
from su3d_bench.metrics.matching.nearest import Candidates
from su3d_bench.reports.pictures.scene import spread
from su3d_bench.runs.finished import FinishedRun

MOST_LOOKED_AT = 48  # frames of a scene
SKETCH_WIDTH = 160  # of a frame to look at, where that saves time


class SceneData:
    """The data of one scene, of each dataset that is asked for: a run keeps its datasets."""

    def __init__(self, scene: str) -> None:
        self._name = scene.partition("/")[2]
        self._scene = scene
        self._truths: dict[tuple[int, str], GroundTruth] = {}
        self._candidates: dict[int, Candidates] = {}  # of truths that are kept above
        self._sequences: dict[int, Sequence[Frame]] = {}
        self._frames: dict[tuple[int, int, int], Frame] = {}

    def truth(self, dataset: Any, variant: str) -> GroundTruth:
        key = id(dataset), variant
        if key not in self._truths:
            self._truths[key] = dataset.ground_truth(self._name, variant)
        return self._truths[key]

    def candidates(self, truth: GroundTruth) -> Candidates:
        """The points of a truth, to be asked for what is nearest."""
        if id(truth) not in self._candidates:
            self._candidates[id(truth)] = Candidates(truth.points)
        return self._candidates[id(truth)]

    def truth_of_run(self, run: FinishedRun, variant: str) -> GroundTruth:
        """The truth in the data of ``run``, which must be those that it was made from."""
        return self.truth(run.dataset(self._scene), variant)

    def sequence(self, dataset: Any) -> Sequence[Frame]:
        """Every frame, in order."""
        if id(dataset) not in self._sequences:
            self._sequences[id(dataset)] = dataset.frames(self._name, 1)
        return self._sequences[id(dataset)]

    def frame(self, dataset: Any, index: int, width: int) -> Frame:
        """Frame ``index`` of the sequence, of ``width`` pixels where a smaller one is had sooner, else as it is."""
        has_sketches = isinstance(dataset, HasSketches)
        key = id(dataset), index, width if has_sketches else 0
        if key not in self._frames:
            sketched = dataset.sketch(self._name, index, width) if has_sketches else None
            self._frames[key] = self.sequence(dataset)[index] if sketched is None else sketched
        return self._frames[key]

    def in_turn(self, dataset: Any, fed: Iterable[int]) -> list[int]:
        """The frames to look at, far ones first: of those that methods were ``fed``, of all where none is known."""
        n_frames = len(self.sequence(dataset))
        known = sorted({index for index in fed if 0 <= index < n_frames}) or range(n_frames)
        return [known[place] for place in spread(len(known), MOST_LOOKED_AT)]
