"""Weight-free 3D proposals: parts of a mesh that stand out, from its shape alone. Ours; not Mask3D's.

The mesh's segments (the dataset's, else ScanNet's algorithm) are merged to a tree, and the nodes that bend most
against what is around them for the length of their border become masks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.baselines.mesh_segments.segments import MIN_VERTICES, THRESHOLD, mesh_segments
from su3d_bench.baselines.openmask3d.segment_tree import SegmentTree, contacts_of, is_within, merge_tree
from su3d_bench.core.maps import Masks, Proposals
from su3d_bench.core.types import Float64Array, Int64Array, Surface

SOURCE = "weight-free proposals from the mesh's shape, not a network's"
# Square metres of surface from which on size no longer speaks for a part. Chosen on rooms/living0 and rooms/office0.
FULL_AREA_M2 = 0.5
LEAST_BORDER = 0.2  # added to the relative length of a border, which is 0 where a part touches nothing
LONE_BEND = 0.3  # bend of the border of a part that touches nothing


@dataclass(frozen=True)
class NodeChoice:
    """Which nodes become masks: at most ``most``, of ``min_points`` vertices to ``max_share`` of all.

    Of two nested ones whose IoU exceeds ``same_iou`` only the better one.
    """

    most: int
    min_points: int
    max_share: float
    same_iou: float


def segments_of(surface: Surface, threshold: float = THRESHOLD, min_vertices: int = MIN_VERTICES) -> Int64Array:
    """The segment (V,) of each vertex, numbered 0 to S - 1: the published ones, else those of ScanNet's algorithm."""
    segments = surface.segments
    if segments is None:
        segments = mesh_segments(surface.vertices, surface.triangles, threshold, min_vertices)
    return np.unique(segments, return_inverse=True)[1].reshape(-1)


def surface_proposals(surface: Surface, row: Int64Array, choice: NodeChoice) -> Proposals:
    """The masks over the vertices of ``surface``, the best first; ``row`` (V,) is the segment of each vertex."""
    tree = merge_tree(contacts_of(surface.vertices, surface.triangles, row))
    n_points = np.bincount(row, minlength=len(tree.leaves))
    scores = contrast(tree)
    nodes = chosen_nodes(tree, n_points, scores, choice)
    rank = np.empty(len(tree.leaves), np.int64)
    rank[tree.leaves] = np.arange(len(tree.leaves))
    order = np.argsort(rank[row], kind="stable")  # vertices in the order of the leaves
    first = np.concatenate([[0], np.cumsum(n_points[tree.leaves])]).astype(np.int64)
    masks = Masks.of_sets([np.sort(order[first[tree.start[k]] : first[tree.end[k]]]) for k in nodes])
    return Proposals(masks.indptr, masks.indices, points=surface.vertices, scores=scores[nodes], source=SOURCE)


def contrast(tree: SegmentTree) -> Float64Array:
    """How much each node stands out (N,), about 0 to 1: mean bend of its border over the border's relative length.

    The relative length is the number of contacts over the root of the number of patches; nodes of less than
    ``FULL_AREA_M2`` count by the root of their area.
    """
    mean_bend = np.where(tree.n_contacts > 0, tree.bend / np.maximum(tree.n_contacts, 1), LONE_BEND)
    border = tree.n_contacts / np.sqrt(tree.n_patches)
    size = np.minimum(1.0, np.sqrt(tree.n_patches * tree.patch_m**2 / FULL_AREA_M2))
    result: Float64Array = mean_bend * size / (border + LEAST_BORDER)
    return result


def chosen_nodes(tree: SegmentTree, n_points: Int64Array, scores: Float64Array, choice: NodeChoice) -> Int64Array:
    """The nodes that ``choice`` takes, the best first, of equal ones the earlier; ``n_points`` (S,) of the segments."""
    before = np.concatenate([[0], np.cumsum(n_points[tree.leaves])])
    n_of_node = before[tree.end] - before[tree.start]
    fits = (n_of_node >= choice.min_points) & (n_of_node <= choice.max_share * before[-1])
    taken = np.zeros(0, np.int64)
    for node in np.argsort(-scores, kind="stable"):
        if len(taken) == choice.most:
            break
        smaller, larger = np.minimum(n_of_node[taken], n_of_node[node]), np.maximum(n_of_node[taken], n_of_node[node])
        is_same = is_within(tree, taken, int(node)) & (smaller > choice.same_iou * larger)
        if fits[node] and not is_same.any():
            taken = np.append(taken, node)
    return taken
