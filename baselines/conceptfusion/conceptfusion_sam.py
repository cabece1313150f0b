"""ConceptFusion+SAM: ConceptFusion with class-agnostic masks in place of Mask2Former's, as its released code has it."""

from __future__ import annotations

from su3d_bench.baselines.conceptfusion.method import LICENCE, PAPER, SOURCE, STATUS, ConceptFusion, ConceptFusionConfig
from su3d_bench.baselines.conceptfusion.pixel_features import Weights
from su3d_bench.core.interfaces import MethodAbout
from su3d_bench.core.types import PerceptionNeeds


class ConceptFusionSamConfig(ConceptFusionConfig):
    """ConceptFusion's, without the uniqueness term: its README says that SAM's masks do without it."""

    weights: Weights = "softmax"


class ConceptFusionSam(ConceptFusion):
    """Pixel features from class-agnostic masks of every region, fused into one feature a point; it has no instances."""

    name = "conceptfusion-sam"
    Config = ConceptFusionSamConfig
    about = MethodAbout(
        paper=f"{PAPER}; with SAM's masks: Gu et al.: ConceptGraphs, ICRA 2024, Table II",
        source=SOURCE,
        licence=LICENCE,
        needs=("class-agnostic masks",),
        status=STATUS,
    )

    @property
    def needs(self) -> PerceptionNeeds:
        """Every region of an image, of objects and of their parts, which may overlap."""
        return PerceptionNeeds(masks="class-agnostic", automatic="conceptfusion")
