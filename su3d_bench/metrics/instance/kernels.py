"""Compiled loops over the counted predictions of many scenes; imported only there, for numba takes its time to load."""

from __future__ import annotations

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from su3d_bench.numerics.compiled import njit


@intrinsic
def _fused(typing_context, left, right, addend):  # type: ignore[no-untyped-def]
    """left * right + addend, rounded once: by the processor where it can, else by the C library."""

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), build


@njit(cache=True, nogil=True)
def _dot(left, right, n):  # type: ignore[no-untyped-def]
    """The first ``n`` products, added in the order of ``dot_product.dot``: the same bits."""
    n_blocked = n - n % 16
    n_wide = n_blocked - n_blocked % 32
    total = 0.0
    if n_blocked:
        wide = np.zeros(32)
        for i in range(n_wide):
            wide[i % 32] = _fused(left[i], right[i], wide[i % 32])  # type: ignore[call-arg]
        halves = wide.reshape(4, 2, 4)  # of four registers
        lanes = (halves[:, 0] + halves[:, 1]).ravel()
        for i in range(n_wide, n_blocked):
            lanes[i - n_wide] = _fused(left[i], right[i], lanes[i - n_wide])  # type: ignore[call-arg]
        four = ((lanes[0:4] + lanes[4:8]) + lanes[8:12]) + lanes[12:16]
        total = (four[0] + four[2]) + (four[1] + four[3])
    for i in range(n_blocked, n):
        total = _fused(left[i], right[i], total)  # type: ignore[call-arg]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def areas(score, is_true, bounds, n_missed, is_wanted, area_of_cell):  # type: ignore[no-untyped-def]
    """Writes ``average_precision`` of each wanted cell, whose rows come with rising score between its ``bounds``."""
    n_rows = len(score)  # no cell has more vertices
    precision, recall, width = np.empty(n_rows + 1), np.empty(n_rows + 3), np.empty(n_rows + 1)
    for cell in range(len(area_of_cell)):
        start, end = bounds[cell], bounds[cell + 1]
        if not is_wanted[cell]:
            continue
        if start == end:
            area_of_cell[cell] = 0.0
            continue
        n_true = 0
        for row in range(start, end):
            n_true += is_true[row]
        n_true_below, n_vertices = 0, 0
        for row in range(start, end):
            if row == start or score[row] != score[row - 1]:
                hits = n_true - n_true_below
                precision[n_vertices] = hits / (end - row)
                recall[n_vertices + 1] = hits / (hits + n_true_below + n_missed[cell])
                n_vertices += 1
            n_true_below += is_true[row]
        precision[n_vertices] = 1.0
        recall[0] = recall[1]
        recall[n_vertices + 1] = recall[n_vertices + 2] = 0.0
        for i in range(n_vertices + 1):
            width[i] = 0.5 * (recall[i] - recall[i + 2])
        area_of_cell[cell] = _dot(precision, width, n_vertices + 1)


@njit(cache=True, nogil=True, error_model="numpy")
def resampled_areas(scene, is_true, is_last, bounds, class_of_cell, n_truth, drawn, area_of_cell):  # type: ignore[no-untyped-def]
    """Writes the area (cells, R) of each resample; rows of a cell come with falling score.

    ``is_last`` marks the last row of a score, ``n_truth`` (C, R) counts the instances of the drawn scenes, ``drawn``
    (S, R) says how often each scene was drawn. Resamples go side by side, so that the inner loops are vectors. The
    curve rises only where a true positive was drawn, so nothing is added elsewhere.
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
