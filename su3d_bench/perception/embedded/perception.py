"""The profile without weights: geometric segmentation, the embedded encoder, names by zero-shot classification."""

from __future__ import annotations

from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, Regions, SceneInfo
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.detections import Assembler, captioned_by_colour
from su3d_bench.perception.embedded.naming import Namer, NamingConfig
from su3d_bench.perception.embedded.segmenter.segmenter import RgbdSegmenter, SegmenterConfig
from su3d_bench.perception.regions import RegionsOnDemand, cached_regions

CAMERA_CAVEAT = (
    "embedded perception on camera images: its encoder has seen rendered rooms only, so names and labels mean little "
    "here; use --profile paper, or --profile stored with detections made by real models"
)


class EmbeddedPerception:
    """Geometric segmentation of the frame, names by the encoder, captions from a template."""

    profile = "embedded"

    def __init__(
        self, segmenter: SegmenterConfig, naming: NamingConfig, scene: SceneInfo, encoder: Encoder, cache: FrameCache
    ) -> None:
        self.encoder = encoder
        self.caveat = CAMERA_CAVEAT if scene.image_domain == "camera" else None
        self._segmenters = {
            "grounded": RgbdSegmenter(segmenter, "objects"),
            "class-agnostic": RgbdSegmenter(segmenter, "parts"),
        }
        self._namer = Namer(naming, encoder)
        self._cache = cache
        self._assembler = Assembler(encoder, cache, "own")
        digests = [segmenter.digest for segmenter in self._segmenters.values()]
        self.digest = content_key(self.profile, *digests, self._namer.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        assert needs.masks != "none", "the runner asks nothing for a method that needs no masks"
        segmented = self._segmented(needs.masks, frame, timer)
        regions, known = self._assembler.named(frame, segmented, self._namer, needs, timer)
        return self._assembler.assemble(frame, regions, needs, timer, describe=captioned_by_colour, known=known)

    def regions(self) -> RegionPerception:
        return RegionsOnDemand(lambda frame: self._segmented("class-agnostic", frame, Timer()), self.encoder)

    def _segmented(self, masks: str, frame: Frame, timer: StageTimer) -> Regions:
        return cached_regions(self._segmenters[masks], frame, self._cache, False, timer)
