"""What OpenSU3D's paper fixes and what it leaves open, each as a named parameter with its default.

Defaults are the paper's (section IV-A) where it states one; a comment says so where the choice is ours.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.core.types import PerceptionNeeds

MultiScale = Literal["direct", "weighted"]
MultiView = Literal["direct", "global"]
Scheme = Literal["scheme1", "scheme2", "scheme3", "scheme4", "scheme4-narrow"]
OverlapRule = Literal["smaller-segment", "frame-segment", "as-printed"]
Density = Literal["scene", "frame", "all"]
InstanceScore = Literal["ones", "mean", "max", "top-m-sum"]
BEST_FIT_RATIO = 1.0


@dataclass(frozen=True)
class Fusion:
    """One feature-fusion scheme: the crop ratios S_r and the two equations it uses."""

    multi_scale: MultiScale
    multi_view: MultiView
    crop_ratios: tuple[float, ...]


_NARROW = (0.8, 1.0, 1.2)
_WIDE = (1.0, 2.0, 4.0)
# Scheme 4 is the "combination of updated multiview and multiscale features fusion formulation", so it keeps scheme 3's
# crops; the paper names those for scheme 3 alone, which leaves the narrow ones possible too.
SCHEMES: dict[Scheme, Fusion] = {
    "scheme1": Fusion("direct", "direct", _NARROW),
    "scheme2": Fusion("direct", "global", _NARROW),
    "scheme3": Fusion("weighted", "direct", _WIDE),
    "scheme4": Fusion("weighted", "global", _WIDE),
    "scheme4-narrow": Fusion("weighted", "global", _NARROW),
}

INCREMENT = 0.2  # "a scaling ratio increment of 0.2"


def crop_levels(k: int) -> tuple[float, ...]:
    """The crop ratios of ``k`` levels: S_r = [0.8, 1, 1.2] for 3, and larger crops for more, as the paper says.

    One level is the best-fit crop alone, which its equations compare with.

    >>> crop_levels(1), crop_levels(3), crop_levels(5)
    ((1.0,), (0.8, 1.0, 1.2), (0.8, 1.0, 1.2, 1.4, 1.6))
    """
    if not isinstance(k, int) or not 1 <= k <= 20:
        raise ValueError(f"crop levels are a whole number from 1 to 20, not {k!r}")
    if k == 1:
        return (BEST_FIT_RATIO,)
    return tuple(round(_NARROW[0] + INCREMENT * level, 10) for level in range(k))


Ratio = Annotated[float, Field(gt=0)]
Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class OpenSU3DConfig(BaseModel):
    """Every hyper-parameter of OpenSU3D; ``multi_scale``, ``multi_view`` and ``crop_ratios`` override the scheme's."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=40, ge=1)
    border_px: float = Field(default=20.0, ge=0)
    # The paper's 20 px belong to 1200x680 images; other widths take the same share of the image. 0: pixels as they are.
    border_reference_width: int = Field(default=1200, ge=0)
    border_shape: Literal["disc", "square"] = "disc"
    # What a ring's pixels that lie in another mask become in the map: points of no instance, for M' holds the ring and
    # Eq. 1 back-projects M'; points of that mask's instance, once the matching has gone without them; or none at all.
    border_pixels: Literal["background", "owner", "drop"] = "background"
    # Points of pixels in no mask: Eq. 1 back-projects every pixel.
    background_pixels: Literal["keep", "drop"] = "keep"
    # The head nouns of what is left out: the paper's "walls" are "brick wall" to a tagger, and "wall lamp" is a lamp.
    background_names: Annotated[tuple[str, ...], Field(strict=False)] = ("wall", "floor", "ceiling", "ground", "roof")
    max_box_fraction: Fraction = 0.95
    scheme: Scheme = "scheme1"
    multi_scale: MultiScale | None = None
    multi_view: MultiView | None = None
    crop_ratios: Annotated[tuple[Ratio, ...] | None, Field(strict=False, min_length=1)] = None
    top_m: int = Field(default=5, ge=1)
    depth_min: float = Field(default=0.0, ge=0)
    depth_max: Metres = 10.0
    eps: Metres = 0.02
    # The frame cloud holds one point a voxel of this side and an ID; unset, of eps, and 0 for every pixel.
    frame_voxel: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    overlap_threshold: float = Field(default=0.3, ge=0)
    overlap_rule: OverlapRule = "smaller-segment"
    # Which point goes where a new one meets a voxel of eps that is held: the scene's ("set of points from P'_scene can
    # also be deleted to retain constant sparsity"), the new one, or neither.
    density: Density = "scene"
    dbscan_eps: Metres = 0.1
    dbscan_min_points: int = Field(default=20, ge=1)
    split_fraction: Fraction = 0.8
    # The paper ranks views, not instances, and the set-up that it takes for AP, OpenMask3D's, gives 1 to every mask.
    # The others are made of the detector's scores of an instance's views; top-m-sum is the sum of the best m over m.
    instance_score: InstanceScore = "ones"

    @model_validator(mode="after")
    def _settings_agree(self) -> OpenSU3DConfig:
        fusion = self.fusion
        if fusion.multi_scale == "weighted" and BEST_FIT_RATIO not in fusion.crop_ratios:
            raise ValueError(
                f"crop_ratios {fusion.crop_ratios} hold no 1.0; weighted multi-scale fusion compares with that crop"
            )
        if self.border_pixels == "background" and self.background_pixels == "drop":
            raise ValueError(
                "border_pixels 'background' makes points of rings that background_pixels 'drop' leaves out; set "
                "border_pixels to 'drop' or 'owner'"
            )
        if self.depth_min >= self.depth_max:
            raise ValueError(f"depth_min {self.depth_min} m is not below depth_max {self.depth_max} m")
        return self

    @property
    def voxel_of_frame(self) -> float:
        """Side in metres of the voxels of the frame cloud, 0 for none."""
        return self.eps if self.frame_voxel is None else self.frame_voxel

    @property
    def fusion(self) -> Fusion:
        """The scheme with its overrides."""
        preset = SCHEMES[self.scheme]
        return Fusion(
            self.multi_scale or preset.multi_scale,
            self.multi_view or preset.multi_view,
            self.crop_ratios or preset.crop_ratios,
        )

    def effective(self) -> dict[str, Any]:
        """The settings with what follows from others written out, so that equal behaviour is equal."""
        return {**self.model_dump(exclude={"scheme"}), "frame_voxel": self.voxel_of_frame, **asdict(self.fusion)}

    @property
    def needs(self) -> PerceptionNeeds:
        """What perception must supply, and which regions it leaves out."""
        return PerceptionNeeds(
            masks="grounded",
            crop_ratios=self.fusion.crop_ratios,
            background_names=self.background_names,
            background_by_head=True,
            max_box_fraction=self.max_box_fraction,
        )

    def border_in(self, image_width: int) -> int:
        """Width of the ring in pixels of an image ``image_width`` wide."""
        scale = image_width / self.border_reference_width if self.border_reference_width else 1.0
        return round(self.border_px * scale)
