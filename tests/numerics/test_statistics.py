"""Intervals over scenes: seeded, from additive counts, honest about a single scene."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

import su3d_bench.numerics.statistics
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import resampling
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.numerics.statistics import bootstrap_interval, percentile_interval, resample_weights


def test_the_examples_in_the_docstrings_run() -> None:
    assert doctest.testmod(su3d_bench.numerics.statistics).failed == 0
    assert doctest.testmod(resampling).failed == 0


def test_the_same_seed_gives_the_same_interval_and_another_seed_another() -> None:
    values: Float64Array = np.random.default_rng(5).random(8)

    def mean(weights: Int64Array) -> Float64Array:
        return np.array([float(row @ values) / 8 for row in weights])

    assert bootstrap_interval(mean, 8) == bootstrap_interval(mean, 8)
    assert bootstrap_interval(mean, 8, seed=0) != bootstrap_interval(mean, 8, seed=1)


def test_a_single_scene_has_no_interval() -> None:
    assert bootstrap_interval(lambda weights: np.zeros(len(weights)), 1) is None


def test_resamples_in_which_nothing_can_be_scored_are_left_out() -> None:
    assert percentile_interval(np.array([np.nan, 0.5, 0.5])) == (0.5, 0.5)
    assert percentile_interval(np.array([np.nan])) is None


def test_every_resample_draws_as_many_scenes_as_there_are() -> None:
    weights = resample_weights(8)
    assert weights.shape == (1000, 8)
    assert (weights.sum(axis=1) == 8).all()


def random_scene(rng: np.random.Generator) -> instance_ap.InstanceCounts:
    truth = np.repeat(rng.integers(0, 4, 12) * 1000 + np.arange(1, 13), rng.integers(80, 200, 12))
    masks = [np.flatnonzero(rng.random(len(truth)) < 0.02) for _ in range(4)]
    for _ in range(20):
        start = rng.integers(0, len(truth) - 200)
        masks.append(np.arange(start, start + rng.integers(100, 200)))
    indptr = np.concatenate([[0], np.cumsum([len(m) for m in masks])])
    labels, scores = rng.integers(1, 4, len(masks)), rng.integers(1, 6, len(masks)) / 5
    return instance_ap.per_scene(truth, indptr, np.concatenate(masks), labels, scores, [1, 2, 3])


def test_resampled_ap_equals_the_ap_of_the_scenes_drawn() -> None:
    rng = np.random.default_rng(11)
    counts = [random_scene(rng) for _ in range(5)]
    weights = np.concatenate([np.ones((1, 5), np.int64), resample_weights(5, 20, seed=3), [[0, 0, 5, 0, 0]]])
    resampled = resampling.resampled_ap(counts, weights)
    for row, weight in enumerate(weights):
        ap = instance_ap.combine([counts[s] for s in range(5) for _ in range(weight[s])])
        drawn = [resampled["AP"][row], resampled["AP50"][row], resampled["AP25"][row]]
        np.testing.assert_allclose(drawn, [ap.ap, ap.ap50, ap.ap25], rtol=0, atol=1e-12)


@pytest.mark.parametrize("metric", ["conceptgraphs", "scannet"])
def test_resampled_semantic_metrics_equal_those_of_the_scenes_drawn(metric: str) -> None:
    rng = np.random.default_rng(2)
    counts = []
    for scene in range(4):
        truth = rng.integers(0, 3, 200) + scene % 2
        truth[: 50 * (scene == 1)] = 4
        counts.append(semantic.per_scene(truth, rng.integers(-1, 6, 200), np.ones(6, bool)))
    weights = resample_weights(4, 30, seed=1)
    resampled = semantic.resampled_semantic(counts, weights, "scannet" if metric == "scannet" else "conceptgraphs")
    for row, weight in enumerate(weights):
        whole = semantic.concatenate([counts[s] for s in range(4) for _ in range(weight[s])]).confusion
        if metric == "scannet":
            expected = semantic.scannet_metrics(whole)
        else:
            keep = np.flatnonzero(whole.sum(axis=1) > 0)
            whole[:, -1] += whole[:, [c for c in range(6) if c not in keep]].sum(axis=1)
            expected = semantic.conceptgraphs_metrics(whole, keep)
        drawn = [resampled["mAcc"][row], resampled["mIoU"][row], resampled["F-mIoU"][row]]
        values = [expected.mean_accuracy, expected.mean_iou, expected.frequency_weighted_iou]
        np.testing.assert_allclose(drawn, values, rtol=0, atol=1e-12)
