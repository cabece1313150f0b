"""A graph of neighbouring surface pieces, contracted in rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array

IndexArray = NDArray[np.intp]


@dataclass(frozen=True)
class Pieces:
    """Sums over the pixels of N pieces; points and normals only where depth is known.

    ``n_pixels``, ``n_points`` (N,); ``colour`` (N, 3) sum of Lab; ``point`` (N, 3) sum of camera-frame points m;
    ``scatter`` (N, 6) sums of xx, xy, xz, yy, yz, zz; ``normal`` (N, 3) sum of unit normals towards the camera;
    ``n_pairs``, ``contrast`` (N,) neighbouring pixels inside and the sum of their colour differences.
    """

    n_pixels: Float64Array
    n_points: Float64Array
    colour: Float64Array
    point: Float64Array
    scatter: Float64Array
    normal: Float64Array
    n_pairs: Float64Array
    contrast: Float64Array

    @classmethod
    def from_sums(cls, sums: Float64Array) -> Pieces:
        """Pieces from the columns of ``kernels.sum_pixels``."""
        return cls(
            n_pixels=sums[:, 0],
            n_points=sums[:, 1],
            colour=sums[:, 2:5],
            point=sums[:, 5:8],
            scatter=sums[:, 8:14],
            normal=sums[:, 14:17],
            n_pairs=sums[:, 17],
            contrast=sums[:, 18],
        )

    def __len__(self) -> int:
        return len(self.n_pixels)

    def joined(self, label: IndexArray, n: int) -> Pieces:
        """The pieces with equal ``label`` (N,) in 0..n-1 as one."""
        return Pieces(*(_sum_by(label, values, n) for values in vars(self).values()))

    def mean_colour(self) -> Float64Array:
        return self.colour / np.maximum(self.n_pixels, 1)[:, None]

    def centroid(self) -> Float64Array:
        return self.point / np.maximum(self.n_points, 1)[:, None]

    def unit_normal(self) -> Float64Array:
        """Mean directions (N, 3), zero if no normal is known."""
        length = np.linalg.norm(self.normal, axis=1, keepdims=True)
        return self.normal / np.where(length > 0, length, 1)

    def plane_of(self, piece: int) -> tuple[Float64Array, float]:
        """The unit normal, towards the camera, of a piece's best plane, and the rms distance m of its points."""
        n = max(float(self.n_points[piece]), 1.0)
        mean, s = self.point[piece] / n, self.scatter[piece] / n
        matrix = np.array([[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]]) - np.outer(mean, mean)
        values, vectors = np.linalg.eigh(matrix)
        axis: Float64Array = vectors[:, 0]
        return (-axis if axis @ mean > 0 else axis), float(np.sqrt(max(values[0], 0.0)))


@dataclass(frozen=True)
class Borders:
    """Sums along the E borders between pieces ``a`` < ``b`` (E,): pixel pairs, and the measurements at each pair.

    ``length`` pairs; ``contrast`` colour difference; ``n_deep`` pairs with depth on both sides; ``gap`` those of them
    with a jump in depth; ``jump`` their relative depth steps; ``bend`` signed angle between the pieces over the pairs
    without a jump, positive if convex.
    """

    a: IndexArray
    b: IndexArray
    length: Float64Array
    contrast: Float64Array
    n_deep: Float64Array
    gap: Float64Array
    jump: Float64Array
    bend: Float64Array

    def joined(self, label: IndexArray) -> Borders:
        """The borders that remain between pieces of different ``label``, sorted by (a, b)."""
        a, b = label[self.a], label[self.b]
        stays = a != b
        low, high = np.minimum(a, b)[stays], np.maximum(a, b)[stays]
        n = int(label.max()) + 1 if len(label) else 0
        keys, group = np.unique(low * n + high, return_inverse=True)
        sums = (self.length, self.contrast, self.n_deep, self.gap, self.jump, self.bend)
        return Borders(
            keys // max(n, 1), keys % max(n, 1), *(_sum_by(group, values[stays], len(keys)) for values in sums)
        )


@dataclass(frozen=True)
class Graph:
    """Pieces and borders, and the piece of each original superpixel (S,)."""

    pieces: Pieces
    borders: Borders
    piece_of_superpixel: IndexArray


def _sum_by(label: IndexArray, values: Float64Array, n: int) -> Float64Array:
    from su3d_bench.perception.embedded.kernels import sum_rows

    if values.ndim == 1:
        return np.asarray(np.bincount(label, values, n), np.float64)
    sums: Float64Array = sum_rows(label, np.ascontiguousarray(values), n)
    return sums


def contract(graph: Graph, pairs: tuple[IndexArray, IndexArray]) -> Graph:
    """The graph with the two pieces of each pair joined, chains included."""
    from su3d_bench.perception.embedded.kernels import connected

    label, n_joined = connected(*pairs, len(graph.pieces))
    pieces, borders = graph.pieces.joined(label, n_joined), graph.borders
    inside = label[borders.a] == label[borders.b]
    owner = label[borders.a[inside]]
    pieces = replace(
        pieces,
        n_pairs=pieces.n_pairs + np.bincount(owner, borders.length[inside], n_joined),
        contrast=pieces.contrast + np.bincount(owner, borders.contrast[inside], n_joined),
    )
    return Graph(pieces, borders.joined(label), label[graph.piece_of_superpixel])


def merge_cheapest(
    graph: Graph, cost: Callable[[Graph], Float64Array], is_apart: BoolArray | None = None, n_levels: int = 8
) -> Graph:
    """Join pieces while a border's ``cost`` (E,) is below 1, cheap borders first.

    The limit rises to 1 in ``n_levels`` steps. At each step every piece joins its cheapest neighbour below the limit,
    and costs are recomputed from the joined sums, until none is left. Ties go to the pair first by (a, b).
    Pieces with ``is_apart`` (N,) are not joined.
    """
    if is_apart is not None:
        apart_first = is_apart[graph.piece_of_superpixel]
    for level in range(1, n_levels + 1):
        while True:
            price = cost(graph)
            if is_apart is not None:
                apart = np.zeros(len(graph.pieces), bool)
                apart[graph.piece_of_superpixel] = apart_first
                price = np.where(apart[graph.borders.a] | apart[graph.borders.b], np.inf, price)
            a, b = graph.borders.a, graph.borders.b
            cheap = np.flatnonzero(price < level / n_levels)
            if not len(cheap):
                break
            rank = np.empty(len(price), np.int64)
            rank[np.argsort(price, kind="stable")] = np.arange(len(price))
            best = np.full(len(graph.pieces), len(price), np.int64)
            np.minimum.at(best, a[cheap], rank[cheap])
            np.minimum.at(best, b[cheap], rank[cheap])
            is_best = (best[a[cheap]] == rank[cheap]) | (best[b[cheap]] == rank[cheap])
            graph = contract(graph, (a[cheap[is_best]], b[cheap[is_best]]))
    return graph


def measure_borders(
    labels: Int32Array, contrast: Float32Array, depth_cost: Float32Array, depth_unit: float, pieces: Pieces
) -> Borders:
    """The borders of the superpixels in ``labels`` (H, W), from per-pair colour and depth differences (2, H, W).

    Depth differences are relative, in units of ``depth_unit``, and count as jumps from 1 on; -1 where unknown.
    """
    a, b, contrasts, depth = border_pairs(labels, contrast, depth_cost)
    deep, gap = (depth >= 0).astype(np.float64), (depth >= 1).astype(np.float64)
    jump = np.where(gap > 0, depth.astype(np.float64) * depth_unit, 0.0)
    pairs = Borders(a, b, np.ones(len(depth)), contrasts.astype(np.float64), deep, gap, jump, np.zeros(len(depth)))
    borders = pairs.joined(np.arange(len(pieces)))
    return replace(borders, bend=(borders.n_deep - borders.gap) * signed_bend(pieces, borders.a, borders.b))


def border_pairs(
    labels: Int32Array, contrast: Float32Array, depth_cost: Float32Array
) -> tuple[IndexArray, IndexArray, Float32Array, Float32Array]:
    """The neighbouring pixels of different ``labels`` (H, W): the lower and the higher label, and both differences.

    First the pairs along rows, then those along columns, as in ``contrast`` and ``depth_cost`` (2, H, W).
    """
    differs = np.zeros(contrast.shape, bool)
    np.not_equal(labels[:, :-1], labels[:, 1:], out=differs[0, :, :-1])
    np.not_equal(labels[:-1], labels[1:], out=differs[1, :-1])
    at, flat = np.flatnonzero(differs), labels.ravel().astype(np.intp)
    pixel = at % labels.size
    here, there = flat[pixel], flat[pixel + np.where(at < labels.size, 1, labels.shape[1])]
    return np.minimum(here, there), np.maximum(here, there), contrast.ravel()[at], depth_cost.ravel()[at]


def signed_bend(pieces: Pieces, a: IndexArray, b: IndexArray) -> Float64Array:
    """Angles (E,) rad between the normals of pieces ``a`` and ``b``: positive if the edge is convex."""
    normal, centroid = pieces.unit_normal(), pieces.centroid()
    angle = np.arccos(np.clip((normal[a] * normal[b]).sum(axis=1), -1, 1))
    known = (pieces.n_points[a] > 0) & (pieces.n_points[b] > 0)
    side = ((normal[a] - normal[b]) * (centroid[a] - centroid[b])).sum(axis=1)
    return np.where(known, np.where(side >= 0, angle, -angle), 0.0)
