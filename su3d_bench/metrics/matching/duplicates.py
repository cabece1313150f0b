"""Masks that are almost the same points, found without comparing every mask with every other."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import Int64Array
from su3d_bench.metrics.matching.remembered import remembered


@remembered
def duplicate_pairs(masks: Masks, n_points: int, iou: float) -> list[tuple[int, int]]:
    """Pairs of masks, the lower first, whose IoU is above ``iou``.

    >>> masks = Masks.of_sets([np.arange(20), np.arange(10), np.arange(1, 20)])
    >>> duplicate_pairs(masks, 20, 0.9)
    [(0, 2)]
    """
    size, pairs = masks.sizes, []
    is_in = np.zeros(n_points, np.bool_)
    marked = -1
    for k, m in zip(*_candidates(masks, n_points, iou), strict=True):
        if k != marked:
            is_in[:] = False
            is_in[masks.mask(k)] = True
            marked = k
        shared = np.count_nonzero(is_in[masks.mask(m)])
        if shared > iou * (size[k] + size[m] - shared):
            pairs.append((k, m))
    return pairs


def _candidates(masks: Masks, n_points: int, iou: float) -> tuple[list[int], list[int]]:
    """The pairs, in order, that may have such an IoU: of masks whose first points are shared already.

    Two masks with an IoU above t share more than t of each. So of the points of one, by their number, all but (1 - t)
    are the other's; and among the first 2 (1 - t) + 1 of each must be as many common ones as are left when those that
    may be foreign are taken away. All other pairs are passed over, and their points are never looked at.
    """
    size = masks.sizes
    n_foreign = np.minimum(size, ((1.0 - iou) * size).astype(np.int64) + 1)  # at most; 1 more, for that is rounded
    n_first = np.minimum(size, 2 * n_foreign + 1)
    n_common = np.maximum(n_first - n_foreign, 1)
    owner = np.repeat(np.arange(len(size)), n_first)
    point = masks.indices[np.arange(len(owner)) + np.repeat(masks.indptr[:-1] - np.cumsum(n_first) + n_first, n_first)]
    is_shared = np.bincount(point, minlength=n_points)[point] > 1
    point, owner = point[is_shared], owner[is_shared]
    order = np.argsort(point, kind="stable")
    point, owner = point[order], owner[order]
    keys: list[Int64Array] = [np.zeros(0, np.int64)]
    at, step = np.arange(len(point)), 0
    while len(at):
        step += 1
        at = at[: np.searchsorted(at, len(point) - step)]
        at = at[point[at + step] == point[at]]
        first, second = owner[at], owner[at + step]
        is_alike = np.minimum(size[first], size[second]) > iou * np.maximum(size[first], size[second])
        keys.append(first[is_alike] * len(size) + second[is_alike])
    key, n_shared = np.unique(np.concatenate(keys), return_counts=True)
    first, second = np.divmod(key, max(len(size), 1))
    is_candidate = n_shared >= np.minimum(n_common[first], n_common[second])
    return first[is_candidate].tolist(), second[is_candidate].tolist()
