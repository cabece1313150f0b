"""The profile without weights: geometric segmentation, the embedded encoder, names by zero-shot classification."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import Detections, Float32Array, Frame, PerceptionNeeds, SceneInfo
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.config import PerceptionConfig
from su3d_bench.perception.embedded.naming import Namer, colour_word, scene_caption
from su3d_bench.perception.embedded.segmenter.segmenter import RgbdSegmenter
from su3d_bench.perception.regions import (
    CropEncoder,
    NameEncoder,
    SegmentedRegions,
    cached_regions,
    grown_boxes,
    regions_to_keep,
)

CAMERA_CAVEAT = (
    "embedded perception on camera images: its encoder has seen rendered rooms only, so names and labels mean little "
    "here; use --profile paper, or --profile stored with detections made by real models"
)


class EmbeddedPerception:
    """Geometric segmentation of the frame, names by the encoder, captions from a template."""

    profile = "embedded"

    def __init__(self, config: PerceptionConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache) -> None:
        self.encoder = encoder
        self.caveat = CAMERA_CAVEAT if scene.image_domain == "camera" else None
        self._segmenters = {
            "grounded": RgbdSegmenter(config.segmenter, "objects"),
            "class-agnostic": RgbdSegmenter(config.segmenter, "parts"),
        }
        self._namer = Namer(config.naming, encoder)
        self._cache = cache
        self._crops = CropEncoder(encoder, cache)
        self._names = NameEncoder(encoder)
        digests = [segmenter.digest for segmenter in self._segmenters.values()]
        self.digest = content_key(self.profile, *digests, self._namer.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        assert needs.masks != "none", "the runner asks nothing for a method that needs no masks"
        regions = cached_regions(self._segmenters[needs.masks], frame, self._cache, False, timer)
        everything = np.arange(len(regions.boxes))
        best_fit = self._crops.crops(frame, regions.boxes, everything, (1.0,), timer)[:, 0]
        with timer.stage("encode"):
            named = self._namer.name(best_fit)
        kept = regions_to_keep(named.names, regions.boxes, frame.depth_m.shape, needs)
        masks = regions.masks[kept]
        names = tuple(named.names[k] for k in kept)
        with timer.stage("encode"):
            colours = [colour_word(frame.rgb, mask) for mask in masks]
        return Detections(
            frame_index=frame.index,
            masks=masks,
            boxes=regions.boxes[kept],
            scores=(regions.scores[kept] * named.confidences[kept]).astype(np.float32),
            names=names,
            captions=tuple(scene_caption(name, colour) for name, colour in zip(names, colours, strict=True)),
            crop_ratios=needs.crop_ratios,
            crop_features=self._features(frame, regions.boxes, kept, needs, best_fit, timer),
            global_feature=self._crops.whole(frame, timer),
            name_features=self._names.features(names, needs),
            score_scale="own",
        )

    def _features(
        self,
        frame: Frame,
        boxes: Float32Array,
        kept: NDArray[np.intp],
        needs: PerceptionNeeds,
        best_fit: Float32Array,
        timer: StageTimer,
    ) -> Float32Array:
        known = None if needs.crop_padding_px else {1.0: best_fit}
        grown = grown_boxes(boxes, needs.crop_padding_px)
        return self._crops.crops(frame, grown, kept, needs.crop_ratios, timer, known)

    def regions(self) -> RegionPerception:
        return SegmentedRegions(self._segmenters["class-agnostic"], self.encoder, self._cache)
