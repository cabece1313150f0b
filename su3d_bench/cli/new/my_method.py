"""A first method: every mask is an instance until another holds half of its points. Make it yours."""

from __future__ import annotations

import itertools

import numpy as np
import pydantic

from su3d_bench import Detections, Frame, Instances, PerceptionNeeds, SceneInfo, Timer, back_project


class MyMethod:
    name = "my-method"

    class Config(pydantic.BaseModel):
        model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

        stride: int = 40  # frames from one update to the next
        cell_m: float = 0.05  # two points are one where they lie in the same cell
        least_points: int = 20

    def __init__(self, config: Config) -> None:
        self._config = config

    @property
    def needs(self) -> PerceptionNeeds:
        """Masks of named objects, and one feature of each mask's crop."""
        return PerceptionNeeds(masks="grounded", crop_ratios=(1.0,))

    def start(self, scene: SceneInfo) -> None:
        """A new scene; nothing of the last one may stay."""
        self._cells: list[dict[tuple[int, ...], np.ndarray]] = []  # of each instance: a point in each of its cells
        self._features: list[list[np.ndarray]] = []

    def update(self, frame: Frame, detections: Detections, timer: Timer) -> None:
        """One image: ``detections.masks`` (K, H, W) with their features (K, 1, D)."""
        with timer.stage("match"):
            for mask, feature in zip(detections.masks, detections.crop_features[:, 0], strict=True):
                points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, mask)
                cells = dict(zip(map(tuple, np.floor(points / self._config.cell_m).astype(int)), points, strict=True))
                shared = [len(cells.keys() & known.keys()) / max(1, len(cells)) for known in self._cells]
                if max(shared, default=0.0) < 0.5:
                    self._cells.append({})
                    self._features.append([])
                best = int(np.argmax(shared)) if max(shared, default=0.0) >= 0.5 else -1
                self._cells[best] |= cells
                self._features[best].append(feature)

    def finish(self) -> Instances:
        """The map: points (N, 3) in metres, each instance's rows of them, its score and its feature (D,)."""
        kept = [k for k, cells in enumerate(self._cells) if len(cells) >= self._config.least_points]
        clouds = [np.array(list(self._cells[k].values()), np.float32) for k in kept]
        ends = np.cumsum([0, *map(len, clouds)])
        masks = [np.arange(start, end) for start, end in itertools.pairwise(ends)]
        points = np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)
        features = np.array([np.mean(self._features[k], axis=0) for k in kept], np.float32) if kept else None
        return Instances.of(points, masks, np.ones(len(kept)), features)
