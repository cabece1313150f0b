"""Cost of a complete update of OpenSU3D, without perception, with 0.1 to 10 million points in the map.

    python -m pytest benchmarks/speed/bench_update.py --benchmark-only --benchmark-group-by=group

A 1200x680 image of a wall with 24 masks; the map contains that wall, far beyond the view, at one point per 2 cm voxel.
Either every pixel is back-projected and reduced to voxels (the default), or every second one each way: 204,000
points with 3 mm of depth noise that are all matched and inserted (``frame_voxel`` 0).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from wall import DISTANCE_M, HEIGHT, VOXEL_M, WIDTH, view

from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D


def every_second_pixel(frame: Frame, detections: Detections) -> tuple[Frame, Detections]:
    noise_m = np.random.default_rng(0).normal(0, 0.003, (HEIGHT // 2, WIDTH // 2))
    halved = frame.intrinsics * [[0.5], [0.5], [1.0]]
    depth_m = (frame.depth_m[::2, ::2] + noise_m).astype(np.float32)
    masks = np.ascontiguousarray(detections.masks[:, ::2, ::2])
    rgb = np.ascontiguousarray(frame.rgb[::2, ::2])
    return replace(frame, rgb=rgb, depth_m=depth_m, intrinsics=halved), replace(detections, masks=masks)


def filled(method: OpenSU3D, n_points: int) -> OpenSU3D:
    side = round(n_points**0.5)
    for rows in np.array_split(np.arange(side), max(1, n_points // 100_000)):
        y, x = np.meshgrid(rows, np.arange(side), indexing="ij")
        points = (np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + 0.5) * VOXEL_M
        points += [-side * VOXEL_M / 2, -side * VOXEL_M / 2, DISTANCE_M - VOXEL_M / 2]
        ids = 1 + (x.ravel() // 50) + (y.ravel() // 50) * (side // 50 + 1)
        method._map.insert(points, ids.astype(np.int32))
    return method


@pytest.mark.parametrize("n_points", [100_000, 1_000_000, 10_000_000])
def test_update(benchmark: BenchmarkFixture, n_points: int) -> None:
    benchmark.group = "update, all 816,000 pixels reduced to voxels"
    method = filled(OpenSU3D(), n_points)
    frame, detections = view()
    n_before = method.n_points
    benchmark.pedantic(lambda: method.update(frame, detections, Timer()), rounds=10, warmup_rounds=2)
    assert n_before <= method.n_points <= n_before + 100


@pytest.mark.parametrize("n_points", [100_000, 500_000, 10_000_000])
def test_update_of_204_000_points(benchmark: BenchmarkFixture, n_points: int) -> None:
    benchmark.group = "update, 204,000 points"
    method = filled(OpenSU3D(OpenSU3DConfig(frame_voxel=0.0)), n_points)
    frame, detections = every_second_pixel(*view())
    benchmark.pedantic(lambda: method.update(frame, detections, Timer()), rounds=10, warmup_rounds=2)
    assert method.n_points < n_points + 204_000  # nearly every point fell into an occupied voxel
