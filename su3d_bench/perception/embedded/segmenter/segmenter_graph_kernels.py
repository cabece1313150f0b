"""Loops over the graph of surface pieces, compiled; import this module only where a frame is segmented."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array
from su3d_bench.numerics.compiled import njit


@njit(cache=True)
def connected(a: NDArray[np.intp], b: NDArray[np.intp], n: int) -> tuple[NDArray[np.intp], int]:
    """The component (n,) of each of ``n`` nodes under links from ``a`` to ``b`` (L,), and how many there are.

    Components are counted in the order of their first nodes.
    """
    parent = np.arange(n)
    for k in range(len(a)):
        i, j = a[k], b[k]
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        while parent[j] != j:
            parent[j] = parent[parent[j]]
            j = parent[j]
        if i < j:
            parent[j] = i
        else:
            parent[i] = j
    component = np.empty(n, np.intp)
    n_components = 0
    for i in range(n):
        if parent[i] == i:
            component[i] = n_components
            n_components += 1
        else:  # a parent is a node before its children
            component[i] = component[parent[i]]
    return component, n_components


@njit(cache=True)
def sum_rows(label: NDArray[np.intp], values: Float64Array, n: int) -> Float64Array:
    """The sums (n, C) of the rows of ``values`` (N, C) with equal ``label`` (N,), added in their order."""
    sums = np.zeros((n, values.shape[1]))
    for i in range(len(label)):
        for c in range(values.shape[1]):
            sums[label[i], c] += values[i, c]
    return sums


@njit(cache=True)
def border_pairs(
    labels: Int32Array, contrast: Float32Array, depth_cost: Float32Array
) -> tuple[Int64Array, Int64Array, Float32Array, Float32Array]:
    """The neighbouring pixels of different ``labels`` (H, W): the lower and the higher label, and both differences.

    First the pairs along rows, then those along columns, as ``contrast`` and ``depth_cost`` (2, H, W) have them.
    """
    height, width = labels.shape
    n = 0
    for axis in range(2):
        for v in range(height - axis):
            for u in range(width - 1 + axis):
                n += labels[v, u] != labels[v + axis, u + 1 - axis]
    low, high = np.empty(n, np.int64), np.empty(n, np.int64)
    contrasts, depths = np.empty(n, np.float32), np.empty(n, np.float32)
    k = 0
    for axis in range(2):
        for v in range(height - axis):
            for u in range(width - 1 + axis):
                here, there = labels[v, u], labels[v + axis, u + 1 - axis]
                if here != there:
                    low[k], high[k] = min(here, there), max(here, there)
                    contrasts[k], depths[k] = contrast[axis, v, u], depth_cost[axis, v, u]
                    k += 1
    return low, high, contrasts, depths
