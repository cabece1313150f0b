"""Which points frames show: a box between two cameras, an occluder, points outside the images."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.types import Frame
from su3d_bench.numerics import visibility
from su3d_bench.numerics.visibility import depth_gap, first_shown, visible

CAMERA = np.array([[20.0, 0, 20], [0, 20.0, 20], [0, 0, 1]])
SIZE = (41, 41)


def frame(depth_m: np.ndarray, pose: np.ndarray | None = None) -> Frame:
    return Frame(0, 0.0, np.zeros((*SIZE, 3), np.uint8), depth_m, np.eye(4) if pose is None else pose, CAMERA)


def from_the_front() -> Frame:
    """The front of a box at z = 2 m before a wall at 4 m, a pillar at 1 m at the left, and no depth at the top."""
    depth_m = np.full(SIZE, 4.0, np.float32)
    depth_m[:, 10:31] = 2.0
    depth_m[:, :10] = 1.0
    depth_m[0, :] = 0.0
    return frame(depth_m)


def from_behind() -> Frame:
    """The same box from z = 5 m, where the camera looks back: its back, at z = 3 m, is 2 m away."""
    pose = np.diag([-1.0, 1, -1, 1])
    pose[2, 3] = 5
    depth_m = np.full(SIZE, 5.0, np.float32)
    depth_m[:, 10:31] = 2.0
    return frame(depth_m, pose)


POINTS = {  # point: shown from the front, from behind
    (0, 0, 2): (True, False),  # the front of the box
    (0, 0, 3): (False, True),  # its back
    (0, 0, 2.04): (True, False),  # within the distance
    (0, 0, 1.96): (True, False),
    (0, 0, 2.06): (False, False),  # inside the box
    (0, 0, 1.9): (False, False),  # in front of it
    (3, 0, 4): (True, False),  # the wall, at column 35; outside the image from behind
    (-3, 0, 4): (False, False),  # behind the pillar, at column 5
    (-0.75, 0, 1): (True, False),  # the pillar itself, whose pixels from behind have another depth
    (5, 0, 4): (False, False),  # outside both images
    (0, 0, -2): (False, False),  # behind the camera; from behind it is farther than the box
    (0, -0.045, 0.045): (False, False),  # a pixel without depth
    (4.08, 0, 4): (True, False),  # column 40.4, nearest to the last pixel
    (4.12, 0, 4): (False, False),  # column 40.6, outside
}
CLOUD = np.array(list(POINTS), np.float32)


def test_visible_points_agree_with_the_depth_at_their_pixel() -> None:
    assert visible(CLOUD, from_the_front()).tolist() == [front for front, _ in POINTS.values()]
    assert visible(CLOUD, from_behind()).tolist() == [behind for _, behind in POINTS.values()]
    assert visible(CLOUD, from_the_front(), distance_m=0.03).sum() == sum(front for front, _ in POINTS.values()) - 2


def test_result_does_not_depend_on_the_size_of_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "CHUNK", 3)
    assert visible(CLOUD, from_the_front()).tolist() == [front for front, _ in POINTS.values()]
    assert visible(CLOUD[:0], from_the_front()).tolist() == []


def test_each_point_has_the_first_frame_that_shows_it() -> None:
    front, behind = from_the_front(), from_behind()
    cloud, back = first_shown([CLOUD, CLOUD[1:2]], [front, behind, front])
    expected = [0 if from_front else 1 if from_back else 9 for from_front, from_back in POINTS.values()]
    assert np.minimum(cloud, 9).tolist() == expected
    assert back.tolist() == [1]


def test_gap_is_the_distance_to_the_surface_behind_a_point() -> None:
    points = np.array([[0, 0, 1.5], [0, 0, 2], [0, 0, 2.5], [9, 0, 2], [0, -0.045, 0.045]], np.float32)
    gap = depth_gap(points, from_the_front())
    np.testing.assert_allclose(gap, [0.5, 0, -0.5, np.nan, np.nan])
