"""The paper's own perception: RAM++, GroundingDINO, SAM and CLIP; optionally captions by a vision model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from su3d_bench.core.errors import ConfigError, suggest
from su3d_bench.core.interfaces import Encoder, RegionPerception, Segmenter, StageTimer
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, Regions
from su3d_bench.perception.cache import FrameCache, cached_regions, content_key, crop_images
from su3d_bench.perception.detections import Assembler, captioned
from su3d_bench.perception.language.captioner import Captioner
from su3d_bench.perception.language.chat import PRESETS
from su3d_bench.perception.models.catalogue import MODELS
from su3d_bench.perception.models.config import PaperConfig
from su3d_bench.perception.models.masks.automatic_masks import AUTOMATIC_MASKS
from su3d_bench.perception.models.masks.grounded_sam import (
    GROUNDED_MASKS,
    AutomaticSam,
    GroundedConfig,
    GroundedSam,
    Networks,
    SamRegions,
)

# OpenSU3D, section III-A.
PAPER_ENCODER, PAPER_SEGMENTER = "clip-vit-h-14", "sam-vit-h"
PAPER_VISION_MODEL = PRESETS["paper"]["vision_model"]


def paper_deviations(
    config: PaperConfig, networks: Networks, encoder: Encoder, captioner: Captioner | None
) -> list[str]:
    """The differences from OpenSU3D's paper, one clause each; empty if there are none."""
    deviations = [networks.tagger.caveat] if networks.tagger.caveat else []
    if config.segmenter != PAPER_SEGMENTER:
        deviations.append(f"masks: {config.segmenter} replaces the paper's {PAPER_SEGMENTER}")
    if others := _non_default_settings(config.grounded):
        deviations.append(f"named masks: {', '.join(others)} differ from OpenSU3D's settings")
    if encoder.name != MODELS[PAPER_ENCODER].known_as:
        deviations.append(f"features: {encoder.name} replaces the paper's {PAPER_ENCODER}")
    if captioner is None:
        deviations.append("names and captions: the tagger's names and a template replace the paper's vision model")
    elif captioner.vision_model != PAPER_VISION_MODEL:
        deviations.append(f"names and captions: {captioner.vision_model} replaces the paper's {PAPER_VISION_MODEL}")
    return deviations


def _non_default_settings(config: GroundedConfig) -> list[str]:
    """The settings of named masks, including those of boxes, that differ from the defaults."""
    given, papers = (
        {f"boxes.{name}": value for name, value in one.boxes} | {name: value for name, value in one if name != "boxes"}
        for one in (config, GroundedConfig())
    )
    return [name for name, value in given.items() if value != papers[name]]


class PaperPerception:
    """Foundation models; a method that names its own program's settings gets masks computed with these."""

    profile = "paper"

    def __init__(
        self,
        config: PaperConfig,
        networks: Networks,
        encoder: Encoder,
        cache: FrameCache,
        captioner: Captioner | None = None,
    ) -> None:
        self.encoder = encoder
        self.caveat: str | None = "; ".join(paper_deviations(config, networks, encoder, captioner)) or None
        self._networks = networks
        self._captioner = captioner
        self._cache = cache
        self._assembler = Assembler(encoder, cache)
        grounded = {"paper": config.grounded, **GROUNDED_MASKS}
        automatic = {**AUTOMATIC_MASKS, "sam": config.automatic}
        self._segmenters: Mapping[str, Mapping[str, Segmenter]] = {
            "grounded": {kind: GroundedSam(networks, settings) for kind, settings in grounded.items()},
            "class-agnostic": {kind: AutomaticSam(networks, settings) for kind, settings in automatic.items()},
        }
        captions = "" if captioner is None else captioner.digest
        digests = [segmenter.digest for known in self._segmenters.values() for segmenter in known.values()]
        self.digest = content_key(self.profile, *digests, encoder.digest, captions)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        assert needs.masks != "none", "the runner asks nothing for a method that needs no masks"
        regions = cached_regions(self._segmenter(needs), frame, self._cache, False, timer)
        # A region without a name is not an object that the paper's model was asked for.
        describe = captioned if self._captioner is None or needs.masks != "grounded" else self._described
        return self._assembler.assemble(frame, regions, needs, timer, describe=describe)

    def regions(self) -> RegionPerception:
        return SamRegions(self._networks, self.encoder)

    def _described(self, frame: Frame, regions: Regions, timer: StageTimer) -> Regions:
        """``regions`` named and described by the vision model."""
        assert self._captioner is not None and regions.names is not None
        with timer.stage("caption"):
            replies = self._captioner.captions(crop_images(frame.rgb, regions.boxes, 1.0), regions.names)
        names, captions = tuple(reply.name for reply in replies), tuple(reply.caption for reply in replies)
        return replace(regions, names=names, captions=captions)

    def _segmenter(self, needs: PerceptionNeeds) -> Segmenter:
        kind = needs.grounding if needs.masks == "grounded" else needs.automatic
        known = self._segmenters[needs.masks]
        if kind not in known:
            hint = suggest(kind, known)
            raise ConfigError(
                f"profile 'paper': the method needs {needs.masks} masks '{kind}', which are not available{hint}"
            )
        return known[kind]
