"""Rules and parameters for merging superpixels into surfaces, and surfaces into floor, walls and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.perception.embedded.surface_graph import Graph, IndexArray, Pieces, contract, merge_cheapest


class JoinWeights(BaseModel):
    """Evidence for (positive) and against (negative) two touching surfaces being parts of one object.

    Log-odds per unit of a cue, by logistic regression over the borders in rooms that no benchmark uses; a lower
    ``bias`` keeps more regions separate. The cues are those of ``join_cues``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bias: float = 2.8
    contrast: float = -0.68  # colour difference right at the border
    concave: float = -1.25  # the border is an inner edge
    colour_at_step: float = -3.73  # the colours differ, and the surfaces are off each other's plane by centimetres
    colour_at_small_step: float = -0.8  # the same for millimetres, if one is much smaller: a plate on a table
    gap: float = -1.0  # share of the border with a jump in depth
    step: float = -1.77  # size of the jump
    contact: float = 0.71  # length of border without a jump
    depth: float = 1.25  # share of the border where depth is known
    larger: float = -0.63  # size of the larger of the two


class QualityWeights(BaseModel):
    """Weights of a region's score: log-odds that its mask overlaps an object by half, fitted on the same rooms."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    bias: float = -8.75
    border: float = 6.48  # certainty of the region's borders, 0..1
    cut_off: float = -2.26  # share of the outline at the border of the image
    size: float = 1.47  # per factor of ten in pixels
    compactness: float = 3.94  # 1 for a square, less for elongated or ragged regions


class SegmenterConfig(BaseModel):
    """Parameters that define edges, surfaces and objects.

    Colours are CIELAB units with lightness times ``lightness_weight``, because shading changes lightness more than hue;
    angles are degrees; depth jumps are relative to the depth. Parameters are grouped by stage: larger ``*_scale``,
    ``surface_*`` and ``object_*`` values merge more, ``min_region_px`` drops more.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    # pixels
    max_width: int = Field(default=640, ge=32)  # wider frames are segmented at a whole fraction of their size
    lightness_weight: float = Field(default=0.6, gt=0)
    smoothing_colour: float = Field(default=35.0, gt=0)  # bilateral filter: colour steps above this stay sharp
    noise_floor: float = Field(default=1e-4, ge=0)  # 1/m: quieter disparity is not smoothed; 0.4 mm at 2 m
    noise_smoothing: float = Field(default=4.0, gt=0)  # bilateral filter of disparity, in standard deviations
    noise_margin: float = Field(default=4.0, ge=0)  # noise standard deviations not counted as a depth step
    depth_jump: float = Field(default=0.012, gt=0)
    normal_radius: int = Field(default=4, ge=1)  # at half resolution; smaller near jumps in depth
    normal_min_gain: float = Field(default=0.001, ge=0)  # relative depth by which a neighbour's plane must fit better

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
    structure_relief_m: float = Field(default=0.1, gt=0)  # doors and windows are within this of their wall
    structure_behind_fraction: float = Field(default=0.02, ge=0, le=1)
    structure_flush_m: float = Field(default=0.005, gt=0)
    structure_flush_relative: float = Field(default=0.0015, gt=0)
    structure_colour: float = Field(default=12.0, gt=0)
    structure_lightness_weight: float = Field(default=0.4, ge=0)
    structure_pattern_fraction: float = Field(default=0.01, ge=0, le=1)  # smaller flush patches are its pattern

    # objects
    join: JoinWeights = JoinWeights()
    part_penalty: float = Field(default=1.5, ge=0)  # subtracted from the bias if parts are requested, not objects

    # answer
    quality: QualityWeights = QualityWeights()
    min_region_px: int = Field(default=100, ge=1)


def join_surfaces(graph: Graph, config: SegmenterConfig, is_apart: BoolArray | None = None) -> Graph:
    """Superpixels joined if similar in colour across borders without jump or crease, except those ``is_apart``."""

    def cost(current: Graph) -> Float64Array:
        colour, contrast, bend, gap = _differences(current)
        terms = (
            colour / config.surface_colour,
            contrast / config.surface_contrast,
            np.abs(bend) / np.deg2rad(config.surface_bend_degrees),
            gap / config.surface_gap,
        )
        return np.sqrt(sum(term**2 for term in terms))

    return merge_cheapest(graph, cost, is_apart)


def _differences(graph: Graph) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """For every border: distance of the mean colours, mean contrast, mean bend rad, fraction of pairs with a jump."""
    borders, means = graph.borders, graph.pieces.mean_colour()
    colour = np.linalg.norm(means[borders.a] - means[borders.b], axis=1)
    n_smooth = borders.n_deep - borders.gap
    bend = borders.bend / np.maximum(n_smooth, 1)
    gap = borders.gap / np.maximum(borders.n_deep, 1)
    return colour, borders.contrast / borders.length, bend, gap


@dataclass(frozen=True)
class StructuralPlane:
    """A floor, wall or ceiling: its points p satisfy ``normal`` . p = ``offset``; ``colour`` is its mean.

    ``roughness_m`` is the root mean square distance of its points: the noise of the depth.
    """

    normal: Float64Array
    offset: float
    roughness_m: float
    colour: Float64Array


def structural_planes(surfaces: Graph, config: SegmenterConfig) -> list[StructuralPlane]:
    """Large planes with nothing behind them, largest first: floor, walls, ceiling."""
    pieces = surfaces.pieces
    centroid, normal, colour = pieces.centroid(), pieces.unit_normal(), pieces.mean_colour()
    total = max(float(pieces.n_pixels.sum()), 1.0)
    planes: list[StructuralPlane] = []
    is_taken = np.zeros(len(pieces), bool)
    for seed in np.argsort(-pieces.n_points, kind="stable"):
        if pieces.n_points[seed] < 0.25 * config.structure_min_fraction * total:
            break
        axis, rms = pieces.plane_of(int(seed))
        if is_taken[seed] or rms > config.structure_distance_m:
            continue
        offset = float(axis @ centroid[seed])
        distance = centroid @ axis - offset
        tolerance = np.maximum(config.structure_distance_m, 0.015 * centroid[:, 2])
        has_depth = pieces.n_points > 0
        is_parallel = has_depth & (normal @ axis > np.cos(np.deg2rad(12)))
        on_plane = is_parallel & (np.abs(distance) < tolerance)
        # A wall hides everything behind it; a door is in front of a wall that is larger than the door.
        is_relief = is_parallel & (np.abs(distance) < config.structure_relief_m)
        is_level = np.abs(distance) < np.maximum(0.25 * tolerance, rms)
        n_level = pieces.n_points[is_relief & is_level].sum()
        n_just_behind = pieces.n_points[is_relief & (distance < 0) & ~is_level].sum()
        n_behind = pieces.n_points[has_depth & (distance < -2 * tolerance) & ~is_relief].sum()
        is_large = pieces.n_points[on_plane].sum() >= config.structure_min_fraction * total
        if is_large and n_behind <= config.structure_behind_fraction * total and n_just_behind <= n_level:
            planes.append(StructuralPlane(axis, offset, rms, colour[seed]))
            is_taken |= on_plane
    return planes


def plane_of_flush(pieces: Pieces, planes: list[StructuralPlane], config: SegmenterConfig) -> IndexArray:
    """The structural plane (N,) that a piece is flush with, -1 for none."""
    plane_of_piece = np.full(len(pieces), -1, np.intp)
    centroid, normal = pieces.centroid(), pieces.unit_normal()
    tolerance = np.maximum(config.structure_flush_m, config.structure_flush_relative * centroid[:, 2])
    for number, plane in enumerate(planes):
        distance = np.abs(centroid @ plane.normal - plane.offset)
        is_flush = (
            (distance < np.maximum(tolerance, plane.roughness_m))
            & (normal @ plane.normal > np.cos(np.deg2rad(12)))
            & (pieces.n_points > 0)
        )
        plane_of_piece[is_flush & (plane_of_piece < 0)] = number
    return plane_of_piece


def remove_structure(graph: Graph, config: SegmenterConfig) -> tuple[Graph, BoolArray]:
    """The surfaces of superpixels ``graph``, with the pieces of floor, walls and ceiling joined and marked (N,)."""
    surfaces = join_surfaces(graph, config)
    planes = structural_planes(surfaces, config)
    if not planes:
        return surfaces, np.zeros(len(surfaces.pieces), bool)
    colours = np.stack([plane.colour for plane in planes])
    flush = plane_of_flush(graph.pieces, planes, config)
    # Shading changes lightness: it counts less for pieces flush with a wall.
    weights = np.array([config.structure_lightness_weight, 1, 1])
    off_colour = np.linalg.norm((graph.pieces.mean_colour() - colours[flush]) * weights, axis=1)
    flush[off_colour > config.structure_colour] = -1
    graph, of_plane = _join_marked(graph, flush, len(planes))
    is_structure = of_plane >= 0
    rest = join_surfaces(graph, config, is_structure)
    of_plane = _marks_after(rest, graph, of_plane)
    flush = plane_of_flush(rest.pieces, planes, config)
    small = rest.pieces.n_pixels < config.structure_pattern_fraction * rest.pieces.n_pixels.sum()
    of_plane = np.where((of_plane < 0) & small, flush, of_plane)
    joined, of_plane = _join_marked(rest, of_plane, len(planes))
    return joined, of_plane >= 0


def _join_marked(graph: Graph, mark: IndexArray, n_marks: int) -> tuple[Graph, IndexArray]:
    """The graph with all pieces of equal ``mark`` (N,) >= 0 as one, and the marks of its pieces."""
    n = len(graph.pieces)
    first = np.full(n_marks, n, np.intp)
    marked = np.flatnonzero(mark >= 0)
    np.minimum.at(first, mark[marked], marked)
    joined = contract(graph, (marked, first[mark[marked]]))
    return joined, _marks_after(joined, graph, mark)


def _marks_after(joined: Graph, before: Graph, mark: IndexArray) -> IndexArray:
    after = np.full(len(joined.pieces), -1, np.intp)
    after[joined.piece_of_superpixel] = mark[before.piece_of_superpixel]
    return after


def join_objects(graph: Graph, is_structure: BoolArray, config: SegmenterConfig) -> tuple[Graph, BoolArray]:
    """Surfaces joined to objects if the evidence supports it; structure is not joined and stays marked."""

    def cost(current: Graph) -> Float64Array:
        return 2 / (1 + np.exp(np.clip(join_evidence(current, config.join), -30, 30)))

    joined = merge_cheapest(graph, cost, is_structure)
    mark = _marks_after(joined, graph, np.where(is_structure, 0, -1).astype(np.intp))
    return joined, mark >= 0


def join_evidence(graph: Graph, weights: JoinWeights) -> Float64Array:
    """The log-odds (E,) that the two pieces at a border are parts of one object: the weighted sum of the cues."""
    cues = join_cues(graph)
    evidence = np.full(len(graph.borders.a), weights.bias)
    for name, values in cues.items():
        evidence += float(getattr(weights, name)) * values
    return evidence


def join_cues(graph: Graph) -> dict[str, Float64Array]:
    """The factors of the weights in ``JoinWeights``, at every border (E,).

    Cues are combined as in boundary detectors (Martin, Fowlkes and Malik 2004); that concave edges separate objects and
    convex ones join parts is from Stein et al. (2014). Most saturate, as 1 - exp(-value / scale).
    """
    borders, pieces = graph.borders, graph.pieces
    colour, contrast, bend, gap = _differences(graph)
    sizes = np.stack([pieces.n_pixels[borders.a], pieces.n_pixels[borders.b]])
    off_colour = _saturating(colour, 12.0)
    distance = _distance_of_planes(graph)
    return {
        "contrast": _saturating(contrast, 10.0),
        "concave": _saturating(np.maximum(-bend, 0), 0.5),
        "colour_at_step": _saturating(distance, 0.03) * off_colour,
        "colour_at_small_step": _saturating(distance, 0.004) * off_colour * (1 - sizes.min(axis=0) / sizes.max(axis=0)),
        "gap": gap,
        "step": _saturating(borders.jump / np.maximum(borders.gap, 1), 0.1),
        "contact": np.log10(1 + borders.n_deep - borders.gap),
        "depth": borders.n_deep / borders.length,
        "larger": np.log10(sizes.max(axis=0)) - 3,
    }


def _saturating(values: Float64Array, scale: float) -> Float64Array:
    return np.asarray(1 - np.exp(-values / scale))


def _distance_of_planes(graph: Graph) -> Float64Array:
    """Distance m (E,) of the centre of a piece from the other's plane, the larger of the two."""
    borders, centroid, normal = graph.borders, graph.pieces.centroid(), graph.pieces.unit_normal()
    between = centroid[borders.a] - centroid[borders.b]
    off_a = np.abs((between * normal[borders.a]).sum(axis=1))
    off_b = np.abs((between * normal[borders.b]).sum(axis=1))
    return np.asarray(np.maximum(off_a, off_b))


def region_quality(
    graph: Graph, is_structure: BoolArray, at_image_border: Float64Array, config: SegmenterConfig
) -> Float64Array:
    """Probability (N,) that each piece is one complete object, 0..1; lower if little of its depth is known.

    The log-odds rise with the certainty of its borders, its size and its compactness, and fall with the share of its
    outline cut off by the image. ``at_image_border`` (N,) counts its pixels there.
    """
    borders, pieces, weights = graph.borders, graph.pieces, config.quality
    apart = 1 / (1 + np.exp(np.clip(join_evidence(graph, config.join), -30, 30)))
    apart[is_structure[borders.a] | is_structure[borders.b]] = 1

    def around(values: Float64Array) -> Float64Array:
        n = len(pieces)
        return np.asarray(np.bincount(borders.a, values, n) + np.bincount(borders.b, values, n))

    inner = around(borders.length)
    outline = np.maximum(inner + at_image_border, 1)
    evidence = (
        weights.bias
        + weights.border * around(borders.length * apart) / np.maximum(inner, 1)
        + weights.cut_off * at_image_border / outline
        + weights.size * (np.log10(pieces.n_pixels) - 2)
        + weights.compactness * np.minimum(16 * pieces.n_pixels / outline**2, 1)  # 1 for a square
    )
    coverage = 0.5 + 0.5 * pieces.n_points / np.maximum(pieces.n_pixels, 1)
    return np.asarray(coverage / (1 + np.exp(-evidence)))
