"""Collisions of objects: an object is a set of upright boxes, one per connected piece of its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.procedural.items import Item

MAX_PIECES = 24  # of an object; those of foliage and the like are merged by height
N_LEVELS = 6  # into which they are merged


def pieces_of(item: Item) -> Float64Array:
    """Bounds (K, 2, 3) in item coordinates of the connected pieces of an item's parts."""
    boxes = _connected(item)
    if len(boxes) <= MAX_PIECES:
        return boxes
    low, high = boxes[:, 0, 2].min(), boxes[:, 1, 2].max()
    level = ((boxes[:, :, 2].mean(axis=1) - low) / max(high - low, 1e-9) * N_LEVELS).astype(int).clip(0, N_LEVELS - 1)
    merged = [boxes[level == k] for k in range(N_LEVELS) if (level == k).any()]
    return np.stack([np.stack([b[:, 0].min(axis=0), b[:, 1].max(axis=0)]) for b in merged])


def _connected(item: Item) -> Float64Array:
    """Quads of one part that share a corner are one piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    quads = np.concatenate([part.shape.quads for part in item.parts])
    part = np.repeat(np.arange(len(item.parts)), [len(one.shape.quads) for one in item.parts])
    n, grid = len(quads), np.round(quads.reshape(-1, 3) * 1e4).astype(np.int64)
    key = grid @ np.array([1, 1 << 18, 1 << 36]) * len(item.parts) + np.repeat(part, 4)
    _, corner = np.unique(key, return_inverse=True)
    edges = coo_matrix((np.ones(4 * n, bool), (np.repeat(np.arange(n), 4), n + corner)), (n + corner.max() + 1,) * 2)
    label = connected_components(edges, directed=False)[1][:n]
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    low = np.minimum.reduceat(quads.min(axis=1)[order], starts)
    high = np.maximum.reduceat(quads.max(axis=1)[order], starts)
    return np.stack([low, high], axis=1)


@dataclass(frozen=True)
class Solids:
    """Upright boxes in the world: centres (K, 2), half sizes (K, 2), yaw (K,) radians, z (K, 2)."""

    centre: Float64Array
    half: Float64Array
    yaw: Float64Array
    z: Float64Array

    @staticmethod
    def of(pieces: Float64Array, yaw: float, position: Float64Array) -> Solids:
        angle = np.deg2rad(yaw)
        cos, sin = np.cos(angle), np.sin(angle)
        middle = pieces[..., :2].mean(axis=1)
        centre = middle @ np.array([[cos, sin], [-sin, cos]]) + position[:2]
        half = (pieces[:, 1, :2] - pieces[:, 0, :2]) / 2
        return Solids(centre, half, np.full(len(pieces), angle), pieces[..., 2] + position[2])

    @property
    def corners(self) -> Float64Array:
        """(K, 4, 2)."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        u = np.stack([cos, sin], axis=1) * self.half[:, :1]
        v = np.stack([-sin, cos], axis=1) * self.half[:, 1:]
        return np.stack([self.centre + a * u + b * v for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))], axis=1)

    @property
    def reach(self) -> Float64Array:
        """Half sizes (K, 2) of the rectangles parallel to x and y around them."""
        cos, sin = np.abs(np.cos(self.yaw)), np.abs(np.sin(self.yaw))
        w, d = self.half.T
        return np.stack([w * cos + d * sin, w * sin + d * cos], axis=1)

    def chosen(self, which: BoolArray) -> Solids:
        return Solids(self.centre[which], self.half[which], self.yaw[which], self.z[which])


def overlap(first: Solids, second: Solids, allowed: float, gap: float = 0.0) -> BoolArray:
    """Which pairs (K1, K2) overlap by more than ``allowed`` m, with ``gap`` m of air around to the sides.

    Separating axes: the sides of both rectangles, and z.
    """
    between = second.centre[None] - first.centre[:, None]
    hit = np.minimum(first.z[:, None, 1], second.z[None, :, 1]) - np.maximum(first.z[:, None, 0], second.z[None, :, 0])
    meet = np.asarray(hit > allowed)
    turn = second.yaw[None] - first.yaw[:, None]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    for one, other, axis_is_first in ((first, second, True), (second, first, False)):
        yaw = one.yaw[:, None] if axis_is_first else one.yaw[None]
        half = one.half[:, None] if axis_is_first else one.half[None]
        far = other.half[None] if axis_is_first else other.half[:, None]
        along = np.abs(between[..., 0] * np.cos(yaw) + between[..., 1] * np.sin(yaw))
        across = np.abs(between[..., 1] * np.cos(yaw) - between[..., 0] * np.sin(yaw))
        meet &= half[..., 0] + far[..., 0] * cos + far[..., 1] * sin - along > allowed - gap
        meet &= half[..., 1] + far[..., 0] * sin + far[..., 1] * cos - across > allowed - gap
    return meet
