"""ConceptFusion: pixel-aligned features of image and regions, fused into points; a feature a point, no instances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.baselines.conceptfusion.feature_table import FeatureTable, Place
from su3d_bench.baselines.conceptfusion.pixel_features import (
    Overlaps,
    PixelFeatures,
    Weights,
    mixed_features,
    mixing_weights,
    paint,
    picked,
)
from su3d_bench.baselines.conceptfusion.point_fusion import ABSENT, PointFusion, View, view_of
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import DenseFeatures
from su3d_bench.core.types import Detections, Frame, Int64Array, PerceptionNeeds, SceneInfo

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PAPER = "Jatavallabhula et al.: ConceptFusion: Open-set Multimodal 3D Mapping, RSS 2023"
SOURCE = (
    "https://github.com/concept-fusion/concept-fusion, commit 4457c1f (its branch fastsam: 668c26c); "
    "https://github.com/gradslam/gradslam, branch conceptfusion, commit 59ca872"
)


class ConceptFusionConfig(BaseModel):
    """Every hyper-parameter; the defaults are the released scripts' where a comment says nothing else."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=20, ge=1)
    # The size at which pixels are fused, whatever the images' own: image_height and image_width of the fusion script.
    height: int = Field(default=120, ge=2, le=4096)
    width: int = Field(default=160, ge=2, le=4096)
    # The paper's Eq. 4: its README says that masks like Mask2Former's need it and that SAM's do without.
    weights: Weights = "uniqueness"
    temperature: Positive = 1.0
    # "small-over-large" is that of the branch fastsam.
    overlaps: Overlaps = "sum"
    # gradslam at 59ca872 averages a feature only where no channel is zero, which its own remark (and forks) take for
    # "where not all are": "any-channel".
    valid_features: Literal["no-zero-channel", "any-channel"] = "no-zero-channel"
    # gradslam at 59ca872 multiplies confidence by feature in half precision, so that points beyond some 3 m, whose
    # confidence is at its floor, lose the feature of the first image: "half", the preset half-products. Ours is
    # "single", for what is lost there is neither in the paper nor meant.
    products: Literal["single", "half"] = "single"
    distance_m: Positive = 0.05  # PointFusion's dist_th
    normal_angle_deg: float = Field(default=20.0, ge=0, le=180)  # angle_th
    sigma: Positive = 0.6  # m, of alpha
    # Ours: the same numbers from memory or from a file; a scene of 2 M points x 1024 dimensions is 4.1 GB.
    features_in: Place = "disk"


class ConceptFusion:
    """Pixel features from masks of named objects, fused into one feature a point; it has no instances."""

    name = "conceptfusion"
    warms_up = True
    Config: type[ConceptFusionConfig] = ConceptFusionConfig
    presets: ClassVar[Mapping[str, Mapping[str, str]]] = {"half-products": {"products": "half"}}
    about = MethodAbout(
        paper=PAPER,
        source=f"{SOURCE}; masks of Mask2Former and the uniqueness term are the paper's alone",
        licence="MIT (concept-fusion and gradslam)",
        needs=("masks of named objects",),
        status="each formula of the released code and of the paper is tested on hand-worked values; run beside the "
        "original programs on one made room with the same detections: points within 2e-6 m; the originals multiply "
        "confidence by feature in half precision, where 15 % of the first frame's points, the far ones, lose their "
        "feature (the preset half-products does so too); no figure of a paper has been reproduced",
    )

    def __init__(self, config: ConceptFusionConfig | None = None) -> None:
        self.config = config or self.Config()
        self._features: FeatureTable | None = None
        self._clear()

    def _clear(self) -> None:
        self.close()
        self._features = None
        self._map = PointFusion(self.config.distance_m, self.config.normal_angle_deg)

    @property
    def needs(self) -> PerceptionNeeds:
        """Masks of named objects and surfaces, background too, as Mask2Former gives them in the paper.

        ConceptGraphs' table tells the two apart so: its ConceptFusion+SAM has SAM in Mask2Former's place.
        """
        return PerceptionNeeds(masks="grounded")

    @property
    def n_points(self) -> int:
        """Points of the map so far, those without a feature included."""
        return len(self._map)

    @property
    def map_bytes(self) -> int:
        """What points, normals, counts and features take, wherever they lie."""
        features = self._features
        return self._map.n_bytes + (features.n_bytes + len(features) * 8 if features else 0)

    def start(self, scene: SceneInfo) -> None:
        """Forgets the scene before; of the new one nothing needs to be known."""
        self._clear()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Fuses one image into the map; the association goes over the whole map, the rest over the image."""
        detections.check_of(frame)
        features = self._table_for(detections)
        with timer.stage("backproject"):
            rows, columns = map(picked, frame.depth_m.shape, (self.config.height, self.config.width))
            view = view_of(frame, rows, columns, self.config.sigma)
        with timer.stage("paint"):
            field = self._field(detections)
        with timer.stage("match"):
            matched = self._map.associate(view)
        with timer.stage("fuse"):
            self._map.fuse(view, matched)
            self._average(features, view, field, matched)
        with timer.stage("insert"):
            pixel = self._map.insert(view, matched)
            # a pixel of no mask makes a point too: its feature is zero, its confidence that of any other
            features.append(field.features, field.row.ravel()[pixel], view.alpha[pixel])

    def _table_for(self, detections: Detections) -> FeatureTable:
        n_dimensions = len(detections.global_feature)
        if self._features is None:
            self._features = FeatureTable(n_dimensions, self.config.features_in)
        if self._features.n_dimensions != n_dimensions:
            raise DataError(
                f"frame {detections.frame_index}: features have {n_dimensions} dimensions, those of the map have "
                f"{self._features.n_dimensions}; make all with one encoder"
            )
        return self._features

    def _field(self, detections: Detections) -> PixelFeatures:
        config, whole, regions = self.config, detections.global_feature, detections.crop_features[:, 0]
        mixed = np.zeros((0, len(whole)))
        if len(regions):
            weights = mixing_weights(whole, regions, config.weights, config.temperature)
            mixed = mixed_features(whole, regions, weights)
        return paint(detections.masks, detections.boxes, mixed, config.overlaps, config.height, config.width)

    def _average(self, features: FeatureTable, view: View, field: PixelFeatures, matched: Int64Array) -> None:
        is_set = np.all if self.config.valid_features == "no-zero-channel" else np.any
        is_valid = is_set(field.features != 0, axis=1)
        is_met = matched != ABSENT
        pixel = np.flatnonzero(is_met & is_valid[field.row.ravel()])
        seen = matched[pixel], field.features, field.row.ravel()[pixel], view.alpha[pixel]
        if self.config.products == "single":
            features.average(*seen)
        elif is_met.any():
            features.average_in_half(*seen)

    def finish(self) -> DenseFeatures:
        """The points so far, each with its feature, zero for none; features are a view until the next update."""
        features = np.zeros((0, 0), np.float16) if self._features is None else self._features.features()
        return DenseFeatures(self._map.points.astype(np.float32), features)

    def close(self) -> None:
        """Give the features' disk space back; the map cannot be updated after that."""
        if self._features is not None:
            self._features.close()


class ConceptFusionSamConfig(ConceptFusionConfig):
    """ConceptFusion's, without the uniqueness term: its README says that SAM's masks do without it."""

    weights: Weights = "softmax"


class ConceptFusionSam(ConceptFusion):
    """Pixel features from class-agnostic masks of every region, fused into one feature a point; it has no instances."""

    name = "conceptfusion-sam"
    Config = ConceptFusionSamConfig
    about = replace(
        ConceptFusion.about,
        paper=f"{PAPER}; with SAM's masks: Gu et al.: ConceptGraphs, ICRA 2024, Table II",
        source=SOURCE,
        needs=("class-agnostic masks",),
    )

    @property
    def needs(self) -> PerceptionNeeds:
        """Every region of an image, of objects and of their parts, which may overlap."""
        return PerceptionNeeds(masks="class-agnostic", automatic="conceptfusion")
