"""The corridor that ``make bench-methods`` walks along."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT

from su3d_bench.core.registry import load
from su3d_bench.core.types import Float64Array, Int32Array
from su3d_bench.reports.pictures.plots import medians_by_size


def corridor(**options: float) -> Any:
    dataset = load("dataset", f"{ROOT / 'benchmarks/scale/corridor.py'}:Corridor")
    return dataset(Path(), dataset.Options(**options))


def corners_of(vertices: Any, triangles: Int32Array) -> Float64Array:
    result: Float64Array = vertices.astype(np.float64)[triangles]
    return result


def normals_m2(mesh: Any) -> Float64Array:
    """The normal (T, 3) of each triangle, twice as long as its area."""
    a, b, c = corners_of(mesh.vertices, mesh.triangles).transpose(1, 0, 2)
    result: Float64Array = np.cross(b - a, c - a)
    return result


def volume_m3(mesh: Any) -> float:
    """What its boxes hold together; negative where the triangles face inwards."""
    a, b, c = corners_of(mesh.vertices, mesh.triangles).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def test_the_scan_covers_what_is_cast_and_faces_the_same_way() -> None:
    dataset = corridor(surface_edge_m=0.5)
    scan, cast = dataset.surface("3m"), dataset.instance_mesh("3m")
    fine, coarse = normals_m2(scan), normals_m2(cast)
    assert np.linalg.norm(fine, axis=1).sum() == pytest.approx(np.linalg.norm(coarse, axis=1).sum(), rel=1e-6)
    np.testing.assert_allclose(volume_m3(scan), volume_m3(cast), rtol=1e-6)
    np.testing.assert_allclose(scan.vertices.min(axis=0), cast.vertices.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(scan.vertices.max(axis=0), cast.vertices.max(axis=0), atol=1e-6)
    assert set(scan.triangles.reshape(-1)) == set(range(len(scan.vertices)))


def test_medians_by_size_are_those_of_ranges_of_one_width_on_a_log_axis() -> None:
    sizes = np.array([1.0, 1.1, 1.2, 500.0, 1024.0, 1024.0])
    x, y = medians_by_size(sizes, np.array([3.0, 9.0, 4.0, 7.0, 10.0, 30.0]))
    np.testing.assert_allclose(x, [1.1, 500.0, 1024.0])
    np.testing.assert_allclose(y, [4.0, 7.0, 20.0])
