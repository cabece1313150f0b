"""What a run hands to methods that work on a whole scene: its frames, its mesh without labels, proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Detections, Frame, GroundTruth, PerceptionNeeds, Proposals, Surface


@dataclass(frozen=True)
class FirstFrames(Sequence[Frame]):
    """The first ``n`` of ``frames``, read anew at every access."""

    frames: Sequence[Frame]
    n: int

    def __len__(self) -> int:
        return self.n

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return [self.frames[i] for i in range(self.n)[index]]
        return self.frames[range(self.n)[index]]


def no_detections(frame: Frame, needs: PerceptionNeeds) -> Detections:
    """What a method that needs no masks gets."""
    return Detections(
        frame_index=frame.index,
        masks=np.zeros((0, *frame.depth_m.shape), np.bool_),
        boxes=np.zeros((0, 4), np.float32),
        scores=np.zeros(0, np.float32),
        names=(),
        captions=(),
        crop_ratios=needs.crop_ratios,
        crop_features=np.zeros((0, len(needs.crop_ratios), 0), np.float32),
        global_feature=np.zeros(0, np.float32),
    )


def surface_of(dataset: Any, scene: str) -> Surface:
    """The mesh of a scene without labels; ``DataError`` where its dataset has none."""
    if not hasattr(dataset, "surface"):
        raise DataError(f"{dataset.name}/{scene}: the dataset has no mesh; this method works on one")
    surface: Surface = dataset.surface(scene)
    return surface


def true_proposals(truth: GroundTruth) -> Proposals:
    """Every annotated instance of ``truth`` as a class-agnostic mask, in the order of the instance ids."""
    order = np.argsort(truth.instance, kind="stable").astype(np.int32)
    order = order[truth.instance[order] > 0]
    n_points = np.unique(truth.instance[order], return_counts=True)[1]
    indptr = np.cumsum([0, *n_points]).astype(np.int64)
    return Proposals(truth.points, indptr, order, np.ones(len(n_points)), "ground truth")
