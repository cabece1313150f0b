"""The counts behind many resampled precision-recall polylines, in one pass over their rows a resample."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def vertex_counts(weights: Any, scene: Any, is_true: Any, last_of_score: Any) -> Any:
    """How many rows (R, V), and how many true ones, stand up to each vertex under each resample; exact.

    ``weights`` (R, S) says how often each scene is drawn, ``scene`` and ``is_true`` (E,) belong to the rows, and
    ``last_of_score`` (V,) ascending are the rows that vertices stand at.
    """
    n_counted = np.empty((len(weights), len(last_of_score)), np.float64)
    n_hit = np.empty((len(weights), len(last_of_score)), np.float64)
    for resample in range(len(weights)):
        drawn = weights[resample]
        counted = 0
        hit = 0
        row = 0
        for vertex in range(len(last_of_score)):
            while row <= last_of_score[vertex]:
                times = drawn[scene[row]]
                counted += times
                hit += times * is_true[row]
                row += 1
            n_counted[resample, vertex] = counted
            n_hit[resample, vertex] = hit
    return n_counted, n_hit
