"""PointFusion as in gradslam: projection, unique matches, confidence-weighted means, on hand-worked values."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.baselines.conceptfusion.method import picked
from su3d_bench.baselines.conceptfusion.point_fusion import ABSENT, PointFusion, View, alpha, normals_of, view_of
from su3d_bench.core.types import Frame

TOWARDS = np.array([0.0, 0.0, 1.0])


def row_of_pixels(width: int = 4, depth_m: float = 1.0) -> View:
    """One row of pixels per metre apart at depth 1 m, seen by a camera of focal length 1 at the origin."""
    points = np.stack([np.arange(width) * depth_m, np.zeros(width), np.full(width, depth_m)], axis=1)
    return View(
        1, width, points, np.tile(TOWARDS, (width, 1)), np.ones(width, bool), np.ones(width), np.eye(3), np.eye(4)
    )


def a_map(
    *points: tuple[float, float, float], counts: list[float] | None = None, distance_m: float = 10
) -> PointFusion:
    fusion = PointFusion(distance_m, 20.0)
    n = len(points)
    shown = View(
        1, n, np.array(points, float), np.tile(TOWARDS, (n, 1)), np.ones(n, bool),
        np.array(counts or [1.0] * n), np.eye(3), np.eye(4),
    )  # fmt: skip
    fusion.insert(shown, np.full(n, ABSENT, np.int64))
    return fusion


def test_alpha_falls_with_distance_to_its_minimum_beyond_3_4_metres() -> None:
    distances = np.array([0.0, 0.6, 1.2, 3.40, 3.41, 8.0])
    values = alpha(np.stack([np.zeros(6), np.zeros(6), distances], axis=1), 0.6)
    assert values[:3] == pytest.approx([1.0, np.exp(-0.5), np.exp(-2.0)])
    assert values[3] > 1e-7
    assert values[4:].tolist() == [1e-7, 1e-7]


def test_normals_are_cross_products_of_steps_and_the_last_ones_repeat() -> None:
    x, y = np.meshgrid(np.arange(3.0), np.arange(2.0))
    flat = normals_of(np.stack([x, y, np.full_like(x, 2.0)], axis=-1))
    assert flat.tolist() == [[[0, 0, 1]] * 3] * 2
    tilted = normals_of(np.stack([x, y, x], axis=-1))  # right (1, 0, 1), down (0, 1, 0): (-1, 0, 1) / sqrt 2
    assert tilted == pytest.approx(np.broadcast_to(np.array([-1, 0, 1]) / np.sqrt(2), (2, 3, 3)))
    folded = np.stack([x, y, np.array([[0.0, 0, 1], [0, 0, 1]])], axis=-1)
    assert normals_of(folded)[0, :, 0].tolist() == pytest.approx([0, -(0.5**0.5), -(0.5**0.5)])


def test_pixel_without_depth_has_no_point_and_creates_none() -> None:
    depth_m = np.array([[1.0, 0.0], [np.nan, 1.0]], np.float32)
    frame = Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8), depth_m, np.eye(4), np.eye(3))
    view = view_of(frame, picked(2, 2), picked(2, 2), 0.6)
    assert view.has_depth.tolist() == [True, False, False, True]
    assert not view.points[1:3].any() and not view.normals[1:3].any()
    fusion = PointFusion(0.05, 20.0)
    assert fusion.insert(view, fusion.associate(view)).tolist() == [0, 3]


@pytest.mark.parametrize(
    ("u", "pixel"), [(0.5, 0), (0.51, 1), (1.5, 2), (2.4, 2), (-0.0005, 0), (3.0005, 3), (-0.002, None), (3.002, None)]
)
def test_map_point_goes_to_the_nearest_pixel_or_outside_to_none(u: float, pixel: int | None) -> None:
    matched = a_map((u, 0, 1)).associate(row_of_pixels())
    assert np.flatnonzero(matched != ABSENT).tolist() == ([] if pixel is None else [pixel])


def test_match_is_nearer_than_the_distance_and_within_the_angle() -> None:
    view = row_of_pixels(2)
    for z, matches in ((1.0499, True), (1.05, False), (0.96, True)):
        assert (a_map((0, 0, z), distance_m=0.05).associate(view)[0] == 0) == matches, z
    for degrees, matches in ((19.9, True), (20.1, False)):
        turned = np.array([np.sin(np.deg2rad(degrees)), 0, np.cos(np.deg2rad(degrees))])
        seen = view._replace(normals=np.tile(turned, (2, 1)))
        assert (a_map((0, 0, 1)).associate(seen)[0] == 0) == matches, degrees


def test_most_confident_point_is_matched_then_nearest_then_oldest() -> None:
    near, far = (0.0, 0.0, 1.01), (0.0, 0.0, 1.04)
    view = row_of_pixels(2)
    assert a_map(near, far, counts=[1, 2], distance_m=0.05).associate(view).tolist() == [1, ABSENT]
    assert a_map(far, near, counts=[1, 1], distance_m=0.05).associate(view).tolist() == [1, ABSENT]
    assert a_map(near, near, counts=[1, 1], distance_m=0.05).associate(view).tolist() == [0, ABSENT]


def test_matched_point_moves_to_the_weighted_mean_with_unnormalised_normal() -> None:
    fusion = a_map((0, 0, 1.04), counts=[0.5], distance_m=0.05)
    tilt = np.array([0.28, 0, 0.96])
    view = row_of_pixels(2)._replace(alpha=np.array([0.25, 1.0]), normals=np.tile(tilt, (2, 1)))
    matched = fusion.associate(view)
    fusion.fuse(view, matched)
    assert fusion.points[0].tolist() == pytest.approx([0, 0, (0.5 * 1.04 + 0.25 * 1.0) / 0.75])
    assert fusion.normals[0].tolist() == pytest.approx([0.28 / 3, 0, (2 + 0.96) / 3])
    assert fusion.counts.tolist() == [0.75]
    assert fusion.insert(view, matched).tolist() == [1]
    assert fusion.points[1].tolist() == [1, 0, 1]
