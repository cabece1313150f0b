"""Over-segmentation of a mesh by surface curvature, identical to ScanNet's segments (``.segs.json``).

Felzenszwalb and Huttenlocher's graph segmentation on smoothed normals, in the arithmetic of ScanNet's program
(Segmentator/segmentator.cpp at commit b38b278): single precision throughout, an unstable sort whose order of equal
weights decides segment borders, and segment ids are the root vertices of its forest. The sort is that of
GNU's C++ library; a program built with another library may order equal weights differently and give other segments.
"""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import Float32Array, Int32Array

THRESHOLD = 0.01  # kThresh of the released .segs.json files
MIN_VERTICES = 20  # segMinVerts of the released files


def mesh_segments(
    vertices: Float32Array, triangles: Int32Array, threshold: float = THRESHOLD, min_vertices: int = MIN_VERTICES
) -> Int32Array:
    """The segment (V,) of each of ``vertices`` (V, 3), named by one of its vertices, as in ``segIndices``.

    A segment joins its neighbour over an edge that bends no more than either of them internally, plus ``threshold``
    over its number of vertices; then segments below ``min_vertices`` join a neighbour. Vertices without a triangle form
    separate segments. A degenerate triangle has no normal: its vertices join others by size only.
    """
    from su3d_bench.baselines.mesh_segments.kernels import edges_of, joined, sort_as_gnu

    edges, weights = edges_of(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.int32))
    sort_as_gnu(weights, edges)
    segments: Int32Array = joined(len(vertices), edges, weights, np.float32(threshold), min_vertices)
    return segments
