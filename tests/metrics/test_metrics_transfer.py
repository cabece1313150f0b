"""From predicted to ground-truth points: exact, the lowest index on ties, overlaps kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_room import ROOM, OneHotEncoder
from threadpoolctl import threadpool_info

from su3d_bench.core.maps import Masks, Partition
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics import graphs
from su3d_bench.metrics.matching import labelling, votes
from su3d_bench.metrics.matching import nearest as nearest_module
from su3d_bench.metrics.matching.checks import duplicate_pairs
from su3d_bench.metrics.matching.labelling import most_similar
from su3d_bench.metrics.matching.nearest import MIN_SORTED_CANDIDATES, Candidates, nearest
from su3d_bench.metrics.matching.transfer import reduce_to_voxels, transfer_masks, transfer_values


def brute_force(candidates: np.ndarray, queries: np.ndarray) -> np.ndarray:
    offset = candidates[None].astype(np.float64) - queries[:, None].astype(np.float64)
    return np.asarray((offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2).argmin(axis=1))


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 300), on_a_grid=st.booleans(), is_ordered=st.booleans())
def test_nearest_equals_brute_force_with_the_lowest_index_on_ties(
    seed: int, n: int, on_a_grid: bool, is_ordered: bool
) -> None:
    rng = np.random.default_rng(seed)
    if on_a_grid:  # few positions, many points at each, queries half-way between
        candidates = rng.integers(0, 3, (n, 3)).astype(np.float64)
        queries = rng.integers(0, 5, (50, 3)) / 2
    else:
        candidates, queries = rng.random((n, 3)), rng.random((50, 3))
    with pytest.MonkeyPatch.context() as patch:
        if is_ordered:  # as for large clouds
            patch.setattr(nearest_module, "MIN_SORTED_CANDIDATES", 0)
        distance, index = nearest(candidates, queries)
        capped = nearest(candidates, queries, cap_m=0.2)[1]
    assert np.array_equal(index, brute_force(candidates, queries))
    assert np.array_equal(capped, np.where(distance <= 0.2, index, -1))
    exact = np.sqrt(((candidates[index].astype(np.float64) - queries) ** 2).sum(axis=1))
    np.testing.assert_allclose(distance, exact, rtol=1e-12, atol=0)


def test_lowest_index_wins_among_more_ties_than_one_request() -> None:
    candidates = np.zeros((5000, 3), np.float32)
    candidates[:4000] += 1
    assert nearest(candidates, np.zeros((3, 3), np.float32))[1].tolist() == [4000] * 3


@pytest.mark.parametrize("first", [-1.0, 1.0])
def test_lowest_index_wins_in_any_search_order(first: float) -> None:
    candidates = np.zeros((40, 3))
    candidates[:20, 0], candidates[20:, 0] = first, -first  # more of each than one request returns
    distance, index = nearest(candidates, np.zeros((2, 3)))
    assert (index.tolist(), distance.tolist()) == ([0, 0], [1.0, 1.0])


def test_a_neighbour_at_the_cap_counts_and_one_beyond_it_does_not() -> None:
    candidates = np.array([[0.0, 0, 0], [0.5, 0, 0]])
    queries = np.array([[1.0, 0, 0], [1.0 + 1e-9, 0, 0]])
    distance, index = nearest(candidates, queries, cap_m=0.5)
    assert index.tolist() == [1, -1]
    assert distance.tolist() == [0.5, np.inf]


def test_no_candidates_means_no_neighbours() -> None:
    distance, index = nearest(np.zeros((0, 3)), np.zeros((2, 3)))
    assert (index.tolist(), distance.tolist()) == ([-1, -1], [np.inf, np.inf])


def test_points_at_one_position_keep_their_values_on_a_copy() -> None:
    points, rank, wanted = np.zeros((3, 3)), np.array([0, 1, -1]), np.array([True, True, True])
    values, distance = transfer_values(points, np.array([7, 8, 9]), rank, points.copy(), wanted)
    assert (values.tolist(), distance.tolist()) == ([7, 8, 7], [0.0, 0.0, 0.0])
    masks = Masks(np.array([0, 1, 2]), np.array([0, 1], np.int32))
    assert transfer_masks(points, masks, points.copy()).indices.tolist() == [0, 1]


def test_unwanted_targets_and_those_beyond_the_cap_have_no_value() -> None:
    points, targets = np.array([[1.0, 0, 0]]), np.array([[1.0, 0, 0], [1, 0, 0], [9, 0, 0]])
    wanted = np.array([True, False, True])
    values, distance = transfer_values(points, np.array([7]), np.array([0]), targets, wanted, 0.5)
    assert (values.tolist(), distance.tolist()) == ([7, -1, -1], [0.0, np.inf, np.inf])


def test_overlapping_masks_stay_overlapping_and_background_competes() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    masks = Masks(np.array([0, 2, 4]), np.array([0, 1, 1, 2], np.int32))
    targets = np.array([[0.1, 0, 0], [1.1, 0, 0], [2.6, 0, 0], [2.1, 0, 0], [9.0, 0, 0]])
    moved = transfer_masks(points, masks, targets, cap_m=1.0)
    assert moved.indptr.tolist() == [0, 2, 4]
    assert moved.indices.tolist() == [0, 1, 1, 3]


def test_voxel_reduction_keeps_the_first_point_of_each_mask_and_of_the_background_in_a_voxel() -> None:
    points = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0], [0.04, 0, 0], [0.2, 0, 0], [0.21, 0, 0]])
    masks = Masks(np.array([0, 2, 4]), np.array([1, 2, 2, 4], np.int32))
    assert reduce_to_voxels(points, masks, 0.1).tolist() == [0, 1, 2, 4, 5]
    assert reduce_to_voxels(points[:0], Masks(np.zeros(1, np.int64), np.zeros(0, np.int32)), 0.1).tolist() == []


def test_a_reduced_map_gives_the_same_masks_where_they_are_farther_apart_than_a_voxel() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.random((500, 3)), rng.random((500, 3)) + np.array([3, 0, 0])])
    masks = Masks(np.array([0, 500]), np.arange(500, dtype=np.int32))
    targets = points + 0.003
    whole = transfer_masks(points, masks, targets, cap_m=0.3)
    reduced = transfer_masks(points, masks, targets, cap_m=0.3, voxel_m=0.1)
    assert len(reduce_to_voxels(points, masks, 0.1)) < 900
    assert np.array_equal(whole.indices, reduced.indices)


def test_duplicates_are_pairs_strictly_above_the_iou() -> None:
    tens = np.arange(10, dtype=np.int32)
    masks = Masks(np.array([0, 10, 19, 28]), np.concatenate([tens, tens[:9], tens[1:]]))
    assert duplicate_pairs(masks, 10, 0.9) == []
    assert duplicate_pairs(masks, 10, 0.89) == [(0, 1), (0, 2)]


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 160), iou=st.sampled_from([0.0, 0.1, 0.5, 0.89, 0.9, 0.95, 0.99]))
def test_duplicates_are_those_of_a_comparison_of_every_pair(seed: int, n: int, iou: float) -> None:
    rng = np.random.default_rng(seed)
    sets: list[set[int]] = []
    for _ in range(rng.integers(0, 14)):
        if sets and rng.random() < 0.6:  # almost equal to a previous one
            sets.append(sets[rng.integers(len(sets))] ^ set(rng.integers(0, n, rng.integers(0, 6)).tolist()))
        else:
            sets.append(set(np.flatnonzero(rng.random(n) < rng.random()).tolist()))
    masks = Masks.of_sets([np.array(sorted(one), np.int64) for one in sets])
    pairs = [(k, m) for m, other in enumerate(sets) for k, one in enumerate(sets[:m])
             if len(one & other) > iou * len(one | other)]  # fmt: skip
    assert duplicate_pairs(masks, n, iou) == sorted(pairs)


def test_features_without_candidate_classes_have_no_class() -> None:
    features = np.ones((2, OneHotEncoder().dim), np.float32)
    partition = Partition(np.zeros((3, 3), np.float32), np.array([0, 1, -1], np.int32), features)
    rules, none = ROOM.model_copy(update={"vocabulary": "scene"}), np.zeros(len(ROOM.classes), bool)
    nothing = labelling.classes_of_prediction(rules, partition, OneHotEncoder(), none)
    assert nothing.tolist() == [-1, -1]
    assert labelling.class_index_of_ids(ROOM, []).tolist() == []


def test_the_first_class_wins_ties_and_features_without_direction() -> None:
    text = np.array([[1.0, 0], [0, 1], [0, 1]])
    features = np.array([[0.0, 5], [1, 1], [0, 0], [np.nan, 1]])
    assert most_similar(features, text).tolist() == [1, 0, 0, 0]


def test_feature_with_non_finite_values_has_zero_similarity() -> None:
    features = np.array([[np.nan, 1], [1, np.inf], [np.nan, np.nan], [0, 2]])
    assert labelling.cosines(features, np.array([[1.0, 0], [0, 1]])).tolist() == [[0, 0], [0, 0], [0, 0], [0, 1]]


def test_cosines_are_summed_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    n_threads: list[int] = []

    def normalised(rows: Float64Array) -> Float64Array:
        n_threads.append(max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
        return rows

    monkeypatch.setattr(labelling, "_normalised", normalised)
    labelling.cosines(np.eye(3), np.eye(3))
    assert n_threads == [1, 1]
    most_similar(np.eye(3), np.eye(3))
    assert n_threads[3:] == [1]  # after the directions of the texts, which are computed first


def test_labels_do_not_depend_on_the_block_size() -> None:
    rng = np.random.default_rng(0)
    features, text = rng.normal(size=(20_000, 16)).astype(np.float16), rng.normal(size=(9, 16))
    whole = most_similar(features, text)
    assert np.array_equal(whole[15_000:15_100], most_similar(features[15_000:15_100], text))


@pytest.mark.parametrize("n", [2_000, MIN_SORTED_CANDIDATES + 5])
@pytest.mark.parametrize("apart_m", [0.0, 1e-25])
def test_points_at_one_place_are_searched_once(n: int, apart_m: float) -> None:
    rng = np.random.default_rng(n)
    places = np.array([[0.0, 0, 0], [1, 1, 1], [2, 0, 1]])
    points, queries = places[rng.integers(0, 3, n)], rng.integers(0, 5, (40, 3)) / 2
    points += apart_m * np.arange(n)[:, None]
    _, index = nearest(points, queries)
    assert index.tolist() == brute_force(points, queries).tolist()
    assert Candidates(points)._tree.n == 3
    assert votes._Search(points, 5).tree.n == 18  # one more than 5 of each place, to notice ties
    assert graphs.Cloud(points)._tree.n == 3
