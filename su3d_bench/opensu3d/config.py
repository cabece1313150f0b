"""Parameters of OpenSU3D: those the paper fixes and those it leaves open, with their defaults.

Defaults are the paper's (section III-A) where it states one; comments mark our own choices.
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
# crops; the paper names these for scheme 3 only, so the narrow ones remain possible.
SCHEMES: dict[Scheme, Fusion] = {
    "scheme1": Fusion("direct", "direct", _NARROW),
    "scheme2": Fusion("direct", "global", _NARROW),
    "scheme3": Fusion("weighted", "direct", _WIDE),
    "scheme4": Fusion("weighted", "global", _WIDE),
    "scheme4-narrow": Fusion("weighted", "global", _NARROW),
}

INCREMENT = 0.2  # "a scaling ratio increment of 0.2"


def crop_levels(k: int) -> tuple[float, ...]:
    """The crop ratios of ``k`` levels: S_r = [0.8, 1, 1.2] for 3, with larger crops for more, as in the paper.

    One level is only the best-fit crop, the reference of the fusion equations.

    >>> crop_levels(1), crop_levels(3), crop_levels(5)
    ((1.0,), (0.8, 1.0, 1.2), (0.8, 1.0, 1.2, 1.4, 1.6))
    """
    if not isinstance(k, int) or not 1 <= k <= 20:
        raise ValueError(f"crop levels must be an integer from 1 to 20 ({k!r})")
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
    # The paper's 20 px belong to 1200x680 images; other widths use the same fraction of the width. 0: do not scale.
    border_reference_width: int = Field(default=1200, ge=0)
    border_shape: Literal["disc", "square"] = "disc"
    # Ring pixels that are in another mask: points of no instance in the map, because M' contains the ring and
    # Eq. 1 back-projects M'; points of that mask's instance, excluded from matching; or no points.
    border_pixel_rule: Literal["background", "owner", "drop"] = "background"
    # Pixels in no mask: Eq. 1 back-projects every pixel.
    background_pixel_rule: Literal["keep", "drop"] = "keep"
    # Head nouns of excluded labels: a tagger calls the paper's "walls" "brick wall"; "wall lamp" is a lamp.
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
    # Voxel size of the frame cloud, one point per voxel and ID; unset: eps; 0: every pixel.
    frame_voxel: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    overlap_threshold: float = Field(default=0.3, ge=0)
    overlap_rule: OverlapRule = "smaller-segment"
    # Which point is dropped when a new one meets an occupied voxel of side eps: the scene's ("set of points from
    # P'_scene can also be deleted to retain constant sparsity"), the new one, or neither.
    density: Density = "scene"
    dbscan_eps: Metres = 0.1
    dbscan_min_points: int = Field(default=20, ge=1)
    split_fraction: Fraction = 0.8
    # Not in the paper, which never removes: an instance is removed if this many views in a row, of those that show its
    # place, look through most of its points; 0 for never. 3: the sightings after which ORB-SLAM (Mur-Artal et al. 2015,
    # section VI-B) keeps a new point. The margin is the default ``depth_tolerance`` of Khronos' ray verificator.
    removal_views: int = Field(default=0, ge=0)
    removal_margin_m: Metres = 0.1
    # The paper ranks views, not instances; the AP set-up it uses (OpenMask3D's) gives every mask confidence 1.
    # The other rules use the detector scores of an instance's views; top-m-sum is the sum of the best m over m.
    instance_score: InstanceScore = "ones"

    @model_validator(mode="after")
    def _settings_agree(self) -> OpenSU3DConfig:
        fusion = self.fusion
        if fusion.multi_scale == "weighted" and BEST_FIT_RATIO not in fusion.crop_ratios:
            raise ValueError(
                f"crop_ratios: 1.0 is missing ({fusion.crop_ratios}); weighted multi-scale fusion needs that crop"
            )
        if self.border_pixel_rule == "background" and self.background_pixel_rule == "drop":
            raise ValueError(
                "border_pixel_rule: 'background' conflicts with background_pixel_rule 'drop'; set "
                "border_pixel_rule to 'drop' or 'owner'"
            )
        if self.depth_min >= self.depth_max:
            raise ValueError(f"depth_min ({self.depth_min} m) must be below depth_max ({self.depth_max} m)")
        return self

    @property
    def voxel_of_frame(self) -> float:
        """Voxel size of the frame cloud in metres, 0 for none."""
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
        """The settings with derived values filled in, so that equal behaviour compares equal."""
        return {**self.model_dump(exclude={"scheme"}), "frame_voxel": self.voxel_of_frame, **asdict(self.fusion)}

    @property
    def needs(self) -> PerceptionNeeds:
        """Required perception outputs and excluded regions."""
        return PerceptionNeeds(
            masks="grounded",
            crop_ratios=self.fusion.crop_ratios,
            background_names=self.background_names,
            background_by_head=True,
            max_box_fraction=self.max_box_fraction,
        )

    def border_in(self, image_width: int) -> int:
        """Width of the ring in pixels for an image ``image_width`` pixels wide."""
        scale = image_width / self.border_reference_width if self.border_reference_width else 1.0
        return round(self.border_px * scale)
