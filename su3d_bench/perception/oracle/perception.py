"""The profile of perfect masks: the ground truth seen from each frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Frame,
    InstanceMesh,
    Int64Array,
    PerceptionNeeds,
    Regions,
)
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.config import PerceptionConfig
from su3d_bench.perception.embedded.naming import scene_caption, with_article
from su3d_bench.perception.oracle.segmenter import OracleSegmenter
from su3d_bench.perception.regions import NameEncoder, cached_regions, region_under, regions_to_keep

ORACLE_CAVEAT = "oracle perception: masks and names come from the ground truth; a ceiling, not a result"


class OraclePerception:
    """The ground truth seen from the frame; features are those of the class names, alike at every ratio."""

    profile = "oracle"
    caveat: str | None = ORACLE_CAVEAT

    def __init__(self, config: PerceptionConfig, mesh: InstanceMesh, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self._prompt = config.oracle.prompt
        self._segmenter = OracleSegmenter(mesh, config.oracle)
        self._cache = cache
        self._names = NameEncoder(encoder)
        self._feature_of_name: dict[str, Float32Array] = {}
        self.digest = content_key(self.profile, self._segmenter.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        regions = cached_regions(self._segmenter, frame, self._cache, True, timer)
        assert regions.names is not None
        with timer.stage("encode"):
            features = self._name_features(regions.names)
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        mean = features.astype(np.float64).sum(axis=0)
        length = float(np.linalg.norm(mean))
        names = tuple(regions.names[k] for k in kept)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=names,
            captions=tuple(scene_caption(name) for name in names),
            crop_ratios=needs.crop_ratios,
            crop_features=np.repeat(features[kept][:, None], len(needs.crop_ratios), axis=1),
            global_feature=(mean / length if length > 0 else mean).astype(np.float32),
            name_features=self._names.features(names, needs),
        )

    def regions(self) -> RegionPerception:
        return OracleRegions(self._segmenter, self.encoder.dim, self._name_features)

    def _name_features(self, names: tuple[str, ...]) -> Float32Array:
        for name in names:
            if name not in self._feature_of_name:
                prompt = self._prompt.replace("{}", with_article(name))
                self._feature_of_name[name] = self.encoder.encode_texts([prompt])[0]
        features = [self._feature_of_name[name] for name in names]
        return np.array(features, np.float32).reshape(len(names), self.encoder.dim)


class OracleRegions:
    """``RegionPerception`` from the truth: the instance under the points, the feature of its name for every crop."""

    def __init__(
        self, segmenter: OracleSegmenter, dim: int, feature_of: Callable[[tuple[str, ...]], Float32Array]
    ) -> None:
        self.dim = dim
        self._segmenter = segmenter
        self._feature_of = feature_of
        self._last: tuple[Frame, Regions] | None = None

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """The mask of the instance that holds most of ``points``, as sure as their share; empty and 0 for none."""
        regions = self._regions(frame)
        best, share = region_under(regions.masks, points)
        return (regions.masks[best], share) if best >= 0 else (np.zeros(frame.depth_m.shape, np.bool_), 0.0)

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """The name feature of the instance that most of ``mask`` belongs to; zeros where it belongs to none."""
        regions = self._regions(frame)
        rows, columns = np.nonzero(mask)
        best, _ = region_under(regions.masks, np.stack([columns, rows], axis=1))
        if best < 0:
            return np.zeros((len(boxes), self.dim), np.float32)
        assert regions.names is not None
        return np.repeat(self._feature_of((regions.names[best],)), len(boxes), axis=0)

    def _regions(self, frame: Frame) -> Regions:
        if self._last is None or self._last[0] is not frame:
            self._last = frame, self._segmenter.segment(frame)
        return self._last[1]
