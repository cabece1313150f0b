"""Clouds with group ids, a plain loop of SAM3D's overlap to compare with, and images of plates, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.baselines.sam3d.overlap import GroupedCloud
from su3d_bench.core.types import Detections, Float64Array, Frame, Int64Array

WIDTH, HEIGHT, FOCAL = 160, 120, 120.0
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
PLATE_M = 2.0


def ids(*values: int) -> Int64Array:
    return np.array(values, np.int64)


def cloud(points: object, group: object, view_group: Sequence[int] = (), views: Sequence[int] = ()) -> GroupedCloud:
    return GroupedCloud(
        np.array(points, np.float64).reshape(-1, 3), np.array(group, np.int64), ids(*view_group), ids(*views)
    )


def row(*centres: float) -> Float64Array:
    """Points along x at these centimetres."""
    return np.array([[x / 100, 0, 0] for x in centres]).reshape(-1, 3)


def patch(n_x: int, n_y: int, x: int = 0, y: int = 0) -> Float64Array:
    """Centres of the 5 cm voxels from (x, y) on, in the plane z = 0.02 m."""
    grid = np.stack(np.meshgrid(np.arange(x, x + n_x), np.arange(y, y + n_y), indexing="ij"), -1).reshape(-1, 2)
    return np.column_stack([(grid + 0.5) * 0.05, np.full(len(grid), 0.02)])


def nearest_by_brute_force(queries: Float64Array, points: Float64Array, radius_m: float) -> list[tuple[int, int]]:
    """Pairs by comparing every two points in float32; the first of equals, the radius itself is too far."""
    pairs = []
    held = points.astype(np.float32)
    for i, query in enumerate(queries.astype(np.float32)):
        offset = query - held
        squared = offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1] + offset[:, 2] * offset[:, 2]
        best = int(np.argmin(squared))
        if np.sqrt(squared[best]) < np.float32(radius_m):
            pairs.append((i, best))
    return pairs


@dataclass(frozen=True)
class Plate:
    """A rectangle facing the camera 2 m away: its lower and upper x and y, metres; ``axis`` is that of its feature."""

    x: tuple[float, float]
    y: tuple[float, float] = (-0.5, 0.5)
    axis: int = 0


def look(plates: Sequence[Plate], index: int, camera_x: float = 0.0, n_axes: int = 4) -> tuple[Frame, Detections]:
    """A frame of the plates alone, nothing behind them, with one mask each, in order, which may overlap."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x = (u - INTRINSICS[0, 2]) / FOCAL * PLATE_M + camera_x
    y = (v - INTRINSICS[1, 2]) / FOCAL * PLATE_M
    masks = [(p.x[0] <= x) & (x < p.x[1]) & (p.y[0] <= y) & (y < p.y[1]) for p in plates]
    depth_m = np.where(np.any(masks, axis=0) if masks else np.zeros(u.shape, bool), PLATE_M, 0).astype(np.float32)
    pose = np.eye(4)
    pose[0, 3] = camera_x
    n = len(plates)
    features = np.zeros((n, 1, n_axes), np.float32)
    features[np.arange(n), 0, [plate.axis for plate in plates]] = 1
    frame = Frame(index, 0.0, np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth_m, pose, INTRINSICS)
    detections = Detections(
        index,
        np.array(masks, np.bool_).reshape(n, HEIGHT, WIDTH),
        np.zeros((n, 4), np.float32),
        np.full(n, 0.5, np.float32),
        tuple(f"plate {k}" for k in range(n)),
        tuple(f"a plate, number {k}" for k in range(n)),
        (1.0,),
        features,
        np.full(n_axes, n_axes**-0.5, np.float32),
    )
    return frame, detections
