"""The points of a map on a page: thinned, packed, read back, coloured by what is near."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from packed_maps import unpacked

from su3d_bench.analysis.page.maps import points_of_each
from su3d_bench.core.maps import Instances
from su3d_bench.metrics.matching.nearest import Candidates
from su3d_bench.reports.page import maps as html_map
from su3d_bench.reports.page.maps import (
    NO_GROUND_TRUTH_NEAR,
    NOT_SCORED,
    index_plane,
    nearest_classes,
    pack_map,
    point_owners,
    thinned,
)


def surface(n: int, seed: int) -> Any:
    """Random points (n, 3) on the walls of a room of 6 x 5 x 3 m."""
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3)) * [6.0, 5.0, 3.0]
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.where(rng.random(n) < 0.5, 0.0, np.array([6.0, 5.0, 3.0])[axis])
    return points.astype(np.float32)


def test_twenty_scenes_under_eight_methods_stay_below_thirty_megabytes() -> None:
    most = points_of_each(160, 30_000_000)
    cloud = thinned(surface(150_000, 0), most)
    assert 0.6 * most < len(cloud.points) <= most
    rng = np.random.default_rng(1)
    cells = np.floor(cloud.points / 0.4).astype(np.int64) @ [1, 20, 400]
    planes: dict[str, Any] = {
        "owner": index_plane(cells % 150),
        "colour": html_map.colour_plane(rng.integers(0, 256, (len(cells), 3), np.uint8)),  # noise: the worst case
        "truth": index_plane(cells % 60),
    }
    assert 160 * len(pack_map(cloud, planes, {})) < 30_000_000


def test_thinned_points_are_one_a_cell_and_keep_the_order_of_the_curve() -> None:
    points = np.array([[0, 0, 0], [0.001, 0, 0], [1, 0, 0], [1, 1, 1], [0.02, 0, 0]], np.float32)
    cloud = thinned(points, 10)
    assert sorted(cloud.rows.tolist()) == [0, 2, 3, 4]
    assert cloud.rows[0] == 0
    assert len(thinned(points, 2).rows) <= 2
    assert len(thinned(np.zeros((0, 3), np.float32), 5).rows) == 0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
def test_places_read_back_within_half_a_step_at_every_size(scale: float) -> None:
    points = surface(5000, 3) * np.float32(scale) - np.float32(2 * scale)
    cloud = thinned(points, 2000)
    about, planes = unpacked(pack_map(cloud, {"owner": index_plane(np.arange(len(cloud.rows)))}, {}))
    assert planes["owner"].tolist() == list(range(about["n"]))
    assert np.abs(planes["position"] - cloud.points).max() <= 0.5 * about["step"] * (1 + 1e-4)
    assert about["depth"] <= 16  # a page counts cells in sixteen bits


def test_of_masks_that_overlap_the_smaller_one_is_seen() -> None:
    masks = [np.array([0, 1, 2]), np.array([1])]
    prediction = Instances.of(np.zeros((4, 3), np.float32), masks, names=["large", "small"])
    assert point_owners(prediction, np.arange(4)).tolist() == [0, 1, 0, -1]


def test_the_truth_of_a_point_is_the_nearest_within_five_centimetres() -> None:
    truth = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    points = np.array([[0.04, 0, 0], [0.06, 0, 0], [1, 0, 0]], np.float32)
    assert nearest_classes(points, Candidates(truth), np.array([7, -1])).tolist() == [
        7,
        NO_GROUND_TRUTH_NEAR,
        NOT_SCORED,
    ]
    assert nearest_classes(points, Candidates(truth[:0]), np.zeros(0, np.int64)).tolist() == [NO_GROUND_TRUTH_NEAR] * 3
