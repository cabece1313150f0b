"""Votes of several neighbours and masks that include near points: exact, with ties as in the original searches."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from su3d_bench.core.maps import Masks
from su3d_bench.metrics.matching.nearest import Search, ball_tree, chosen_tree, kd_tree, nearest, nearest_as_found
from su3d_bench.metrics.matching.votes import transfer_each_mask, transfer_votes


def plain_votes(indices: np.ndarray, squared: np.ndarray, values: np.ndarray, cap_m: float) -> list[int]:
    answer = []
    for row, chosen in enumerate(indices):
        counted = Counter(int(values[i]) for i in chosen if squared[row, i] <= cap_m**2)
        answer.append(min(counted, key=lambda value: (-counted[value], value)) if counted else -1)
    return answer


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.sampled_from([*range(1, 120), 600]),
    k=st.integers(2, 7),
    on_a_grid=st.booleans(),
    cap_m=st.sampled_from([np.inf, 0.5]),
    search=st.sampled_from([ball_tree, kd_tree]),
)
def test_votes_equal_brute_force_with_ties_broken_by_the_original_search(
    seed: int, n: int, k: int, on_a_grid: bool, cap_m: float, search: Search
) -> None:
    rng = np.random.default_rng(seed)
    if on_a_grid:  # few positions, many points at each, so that there are ties beyond the last neighbour
        points, targets = rng.integers(0, rng.integers(1, 4), (n, 3)) / 1.0, rng.integers(0, 5, (30, 3)) / 2
    else:
        points, targets = rng.random((n, 3)), rng.random((30, 3))
    values = rng.integers(0, 4, n)
    squared = ((points[None] - targets[:, None]) ** 2).sum(axis=2)
    indices = search(points)(targets, min(k, n)).reshape(30, -1) if on_a_grid else squared.argsort(axis=1)[:, :k]
    ours, distance = transfer_votes(points, values, targets, np.ones(30, bool), k, cap_m, search)
    assert ours.tolist() == plain_votes(indices, squared, values, cap_m)
    exact = np.sqrt(squared).min(axis=1)
    np.testing.assert_allclose(distance, np.where(exact > cap_m, np.inf, exact), rtol=1e-12)


@pytest.mark.parametrize("search", [ball_tree, chosen_tree])
@pytest.mark.parametrize("n", [3, 9, 200])
def test_nearest_points_of_several_values_are_those_of_the_original_search(search: Search, n: int) -> None:
    rng = np.random.default_rng(n)
    points, targets, values = rng.integers(0, 2, (n, 3)) / 8, rng.integers(0, 3, (90, 3)) / 16, np.arange(n)
    distance, index, n_tied = nearest_as_found(search, points, values, targets, 0.2)
    exact, _ = nearest(points, targets, 0.2)
    assert distance.tolist() == exact.tolist() and n_tied > 0
    found = np.where(np.isfinite(exact), search(points)(targets, 1)[:, 0], -1)
    assert np.append(values, -1)[index].tolist() == np.append(values, -1)[found].tolist()


def test_smallest_value_wins_on_equal_votes() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]])
    value, _ = transfer_votes(points, np.array([7, 3, 7, 3, 5]), points[:1], np.ones(1, bool), 5)
    assert value.tolist() == [3]


def test_unwanted_targets_and_a_map_without_points_get_no_vote() -> None:
    points = np.zeros((1, 3))
    value, distance = transfer_votes(points, np.array([4]), np.zeros((2, 3)), np.array([True, False]), 5)
    assert (value.tolist(), distance.tolist()) == ([4, -1], [0.0, np.inf])
    value, distance = transfer_votes(points[:0], np.zeros(0, int), np.zeros((2, 3)), np.ones(2, bool), 5)
    assert (value.tolist(), distance.tolist()) == ([-1, -1], [np.inf, np.inf])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), n_masks=st.integers(0, 6), on_a_grid=st.booleans())
def test_masks_include_points_nearer_than_the_cap(seed: int, n_masks: int, on_a_grid: bool) -> None:
    rng = np.random.default_rng(seed)
    points, targets = rng.random((80, 3)), rng.random((100, 3))
    if on_a_grid:  # distances equal to the cap, and targets that share their position
        points, targets = np.round(points * 4) / 4, np.round(targets * 4) / 4
    sets = [np.sort(rng.permutation(80)[: rng.integers(0, 30)]) for _ in range(n_masks)]
    masks = Masks(
        np.cumsum([0, *(len(one) for one in sets)]), np.concatenate([np.zeros(0, int), *sets]).astype(np.int32)
    )
    moved = transfer_each_mask(points, masks, targets, 0.25)
    squared = ((points[None].astype(float) - targets[:, None].astype(float)) ** 2).sum(axis=2)
    assert len(moved) == n_masks
    for k, one in enumerate(sets):
        expected = np.flatnonzero((squared[:, one] < 0.25**2).any(axis=1))
        assert moved.indices[moved.indptr[k] : moved.indptr[k + 1]].tolist() == expected.tolist()
