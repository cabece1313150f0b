"""Cost of OpenSU3D's post-processing: clustering, views, boxes, features of 200 instances with 2 million points.

    python -m pytest benchmarks/speed/bench_postprocess.py --benchmark-only --benchmark-columns=min,median,rounds

Each instance is a box of 0.6 to 0.9 m with points on its faces, about 2 cm apart; one in ten is two boxes 1 m apart,
the second of which becomes a separate instance. The comparison is scikit-learn's DBSCAN on each instance's points.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.opensu3d.postprocess import cluster
from su3d_bench.opensu3d.tracking import ImageRecord, View

N_INSTANCES = 200
N_POINTS = 10_000  # of an instance
N_VIEWS = 20  # of an instance
FEATURES = 512


def instance_points(generator: np.random.Generator, n: int) -> Float64Array:
    """``n`` points on the faces of a box at the origin."""
    points = generator.uniform(-0.5, 0.5, (n, 3))
    face = generator.integers(0, 3, n)
    points[np.arange(n), face] = np.sign(points[np.arange(n), face]) * 0.5
    return points * generator.uniform(0.6, 0.9, 3)


@cache
def filled() -> OpenSU3D:
    generator = np.random.default_rng(0)
    method = OpenSU3D(OpenSU3DConfig(density="all"))
    hits: list[Int64Array] = []
    for k in range(N_INSTANCES):
        points = instance_points(generator, N_POINTS)
        if k % 10 == 0:
            points[: N_POINTS // 2, 2] += 1.9  # two boxes, each with half of the points
        points += [4.0 * (k % 15), 4.0 * (k // 15), 0.0]
        placed = method._map.insert(points, np.full(N_POINTS, k + 1, np.int32))
        hits.append(placed)
    method._next_id = N_INSTANCES + 1
    for position in range(N_VIEWS):
        seen = [np.sort(generator.choice(each, N_POINTS // 20, replace=False)) for each in hits]
        method._images.append(
            ImageRecord(
                frame_index=position,
                rows=np.arange(N_INSTANCES),
                scores=generator.random(N_INSTANCES),
                names=("thing",) * N_INSTANCES,
                captions=("",) * N_INSTANCES,
                multi_scale=method._scratch.put(generator.normal(size=(N_INSTANCES, FEATURES))),
                global_feature=method._scratch.put(generator.normal(size=(1, FEATURES))),
                hit_indptr=np.arange(N_INSTANCES + 1) * (N_POINTS // 20),
                hits=method._scratch.put(np.concatenate(seen)),
            )
        )
        for k in range(N_INSTANCES):
            method._table[k + 1].append(View(position, k))
    return method


def test_the_whole_post_processing(benchmark: BenchmarkFixture) -> None:
    benchmark.group = "post-processing of 200 instances, 2 million points"
    instances = benchmark.pedantic(filled().finish, rounds=3, warmup_rounds=1)
    assert len(instances.ids) == N_INSTANCES + N_INSTANCES // 10


def test_clustering_on_a_grid(benchmark: BenchmarkFixture) -> None:
    benchmark.group = "post-processing of 200 instances, 2 million points"
    method = filled()
    parts = np.split(method._map.points, N_INSTANCES)
    labels = benchmark.pedantic(lambda: [cluster(part, method.config) for part in parts], rounds=3, warmup_rounds=1)
    assert max(each.max() for each in labels) == 1


def test_clustering_by_scikit_learn(benchmark: BenchmarkFixture) -> None:
    from sklearn.cluster import DBSCAN

    benchmark.group = "post-processing of 200 instances, 2 million points"
    method = filled()
    parts = np.split(method._map.points, N_INSTANCES)
    peer = DBSCAN(eps=method.config.dbscan_eps, min_samples=method.config.dbscan_min_points)
    labels = benchmark.pedantic(lambda: [peer.fit_predict(part) for part in parts], rounds=1)
    for part, expected in zip(parts[:20], labels, strict=False):
        np.testing.assert_array_equal(cluster(part, method.config), expected)
