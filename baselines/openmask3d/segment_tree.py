"""A tree over the segments of a mesh: which parts belong together, from the surface's shape only.

Our own design, not from a paper. Segments touch along edges and if they share a small cube of space, so
cracks in a scan do not separate. Two regions are merged earlier the less the surface bends into the room's
interior between them, the larger the shared part of the smaller one's border, and the smaller they are.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array

MIN_PATCH_M = 0.02  # side of the cubes, unless the mesh's edges are longer
FLAT_BEND = 0.01  # bend of a flat contact, so that flat borders still count by their length
CONVEX_SHARE = 0.5  # convex edges are more often inside an object than at its border: their bend is squared and halved
# Added to the mean bend and subtracted from the share, so that no factor of a cost is 0.
MIN_BEND, MIN_OPEN = 0.02, 0.01
NO_PARENT = -1
Border = dict[int, tuple[int, float]]  # region -> number of contacts with it, and their summed bend


@dataclass(frozen=True)
class Contacts:
    """Borders between segments: E pairs ``first`` < ``second`` with their number of contacts and summed bend.

    ``n_patches`` (S,) is the size of each of S segments in cubes of side ``patch_m``.
    """

    first: Int64Array
    second: Int64Array
    n: Int64Array
    bend: Float64Array
    n_patches: Int64Array
    patch_m: float


@dataclass(frozen=True)
class SegmentTree:
    """N nodes: first the S segments, then merges of two earlier nodes.

    ``parent`` (N,), -1 for roots; ``n_patches`` (N,); ``n_contacts`` and ``bend`` (N,) of a node's border with all
    others. Node k contains the segments ``leaves[start[k]:end[k]]``, so nodes are nested or disjoint.
    """

    parent: Int64Array
    n_patches: Int64Array
    n_contacts: Int64Array
    bend: Float64Array
    leaves: Int64Array
    start: Int64Array
    end: Int64Array
    patch_m: float


def contacts_of(vertices: Float32Array, triangles: Int32Array, segments: Int64Array) -> Contacts:
    """Contacts between ``segments`` (V,), numbered 0 to S - 1: patches with a common edge, or in touching cubes.

    A patch is the part of one segment in one cube; cubes touch if identical or sharing a face. The bend of a contact is
    (1 - cos) / 2 of the angle between the normals of its patches, reduced where the surface is convex.
    """
    n_segments = int(segments.max()) + 1 if len(segments) else 0
    patch_m = _patch_size_m(vertices, triangles)
    cells, step = _cells(vertices, n_segments, patch_m)
    keys, inverse = np.unique(cells * max(n_segments, 1) + segments, return_inverse=True)
    patch, owner = np.divmod(keys, max(n_segments, 1))
    n = np.bincount(inverse, minlength=len(patch))
    centres = _sums(inverse, vertices, len(patch)) / n[:, None]
    normals = _sums(inverse, _vertex_normals(vertices, triangles), len(patch))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    a, b = _touching(patch, owner, step, inverse[triangles])
    bend = (1 - np.einsum("ij,ij->i", normals[a], normals[b])) / 2
    is_convex = np.einsum("ij,ij->i", normals[b] - normals[a], centres[b] - centres[a]) > 0
    bend = np.where(is_convex, CONVEX_SHARE * bend * bend, bend) + FLAT_BEND
    low, high = np.minimum(owner[a], owner[b]), np.maximum(owner[a], owner[b])
    pairs, of_pair = np.unique(low * max(n_segments, 1) + high, return_inverse=True)
    first, second = np.divmod(pairs, max(n_segments, 1))
    return Contacts(
        first=first,
        second=second,
        n=np.bincount(of_pair, minlength=len(pairs)),
        bend=np.bincount(of_pair, bend, len(pairs)).astype(np.float64),
        n_patches=np.bincount(owner, minlength=n_segments),
        patch_m=patch_m,
    )


def _patch_size_m(vertices: Float32Array, triangles: Int32Array) -> float:
    """The median edge length, so that neighbours are in touching cubes; decimated scans have at least 3 cm."""
    if not len(triangles):
        return MIN_PATCH_M
    edges = vertices[triangles].astype(np.float64)
    return max(MIN_PATCH_M, float(np.median(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))))


def _cells(vertices: Float32Array, n_segments: int, patch_m: float) -> tuple[Int64Array, tuple[int, int, int]]:
    """A number for the cube of each vertex, and its increment for a step along each axis."""
    extent_m = np.ptp(vertices.astype(np.float64), axis=0) if len(vertices) else np.zeros(3)
    sizes = [int(side / patch_m) + 3 for side in extent_m]  # a free layer on both sides: steps never wrap around
    if sizes[0] * sizes[1] * sizes[2] * max(n_segments, 1) > 2**62:
        raise DataError(f"the mesh spans {extent_m.max():.0f} m; proposals from its surface need a mesh in metres")
    step = (sizes[1] * sizes[2], sizes[2], 1)
    low = vertices.min(axis=0).astype(np.float64) if len(vertices) else np.zeros(3)
    grid = np.floor((vertices - low) / patch_m).astype(np.int64) + 1
    return grid @ np.array(step, np.int64), step


def _sums(group: Int32Array | Int64Array, values: Float32Array | Float64Array, n: int) -> Float64Array:
    return np.stack([np.bincount(group, values[:, axis].astype(np.float64), n) for axis in range(3)], axis=1)


def _vertex_normals(vertices: Float32Array, triangles: Int32Array) -> Float64Array:
    """Area-weighted sums (V, 3) of the triangles' normals around each vertex."""
    corners = vertices.astype(np.float64)[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return sum((_sums(triangles[:, k], normals, len(vertices)) for k in range(3)), np.zeros((len(vertices), 3)))


def _touching(
    cube: Int64Array, owner: Int64Array, step: tuple[int, int, int], triangles: Int64Array
) -> tuple[Int64Array, Int64Array]:
    """Pairs of patches of two segments, without duplicates; ``cube`` ascends, ``triangles`` (T, 3) index patches."""
    pairs = []
    for offset in (0, *step):
        begin = np.searchsorted(cube, cube + offset, "left")
        n = np.searchsorted(cube, cube + offset, "right") - begin
        a = np.repeat(np.arange(len(cube)), n)
        b = np.arange(len(a)) - np.repeat(np.cumsum(n) - n - begin, n)
        pairs.append(np.stack([a, b]))
    pairs += [np.sort(triangles[:, ends].T, axis=0) for ends in ([0, 1], [1, 2], [2, 0])]
    a, b = np.concatenate(pairs, axis=1)
    is_pair = (owner[a] != owner[b]) & (a < b)
    keys = np.unique(a[is_pair] * len(cube) + b[is_pair])
    return keys // max(len(cube), 1), keys % max(len(cube), 1)


def merge_cost(bend: float, n: int, n_smaller_border: int, n_patches: int) -> float:
    """The cost of merging two regions that share ``n`` of the contacts of the one with fewer.

    >>> round(merge_cost(bend=5.0, n=10, n_smaller_border=40, n_patches=100), 4)  # (0.5 + 0.02) * (1.01 - 0.25) * 10
    3.952
    """
    return float((bend / n + MIN_BEND) * (1 + MIN_OPEN - n / n_smaller_border) * n_patches**0.5)


def merge_tree(contacts: Contacts) -> SegmentTree:
    """The tree built by merging the cheapest pair of touching regions, ties by lowest numbers.

    Isolated regions stay separate: the tree may have several roots.
    """
    n_leaves = len(contacts.n_patches)
    borders: list[Border] = [{} for _ in range(n_leaves)]
    rows = zip(*(part.tolist() for part in (contacts.first, contacts.second, contacts.n, contacts.bend)), strict=True)
    for a, b, n, bend in rows:
        borders[a][b] = borders[b][a] = n, bend
    n_patches = contacts.n_patches.tolist()
    totals = [_total(border) for border in borders]
    parent = [NO_PARENT] * n_leaves

    def cost(a: int, b: int) -> tuple[float, int, int]:
        n, bend = borders[a][b]
        least = min(totals[a][0], totals[b][0])
        return merge_cost(bend, n, least, n_patches[a] + n_patches[b]), min(a, b), max(a, b)

    queue = [cost(a, b) for a, b in zip(contacts.first.tolist(), contacts.second.tolist(), strict=True)]
    heapq.heapify(queue)
    while queue:
        _, a, b = heapq.heappop(queue)
        if parent[a] != NO_PARENT or parent[b] != NO_PARENT:
            continue
        new = len(parent)
        parent[a] = parent[b] = new
        parent.append(NO_PARENT)
        n_patches.append(n_patches[a] + n_patches[b])
        borders.append(_joined_border(borders, a, b, new))
        totals.append(_total(borders[new]))
        for other in borders[new]:
            heapq.heappush(queue, cost(new, other))
    leaves, start, end = _ranges(parent, n_leaves)
    return SegmentTree(
        parent=np.array(parent, np.int64),
        n_patches=np.array(n_patches, np.int64),
        n_contacts=np.array([n for n, _ in totals], np.int64),
        bend=np.array([bend for _, bend in totals], np.float64),
        leaves=leaves,
        start=start,
        end=end,
        patch_m=contacts.patch_m,
    )


def _total(border: Border) -> tuple[int, float]:
    return sum(n for n, _ in border.values()), sum(bend for _, bend in border.values())


def _joined_border(borders: list[Border], a: int, b: int, new: int) -> Border:
    """The border of the region merged from ``a`` and ``b``, updated at its neighbours too."""
    joined: Border = {}
    for old in (a, b):
        for other, (n, bend) in borders[old].items():
            if other not in (a, b):
                before = joined.get(other, (0, 0.0))
                joined[other] = before[0] + n, before[1] + bend
        borders[old] = {}
    for other, border in joined.items():
        borders[other].pop(a, None)
        borders[other].pop(b, None)
        borders[other][new] = border
    return joined


def _ranges(parent: list[int], n_leaves: int) -> tuple[Int64Array, Int64Array, Int64Array]:
    """An order of the leaves in which each node's leaves are contiguous, and their start and end."""
    n = len(parent)
    size = np.zeros(n, np.int64)
    size[:n_leaves] = 1
    for node in range(n):  # children come before parents
        if parent[node] != NO_PARENT:
            size[parent[node]] += size[node]
    start, free = np.zeros(n, np.int64), np.zeros(n, np.int64)
    next_root = 0
    for node in range(n - 1, -1, -1):  # parents first; each child takes the next part of its parent's range
        above = parent[node]
        if above == NO_PARENT:
            start[node], next_root = next_root, next_root + int(size[node])
        else:
            start[node] = start[above] + free[above]
            free[above] += size[node]
    leaves = np.empty(n_leaves, np.int64)
    leaves[start[:n_leaves]] = np.arange(n_leaves)
    return leaves, start, start + size


def is_within(tree: SegmentTree, nodes: Int64Array, node: int) -> BoolArray:
    """Whether each of ``nodes`` is inside ``node`` or contains it."""
    inside = (tree.start[nodes] >= tree.start[node]) & (tree.end[nodes] <= tree.end[node])
    around = (tree.start[nodes] <= tree.start[node]) & (tree.end[nodes] >= tree.end[node])
    result: BoolArray = inside | around
    return result
