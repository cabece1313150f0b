"""Mesh edges with weights, GNU's sort, and the forest that joins vertices; single precision as in ScanNet's program."""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.numerics.clusters import root_of

ONE = np.float32(1.0)
ZERO = np.float32(0.0)
SHORT = 16  # runs up to this length use insertion sort: _S_threshold of GNU's std::sort


@njit(cache=True)
def vertex_normals(vertices, triangles):  # type: ignore[no-untyped-def]
    """Running means (V, 3) of the unit normals of the triangles around each vertex, in triangle order."""
    normals = np.zeros((len(vertices), 3), np.float32)
    counts = np.zeros(len(vertices), np.int32)
    for t in range(len(triangles)):
        first, second, third = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux = vertices[second, 0] - vertices[first, 0]
        uy = vertices[second, 1] - vertices[first, 1]
        uz = vertices[second, 2] - vertices[first, 2]
        vx = vertices[third, 0] - vertices[first, 0]
        vy = vertices[third, 1] - vertices[first, 1]
        vz = vertices[third, 2] - vertices[first, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = np.float32(math.sqrt(x * x + y * y + z * z))
        if length == ZERO:  # 0 / 0 in C
            x = y = z = np.float32(np.nan)
        else:
            x, y, z = np.float32(x / length), np.float32(y / length), np.float32(z / length)
        for corner in range(3):
            vertex = triangles[t, corner]
            share = np.float32(ONE / (np.float32(counts[vertex]) + ONE))
            rest = np.float32(ONE - share)
            normals[vertex, 0] = share * x + rest * normals[vertex, 0]
            normals[vertex, 1] = share * y + rest * normals[vertex, 1]
            normals[vertex, 2] = share * z + rest * normals[vertex, 2]
        for corner in range(3):
            counts[triangles[t, corner]] += 1
    return normals


@njit(cache=True)
def edges_of(vertices, triangles):  # type: ignore[no-untyped-def]
    """Three edges (3 T, 2) per triangle, shared edges twice, and their weights (3 T,).

    The weight is 1 minus the dot product of the normals, squared if the end's normal leans away from the start:
    convex edges count less.
    """
    normals = vertex_normals(vertices, triangles)
    edges = np.empty((3 * len(triangles), 2), np.int32)
    weights = np.empty(3 * len(triangles), np.float32)
    for t in range(len(triangles)):
        first, second, third = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        edges[3 * t, 0], edges[3 * t, 1] = first, second
        edges[3 * t + 1, 0], edges[3 * t + 1, 1] = first, third
        edges[3 * t + 2, 0], edges[3 * t + 2, 1] = third, second
    for k in range(len(edges)):
        a, b = edges[k, 0], edges[k, 1]
        dx = vertices[b, 0] - vertices[a, 0]
        dy = vertices[b, 1] - vertices[a, 1]
        dz = vertices[b, 2] - vertices[a, 2]
        length = np.float32(math.sqrt(dx * dx + dy * dy + dz * dz))
        same = normals[a, 0] * normals[b, 0] + normals[a, 1] * normals[b, 1] + normals[a, 2] * normals[b, 2]
        weight = np.float32(ONE - same)
        if length > ZERO:
            dx, dy, dz = np.float32(dx / length), np.float32(dy / length), np.float32(dz / length)
            if normals[b, 0] * dx + normals[b, 1] * dy + normals[b, 2] * dz > ZERO:
                weight = np.float32(weight * weight)
        weights[k] = weight
    return edges, weights


@njit(cache=True)
def joined(n_vertices, edges, weights, threshold, min_vertices):  # type: ignore[no-untyped-def]
    """The root (V,) of each vertex after joining along the edges in the given order, and then small segments."""
    parent = np.arange(n_vertices).astype(np.int32)
    rank = np.zeros(n_vertices, np.int32)
    size = np.ones(n_vertices, np.int32)
    limit = np.full(n_vertices, threshold, np.float32)
    for k in range(len(edges)):
        a, b = root_of(parent, edges[k, 0]), root_of(parent, edges[k, 1])
        if a != b and weights[k] <= limit[a] and weights[k] <= limit[b]:
            root = _join(parent, rank, size, a, b)
            limit[root] = np.float32(weights[k] + np.float32(threshold / np.float32(size[root])))
    for k in range(len(edges)):
        a, b = root_of(parent, edges[k, 0]), root_of(parent, edges[k, 1])
        if a != b and (size[a] < min_vertices or size[b] < min_vertices):
            _join(parent, rank, size, a, b)
    segments = np.empty(n_vertices, np.int32)
    for vertex in range(n_vertices):
        segments[vertex] = root_of(parent, vertex)
    return segments


@njit(cache=True)
def _join(parent, rank, size, a, b):  # type: ignore[no-untyped-def]
    """Attach the root of lower rank to the other, ``a`` to ``b`` in a tie; the remaining root."""
    if rank[a] > rank[b]:
        parent[b] = a
        size[a] += size[b]
        return a
    parent[a] = b
    size[b] += size[a]
    if rank[a] == rank[b]:
        rank[b] += 1
    return b


@njit(cache=True)
def sort_as_gnu(weights, edges):  # type: ignore[no-untyped-def]
    """Sorts both by ``weights`` in place, ties in the order of GNU's ``std::sort``.

    Introsort: quicksort with median-of-three pivots down to runs of 16, heap sort if the recursion is too deep,
    insertion sort at the end. NaN weights are undefined in the original; here no step leaves the list.
    """
    n = len(weights)
    if n < 2:
        return
    depth = 0
    while (n >> (depth + 1)) > 0:
        depth += 1
    stack = [(0, n, 2 * depth)]
    while len(stack) > 0:
        first, last, depth_left = stack.pop()
        while last - first > SHORT:
            if depth_left == 0:
                _heap_sort(weights, edges, first, last)
                break
            depth_left -= 1
            cut = _partition(weights, edges, first, last)
            # the parts are independent: their order does not matter
            stack.append((cut, last, depth_left))
            last = cut
    for k in range(1, n):
        _insert(weights, edges, k)


@njit(cache=True)
def _swap(weights, edges, i, j):  # type: ignore[no-untyped-def]
    weights[i], weights[j] = weights[j], weights[i]
    edges[i, 0], edges[j, 0] = edges[j, 0], edges[i, 0]
    edges[i, 1], edges[j, 1] = edges[j, 1], edges[i, 1]


@njit(cache=True)
def _partition(weights, edges, first, last):  # type: ignore[no-untyped-def]
    middle = first + (last - first) // 2
    _swap(weights, edges, first, _median(weights, first + 1, middle, last - 1))
    pivot = weights[first]
    low, high = first + 1, last
    while True:
        while low < last and weights[low] < pivot:
            low += 1
        high -= 1
        while high > first and pivot < weights[high]:
            high -= 1
        if not low < high:
            return low
        _swap(weights, edges, low, high)
        low += 1


@njit(cache=True)
def _median(weights, a, b, c):  # type: ignore[no-untyped-def]
    if weights[a] < weights[b]:
        if weights[b] < weights[c]:
            return b
        return c if weights[a] < weights[c] else a
    if weights[a] < weights[c]:
        return a
    return c if weights[b] < weights[c] else b


@njit(cache=True)
def _insert(weights, edges, k):  # type: ignore[no-untyped-def]
    weight, a, b = weights[k], edges[k, 0], edges[k, 1]
    while k > 0 and weight < weights[k - 1]:
        weights[k], edges[k, 0], edges[k, 1] = weights[k - 1], edges[k - 1, 0], edges[k - 1, 1]
        k -= 1
    weights[k], edges[k, 0], edges[k, 1] = weight, a, b


@njit(cache=True)
def _heap_sort(weights, edges, first, last):  # type: ignore[no-untyped-def]
    n = last - first
    for parent in range((n - 2) // 2, -1, -1):
        at = first + parent
        _sift_down(weights, edges, first, parent, n, weights[at], edges[at, 0], edges[at, 1])
    for end in range(n - 1, 0, -1):
        at = first + end
        weight, a, b = weights[at], edges[at, 0], edges[at, 1]
        weights[at], edges[at, 0], edges[at, 1] = weights[first], edges[first, 0], edges[first, 1]
        _sift_down(weights, edges, first, 0, end, weight, a, b)


@njit(cache=True)
def _sift_down(weights, edges, first, hole, n, weight, a, b):  # type: ignore[no-untyped-def]
    """Moves the hole to a leaf along the larger children, then sifts its new content up, as GNU's __adjust_heap."""
    top, child = hole, hole
    while child < (n - 1) // 2:
        child = 2 * (child + 1)
        if weights[first + child] < weights[first + child - 1]:
            child -= 1
        _move(weights, edges, first + child, first + hole)
        hole = child
    if n % 2 == 0 and child == (n - 2) // 2:
        child = 2 * (child + 1)
        _move(weights, edges, first + child - 1, first + hole)
        hole = child - 1
    parent = (hole - 1) // 2
    while hole > top and weights[first + parent] < weight:
        _move(weights, edges, first + parent, first + hole)
        hole = parent
        parent = (hole - 1) // 2
    weights[first + hole], edges[first + hole, 0], edges[first + hole, 1] = weight, a, b


@njit(cache=True)
def _move(weights, edges, source, target):  # type: ignore[no-untyped-def]
    weights[target], edges[target, 0], edges[target, 1] = weights[source], edges[source, 0], edges[source, 1]
