"""The corridor used by ``make bench-methods``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT

from su3d_bench.core.registry import load
from su3d_bench.core.types import Float64Array
from su3d_bench.reports.pictures.plots import medians_by_size


def normals_and_volume(mesh: Any) -> tuple[Float64Array, float]:
    """The normal (T, 3) of each triangle, twice as long as its area, and the volume, negative where they face in."""
    a, b, c = mesh.vertices.astype(np.float64)[mesh.triangles].transpose(1, 0, 2)
    return np.cross(b - a, c - a), float((a * np.cross(b, c)).sum() / 6)


def test_scan_covers_the_ray_cast_surface_with_the_same_orientation() -> None:
    dataset = load("dataset", f"{ROOT / 'benchmarks/scale/corridor.py'}:Corridor")
    corridor = dataset(Path(), dataset.Options(surface_edge_m=0.5))
    scan, cast = corridor.surface("3m"), corridor.instance_mesh("3m")
    (fine, volume_m3), (coarse, cast_m3) = normals_and_volume(scan), normals_and_volume(cast)
    assert np.linalg.norm(fine, axis=1).sum() == pytest.approx(np.linalg.norm(coarse, axis=1).sum(), rel=1e-6)
    assert volume_m3 == pytest.approx(cast_m3, rel=1e-6)
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(scan.vertices, axis=0), end(cast.vertices, axis=0), atol=1e-6)
    assert set(scan.triangles.reshape(-1)) == set(range(len(scan.vertices)))


def test_medians_by_size_use_equal_ranges_on_a_log_axis() -> None:
    sizes = np.array([1.0, 1.1, 1.2, 500.0, 1024.0, 1024.0])
    x, y = medians_by_size(sizes, np.array([3.0, 9.0, 4.0, 7.0, 10.0, 30.0]))
    np.testing.assert_allclose(x, [1.1, 500.0, 1024.0])
    np.testing.assert_allclose(y, [4.0, 7.0, 20.0])
