"""Time of nearest neighbours between clouds of a scene's size, compared with plain use of SciPy's tree."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from su3d_bench.core.types import Float32Array
from su3d_bench.metrics.matching.nearest import nearest

GROUP = "nearest neighbours: 4 million candidates, 1 million questions"


@pytest.fixture(scope="module")
def clouds() -> tuple[Float32Array, Float32Array]:
    """Points on the walls of a room in random order, 3 mm of noise."""
    rng = np.random.default_rng(0)
    size = np.array([6.0, 5.0, 2.7])

    def surface(n: int) -> Float32Array:
        wall = rng.integers(6, size=n)
        points = rng.random((n, 3)) * size
        points[np.arange(n), wall % 3] = np.where(wall < 3, 0, size[wall % 3])
        return (points + rng.normal(0, 0.003, (n, 3))).astype(np.float32)

    return surface(4_000_000), surface(1_000_000)


@pytest.mark.benchmark(group=GROUP)
def test_ordered_along_a_curve(benchmark: Any, clouds: tuple[Float32Array, Float32Array]) -> None:
    _, index = benchmark.pedantic(nearest, clouds, rounds=2)
    assert index.min() >= 0


@pytest.mark.benchmark(group=GROUP)
def test_plain_tree(benchmark: Any, clouds: tuple[Float32Array, Float32Array]) -> None:
    candidates, queries = (cloud.astype(np.float64) for cloud in clouds)
    benchmark.pedantic(lambda: cKDTree(candidates).query(queries, k=2, workers=1), rounds=2)
