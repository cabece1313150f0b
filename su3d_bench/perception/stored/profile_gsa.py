"""The profile of ConceptGraphs' detections, which were made by its own scripts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import Detections, Float32Array, Frame, PerceptionNeeds, SceneInfo
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.embedded.naming import scene_caption
from su3d_bench.perception.features import CropEncoder, NameEncoder, grown_boxes, regions_to_keep
from su3d_bench.perception.stored.gsa_files import GsaFiles, GsaFrame
from su3d_bench.perception.stored.perception import STORED_CAVEAT, StoredRegions, content_digest

# Who made the features in the files, and of which crops: boxes and 20 px on every side.
FEATURES_ENCODER, FEATURES_PADDING_PX = "clip-vit-h-14", 20


class GsaPerception:
    """Regions from files; their features too where the run has the encoder, and the crops, that made them."""

    profile = "stored"
    caveat: str | None = STORED_CAVEAT

    def __init__(self, folder: Path, pattern: str, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self._files = GsaFiles(folder, pattern, scene)
        self._crops = CropEncoder(encoder, cache)
        self._names = NameEncoder(encoder)
        self.digest = content_key(self.profile, "gsa", content_digest(self._files.files), encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("cache"):
            found = self._files.frame(frame)
        regions = found.regions
        assert regions.names is not None
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        names = tuple(regions.names[k] for k in kept)
        boxes = grown_boxes(regions.boxes, needs.crop_padding_px)
        known = self._known(found, needs)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=names,
            captions=tuple(scene_caption(name) for name in names),
            crop_ratios=needs.crop_ratios,
            crop_features=self._crops.crops(frame, boxes, np.asarray(kept), needs.crop_ratios, timer, known),
            global_feature=self._crops.whole(frame, timer),
            name_features=self._names.features(names, needs),
            score_scale="published",
        )

    def regions(self) -> RegionPerception:
        return StoredRegions(lambda frame: self._files.frame(frame).regions.masks, self.encoder)

    def _known(self, found: GsaFrame, needs: PerceptionNeeds) -> dict[float, Float32Array] | None:
        features = found.image_features
        if features is None or needs.crop_padding_px != FEATURES_PADDING_PX or self.encoder.name != FEATURES_ENCODER:
            return None
        return {1.0: features} if features.shape[1] == self.encoder.dim else None
