"""GroundedSAM: tags of the image, boxes of what they name, masks in the boxes; and SAM without any tag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, Frame, Int64Array, Regions
from su3d_bench.perception.cache import CropsOnDemand, OfLastFrame, content_key, mask_boxes
from su3d_bench.perception.models.encoders.images import Resample
from su3d_bench.perception.models.masks.automatic_masks import AutomaticMaskConfig, AutomaticMasks
from su3d_bench.perception.models.masks.grounding_dino import CONCEPTGRAPHS_BOXES, BoxConfig, GroundingDino
from su3d_bench.perception.models.masks.sam import Sam
from su3d_bench.perception.models.masks.tagging import ADDED_TAGS, BACKGROUND_TAGS, STOP_WORDS, Tagger, chosen_tags

# Moves the digest when what lies between the networks changes.
FRONT_END_VERSION = "2"
# ConceptGraphs calls every region so that no text named; a method that needs better names asks for grounded masks.
UNNAMED = "item"


class GroundedConfig(BaseModel):
    """How named regions come about; the defaults are OpenSU3D's.

    ``masks``: SAM's best of three in each box by predicted IoU, or the one that it gives when asked for one, as in the
    Grounded-SAM demonstrations. ``region_boxes``: the mask's, or the detector's, which may reach beyond the image. Tags
    that contain one of ``stop_words`` are left out, ``added_tags`` are asked for in every image. ``ram_resample``: how
    RAM++'s picture is made small; its own package does it bilinear.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    boxes: BoxConfig = BoxConfig()
    stop_words: tuple[str, ...] = ()
    added_tags: tuple[str, ...] = ()
    masks: Literal["best-of-three", "single"] = "best-of-three"
    region_boxes: Literal["mask", "detector"] = "mask"
    ram_resample: Resample = "bilinear"


# generate_gsa_results.py --class_set ram --add_bg_classes (5c4da70); its --accumu_classes carries tags on from frame to
# frame in an order that changes from run to run, and is left out. Its picture for RAM is Pillow's resize, whose default
# is bicubic. The tagger is the run's: its README names RAM (ram_swin_large_14m.pth), not RAM++.
_CONCEPTGRAPHS = GroundedConfig(
    boxes=CONCEPTGRAPHS_BOXES,
    stop_words=STOP_WORDS,
    added_tags=(*ADDED_TAGS, *BACKGROUND_TAGS),
    region_boxes="detector",
    ram_resample="bicubic",
)
# What methods ask for by PerceptionNeeds.grounding; "paper" is configured.
GROUNDED_MASKS: Mapping[str, GroundedConfig] = MappingProxyType(
    {
        "conceptgraphs": _CONCEPTGRAPHS,
        "conceptgraphs-whole-tags": _CONCEPTGRAPHS.model_copy(
            update={"boxes": CONCEPTGRAPHS_BOXES.model_copy(update={"names": "tag"})}
        ),
    }
)


@dataclass(frozen=True)
class Networks:
    """What the segmenters run, read from disk when first asked for; ``digest`` moves with weights and precision."""

    tagger: Tagger
    load_detector: Callable[[], GroundingDino]
    load_sam: Callable[[], Sam]
    digest: str


class GroundedSam:
    """``Segmenter`` of named regions."""

    name = "grounded-sam"

    def __init__(self, networks: Networks, config: GroundedConfig) -> None:
        self._networks = networks
        self._config = config
        settings = config.model_dump_json()
        self.digest = content_key(self.name, FRONT_END_VERSION, settings, networks.tagger.digest, networks.digest)

    def segment(self, frame: Frame) -> Regions:
        """Named regions, the detector's best first; empty where no tag is found."""
        config = self._config
        found = self._networks.tagger.tags(frame.rgb, config.ram_resample)
        tags = chosen_tags(found, config.stop_words, config.added_tags)
        named = self._networks.load_detector().detect(frame.rgb, tags, config.boxes)
        height, width = frame.rgb.shape[:2]
        if not len(named.names):
            return Regions(np.zeros((0, height, width), bool), named.boxes, named.scores, ())
        sam = self._networks.load_sam()
        image = sam.look(frame.rgb)
        masks, _ = sam.from_boxes(image, named.boxes, is_single=config.masks == "single")
        kept = np.flatnonzero(masks.any(axis=(1, 2)))
        masks, named = masks[kept], named.at(kept)
        boxes = mask_boxes(masks) if config.region_boxes == "mask" else named.boxes
        return Regions(masks, boxes, named.scores, named.names)


class SamRegions(CropsOnDemand):
    """``RegionPerception``: one mask at points that a method chooses; SAM looks at each frame once."""

    def __init__(self, networks: Networks, encoder: Encoder) -> None:
        super().__init__(encoder)
        self._networks = networks
        self._seen = OfLastFrame(lambda frame: networks.load_sam().look(frame.rgb))

    def mask_at(self, frame: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        """SAM's single mask (H, W) of what all ``points`` lie on and its predicted IoU; empty and 0 for no points."""
        if not len(points):
            return np.zeros(frame.depth_m.shape, np.bool_), 0.0
        return self._networks.load_sam().from_points(self._seen(frame), points.astype(np.float32))


class AutomaticSam:
    """``Segmenter`` of every region, none of them named."""

    name = "sam-automatic"

    def __init__(self, networks: Networks, config: AutomaticMaskConfig) -> None:
        self._networks = networks
        self._config = config
        self.digest = content_key(self.name, FRONT_END_VERSION, config.model_dump_json(), networks.digest)

    def segment(self, frame: Frame) -> Regions:
        """Regions as SAM finds them by itself, every one called an item."""
        regions = AutomaticMasks(self._networks.load_sam(), self._config).regions(frame.rgb)
        return Regions(regions.masks, regions.boxes, regions.scores, (UNNAMED,) * len(regions.scores))
