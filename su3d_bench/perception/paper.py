"""The paper's own front end: RAM++, GroundingDINO, SAM and CLIP; captions by a vision model where asked for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.interfaces import Encoder, RegionPerception, Segmenter, StageTimer
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, Regions
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.config import PerceptionConfig
from su3d_bench.perception.crops import crop_images
from su3d_bench.perception.embedded.naming import scene_caption
from su3d_bench.perception.language.captioner import Captioner
from su3d_bench.perception.models.masks.automatic_masks import AUTOMATIC_MASKS, AutomaticMaskConfig
from su3d_bench.perception.models.masks.grounded_sam import (
    GROUNDED_MASKS,
    AutomaticSam,
    GroundedConfig,
    GroundedSam,
    Networks,
    SamRegions,
)
from su3d_bench.perception.regions import CropEncoder, NameEncoder, cached_regions, grown_boxes, regions_to_keep

# What of the language model's settings moves a caption; times, prices and limits do not.
MOVES_CAPTIONS = {"vision_model", "temperature", "seed", "max_answer_tokens", "image_detail", "max_image_px"}


class PaperPerception:
    """Foundation models; a method gets the masks that its own program makes of them where it names the settings."""

    profile = "paper"

    def __init__(
        self,
        config: PerceptionConfig,
        networks: Networks,
        encoder: Encoder,
        cache: FrameCache,
        captioner: Captioner | None = None,
    ) -> None:
        self.encoder = encoder
        self.caveat = networks.tagger.caveat
        self._networks = networks
        self._captioner = captioner
        self._cache = cache
        self._crops = CropEncoder(encoder, cache)
        self._names = NameEncoder(encoder)
        self._grounded: Mapping[str, GroundedConfig] = {"paper": config.paper.grounded, **GROUNDED_MASKS}
        self._automatic: Mapping[str, AutomaticMaskConfig] = {**AUTOMATIC_MASKS, "sam": config.paper.automatic}
        self._segmenters: dict[tuple[str, str], Segmenter] = {}
        language = config.language.model_dump_json(include=MOVES_CAPTIONS) if captioner is not None else ""
        grounded = [GroundedSam(networks, settings).digest for settings in self._grounded.values()]
        automatic = [AutomaticSam(networks, settings).digest for settings in self._automatic.values()]
        self.digest = content_key(self.profile, *grounded, *automatic, encoder.digest, language)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        assert needs.masks != "none", "the runner asks nothing for a method that needs no masks"
        regions = cached_regions(self._segmenter(needs), frame, self._cache, False, timer)
        assert regions.names is not None
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        names, captions = self._words(frame, regions, kept, timer)
        boxes = grown_boxes(regions.boxes, needs.crop_padding_px)
        return Detections(
            frame_index=frame.index,
            masks=regions.masks[kept],
            boxes=regions.boxes[kept],
            scores=regions.scores[kept],
            names=names,
            captions=captions,
            crop_ratios=needs.crop_ratios,
            crop_features=self._crops.crops(frame, boxes, kept, needs.crop_ratios, timer),
            global_feature=self._crops.whole(frame, timer),
            name_features=self._names.features(names, needs),
            score_scale="published",
        )

    def regions(self) -> RegionPerception:
        return SamRegions(self._networks, self.encoder)

    def _words(
        self, frame: Frame, regions: Regions, kept: np.typing.NDArray[np.intp], timer: StageTimer
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and captions of the regions that are kept."""
        assert regions.names is not None
        names = tuple(regions.names[k] for k in kept)
        if self._captioner is None:
            return names, tuple(scene_caption(name) for name in names)
        with timer.stage("caption"):
            found = self._captioner.captions(crop_images(frame.rgb, regions.boxes[kept], 1.0), names)
        return tuple(one.name for one in found), tuple(one.caption for one in found)

    def _segmenter(self, needs: PerceptionNeeds) -> Segmenter:
        kind = needs.grounding if needs.masks == "grounded" else needs.automatic
        if (needs.masks, kind) not in self._segmenters:
            self._segmenters[needs.masks, kind] = self._new_segmenter(needs.masks, kind)
        return self._segmenters[needs.masks, kind]

    def _new_segmenter(self, masks: str, kind: str) -> Segmenter:
        known: Mapping[str, object] = self._grounded if masks == "grounded" else self._automatic
        if kind not in known:
            hint = suggest(kind, list(known)) or "; known: " + ", ".join(known)
            raise ConfigError(f"profile 'paper': the method asks for {masks} masks '{kind}', there are none{hint}")
        if masks == "grounded":
            return GroundedSam(self._networks, self._grounded[kind])
        return AutomaticSam(self._networks, self._automatic[kind])
