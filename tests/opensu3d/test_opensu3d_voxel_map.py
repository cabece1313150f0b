"""The voxel map: equal to a KD-tree, constant density, and no step that scans the whole map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.opensu3d.config import Density
from su3d_bench.opensu3d.voxel_map import ROWS_PER_THREAD, VoxelMap

EPS = 0.02


def map_of(points: Float64Array, eps: float = EPS, ids: Int64Array | None = None) -> VoxelMap:
    filled = VoxelMap(eps, "all")
    labels = np.ones(len(points), np.int32) if ids is None else np.asarray(ids, np.int32)
    filled.insert(np.asarray(points, np.float64), labels)
    return filled


def kd_tree_pairs(points: Float64Array, queries: Float64Array, eps: float = EPS) -> Int64Array:
    """The result of a KD-tree; ties: the lowest index."""
    tree = cKDTree(points)
    distance, index = tree.query(queries, distance_upper_bound=eps)
    found = np.where(np.isfinite(distance), index, -1)
    for row in np.flatnonzero(found >= 0):
        offset = queries[row] - points
        squared = offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2
        found[row] = np.flatnonzero(squared == squared.min())[0]
    return found.astype(np.int64)


@pytest.mark.parametrize("offset", [0.0, -3.7, 12345.678, -250000.0])
def test_matching_equals_a_kd_tree_on_random_surfaces(offset: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.5, 0.5, (3000, 3)) * [1, 1, 0.05] + offset
    queries = rng.uniform(-0.6, 0.6, (2000, 3)) * [1, 1, 0.06] + offset
    found = map_of(points).nearest(queries)
    assert 0 < np.count_nonzero(found < 0) < len(queries)
    np.testing.assert_array_equal(found, kd_tree_pairs(points, queries))


# Steps of half an eps put points on cell borders, on top of each other and at exactly eps from a query.
lattice = st.lists(st.tuples(*[st.integers(-9, 9)] * 3), min_size=1, max_size=60)


@settings(max_examples=150, deadline=None)
@given(lattice, lattice, st.sampled_from([0.0, -1.28, 0.32, 1e4, -0.02]), st.sampled_from([0.25, 0.02, 0.1]))
def test_matching_equals_a_kd_tree_on_lattices(
    points: list[tuple[int, ...]], queries: list[tuple[int, ...]], offset: float, eps: float
) -> None:
    placed = np.array(points, np.float64) * eps / 2 + offset
    asked = np.array(queries, np.float64) * eps / 2 + offset
    np.testing.assert_array_equal(map_of(placed, eps).nearest(asked), kd_tree_pairs(placed, asked, eps))


@pytest.mark.parametrize("n_threads", [2, 3, 64])
def test_matching_is_independent_of_the_number_of_threads(n_threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    filled = map_of(rng.uniform(0, 2, (50_000, 3)) * [1, 1, 0.01])
    queries = rng.uniform(0, 2, (4 * ROWS_PER_THREAD + 1, 3)) * [1, 1, 0.01]
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 1)
    found, visited = filled.nearest_counted(queries)
    assert 0 < np.count_nonzero(found < 0) < len(queries)
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", n_threads)
    in_parts, visited_in_parts = filled.nearest_counted(queries)
    np.testing.assert_array_equal(in_parts, found)
    assert visited_in_parts == visited


@pytest.mark.parametrize(
    ("density", "placed", "ids"),
    [("scene", [0, 0, 1, 2], [2, 3, 4]), ("frame", [0, -1, 1, 2], [1, 3, 4]), ("all", [0, 1, 2, 3], [1, 2, 3, 4])],
)
def test_density_decides_which_of_two_points_in_a_voxel_is_dropped(
    density: Density, placed: list[int], ids: list[int]
) -> None:
    filled = VoxelMap(EPS, density)
    points = np.array([[0.001, 0.001, 0.001], [0.019, 0.019, 0.019], [0.021, 0.001, 0.001], [-0.001, 0.001, 0.001]])
    assert filled.insert(points, np.array([1, 2, 3, 4], np.int32)).tolist() == placed
    assert filled.ids.tolist() == ids
    assert filled.points[0, 0] == (0.019 if density == "scene" else 0.001)


@pytest.mark.parametrize("density", ["scene", "frame"])
def test_density_is_constant_and_memory_bounded_for_repeated_views(density: Density) -> None:
    rng = np.random.default_rng(0)
    filled = VoxelMap(EPS, density)
    n_bytes = []
    for view in range(60):
        points = rng.uniform(0, 0.4, (4000, 3)) * [1, 1, 0]
        filled.insert(points, np.full(len(points), view + 1, np.int32))
        n_bytes.append(filled.n_bytes)
    assert len(filled) <= 20 * 20
    assert n_bytes[1] == n_bytes[-1]  # the first view found an empty map
    assert len(np.unique(np.floor(filled.points / EPS), axis=0)) == len(filled)


seen = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=12)  # a voxel of six, and an id


@settings(max_examples=200, deadline=None)
@given(st.lists(seen, max_size=5), st.sampled_from(["scene", "frame", "all"]))
def test_map_equals_a_point_list_with_deletions(views: list[list[tuple[int, int]]], density: Density) -> None:
    filled, expected = VoxelMap(EPS, density), list[tuple[float, int]]()
    for view in views:
        x = np.array([(voxel + 0.1 + 0.05 * k) * EPS for k, (voxel, _) in enumerate(view)])
        for place, (voxel, own) in zip(x, view, strict=True):
            contents = [each for each in expected if density != "all" and int(each[0] / EPS) == voxel]
            if contents and (density == "frame" or (own == 0 and contents[0][1] != 0)):
                continue
            expected = [each for each in expected if each not in contents] + [(float(place), own)]
        filled.insert(np.column_stack([x, x * 0, x * 0]), np.array([own for _, own in view], np.int32))
    found = [(float(filled.points[k, 0]), int(filled.ids[k])) for k in filled.by_age]
    assert found == expected


def test_oldest_of_equally_near_points_matches_wherever_it_is_stored() -> None:
    filled = VoxelMap(EPS)
    filled.insert(np.array([[0.012, 0, 0], [-0.01, 0, 0]]), np.array([1, 2], np.int32))
    filled.insert(np.array([[0.01, 0, 0]]), np.array([3], np.int32))  # replaces the very first point
    assert filled.ids.tolist() == [3, 2]
    assert filled.by_age.tolist() == [1, 0]
    assert filled.nearest(np.zeros((1, 3))).tolist() == [1]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-40, 40)] * 3), min_size=1, max_size=80),
    st.tuples(*[st.integers(-40, 40)] * 3),
    st.tuples(*[st.integers(0, 60)] * 3),
)
def test_points_inside_a_closed_box_are_counted_by_id(
    lattice_points: list[tuple[int, ...]], corner: tuple[int, ...], size: tuple[int, ...]
) -> None:
    filled, placed = VoxelMap(EPS), np.array(lattice_points, np.float64) * 0.016
    for nth in range(3):  # some points get another id, or none
        filled.insert(placed[:: nth + 1], ((np.arange(len(placed)) + nth) % 5).astype(np.int32)[:: nth + 1])
    points, ids = filled.points, filled.ids
    lower = np.array(corner) * 0.016
    upper = lower + np.array(size) * 0.016
    inside = ((points >= lower) & (points <= upper)).all(axis=1)
    wanted = np.array([4, 1, 3], np.int32)
    counts = filled.count_inside(lower, upper, wanted)
    assert counts.tolist() == [np.count_nonzero(inside & (ids == one)) for one in wanted]


def test_counts_follow_points_that_change_their_instance() -> None:
    """Along x the box from 0 to 0.34 m ends inside the blocks at 0 and 0.32 m and contains that at 0.16 m."""
    filled, points = VoxelMap(EPS), np.full((5, 3), 0.01)
    points[:, 0] = [0.01, 0.17, 0.19, 0.33, 0.35]
    wanted, ends = np.array([1, 2], np.int32), (np.array([0.0, -0.2, -0.2]), np.array([0.34, 0.2, 0.2]))
    counts = []
    for rows, one in ((slice(5), 1), (slice(1, 2), 2), (slice(5), 0), (slice(2, 5), 2), (slice(1), 3)):
        filled.insert(points[rows], np.full(len(points[rows]), one, np.int32))
        counts.append(filled.count_inside(*ends, wanted).tolist())
    assert counts == [[4, 0], [3, 1], [3, 1], [1, 3], [0, 3]]


def test_counting_cost_is_independent_of_other_instances_in_the_box() -> None:
    """A plate of 0.32 m is in four blocks, which are the ones visited among thousands of other instances' points."""
    side = (np.arange(16) + 0.5) * EPS
    plate = np.stack(np.meshgrid(side, side, [0.01]), axis=-1).reshape(-1, 3)
    others = np.random.default_rng(2).uniform(-2, 2, (40_000, 3))
    filled = VoxelMap(EPS)
    filled.insert(others, np.arange(2, 40_002, dtype=np.int32))
    filled.insert(plate, np.ones(256, np.int32))
    counts, visited = filled.count_inside_counted(np.full(3, -2.0), np.full(3, 2.0), np.array([1], np.int32))
    assert (counts.tolist(), visited) == ([256], 4)


def test_matching_and_counting_cost_is_independent_of_map_size() -> None:
    """The number of visited voxels and blocks is the same with 40 times the points elsewhere."""
    rng = np.random.default_rng(1)
    room = rng.uniform(0, 2, (5_000, 3)) * [1, 1, 0.01]
    building = rng.uniform(-60, 60, (200_000, 3)) * [1, 1, 0.01] + [0, 0, 9.0]
    queries = rng.uniform(0, 2, (500, 3)) * [1, 1, 0.01]
    visits = []
    for points in (room, np.concatenate([room, building])):
        filled = VoxelMap(EPS)
        filled.insert(points, np.ones(len(points), np.int32))
        _, voxels = filled.nearest_counted(queries)
        _, blocks = filled.count_inside_counted(np.zeros(3), np.array([2.0, 2.0, 0.1]), np.array([1], np.int32))
        visits.append((voxels, blocks))
    assert visits[0][0] == visits[1][0] <= 27.1 * len(queries)
    assert max(visits[0][1], visits[1][1]) <= 13 * 13 * 1


def test_non_finite_or_too_distant_point_is_rejected() -> None:
    for bad in (np.nan, np.inf, -1e9):
        points = np.array([[0.0, 0, 0], [0.0, bad, 0]])
        with pytest.raises(DataError, match="in metres"):
            VoxelMap(EPS).insert(points, np.ones(2, np.int32))
        with pytest.raises(DataError, match="in metres"):
            VoxelMap(EPS).nearest(points)
