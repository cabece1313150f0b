"""Time of the counts of one scene, compared with one comparison per pair of prediction and instance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from su3d_bench.metrics.instance.scene_counts import per_scene

N_POINTS, N_PREDICTIONS, N_CLASSES, N_INSTANCES = 200_000, 150, 20, 80  # a furnished room of Replica
CLASS_IDS = tuple(range(1, N_CLASSES + 1))


def scene(seed: int = 0) -> tuple[NDArray[Any], list[NDArray[Any]], NDArray[Any], NDArray[Any]]:
    """A scene of Replica's size: instances one after another, predictions that cover parts of them."""
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, N_POINTS, N_INSTANCES - 1))
    classes = rng.integers(0, N_CLASSES + 4, N_INSTANCES)  # some are void
    truth = np.repeat(classes * 1000 + np.arange(1, N_INSTANCES + 1), np.diff([0, *cuts, N_POINTS]))
    masks, labels = [], []
    for _ in range(N_PREDICTIONS):
        start, length = rng.integers(0, N_POINTS - 8000), rng.integers(200, 8000)
        masks.append(np.arange(start, start + length))
        labels.append(truth[start + length // 2] // 1000)
    return truth, masks, np.array(labels), np.ones(N_PREDICTIONS)


def compare_every_pair(truth: NDArray[Any], masks: NDArray[np.bool_], labels: NDArray[Any]) -> int:
    """Intersections as in the official script: full masks, one comparison for void and for each pair."""
    total = 0
    is_void = ~np.isin(truth // 1000, CLASS_IDS)
    values = np.unique(truth)
    for mask, label in zip(masks, labels, strict=True):
        total += int(np.count_nonzero(mask)) + int(np.count_nonzero(np.logical_and(is_void, mask)))
        for value in values[values // 1000 == label]:
            total += int(np.count_nonzero(np.logical_and(truth == value, mask)))
    return total


@pytest.mark.benchmark(group="instance AP, counts of one scene: 200 000 points, 150 predictions")
def test_one_bincount(benchmark: Any) -> None:
    truth, masks, labels, scores = scene()
    indptr = np.concatenate([[0], np.cumsum([len(mask) for mask in masks])])
    counts = benchmark(per_scene, truth, indptr, np.concatenate(masks), labels, scores, CLASS_IDS)
    assert counts.n_predictions.sum() > 0


@pytest.mark.benchmark(group="instance AP, counts of one scene: 200 000 points, 150 predictions")
def test_one_comparison_per_pair(benchmark: Any) -> None:
    truth, masks, labels, _ = scene()
    full = np.zeros((len(masks), len(truth)), bool)
    for row, mask in zip(full, masks, strict=True):
        row[mask] = True
    assert benchmark(compare_every_pair, truth, full, labels) > 0
