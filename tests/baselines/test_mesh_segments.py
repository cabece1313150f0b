"""Segments of meshes: ScanNet's algorithm, by hand, against plain Python, and against the original program."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from su3d_bench.baselines.mesh_segments.kernels import _heap_sort, edges_of, sort_as_gnu, vertex_normals
from su3d_bench.baselines.mesh_segments.segments import mesh_segments

F = np.float32
# std::sort of GNU's library (GCC 12) on 60 weights (k * 7919) % 5, and its make_heap with sort_heap on 37 of them
SORTED = [
    10, 20, 25, 15, 30, 35, 40, 45, 5, 50, 55, 0, 44, 49, 59, 39, 34, 54, 29, 24, 19, 4, 9, 14, 18, 53, 3, 38, 43, 8,
    13, 33, 23, 28, 48, 58, 7, 52, 47, 42, 17, 22, 37, 2, 12, 32, 57, 27, 56, 51, 1, 6, 46, 41, 11, 36, 31, 16, 26, 21,
]  # fmt: skip
HEAP_SORTED = [
    0, 15, 20, 25, 5, 10, 30, 35, 24, 19, 34, 4, 9, 14, 29, 33, 8, 18, 23, 3, 13, 28, 32, 7, 17, 22, 12, 2, 27, 31, 16,
    36, 1, 21, 11, 26, 6,
]  # fmt: skip


def sheet(heights: list[list[float]], spacing_m: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A mesh over a grid of heights, two triangles per cell, normals up."""
    z = np.array(heights, np.float32)
    rows, columns = z.shape
    row, column = np.divmod(np.arange(z.size), columns)
    vertices = np.stack([column * F(spacing_m), row * F(spacing_m), z.reshape(-1)], axis=1).astype(np.float32)
    corner = np.flatnonzero((row < rows - 1) & (column < columns - 1))
    low = np.stack([corner, corner + 1, corner + columns], axis=1)
    high = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return vertices, np.concatenate([low, high]).astype(np.int32)


def rough_sheet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A rough sheet with a fold, bit-identical everywhere: the input given to the original program."""
    row, column = np.divmod(np.arange(n * n), n)
    height = ((row * row * 31 + row * column * 17 + column * column * 13) % 97).astype(np.float32) * F(0.00008)
    height += np.where(column > n // 2, column - n // 2, 0).astype(np.float32) * F(0.015)
    places = (row.astype(np.float32) * F(0.02), column.astype(np.float32) * F(0.02), height)
    corner = np.flatnonzero((row < n - 1) & (column < n - 1))
    low = np.stack([corner, corner + n, corner + 1], axis=1)
    high = np.stack([corner + 1, corner + n, corner + n + 1], axis=1)
    return np.stack(places, axis=1), np.concatenate([low, high]).astype(np.int32)


@pytest.mark.parametrize(
    ("threshold", "digest"),
    [
        (0.01, "377a9a292987d80c8eeea35e1ee4791e2e35f07e3534d81071f2995121d12877"),
        (0.1, "e5f59faf2641adc5b7b7609b5d9bbb713cf98b1079bea78e8e298b616ffab133"),
    ],
)
def test_segments_match_scannets_program_to_the_last_id(threshold: float, digest: str) -> None:
    """Digests of the output of segmentator.cpp (b38b278, GCC 12) on the same triangles, as little-endian int32."""
    segments = mesh_segments(*rough_sheet(60), threshold)
    assert hashlib.sha256(segments.astype("<i4").tobytes()).hexdigest() == digest


def test_equal_weights_are_ordered_as_by_gnus_sort() -> None:
    numbers = np.arange(60, dtype=np.int32)
    weights, edges = ((numbers * 7919) % 5).astype(np.float32), np.stack([numbers, numbers], axis=1)
    sort_as_gnu(weights, edges)
    assert edges[:, 0].tolist() == SORTED
    assert (np.diff(weights) >= 0).all() and (edges[:, 0] == edges[:, 1]).all()


def test_heap_sort_orders_equal_weights_as_gnus() -> None:
    numbers = np.arange(40, dtype=np.int32) - 2  # not starting at the beginning of the list
    weights, edges = ((numbers * 7919) % 5).astype(np.float32), np.stack([numbers, numbers], axis=1)
    _heap_sort(weights, edges, 2, 39)
    assert edges[2:39, 0].tolist() == HEAP_SORTED
    assert edges[[0, 1, 39], 0].tolist() == [-2, -1, 37]


def test_vertex_normal_is_the_running_mean_of_its_triangles() -> None:
    """A horizontal triangle, then a vertical one over the edge 0-1: the mean of (0,0,1) and (0,-1,0) at both."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    normals = vertex_normals(vertices, np.array([[0, 1, 2], [0, 1, 3]], np.int32))
    assert normals.tolist() == [[0, -0.5, 0.5], [0, -0.5, 0.5], [0, 0, 1], [0, -1, 0]]


def test_concave_edge_weighs_one_minus_the_dot_product_and_convex_its_square() -> None:
    """Of the two triangles above: the product is 0.5 along each edge; only from 2 to 1 the end's normal leans away."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    edges, weights = edges_of(vertices, np.array([[0, 1, 2], [0, 1, 3]], np.int32))
    assert edges.tolist() == [[0, 1], [0, 2], [2, 1], [0, 1], [0, 3], [3, 1]]
    assert weights.tolist() == [0.5, 0.5, 0.25, 0.5, 0.5, 0.5]
