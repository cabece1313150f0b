"""What joins: superpixels to surfaces, surfaces to floor and walls, the other surfaces to objects."""

from __future__ import annotations

import numpy as np

from su3d_bench.perception.segmenter_config import SegmenterConfig
from su3d_bench.perception.segmenter_graph import Graph, IndexArray, merge_cheapest
from su3d_bench.types import BoolArray, Float64Array


def join_surfaces(graph: Graph, config: SegmenterConfig) -> Graph:
    """Superpixels of like colour across borders without jump or crease, joined."""

    def cost(current: Graph) -> Float64Array:
        colour, contrast, bend, gap = _differences(current)
        terms = (
            colour / config.surface_colour,
            contrast / config.surface_contrast,
            np.abs(bend) / np.deg2rad(config.surface_bend_degrees),
            gap / config.surface_gap,
        )
        return np.sqrt(sum(term**2 for term in terms))

    return merge_cheapest(graph, cost)


def _differences(graph: Graph) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Of every border: distance of the mean colours, mean contrast, mean bend rad, fraction of pairs with a jump."""
    borders, means = graph.borders, graph.pieces.mean_colour()
    colour = np.linalg.norm(means[borders.a] - means[borders.b], axis=1)
    n_smooth = borders.n_deep - borders.gap
    bend = borders.bend / np.maximum(n_smooth, 1)
    gap = borders.gap / np.maximum(borders.n_deep, 1)
    return colour, borders.contrast / borders.length, bend, gap


def find_structure(graph: Graph, config: SegmenterConfig) -> BoolArray:
    """Which pieces (N,) are floor, wall or ceiling: large planes with nothing behind, in the colour of most of each."""
    pieces = graph.pieces
    centroid, normal = pieces.centroid(), pieces.unit_normal()
    total = float(pieces.n_points.sum())
    is_structure = np.zeros(len(pieces), bool)
    is_seen = np.zeros(len(pieces), bool)
    colour = pieces.mean_colour()
    for seed in np.argsort(-pieces.n_points, kind="stable"):
        if pieces.n_points[seed] < 0.25 * config.structure_min_fraction * total:
            break
        if is_seen[seed]:
            continue
        offset = (centroid - centroid[seed]) @ normal[seed]
        is_parallel = normal @ normal[seed] > np.cos(np.deg2rad(12))
        tolerance = np.maximum(config.structure_distance_m, 0.015 * centroid[:, 2])
        on_plane = is_parallel & (np.abs(offset) < tolerance) & (pieces.n_points > 0)
        behind = (offset < -2 * tolerance) & (pieces.n_points > 0)
        is_large = pieces.n_points[on_plane].sum() >= config.structure_min_fraction * total
        if not is_large or pieces.n_points[behind].sum() > config.structure_behind_fraction * total:
            continue
        is_like = np.linalg.norm(colour - colour[seed], axis=1) < config.structure_colour
        is_structure |= on_plane & is_like
        is_seen |= on_plane
    return is_structure


def join_objects(graph: Graph, is_structure: BoolArray, config: SegmenterConfig) -> tuple[Graph, IndexArray]:
    """Surfaces joined to objects across convex borders; also the piece (S,) of every first surface."""
    # Structure is kept out of every join by a mark that travels with the pieces: its count of pixels is negative.
    structural = np.zeros(len(graph.pieces), bool)
    structural[:] = is_structure
    blocked = structural[graph.borders.a] | structural[graph.borders.b]
    keep = ~blocked
    borders = type(graph.borders)(*(values[keep] for values in vars(graph.borders).values()))
    inner = Graph(graph.pieces, borders, np.arange(len(graph.pieces)))

    def cost(current: Graph) -> Float64Array:
        colour, _, bend, gap = _differences(current)
        limit = np.deg2rad(config.object_bend_degrees)
        unit = np.where(
            bend > limit,
            config.object_convex_colour,
            np.where(bend < -limit, config.object_concave_colour, config.object_flat_colour),
        )
        return np.sqrt((colour / unit) ** 2 + (gap / config.object_gap) ** 2)

    joined = merge_cheapest(inner, cost)
    return joined, joined.piece_of_superpixel
