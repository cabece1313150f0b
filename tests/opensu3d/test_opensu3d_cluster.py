"""Clustering on a grid: the labels of scikit-learn's DBSCAN, noise, borders and ties included."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from su3d_bench.core.types import Float64Array
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.postprocess import cluster


def assert_same_labels(points: Float64Array, eps: float, min_points: int) -> None:
    config = OpenSU3DConfig(dbscan_eps=eps, dbscan_min_points=min_points)
    expected = DBSCAN(eps=eps, min_samples=min_points).fit_predict(points)
    np.testing.assert_array_equal(cluster(points, config), expected)


# Steps of a quarter of eps put many points at exactly eps from each other; binary fractions, of which none is rounded.
lattice = st.lists(st.tuples(*[st.integers(-12, 12)] * 3), min_size=1, max_size=120)


@settings(max_examples=60, deadline=None)
@given(lattice, st.sampled_from([0.0, -3.75, 1e4]), st.sampled_from([0.125, 0.25]), st.integers(1, 12))
def test_labels_are_those_of_scikit_learn_on_lattices(
    points: list[tuple[int, ...]], offset: float, eps: float, min_points: int
) -> None:
    assert_same_labels(np.array(points, np.float64) * eps / 4 + offset, eps, min_points)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-0.4, 0.4)] * 3), min_size=1, max_size=80), st.integers(1, 8))
def test_labels_are_those_of_scikit_learn_on_any_floats(points: list[tuple[float, ...]], min_points: int) -> None:
    assert_same_labels(np.array(points, np.float64), 0.1, min_points)


def test_a_border_point_between_two_clusters_belongs_to_the_first() -> None:
    row = np.column_stack([np.arange(5) * 0.02, np.zeros((5, 2))])
    other = row + np.array([0.26, 0, 0])
    between = np.array([[0.17, 0, 0]])  # 0.09 from the nearest of either
    for order in ([row, between, other], [other, between, row]):
        points = np.concatenate(order)
        assert cluster(points, OpenSU3DConfig(dbscan_min_points=5)).tolist() == [0] * 6 + [1] * 5
        assert_same_labels(points, 0.1, 5)
