"""Parameters of the RGB-D segmenter."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class JoinWeights(BaseModel):
    """What speaks for (positive) and against (negative) two touching surfaces being parts of one object.

    Log-odds for each unit of a cue, by logistic regression over the borders in rooms that no benchmark uses; a lower
    ``bias`` leaves more regions apart. The cues are those of ``rules.join_cues``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bias: float = 2.8
    contrast: float = -0.68  # colour difference right at the border
    concave: float = -1.25  # the border is an inner edge
    stepped_colour: float = -3.73  # the colours differ, and the surfaces lie off each other's plane by centimetres
    raised_colour: float = -0.8  # the same for millimetres, and one is much smaller: a plate on a table
    gap: float = -1.0  # share of the border with a jump in depth
    step: float = -1.77  # how far it jumps
    contact: float = 0.71  # length of border without a jump
    depth: float = 1.25  # share of the border where depth is known
    larger: float = -0.63  # size of the larger of the two


class QualityWeights(BaseModel):
    """What makes a region's score: log-odds that its mask overlaps an object by half, fitted on the same rooms."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    bias: float = -8.75
    border: float = 6.48  # how sure the region is of its borders, 0..1
    cut_off: float = -2.26  # share of the outline at the border of the image
    size: float = 1.47  # tenfold pixels
    compactness: float = 3.94  # 1 for a square, less for what is drawn out or frayed


class SegmenterConfig(BaseModel):
    """What is an edge, what is one surface, what is one object.

    Colours are CIELAB units with lightness counted ``lightness_weight``, because shading moves lightness more than hue;
    angles are degrees; jumps in depth are relative to the depth. Parameters are grouped by stage: larger ``*_scale``,
    ``surface_*`` and ``object_*`` values merge more, ``min_region_px`` drops more.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    # pixels
    max_width: int = Field(default=640, ge=32)  # wider frames are segmented at a whole fraction of their size
    lightness_weight: float = Field(default=0.6, gt=0)
    smoothing_colour: float = Field(default=35.0, gt=0)  # bilateral filter: colour steps above this stay sharp
    noise_floor: float = Field(default=1e-4, ge=0)  # 1/m: quieter disparity is not smoothed; 0.4 mm at 2 m
    noise_smoothing: float = Field(default=4.0, gt=0)  # bilateral filter of disparity, in standard deviations
    noise_margin: float = Field(default=4.0, ge=0)  # standard deviations that no step in depth may rest on
    depth_jump: float = Field(default=0.012, gt=0)
    normal_radius: int = Field(default=4, ge=1)  # at half resolution; smaller beside jumps in depth
    normal_keep: float = Field(default=0.001, ge=0)  # relative depth by which a neighbour's plane must fit better

    # superpixels
    colour_unit: float = Field(default=8.0, gt=0)
    normal_unit_degrees: float = Field(default=25.0, gt=0)
    superpixel_scale: float = Field(default=12.0, gt=0)
    min_superpixel_px: int = Field(default=8, ge=1)

    # surfaces
    surface_colour: float = Field(default=9.0, gt=0)
    surface_contrast: float = Field(default=9.0, gt=0)
    surface_bend_degrees: float = Field(default=12.0, gt=0)
    surface_gap: float = Field(default=0.5, gt=0)

    # structure: floor, walls, ceiling
    structure_min_fraction: float = Field(default=0.03, gt=0, le=1)
    structure_distance_m: float = Field(default=0.03, gt=0)
    structure_relief_m: float = Field(default=0.1, gt=0)  # doors and windows lie within this of their wall
    structure_behind_fraction: float = Field(default=0.02, ge=0, le=1)
    structure_flush_m: float = Field(default=0.005, gt=0)
    structure_flush_relative: float = Field(default=0.0015, gt=0)
    structure_colour: float = Field(default=12.0, gt=0)
    structure_lightness_weight: float = Field(default=0.4, ge=0)
    structure_patch_fraction: float = Field(default=0.01, ge=0, le=1)  # smaller flush patches are its pattern

    # objects
    join: JoinWeights = JoinWeights()
    parts_caution: float = Field(default=1.5, ge=0)  # taken off the bias where parts are asked for, not objects

    # answer
    quality: QualityWeights = QualityWeights()
    min_region_px: int = Field(default=100, ge=1)
