"""The hyper-parameters of ConceptGraphs' mapping, with the values that its README's commands give the SAM-only variant.

Source: concept-graphs at commit 5c4da70, ``configs/slam_pipeline/base.yaml`` and the commands of its README. Options of
the original that its commands leave off and that change the method (``use_contain_number``, other similarities) are
left out.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Cosine = Annotated[float, Field(ge=-1, le=1)]
Interval = Annotated[int, Field(ge=-1)]  # processed frames; -1 or 0: never
InstanceScore = Literal["ones", "num-detections", "max-confidence"]

# The sum of both similarities that joins a detection to an object. The two rules are not equivalent: 1.1 of the paper
# is 1.2 of the code only where the cosine is 0.8.
SIM_THRESHOLDS = {"code": 1.2, "paper": 1.1}


class MappingConfig(BaseModel):
    """What both variants share; names are those of the original's configuration where it has one."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=5, ge=1)
    # code: overlap + cosine >= 1.2; paper: overlap + (cosine / 2 + 1 / 2) >= 1.1 (its equation for phi_sem).
    association: Literal["code", "paper"] = "code"
    sim_threshold: float | None = None  # another threshold than that of the rule
    # overlap: share of the detection's points that lie at the object; iou: of axis-aligned boxes, the default that the
    # original's commands override.
    spatial_sim_type: Literal["overlap", "iou"] = "overlap"
    phys_bias: float = Field(default=0.0, ge=-1, le=1)
    mask_area_threshold: int = Field(default=25, ge=0)  # pixels; the original takes at least 10
    mask_conf_threshold: Fraction = 0.95  # of SAM's predicted IoU
    # Instead, where a profile's scores are on a scale of their own (Detections.score_scale); 0: all regions stay.
    own_scale_conf_threshold: Fraction = 0.0
    max_bbox_area_ratio: Fraction = 0.5
    min_points_threshold: int = Field(default=16, ge=0)  # the original takes at least 5
    # Gaussian noise on every coordinate, "to avoid colinearity": 4 mm in the code, there from an unseeded generator,
    # here from the scene's seed. 0: none.
    noise_m: float = Field(default=0.004, ge=0, allow_inf_nan=False)
    downsample_voxel_size: Metres = 0.025
    dbscan_remove_noise: bool = True
    dbscan_eps: Metres = 0.1
    dbscan_min_points: int = Field(default=10, ge=1)
    denoise_interval: Interval = 20
    filter_interval: Interval = -1
    merge_interval: Interval = 20
    obj_min_points: int = Field(default=0, ge=0)
    obj_min_detections: int = Field(default=3, ge=0)
    merge_overlap_thresh: float = Field(default=0.7, ge=0, le=1)  # 0: no overlap merge
    merge_visual_sim: Cosine = 0.8
    merge_text_sim: Cosine = 0.8
    # The original has no scores; instance AP needs some. ones: as readers of its maps take it.
    instance_score: InstanceScore = "ones"

    @property
    def association_threshold(self) -> float:
        """The least similarity at which a detection joins an object."""
        return SIM_THRESHOLDS[self.association] if self.sim_threshold is None else self.sim_threshold

    @property
    def score_caveat(self) -> str:
        """What must be said of the instances' scores."""
        if self.instance_score == "ones":
            return "the original has no scores: 1 for every object"
        what = {"num-detections": "number of detections", "max-confidence": "largest detection score"}
        return f"the original has no scores: each object's {what[self.instance_score]}"
