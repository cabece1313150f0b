"""ConceptGraphs, class-agnostic: masks of everything, merged into objects by spatial overlap and feature similarity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from su3d_bench.baselines.conceptgraphs.map import CLASSES, FORMS, ObjectMap
from su3d_bench.baselines.conceptgraphs.objects import Cosine, Fraction, Interval, MappingConfig
from su3d_bench.core.files.state import read_state, write_state
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, SceneInfo

CROP_PADDING_PX = 20  # the original's crops: the box plus 20 px on every side


class ConceptGraphs:
    """Class-agnostic masks merged into objects if spatial overlap and feature similarity sum to at least 1.2.

    The SAM-only variant of the original; ``finish`` returns the map so far unchanged. Every region is an "item"
    to it: walls, floor and ceiling are ordinary objects unless their box is too large, and names are only displayed.
    """

    name = "conceptgraphs"
    warms_up = True
    keeps_ids = True
    finishes_in_fork = True
    Config: type[MappingConfig] = MappingConfig
    about = MethodAbout(
        paper="Gu, Kuwajerwala, Morin et al.: ConceptGraphs: Open-Vocabulary 3D Scene Graphs for Perception and "
        "Planning, ICRA 2024",
        source="https://github.com/concept-graphs/concept-graphs, commit 5c4da70",
        licence="MIT",
        needs=("class-agnostic masks", "an image encoder"),
        status="every step is tested on hand-worked values, voxel averages and clusters against Open3D; compared with "
        "the original on one generated room with the same detections: 62 of 62 and 56 of 56 objects, 450 of 450, 511 "
        "of 511 associations, points equal with poses in float32 as in the original; the original's unseeded noise "
        "lowers the median voxel IoU between two of its own runs to 0.65; no results of the paper have been reproduced",
    )

    def __init__(self, config: MappingConfig | None = None) -> None:
        self.config = config or self.Config()
        self._map = self._empty_map(seed=0)

    def _empty_map(self, seed: int) -> ObjectMap:
        return ObjectMap(self.config, seed)

    @property
    def needs(self) -> PerceptionNeeds:
        """Too large boxes are excluded before their features are computed."""
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
        """Current objects, including background and rarely seen ones."""
        return len(self._map)

    def start(self, scene: SceneInfo) -> None:
        self._map = self._empty_map(scene.seed)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        # The original encodes the word "item" for every region; whatever its feature, all are equal and any cosine
        # is 1, as here.
        item = np.ones((len(detections), 1), np.float32)
        self._map.update(frame, detections, item, timer)

    def finish(self) -> Instances:
        return self._map.finish()

    def save_state(self, folder: Path) -> None:
        write_state(folder, self._map.state())

    def load_state(self, folder: Path) -> None:
        self._map = self._empty_map(seed=0)
        self._map.restore(read_state(folder, FORMS, CLASSES))


class DetectorConfig(MappingConfig):
    """The values of the README's command for Detect where they differ; only a final overlap merge.

    ``grounding``: how the profile ``paper`` names boxes. The original guesses by the first word of the phrase of a
    box; ``conceptgraphs-whole-tags`` drops boxes not named by a whole tag.
    """

    mask_conf_threshold: Fraction = 0.25  # of GroundingDINO's score
    merge_interval: Interval = -1
    merge_visual_sim: Cosine = 0.7
    merge_text_sim: Cosine = 0.7
    skip_bg: bool = False  # True: background regions are dropped
    background_names: Annotated[tuple[str, ...], Field(strict=False)] = ("wall", "floor", "ceiling")
    grounding: Literal["conceptgraphs", "conceptgraphs-whole-tags"] = "conceptgraphs"


class ConceptGraphsDetector(ConceptGraphs):
    """ConceptGraphs with named masks of a tagger and a detector; walls, floor and ceiling are one object per class.

    Background regions are merged regardless of appearance. As in the original's evaluation the feature of an object
    decides its class, not its detections' names; background objects have their own name as label.
    """

    name = "conceptgraphs-detector"
    Config = DetectorConfig
    config: DetectorConfig
    presets: ClassVar[Mapping[str, Mapping[str, str]]] = {"whole-tags": {"grounding": "conceptgraphs-whole-tags"}}
    about = replace(
        ConceptGraphs.about,
        needs=("named masks of a tagger and a detector", "an encoder of images and texts"),
    )

    def _empty_map(self, seed: int) -> ObjectMap:
        return ObjectMap(self.config, seed, () if self.config.skip_bg else self.config.background_names)

    @property
    def needs(self) -> PerceptionNeeds:
        """Boxes are not limited here, because background may fill the image."""
        return PerceptionNeeds(
            masks="grounded",
            crop_ratios=(1.0,),
            crop_padding_px=CROP_PADDING_PX,
            background_names=self.config.background_names if self.config.skip_bg else (),
            name_features=True,
            grounding=self.config.grounding,
        )

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        assert detections.name_features is not None, "needs.name_features asks for them"
        self._map.update(frame, detections, detections.name_features, timer)
