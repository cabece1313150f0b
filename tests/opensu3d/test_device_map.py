"""The map on a torch device answers as the one on the CPU does, to the last bit; on a GPU too where there is one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch_devices import on_each_device

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.opensu3d.config import Density
from su3d_bench.opensu3d.voxel_map import VoxelMap

if TYPE_CHECKING:
    from su3d_bench.opensu3d.kernels.voxel_map_torch import DeviceVoxelMap


def maps(eps: float, device: str, density: Density = "scene") -> tuple[VoxelMap, DeviceVoxelMap]:
    from su3d_bench.opensu3d.kernels.voxel_map_torch import DeviceVoxelMap

    return VoxelMap(eps, density), DeviceVoxelMap(eps, device, density)


def assert_equal_maps(one: VoxelMap, other: DeviceVoxelMap, queries: Float64Array) -> None:
    np.testing.assert_array_equal(other.points, one.points)
    np.testing.assert_array_equal(other.ids, one.ids)
    np.testing.assert_array_equal(other.by_age, one.by_age)
    assert (len(other), other.n_blocks) == (len(one), one.n_blocks)
    found = one.nearest(queries)
    np.testing.assert_array_equal(other.nearest(queries), found)
    np.testing.assert_array_equal(other.ids_of(found), one.ids_of(found))
    wanted = np.array([3, 1], np.int32)
    for lower, upper in ((queries.min(axis=0), queries.max(axis=0)), (queries[0], queries[0])):
        np.testing.assert_array_equal(other.count_inside(lower, upper, wanted), one.count_inside(lower, upper, wanted))


# Steps of half an eps put points on cell borders, on top of each other and at exactly eps from a query.
lattice = st.lists(st.tuples(*[st.integers(-9, 9)] * 3), min_size=1, max_size=40)
views = st.lists(lattice, min_size=1, max_size=4)
densities = st.sampled_from(["scene", "frame", "all"])


@on_each_device
@settings(max_examples=100, deadline=None)
@given(
    densities,
    views,
    lattice,
    st.sampled_from([0.0, -1.28, 1e4]),
    st.sampled_from([0.25, 0.02, 0.1]),
    st.integers(0, 2**20),
)
def test_a_device_gives_the_same_map_and_pairs_on_lattices(
    device: str, density: Density, added: Any, asked: Any, offset: float, eps: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    one, other = maps(eps, device, density)
    for lattice_points in added:
        points = np.array(lattice_points, np.float64) * eps / 2 + offset
        ids = rng.integers(0, 6, len(points)).astype(np.int32)
        here, there = (each.insert(points, ids) for each in (one, other))
        np.testing.assert_array_equal(there, here)
    assert_equal_maps(one, other, np.array(asked, np.float64) * eps / 2 + offset)


@on_each_device
@pytest.mark.parametrize("density", ["scene", "frame", "all"])
@pytest.mark.parametrize("offset", [0.0, -3.7, 12345.678, -250000.0])
def test_a_device_gives_the_same_map_and_pairs_on_surfaces_that_are_seen_again(
    device: str, offset: float, density: Density
) -> None:
    rng = np.random.default_rng(3)
    one, other = maps(0.02, device, density)
    for _ in range(4):
        points = rng.uniform(-0.8, 0.8, (9000, 3)) * [1, 1, 0.02] + offset + rng.uniform(-0.5, 0.5, 3) * [1, 1, 0]
        ids = rng.integers(0, 6, len(points)).astype(np.int32)
        here, there = (each.insert(points, ids) for each in (one, other))
        np.testing.assert_array_equal(there, here)
    queries = rng.uniform(-0.9, 0.9, (20_000, 3)) * [1, 1, 0.03] + offset
    assert_equal_maps(one, other, queries)
    assert 0 < np.count_nonzero(one.nearest(queries) < 0) < len(queries)


@on_each_device
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1), (1, 3, 0, 2)])
def test_of_points_equally_near_in_several_voxels_a_device_takes_the_lowest(
    device: str, order: tuple[int, ...]
) -> None:
    points = np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [-0.01, 0.0, 0.0]])[list(order)]
    _, filled = maps(0.02, device, "all")
    filled.insert(points, np.ones(4, np.int32))
    assert filled.nearest(np.zeros((1, 3))).tolist() == [0]


@on_each_device
def test_a_point_at_exactly_eps_does_not_match_on_a_device(device: str) -> None:
    _, filled = maps(0.25, device)
    filled.insert(np.array([[0.25, 0.0, 0.0]]), np.ones(1, np.int32))
    assert filled.nearest(np.array([[0.0, 0, 0], [np.nextafter(0.0, 1.0), 0, 0], [1e-9, 0, 0]])).tolist() == [-1, -1, 0]


@on_each_device
def test_an_empty_device_map_matches_and_counts_nothing(device: str) -> None:
    _, empty = maps(0.02, device)
    assert empty.nearest(np.zeros((2, 3))).tolist() == [-1, -1]
    assert empty.nearest(np.zeros((0, 3))).shape == (0,)
    assert empty.count_inside(np.zeros(3), np.ones(3), np.array([1], np.int32)).tolist() == [0]
    assert empty.insert(np.zeros((0, 3)), np.zeros(0, np.int32)).shape == (0,)


@on_each_device
def test_a_point_beyond_the_reach_of_a_devices_keys_is_one_line_and_a_query_there_matches_nothing(device: str) -> None:
    _, filled = maps(0.02, device)
    filled.insert(np.zeros((1, 3)), np.ones(1, np.int32))
    with pytest.raises(DataError, match=r"reaches 167772 m from its first point; use device cpu"):
        filled.insert(np.full((1, 3), 2e5), np.ones(1, np.int32))
    assert filled.nearest(np.array([[2e5, 0, 0], [0.001, 0, 0], [-167772.0, 0, 0]])).tolist() == [-1, 0, -1]
    with pytest.raises(DataError, match="in metres"):
        filled.nearest(np.array([[np.nan, 0, 0]]))
