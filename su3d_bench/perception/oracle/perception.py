"""The profile of perfect masks: the ground truth seen from each frame."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.english import with_article
from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Frame,
    InstanceMesh,
    Int64Array,
    ObjectBoxes,
    PerceptionNeeds,
)
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.detections import Assembler
from su3d_bench.perception.oracle.segmenter import OracleConfig, OracleSegmenter
from su3d_bench.perception.regions import RegionsOnDemand, cached_regions, region_under

ORACLE_CAVEAT = "oracle perception: masks and names come from the ground truth; a ceiling, not a result"


class OraclePerception:
    """The ground truth seen from the frame; features are those of the class names, alike at every ratio."""

    profile = "oracle"
    caveat: str | None = ORACLE_CAVEAT

    def __init__(
        self, config: OracleConfig, truth: InstanceMesh | ObjectBoxes, encoder: Encoder, cache: FrameCache
    ) -> None:
        self.encoder = encoder
        self.segmenter = OracleSegmenter(truth, config)
        self._prompt = config.prompt
        self._cache = cache
        self._assembler = Assembler(encoder, cache)
        self.digest = content_key(self.profile, self.segmenter.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        regions = cached_regions(self.segmenter, frame, self._cache, True, timer)
        assert regions.names is not None
        with timer.stage("encode"):
            features = self.features_of(regions.names)
        mean = features.astype(np.float64).sum(axis=0)
        length = float(np.linalg.norm(mean))
        whole = (mean / length if length > 0 else mean).astype(np.float32)
        known = dict.fromkeys(needs.crop_ratios, features)
        return self._assembler.assemble(frame, regions, needs, timer, known=known, global_feature=whole)

    def regions(self) -> RegionPerception:
        return OracleRegions(self)

    def features_of(self, names: tuple[str, ...]) -> Float32Array:
        """The features (K, D) of class names in the prompt."""
        prompts = [self._prompt.replace("{}", with_article(name)) for name in names]
        rows = [self._assembler.text_features([prompt]) for prompt in prompts]  # one by one: none depends on another
        return np.array(rows, np.float32).reshape(len(names), self.encoder.dim)


class OracleRegions(RegionsOnDemand):
    """``RegionPerception`` from the truth: the instance under the points, the feature of its name for every crop."""

    def __init__(self, oracle: OraclePerception) -> None:
        super().__init__(oracle.segmenter.segment, oracle.encoder)
        self._features_of = oracle.features_of

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """The name feature of the instance that most of ``mask`` belongs to; zeros where it belongs to none."""
        regions = self._regions(frame)
        rows, columns = np.nonzero(mask)
        best, _ = region_under(regions.masks, np.stack([columns, rows], axis=1))
        if best < 0:
            return np.zeros((len(boxes), self.dim), np.float32)
        assert regions.names is not None
        return np.repeat(self._features_of((regions.names[best],)), len(boxes), axis=0)
