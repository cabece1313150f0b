"""Cost of an update's matching as the map grows: ours compared with KD-trees rebuilt at each update.

A frame of 204,000 points (1200x680, every second pixel in both directions) sees part of a floor-like surface of 10,000
points per square metre; depth noise is 3 mm. Results are exact. Open3D's KDTreeFlann answers one point per call: only
one query in 40 is made, so its time is a lower bound; against 5 million points every query is made too.

    python -m pytest benchmarks/speed/bench_association.py --benchmark-only --benchmark-group-by=group
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.core.types import Float64Array
from su3d_bench.opensu3d.voxel_map import VoxelMap

EPS = 0.02
SIZES = [100_000, 500_000, 1_000_000, 5_000_000]
N_FRAME = 204_000
VIEW_M = 4.5  # side of the square visible in a frame


@dataclass(frozen=True)
class Case:
    scene: Float64Array
    frame: Float64Array


@cache
def case(n_scene: int) -> Case:
    rng = np.random.default_rng(0)
    side = (n_scene / 1e4) ** 0.5
    view = min(side, VIEW_M)
    scene = np.column_stack([rng.uniform(0, side, (n_scene, 2)), rng.normal(0, 0.003, n_scene)])
    scene = scene[np.lexsort(np.floor(scene[:, :2] / 0.5).T)]  # patch by patch, as a map is filled
    rows, columns = np.divmod(np.arange(N_FRAME), 600)  # row by row, in pixel order
    pixels = np.column_stack([columns / 600, rows / 340]) * view
    return Case(scene, np.column_stack([pixels, rng.normal(0, 0.003, N_FRAME)]))


@cache
def filled_map(n_scene: int) -> VoxelMap:
    voxel_map = VoxelMap(EPS, "all")
    scene = case(n_scene).scene
    voxel_map.insert(scene, np.ones(len(scene), np.int32))
    return voxel_map


@pytest.mark.parametrize("n_scene", SIZES)
def test_voxel_map(benchmark: BenchmarkFixture, n_scene: int) -> None:
    benchmark.group = f"match against {n_scene:,} points"
    voxel_map, frame = filled_map(n_scene), case(n_scene).frame
    found = benchmark.pedantic(voxel_map.nearest, (frame,), rounds=5, warmup_rounds=1)
    assert np.count_nonzero(found >= 0) > 0.9 * N_FRAME


@pytest.mark.parametrize("n_scene", [500_000, 10_000_000])
def test_voxel_map_as_it_grows(benchmark: BenchmarkFixture, n_scene: int) -> None:
    benchmark.group = "match as the map grows twentyfold"
    voxel_map, frame = filled_map(n_scene), case(n_scene).frame
    found = benchmark.pedantic(voxel_map.nearest, (frame,), rounds=15, warmup_rounds=2)
    assert np.count_nonzero(found >= 0) > 0.9 * N_FRAME


@pytest.mark.parametrize("n_scene", SIZES)
def test_cropped_ckdtree(benchmark: BenchmarkFixture, n_scene: int) -> None:
    from scipy.spatial import cKDTree

    benchmark.group = f"match against {n_scene:,} points"
    scene, frame = case(n_scene).scene, case(n_scene).frame

    def match() -> int:
        lower, upper = frame.min(axis=0) - EPS, frame.max(axis=0) + EPS
        crop = scene[((scene >= lower) & (scene <= upper)).all(axis=1)]
        tree = cKDTree(crop, balanced_tree=False, compact_nodes=False)
        distance, _ = tree.query(frame, distance_upper_bound=EPS)
        return int(np.count_nonzero(np.isfinite(distance)))

    assert benchmark.pedantic(match, rounds=3) > 0.9 * N_FRAME


def match_by_open3d(scene: Float64Array, frame: Float64Array) -> int:
    """Builds the tree over the whole scene, as needed after each change of the map; returns the number of matches."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene))
    tree = open3d.geometry.KDTreeFlann(cloud)
    return sum(tree.search_hybrid_vector_3d(point, EPS, 1)[0] for point in frame)


@pytest.mark.parametrize("n_scene", SIZES)
def test_open3d_kdtreeflann_one_query_in_40(benchmark: BenchmarkFixture, n_scene: int) -> None:
    benchmark.group = f"match against {n_scene:,} points"
    scene, frame = case(n_scene).scene, case(n_scene).frame
    assert benchmark.pedantic(match_by_open3d, (scene, frame[::40]), rounds=2) > 0.9 * N_FRAME / 40


def test_open3d_kdtreeflann_every_query(benchmark: BenchmarkFixture) -> None:
    benchmark.group = "match against 5,000,000 points"
    scene, frame = case(5_000_000).scene, case(5_000_000).frame
    assert benchmark.pedantic(match_by_open3d, (scene, frame), rounds=1) > 0.9 * N_FRAME


@pytest.mark.parametrize("n_scene", SIZES)
def test_count_of_scene_points_inside_the_view(benchmark: BenchmarkFixture, n_scene: int) -> None:
    benchmark.group = "points of the scene segments inside the view"
    voxel_map, frame = filled_map(n_scene), case(n_scene).frame
    wanted = np.array([1], np.int32)
    counts = benchmark.pedantic(
        voxel_map.count_inside,
        (frame.min(axis=0) - EPS, frame.max(axis=0) + EPS, wanted),
        rounds=5,
        warmup_rounds=1,
    )
    assert counts[0] > 0
