"""Compiled loops over the counted predictions of many scenes; imported on demand, because numba is slow to load."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.compiled import njit


@njit(cache=True, nogil=True, error_model="numpy")
def resampled_areas(scene, is_true, is_last, bounds, class_of_cell, n_truth, drawn, area_of_cell):  # type: ignore[no-untyped-def]
    """Writes the area (cells, R) of each resample; rows of a cell have descending scores.

    ``is_last`` marks the last row of a score, ``n_truth`` (C, R) counts the instances of the drawn scenes, ``drawn``
    (S, R) how often each scene was drawn. Resamples are processed together, so that the inner loops vectorize. The
    curve rises only at drawn true positives, so nothing is added elsewhere.
    """
    n_resamples = drawn.shape[1]
    n_counted, n_hit = np.empty(n_resamples, np.int32), np.empty(n_resamples, np.int32)
    n_counted_before, n_hit_before = np.empty(n_resamples, np.int32), np.empty(n_resamples, np.int32)
    recall_before = np.empty(n_resamples)
    for cell in range(len(class_of_cell)):
        area, n_instances = area_of_cell[cell], n_truth[class_of_cell[cell]]
        area[:] = n_counted[:] = n_hit[:] = n_counted_before[:] = n_hit_before[:] = recall_before[:] = 0
        has_hit = False
        for row in range(bounds[cell], bounds[cell + 1]):
            n = drawn[scene[row]]
            for r in range(n_resamples):
                n_counted[r] += n[r]
            if is_true[row]:
                has_hit = True
                for r in range(n_resamples):
                    n_hit[r] += n[r]
            if not is_last[row]:
                continue
            if has_hit:
                for r in range(n_resamples):
                    before = n_hit_before[r] / n_counted_before[r] if n_counted_before[r] > 0 else 1.0
                    recall = n_hit[r] / n_instances[r]
                    step = (recall - recall_before[r]) * (n_hit[r] / n_counted[r] + before) / 2
                    area[r] += step if n_hit[r] > n_hit_before[r] else 0.0
                    recall_before[r] = recall
                has_hit = False
            n_counted_before[:] = n_counted
            n_hit_before[:] = n_hit
