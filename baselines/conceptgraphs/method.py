"""ConceptGraphs, class-agnostic: masks of everything, joined to objects by overlap in space and alike features."""

from __future__ import annotations

import numpy as np

from su3d_bench.baselines.conceptgraphs.config import MappingConfig
from su3d_bench.baselines.conceptgraphs.map import ObjectMap, warm_up
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.types import Detections, Frame, Instances, PerceptionNeeds, SceneInfo

CROP_PADDING_PX = 20  # the original's crops: the box and 20 px on every side


class ConceptGraphs:
    """Class-agnostic masks joined to objects where overlap in space and likeness of features sum to 1.2.

    The SAM-only variant of the original; ``finish`` gives the map so far and changes nothing. Every region is an "item"
    to it: walls, floor and ceiling are objects like others unless their box is too large, and names are only shown.
    """

    name = "conceptgraphs"
    Config = MappingConfig
    about = MethodAbout(
        paper="Gu, Kuwajerwala, Morin et al.: ConceptGraphs: Open-Vocabulary 3D Scene Graphs for Perception and "
        "Planning, ICRA 2024",
        source="https://github.com/concept-graphs/concept-graphs, commit 5c4da70",
        licence="MIT",
        needs=("class-agnostic masks", "an image encoder"),
        status="every step is tested on hand-worked values, voxel averages and clusters against Open3D; never run "
        "beside the original, and no figure of the paper has been reproduced",
    )

    def __init__(self, config: MappingConfig | None = None) -> None:
        self.config = config or MappingConfig()
        self._map = ObjectMap(self.config, seed=0)

    @property
    def needs(self) -> PerceptionNeeds:
        """Boxes that are too large are left out before their features are computed."""
        return PerceptionNeeds(
            masks="class-agnostic",
            crop_ratios=(1.0,),
            crop_padding_px=CROP_PADDING_PX,
            max_box_fraction=self.config.max_bbox_area_ratio,
            automatic="conceptgraphs",
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
        """Objects now, those seen too rarely included."""
        return len(self._map)

    def start(self, scene: SceneInfo) -> None:
        warm_up(self.config)
        self._map = ObjectMap(self.config, scene.seed)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        # The original encodes the word "item" for every region; whatever its feature, all are equal and the cosine of
        # any two is 1, as it is between these.
        item = np.ones((len(detections), 1), np.float32)
        self._map.update(frame, detections, item, timer)

    def finish(self) -> Instances:
        return self._map.finish()
