"""SAM3D's merging of clouds: the original's results to the last id, hand-worked steps, grid search against a loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CASES

from su3d_bench.baselines.sam3d.overlap import (
    GroupedCloud,
    MergeRules,
    Pairs,
    cal_group,
    drop_small_groups,
    ensemble,
    match_pairs,
    merge,
    merge_regions,
    next_level,
    numbered,
    renumber,
    voxelise,
    without_small_groups,
)
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Float64Array, Int64Array

RULES = MergeRules()


def ids(*values: int) -> Int64Array:
    return np.array(values, np.int64)


def cloud(points: object, group: object, view_group: Sequence[int] = (), views: Sequence[int] = ()) -> GroupedCloud:
    return GroupedCloud(
        np.array(points, np.float64).reshape(-1, 3), np.array(group, np.int64), ids(*view_group), ids(*views)
    )


def row(*centres: float) -> Float64Array:
    """Points along x at these positions in centimetres."""
    return np.array([[x / 100, 0, 0] for x in centres]).reshape(-1, 3)


def patch(n_x: int, n_y: int, x: int = 0, y: int = 0) -> Float64Array:
    """Centres of the 5 cm voxels starting at (x, y), in the plane z = 0.02 m."""
    grid = np.stack(np.meshgrid(np.arange(x, x + n_x), np.arange(y, y + n_y), indexing="ij"), -1).reshape(-1, 2)
    return np.column_stack([(grid + 0.5) * 0.05, np.full(len(grid), 0.02)])


def nearest_by_brute_force(queries: Float64Array, points: Float64Array, radius_m: float) -> list[tuple[int, int]]:
    """Pairs by brute force in float32; the first in a tie, the radius itself is too far."""
    pairs = []
    contents = points.astype(np.float32)
    for i, query in enumerate(queries.astype(np.float32)):
        offset = query - contents
        squared = offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1] + offset[:, 2] * offset[:, 2]
        best = int(np.argmin(squared))
        if np.sqrt(squared[best]) < np.float32(radius_m):
            pairs.append((i, best))
    return pairs


def frames_of(case: np.lib.npyio.NpzFile) -> list[GroupedCloud]:
    n_frames = int(case["n_frames"])
    return [voxelise(cloud(case[f"coord_{i}"], case[f"group_{i}"]), RULES.voxel_m) for i in range(n_frames)]


@pytest.mark.parametrize("k", range(5))
def test_cal_group_gives_the_ids_of_the_original(k: int) -> None:
    case = np.load(CASES / "sam3d01_cal_group.npz")
    pairs = Pairs(case[f"mi_{k}"].astype(np.int64), case[f"mj_{k}"].astype(np.int64))
    found = cal_group(case[f"g0_{k}"].astype(np.int64), case[f"g1_{k}"].astype(np.int64), pairs, 0.5)
    assert found.group.tolist() == case[f"out_{k}"].tolist()


def test_two_clouds_merge_as_in_the_original() -> None:
    case = np.load(CASES / "sam3d02_two_clouds.npz")
    clouds = [voxelise(cloud(case[f"coord{i}"], case[f"group{i}"]), RULES.voxel_m) for i in (0, 1)]
    for i, each in enumerate(clouds):
        assert each.points.tobytes() == case[f"vox_coord{i}"].tobytes()
        assert each.group.tolist() == case[f"vox_group{i}"].tolist()
    merged = merge(clouds[0], clouds[1], RULES, Timer())
    assert merged is not None and merged.n_groups == 10
    assert merged.points.tobytes() == case["out_coord"].tobytes()
    assert merged.group.tolist() == case["out_group"].tolist()


@pytest.mark.parametrize(("name", "n_groups"), [("sam3d03_seven_frames", 16), ("sam3d04_frame_with_nan", 15)])
def test_every_level_of_the_tree_matches_the_original(name: str, n_groups: int) -> None:
    case = np.load(CASES / f"{name}.npz")
    clouds = frames_of(case)
    for level in range(int(case["n_levels"])):
        expected = [case[f"level_{level}_group_{i}"].tolist() for i in range(int(case[f"level_{level}_n"]))]
        assert [each.group.tolist() for each in clouds] == expected
        clouds = next_level(clouds, RULES, Timer()) if len(clouds) > 1 else clouds
    whole = merge_regions(frames_of(case), RULES, Timer())
    assert whole is not None and whole.group.tolist() == clouds[0].group.tolist()
    final = numbered(without_small_groups(whole, 50))
    assert final.n_groups == n_groups
    assert final.group.tolist() == case["out_group"].tolist()
    assert final.points.astype(np.float32).tobytes() == case["out_coord"].tobytes()


def test_superpoints_take_the_groups_of_the_original() -> None:
    case = np.load(CASES / "sam3d05_superpoints.npz")
    group = case["sam3d_group"].astype(np.int64)
    assert renumber(drop_small_groups(group, 20)).tolist() == case["natural"].tolist()
    assert ensemble(group, case["segIndices"], 20, 0.5).tolist() == case["out"].tolist()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.02, 0.3, 1.0]), st.booleans())
def test_grid_search_matches_brute_force(seed: int, spread_m: float, is_coarse: bool) -> None:
    rng = np.random.default_rng(seed)
    queries, points = (rng.normal(size=(n, 3)) * spread_m for n in rng.integers(1, 60, 2))
    if is_coarse:  # many points at the same distance
        queries, points = np.round(queries * 16) / 16, np.round(points * 16) / 16
    found = match_pairs(queries, points, 0.075)
    expected = nearest_by_brute_force(queries, points, 0.075)
    assert list(zip(found.query.tolist(), found.other.tolist(), strict=True)) == expected


def test_first_of_equal_overlaps_wins_not_the_lowest_id() -> None:
    other, group = ids(0, 0, 1, 1), ids(0, 0)
    assert cal_group(other, group, Pairs(ids(0, 1), ids(2, 0)), 0.5).group.tolist() == [1, 1]
    assert cal_group(other, group, Pairs(ids(0, 1), ids(0, 2)), 0.5).group.tolist() == [0, 0]


SMALL = MergeRules(min_points=1)


def test_first_call_joins_groups_of_the_second_cloud_and_second_call_confirms() -> None:
    # The second cloud has the plate in two halves: both take the first's id, and the first matches both.
    points = patch(8, 8)
    first = cloud(points, np.zeros(64), [0], [0])
    second = cloud(points + 0.001, np.repeat([0, 1], 32), [0, 1], [1, 2])
    merged = merge(first, second, SMALL, Timer())
    assert merged is not None
    assert set(merged.group.tolist()) == {0}
    assert sorted(merged.views.tolist()) == [0, 1, 2] and set(merged.view_group.tolist()) == {0}


def line_and_knot(labels: list[int], views: tuple[int, ...]) -> GroupedCloud | None:
    """A line of 20 points, 5 cm apart, with view 3, merged with ten points 3 cm before its end, a millimetre apart.

    All ten match the first of the line; of the line only that point matches one of them.
    """
    line = cloud(row(*range(0, 100, 5)), np.zeros(20), [0], [3])
    knot = cloud([[-0.03, y / 1000, 0.0] for y in range(10)], labels, range(len(views)), views)
    return merge(line, knot, SMALL, Timer())


def test_match_of_the_first_call_is_lost_if_the_second_does_not_confirm_it() -> None:
    # First call: 10 of 10 share, so the knot takes the line's id 0. Second: 1 of 10, so the line gets a new id.
    merged = line_and_knot([0] * 10, (4,))
    assert merged is not None
    in_knot = merged.points[:, 0] < 0
    assert set(merged.group[in_knot].tolist()) == {0} and set(merged.group[~in_knot].tolist()) == {1}
    assert dict(zip(merged.view_group.tolist(), merged.views.tolist(), strict=True)) == {0: 4, 1: 3}


def test_second_call_counts_after_relabelling_by_the_first() -> None:
    # First: one row of 8. Second: halves of 4 over it. After the first call both halves are one group of 8, so the
    # first cloud's group shares 8 of 8 with it; counted before, its best would be a half with 4 of 4.
    first, second = cloud(patch(8, 1), np.zeros(8)), cloud(patch(8, 1), np.repeat([0, 1], 4))
    forward = cal_group(first.group, second.group, match_pairs(second.points, first.points, 0.075), 0.5)
    back = match_pairs(first.points, second.points, 0.075)
    assert cal_group(forward.group, first.group, back, 1.0).group.tolist() == [0] * 8
    assert cal_group(second.group, first.group, back, 1.1).group.tolist() == [2] * 8


def test_groups_below_50_points_are_dropped_even_from_an_unmerged_cloud() -> None:
    valid = cloud(patch(10, 10), np.repeat([0, 3], [49, 51]), [0, 3], [0, 1])
    broken = cloud(np.full((60, 3), np.nan), np.zeros(60), [0], [2])
    for first, second in ((valid, broken), (broken, valid)):
        merged = merge(first, second, RULES, Timer())
        assert merged is not None
        assert merged.group.tolist() == [-1] * 49 + [3] * 51  # not renumbered
        assert (merged.view_group.tolist(), merged.views.tolist()) == ([3], [1])
    assert merge(broken, broken, RULES, Timer()) is None


def test_segment_takes_the_group_covering_half_of_the_smaller_or_keeps_its_id() -> None:
    group = np.repeat([0, 1, -1], [30, 25, 45])
    segments = np.repeat([70, 71, 99], [40, 15, 45])
    # 70 holds 30 of group 0 and 10 of group 1: best 0, 30 of 30. 71 holds 15 of group 1: 15 of 15. 99: nothing.
    assert ensemble(group, segments, 20, 0.5).tolist() == [0] * 40 + [1] * 15 + [99 + 2] * 45
    # group 1 has 25 vertices: below 26 it is ignored, and its segment keeps its id
    assert ensemble(group, segments, 26, 0.5).tolist() == [0] * 40 + [71 + 1] * 15 + [99 + 1] * 45
