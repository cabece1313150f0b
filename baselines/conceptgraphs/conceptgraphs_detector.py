"""ConceptGraphs-Detect: named masks of a tagger and a detector; walls, floor and ceiling kept apart."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from su3d_bench.baselines.conceptgraphs.config import Cosine, Fraction, Interval, MappingConfig
from su3d_bench.baselines.conceptgraphs.map import ObjectMap, warm_up
from su3d_bench.baselines.conceptgraphs.method import CROP_PADDING_PX, ConceptGraphs
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.types import Detections, Frame, Instances, PerceptionNeeds, SceneInfo


class DetectorConfig(MappingConfig):
    """The values of the README's command for Detect where they differ; no overlap merge but the last."""

    mask_conf_threshold: Fraction = 0.25  # of GroundingDINO's score
    merge_interval: Interval = -1
    merge_visual_sim: Cosine = 0.7
    merge_text_sim: Cosine = 0.7
    skip_bg: bool = False  # True: background regions are dropped
    background_names: Annotated[tuple[str, ...], Field(strict=False)] = ("wall", "floor", "ceiling")


class ConceptGraphsDetector:
    """ConceptGraphs with named masks of a tagger and a detector; walls, floor and ceiling are one object a class.

    Background regions are merged whatever they look like. As in the original's evaluation the feature of an object
    decides its class, not its detections' names; background objects have their own name as label.
    """

    name = "conceptgraphs-detector"
    Config = DetectorConfig
    about = MethodAbout(
        paper=ConceptGraphs.about.paper,
        source=ConceptGraphs.about.source,
        licence=ConceptGraphs.about.licence,
        needs=("named masks of a tagger and a detector", "an encoder of images and texts"),
        status=ConceptGraphs.about.status,
    )

    def __init__(self, config: DetectorConfig | None = None) -> None:
        self.config = config or DetectorConfig()
        self._clear(seed=0)

    def _clear(self, seed: int) -> None:
        self._map = ObjectMap(self.config, seed, () if self.config.skip_bg else self.config.background_names)

    @property
    def needs(self) -> PerceptionNeeds:
        """Boxes are not limited here: background may fill the image."""
        return PerceptionNeeds(
            masks="grounded",
            crop_ratios=(1.0,),
            crop_padding_px=CROP_PADDING_PX,
            background_names=self.config.background_names if self.config.skip_bg else (),
            name_features=True,
            grounding="conceptgraphs",
        )

    @property
    def caveat(self) -> str:
        return self.config.score_caveat

    @property
    def n_points(self) -> int:
        return self._map.n_points

    @property
    def map_bytes(self) -> int:
        return self._map.n_bytes

    @property
    def n_instances(self) -> int:
        """Objects now, background and those seen too rarely included."""
        return len(self._map)

    def start(self, scene: SceneInfo) -> None:
        warm_up(self.config)
        self._clear(scene.seed)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        assert detections.name_features is not None, "needs.name_features asks for them"
        self._map.update(frame, detections, detections.name_features, timer)

    def finish(self) -> Instances:
        return self._map.finish()
