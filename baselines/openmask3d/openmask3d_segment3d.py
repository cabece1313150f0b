"""OpenMask3D with Segment3D's proposals in place of Mask3D's: more and finer parts, from a network taught by SAM.

Views, prompts, crops and features are OpenMask3D's. Source of what differs: Segment3D's evaluation script at commit
1861478.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from su3d_bench.baselines.openmask3d.mask_pipeline import MaskPipelineConfig
from su3d_bench.baselines.openmask3d.method import OpenMask3D
from su3d_bench.core.interfaces import MethodAbout


class OpenMask3DSegment3DConfig(MaskPipelineConfig):
    """OpenMask3D's settings with Segment3D's for proposals: 400 queries, and parts by density instead of by gaps."""

    part_eps_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.05  # general.dbscan_eps
    part_min_points: int = Field(default=5, ge=1)  # general.dbscan_min_points
    part_most_dropped: int = Field(default=15, ge=0)
    part_kept_share: Annotated[float, Field(gt=0, le=1)] = 0.8  # general.topk_per_image
    surface_most: int = Field(default=400, ge=1, le=100_000)  # queries of the evaluation script
    surface_min_points: int = Field(default=16, ge=1)  # more than what part_most_dropped drops
    # SAM cuts objects into parts and parts of parts; so of two nested proposals more stay beside each other.
    surface_same_iou: Annotated[float, Field(gt=0, le=1)] = 0.8


class OpenMask3DSegment3D(OpenMask3D):
    """OpenMask3D with Segment3D's proposals: many fine parts, small and weak ones dropped."""

    name = "openmask3d-segment3d"
    Config: type[MaskPipelineConfig] = OpenMask3DSegment3DConfig
    about = MethodAbout(
        paper="Huang et al.: Segment3D: Learning Fine-Grained Class-Agnostic 3D Segmentation without Manual Labels, "
        "ECCV 2024, with the features of OpenMask3D (NeurIPS 2023)",
        source="https://github.com/LeapLabTHU/Segment3D, commit 1861478; "
        "https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="none stated (Segment3D); MIT (OpenMask3D)",
        needs=("a mesh of the scan", "Segment3D's exported masks; without them weight-free proposals from the mesh"),
        status="as openmask3d; connected parts, dropped ones and the kept share are tested on hand-worked values; no "
        "public file of these proposals was found, and no figure has been reproduced",
    )

    def __init__(self, config: MaskPipelineConfig | None = None) -> None:
        super().__init__(config or OpenMask3DSegment3DConfig())
