"""Corruptions of calibration, on values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import INTRINSICS, recording
from severity_measures import apply_to_frame, marks, marks_after

from su3d_bench.core.types import Float32Array, Float64Array
from su3d_bench.corruptions.calibration import ROWS, seen_from

FOCAL, PRINCIPAL_POINT, ROTATION, TRANSLATION = ROWS
SCENES = tuple(f"scene{k}" for k in range(8))
CAMERA = np.array([[100.0, 0, 5], [0, 100.0, 5], [0, 0, 1]])


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64Array:
    motion = np.eye(4)
    motion[:3, 3] = x, y, z
    return motion


def row_of(depths_m: dict[int, float]) -> Float32Array:
    """An image of one row of twelve pixels."""
    image = np.zeros((1, 12), np.float32)
    image[0, list(depths_m)] = list(depths_m.values())
    return image


def test_both_focal_lengths_are_8_percent_too_long_or_too_short() -> None:
    found = [apply_to_frame(FOCAL, 8.0, scene).intrinsics for scene in SCENES]
    assert {round(one[0, 0], 9) for one in found} == {round(140 * 1.08, 9), round(140 * 0.92, 9)}
    for one in found:
        assert one[0, 0] == one[1, 1] and (one[:, 2] == INTRINSICS[:, 2]).all()


def test_the_principal_point_moves_by_pixels_of_the_reference_width() -> None:
    shifts = np.array([apply_to_frame(PRINCIPAL_POINT, 32.0, scene).intrinsics - INTRINSICS for scene in SCENES])
    assert np.hypot(shifts[:, 0, 2], shifts[:, 1, 2]) == pytest.approx(32 * 160 / 640)
    assert not shifts[:, :, :2].any() and len(np.unique(np.arctan2(shifts[:, 1, 2], shifts[:, 0, 2]))) == 8


def test_a_nearer_point_moves_farther_and_hides_the_one_behind_it() -> None:
    # 4 cm to the right are 100 * 0.04 / 1 = 4 px at 1 m and 2 px at 2 m
    found = seen_from(row_of({2: 1.0, 4: 2.0, 8: 2.0}), CAMERA, moved(x=0.04))
    assert found.tolist() == row_of({6: 1.0, 10: 2.0}).tolist()


def test_points_outside_the_image_or_behind_the_camera_are_not_seen() -> None:
    assert not seen_from(row_of({10: 1.0}), CAMERA, moved(x=0.04)).any()
    centre = np.zeros((11, 11), np.float32)
    centre[5, 5] = 1.0
    assert seen_from(centre, CAMERA, moved(z=-0.5))[5, 5] == 0.5
    assert not seen_from(centre, CAMERA, moved(z=-1.5)).any()


def test_a_quarter_turn_about_the_optical_axis_turns_the_image() -> None:
    image = np.random.default_rng(0).uniform(1, 3, (11, 11)).astype(np.float32)
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]  # x becomes y, and y becomes -x: clockwise, as y points down
    assert seen_from(image, CAMERA, turn) == pytest.approx(np.rot90(image, -1))


def test_an_enlarged_surface_has_no_gaps_and_keeps_its_hole() -> None:
    image = np.full((101, 101), 1.3, np.float32)
    image[40:61, 40:61] = 0
    camera = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
    found = seen_from(image, camera, moved(z=-0.3))
    missing = np.argwhere(found == 0)
    assert found[found > 0] == pytest.approx(1.0)
    assert missing.min() == 50 - 13 and missing.max() == 50 + 13  # 10 px from the centre are 13, of which half a pixel
    assert len(missing) == 27**2


def test_the_background_is_not_seen_through_an_enlarged_surface() -> None:
    image = np.full((101, 101), 3.9, np.float32)
    image[40:61, 40:61] = 1.3  # from 1.3 to 1 m: 27 px wide, and 10 px to the right, over pixels of the background
    camera = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
    found = seen_from(image, camera, moved(x=0.1, z=-0.3))
    assert found[37:64, 47:74] == pytest.approx(1.0) and found[:, 74:][found[:, 74:] > 0] == pytest.approx(3.6)


def test_a_slanted_surface_is_not_moved_towards_the_camera() -> None:
    rows = (np.arange(101) - 50) / 100
    plane = np.array([0, 0.8, 0.5])  # its product with a point of the surface is 1: from 10 m to 1.1 m
    image = np.tile(1 / (plane[1] * rows + plane[2])[:, None], 101).astype(np.float32)
    turn, angle = np.eye(4), np.deg2rad(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    found = seen_from(image, np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]]), turn)[10:90, 50]
    expected = 1 / ([0, *turn[1:3, 1:3] @ plane[1:]] @ np.stack([rows, rows, np.ones(101)]))[10:90]
    slope = np.abs(np.gradient(expected))  # per pixel
    assert np.abs((found - expected) / slope).max() < 0.6 and abs(((found - expected) / slope).mean()) < 0.05


def test_depth_is_rotated_by_the_given_angle_about_an_axis_of_the_scene() -> None:
    from scipy.spatial.transform import Rotation

    clean = marks_after(ROTATION, 0.0, SCENES[0])
    axes = []
    for scene in SCENES[:3]:
        turn = Rotation.align_vectors(marks_after(ROTATION, 4.0, scene).T, clean.T)[0].as_rotvec(degrees=True)
        assert np.linalg.norm(turn) == pytest.approx(4.0, abs=0.15)
        axes.append(turn / 4)
    assert np.abs(np.array(axes) @ np.array(axes).T - np.eye(3)).max() < 0.99


def test_depth_is_moved_by_the_given_distance_in_a_direction_of_the_scene() -> None:
    _, _, depths_m = marks()
    for scene in SCENES[:3]:
        shift = marks_after(TRANSLATION, 10.0, scene) - marks_after(TRANSLATION, 0.0, scene)
        assert np.linalg.norm(shift.mean(axis=1)) == pytest.approx(0.10, abs=0.005)
        assert np.abs(shift - shift.mean(axis=1, keepdims=True)).max() < 0.75 * depths_m.max() / 560


def test_colour_does_not_move_with_depth() -> None:
    found = apply_to_frame(TRANSLATION, 10.0, index=12)
    assert found.rgb is recording().frames[12].rgb
