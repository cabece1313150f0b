"""The exact test, and values over scenes that are drawn again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import metric_of
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.numerics.statistics import MAX_EXACT_PAIRS, SignFlipTest, sign_flip_test


def by_enumeration(differences: list[float]) -> float:
    """The share of all sign patterns whose sum is at least as far from 0, one by one."""
    observed = abs(sum(differences))
    patterns = itertools.product((-1, 1), repeat=len(differences))
    sums = [abs(sum(s * d for s, d in zip(signs, differences, strict=True))) for signs in patterns]
    return sum(total >= observed - 1e-12 for total in sums) / len(sums)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-8, 8), min_size=1, max_size=11))
def test_the_sign_flip_test_counts_every_pattern(values: list[int]) -> None:
    differences = [value / 16 for value in values]  # exact in binary, and often equal
    found = sign_flip_test(np.array(differences))
    assert found == SignFlipTest(by_enumeration(differences), 2.0 ** (1 - len(values)), len(values), True)


def test_three_scenes_of_one_sign_give_the_smallest_p_that_three_allow() -> None:
    assert sign_flip_test(np.array([0.1, 0.3, 0.2])) == SignFlipTest(0.25, 0.25, 3, True)
    assert sign_flip_test(np.array([0.1, 0.3, np.nan, -0.2])) == SignFlipTest(0.75, 0.25, 3, True)


def test_no_difference_has_p_one_and_no_pair_has_no_test() -> None:
    assert sign_flip_test(np.zeros(5)) == SignFlipTest(1.0, 0.0625, 5, True)
    assert sign_flip_test(np.array([np.nan])) is None


def test_rounding_does_not_tell_equal_sums_apart() -> None:
    found = sign_flip_test(np.array([0.1, 0.2, 0.3, -0.3]))  # 0.1 + 0.2 is not 0.3 in binary
    assert found is not None
    assert found.p == by_enumeration([0.1, 0.2, 0.3, -0.3]) == 0.75


def test_many_scenes_are_counted_by_halves_and_very_many_are_drawn() -> None:
    same_sign = sign_flip_test(np.ones(MAX_EXACT_PAIRS))
    assert same_sign == SignFlipTest(2.0 ** (1 - MAX_EXACT_PAIRS), 2.0 ** (1 - MAX_EXACT_PAIRS), MAX_EXACT_PAIRS, True)
    rng = np.random.default_rng(0)
    differences = rng.normal(0.1, 1, MAX_EXACT_PAIRS + 20)
    drawn = sign_flip_test(differences)
    assert drawn is not None
    assert not drawn.is_exact
    assert drawn == sign_flip_test(differences)
    # the sum is nearly normal: the share beyond it within a few standard errors of 100,000 draws
    from math import erfc, sqrt

    expected = erfc(abs(differences.sum()) / sqrt(2 * (differences**2).sum()))
    assert abs(drawn.p - expected) < 0.02


# values over drawn scenes


def test_values_over_drawn_scenes_are_those_of_the_scenes_together() -> None:
    rng = np.random.default_rng(4)
    rules = load_protocol("rooms-instance")
    ids = [entry.id for entry in rules.scored][:4]
    counts = []
    for _ in range(4):
        truth = np.repeat(rng.choice(ids, 8) * 1000 + np.arange(1, 9), 150)
        starts = rng.integers(0, len(truth) - 200, 10)
        masks = [np.arange(start, start + rng.integers(110, 200)) for start in starts]
        indptr = np.concatenate([[0], np.cumsum([len(mask) for mask in masks])])
        labels, scores = rng.choice(ids, 10), rng.integers(1, 4, 10) / 4
        scored = [entry.id for entry in rules.scored]
        counts.append(scene_counts.per_scene(truth, indptr, np.concatenate(masks), labels, scores, scored))
    weights = np.concatenate(
        [np.ones((1, 4), np.int64), np.eye(4, dtype=np.int64), rng.multinomial(4, [0.25] * 4, size=6)]
    )
    metric = metric_of(rules)
    drawn = metric.resampled_headline(counts, [], weights)
    classes = metric.resampled_classes(counts, weights)
    for row, weight in enumerate(weights):
        chosen = [counts[s] for s in range(4) for _ in range(weight[s])]
        whole = metric.combine(chosen)
        ap = instance_ap.combine(chosen, rules.thresholds)
        for name in rules.headline:
            assert drawn[name][row] == pytest.approx(whole[name], abs=1e-12)
        for index, name in enumerate(rules.curve_names):
            if name in classes:
                np.testing.assert_allclose(classes[name]["AP"][row], ap.of_class(index)[0], atol=1e-12)
            else:
                assert np.isnan(ap.of_class(index)[0])


def test_recall_and_iou_of_a_class_over_drawn_scenes() -> None:
    rules = load_protocol("rooms-semantic")
    n = len(rules.classes)
    first = semantic.per_scene(np.array([0, 0, 1]), np.array([0, 1, 1]), np.ones(n, bool))
    second = semantic.per_scene(np.array([0, 0]), np.array([0, 0]), np.ones(n, bool))
    values = metric_of(rules).resampled_classes([first, second], np.array([[1, 0], [0, 1], [1, 1]]))
    zero, one = rules.classes[0].name, rules.classes[1].name
    assert set(values) == {zero, one}
    assert values[zero]["recall"].tolist() == [0.5, 1.0, 0.75]
    np.testing.assert_array_equal(values[one]["IoU"], [0.5, np.nan, 0.5])


# runs of painted scenes
