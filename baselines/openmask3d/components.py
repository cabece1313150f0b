"""What Mask3D and Segment3D do to their masks before they save them: connected parts, small ones left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from su3d_bench.core.maps import Masks, Proposals
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array

NOISE = -1


def split_into_parts(
    proposals: Proposals, eps_m: float, min_points: int, most_dropped: int, kept_share: float
) -> Proposals:
    """Each connected part of each mask as a mask with its score, the best first, of equal ones the earlier.

    Parts are DBSCAN's with ``eps_m`` and ``min_points``, whose noise belongs to none; those of at most ``most_dropped``
    points go, and of n others the first floor(``kept_share`` n) stay.
    """
    parts: list[Int64Array] = []
    scores: list[float] = []
    for k in range(len(proposals)):
        members = proposals.mask(k)
        labels = density_clusters(proposals.points[members], eps_m, min_points)
        for label in range(int(labels.max(initial=NOISE)) + 1):
            part = members[labels == label].astype(np.int64)
            if len(part) > most_dropped:
                parts.append(part)
                scores.append(float(proposals.scores[k]))
    order = np.argsort(-np.array(scores), kind="stable")[: int(kept_share * len(scores))]
    masks = Masks.of_sets([parts[k] for k in order])
    return replace(proposals, indptr=masks.indptr, indices=masks.indices, scores=np.array(scores, np.float64)[order])


def voted_by_segments(proposals: Proposals, segments: Int64Array) -> Proposals:
    """Each mask made of whole segments: those of which it holds more than half, as both networks are evaluated.

    ``segments`` (N,) are numbered from 0 on, one a point; masks that hold no segment by more than half become empty.

    >>> points = np.zeros((5, 3), np.float32)
    >>> masks = Proposals(np.array([0, 3]), np.array([0, 1, 3]), points=points, scores=np.ones(1), source="made")
    >>> voted_by_segments(masks, np.array([0, 0, 0, 1, 1])).indices.tolist()
    [0, 1, 2]
    """
    size = np.bincount(segments)
    order = np.argsort(segments, kind="stable")
    start = np.cumsum(size) - size
    kept = []
    for k in range(len(proposals)):
        held = np.bincount(segments[proposals.mask(k)], minlength=len(size))
        whole = np.flatnonzero(2 * held > size)
        kept.append(np.sort(np.concatenate([order[:0], *(order[start[s] : start[s] + size[s]] for s in whole)])))
    masks = Masks.of_sets(kept)
    return replace(proposals, indptr=masks.indptr, indices=masks.indices)


def density_clusters(points: Float32Array, eps_m: float, min_points: int) -> Int64Array:
    """DBSCAN's label (N,) of each point, 0, 1, ... in the order of their first points, -1 for noise."""
    if not len(points):
        return np.zeros(0, np.int64)
    if min_points <= 1:
        return linked_within(points.astype(np.float64), eps_m)
    from su3d_bench.numerics import clusters

    return clusters.density_clusters(points.astype(np.float64), eps_m, min_points)


def linked_within(points: Float64Array, gap_m: float) -> Int64Array:
    """The group (N,) of each point, where points within ``gap_m`` of each other are linked: DBSCAN with one point.

    DBSCAN itself lists all neighbours, which is the square of the number of points where ``gap_m`` spans a room. Here
    points share a cube whose diagonal is ``gap_m``, and two cubes are linked by their nearest points.
    """
    from scipy.spatial import cKDTree

    cells = np.floor((points - points.min(axis=0)) / (gap_m / np.sqrt(3))).astype(np.int64)
    distinct, cell_of = np.unique(cells, axis=0, return_inverse=True)
    cell_of = cell_of.reshape(-1)
    order = np.argsort(cell_of, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(cell_of))[:-1])
    root = np.arange(len(distinct))

    def find(cell: int) -> int:
        while root[cell] != cell:
            root[cell] = root[root[cell]]
            cell = int(root[cell])
        return cell

    # cubes whose points may be within the gap lie at most two apart along each axis
    pairs = cKDTree(distinct).query_pairs(2, p=np.inf, output_type="ndarray")
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        low, high = sorted((find(int(a)), find(int(b))))
        if low != high:
            distances, _ = cKDTree(points[members[a]]).query(points[members[b]], distance_upper_bound=gap_m * 1.001)
            if (distances <= gap_m).any():
                root[high] = low
    roots = np.array([find(cell) for cell in range(len(distinct))])[cell_of]
    _, first, group = np.unique(roots, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[group.reshape(-1)]
