"""Parts of runs that are killed on purpose: lightweight, but writing every kind of file of a run.

Importing this replaces perception by ``KeptPerception``, also in worker processes.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np

if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

from painted import Collector, ColourPerception, Painted

from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import DenseFeatures, Prediction
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.runs import scene as scene_run

logger = logging.getLogger("su3d_bench.kill_subject")


class Dense(Collector):
    """Every point with the feature of its colour, and a warning that the run's record must contain."""

    name = "dense"

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        if not self._points:
            logger.warning("the first frame is %d", frame.index)
        super().update(frame, detections, timer)

    def finish(self) -> Prediction:
        clouds = [np.concatenate(self._points[name]) for name in sorted(self._points)]
        features = [self._features[name] for name in sorted(self._points)]
        rows = [np.tile(feature, (len(cloud), 1)) for feature, cloud in zip(features, clouds, strict=True)]
        return DenseFeatures(np.concatenate(clouds).astype(np.float32), np.concatenate(rows).astype(np.float16))


class KeptPerception(ColourPerception):
    """Masks that are stored in the perception cache."""

    def __init__(self, cache_root: Path) -> None:
        super().__init__()
        self._cache = FrameCache(cache_root)

    def regions(self) -> None:
        """For a method that has its own perception."""

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        key = content_key(self.digest, self._cache.frame_digest(frame, with_pose=False))
        found = super().detect(frame, needs, timer)
        kept = self._cache.load(key)
        if kept is None:
            self._cache.save(key, {"masks": found.masks})
        elif not np.array_equal(kept["masks"], found.masks):
            raise AssertionError("the perception cache returned masks of another frame")
        return found


def kept_perception(*_: Any, cache_root: Path, **__: Any) -> KeptPerception:
    return KeptPerception(cache_root)


scene_run.build_perception = kept_perception  # type: ignore[attr-defined, assignment]

__all__ = ["Dense", "Painted"]
