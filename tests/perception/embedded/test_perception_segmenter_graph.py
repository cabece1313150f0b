"""Sums, components and borders of the segmenter's graph are what SciPy and NumPy give, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from su3d_bench.perception.embedded.kernels import connected, sum_rows
from su3d_bench.perception.embedded.surface_graph import border_pairs


@pytest.mark.parametrize(("n", "n_links"), [(1, 0), (5, 0), (40, 12), (40, 60), (300, 900)])
def test_components_are_counted_by_their_first_nodes(n: int, n_links: int) -> None:
    a, b = np.random.default_rng(n_links).integers(0, n, (2, n_links))
    links = coo_matrix((np.ones(n_links, np.int8), (a, b)), shape=(n, n))
    n_components, expected = connected_components(links, directed=False)
    component, found = connected(a, b, n)
    assert found == n_components
    assert component.tolist() == expected.tolist()


def test_sums_of_rows_are_added_in_their_order() -> None:
    rng = np.random.default_rng(1)
    values, label = rng.normal(0, 1e6, (500, 3)), rng.integers(0, 7, 500)
    expected = np.stack([np.bincount(label, column, 8) for column in values.T], axis=1)
    assert np.array_equal(sum_rows(label, values, 8), expected)
    assert np.array_equal(sum_rows(label[:0], values[:0], 2), np.zeros((2, 3)))


def test_pairs_along_rows_come_before_those_along_columns() -> None:
    labels = np.array([[2, 0, 0], [2, 2, 1]], np.int32)
    contrast = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    low, high, contrasts, depths = border_pairs(labels, contrast, -contrast)
    assert list(zip(low.tolist(), high.tolist(), strict=True)) == [(0, 2), (1, 2), (0, 2), (0, 1)]
    assert contrasts.tolist() == [0, 4, 7, 8]
    assert depths.tolist() == [0, -4, -7, -8]
    assert all(len(column) == 0 for column in border_pairs(labels[:1, :1], contrast[:, :1, :1], contrast[:, :1, :1]))
