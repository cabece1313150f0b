"""The cloud of one image: back-projection as printed, and its reduction to voxels."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.frame_cloud import NO_DETECTION, frame_cloud

INTRINSICS = np.array([[50.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])


def pose() -> Float64Array:
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(0.8) * cross + (1 - np.cos(0.8)) * cross @ cross
    matrix[:3, 3] = [4.0, -2.0, 1.5]
    return matrix


def frame_of(depth_m: Float32Array) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m, pose(), INTRINSICS)


def random_depth() -> Float32Array:
    return np.random.default_rng(0).uniform(0.5, 4, (24, 32)).astype(np.float32)


def test_back_projection_is_the_equation_pixel_by_pixel_in_row_major_order() -> None:
    depth_m, pixels = random_depth(), np.random.default_rng(1).random((24, 32)) < 0.3
    expected = []
    for v, u in zip(*np.nonzero(pixels), strict=True):
        in_camera = float(depth_m[v, u]) * np.linalg.inv(INTRINSICS) @ np.array([u, v, 1.0])
        expected.append((pose() @ np.append(in_camera, 1.0))[:3])
    np.testing.assert_allclose(back_project(depth_m, INTRINSICS, pose(), pixels), expected, atol=1e-12)


def test_zero_nan_negative_and_out_of_range_depth_is_dropped() -> None:
    depth_m = np.array([[0.0, np.nan, np.inf, -1.0, 0.05, 0.1, 2.0, 2.01]], np.float32)
    assert valid_depth(depth_m, 0.1, 2.0).tolist() == [[False] * 5 + [True, True, False]]
    depth_m[0, 5] = 0.11
    cloud = frame_cloud(frame_of(depth_m), np.zeros((0, 1, 8), np.bool_), OpenSU3DConfig(depth_min=0.1, depth_max=2.0))
    assert (len(cloud.points), cloud.n_inside) == (2, 0)


def halves() -> BoolArray:
    masks = np.zeros((2, 24, 32), np.bool_)
    masks[0, :, :16] = True
    masks[1, 8:, 16:] = True
    return masks


def test_the_reduced_cloud_holds_the_first_point_of_each_voxel_and_detection() -> None:
    config = OpenSU3DConfig(border_px=0, frame_voxel=0.3)
    frame = frame_of(random_depth())
    full = frame_cloud(frame, halves(), config.model_copy(update={"frame_voxel": 0.0}))
    cloud = frame_cloud(frame, halves(), config)
    assert len(full.points) == 24 * 32
    keys = np.column_stack([np.floor(full.points / 0.3), full.owner])
    _, first = np.unique(keys, axis=0, return_index=True)
    kept = np.sort(first)
    assert len(kept) < len(full.points)
    np.testing.assert_array_equal(cloud.points, full.points[kept])
    np.testing.assert_array_equal(cloud.owner, full.owner[kept])


def test_points_inside_masks_come_first_then_rings_then_background() -> None:
    config = OpenSU3DConfig(border_px=3, border_reference_width=0, border_pixels="owner", frame_voxel=0)
    cloud = frame_cloud(frame_of(random_depth()), halves(), config)
    n_masked = np.count_nonzero(halves())
    n_ring = 3 * 16 + 2 + 2  # of the smaller mask, on the right: three columns beside it and a disc's corner above
    assert (cloud.owner[:n_masked] != NO_DETECTION).all()
    assert (cloud.owner[n_masked:] == NO_DETECTION).all()
    assert cloud.n_inside == n_masked - n_ring
    assert (cloud.owner[cloud.n_inside : n_masked] == 0).all()
    by_default = frame_cloud(
        frame_of(random_depth()), halves(), config.model_copy(update={"border_pixels": "background"})
    )
    assert by_default.n_inside == cloud.n_inside == np.count_nonzero(by_default.owner != NO_DETECTION)
    assert len(by_default.points) == len(cloud.points)  # a ring's pixels are back-projected too


def test_the_voxels_of_the_frame_cloud_follow_eps_unless_they_are_set() -> None:
    frame = frame_of(random_depth())
    config = OpenSU3DConfig(border_px=0, eps=0.3)
    assert config.effective()["frame_voxel"] == 0.3
    followed = frame_cloud(frame, halves(), config)
    np.testing.assert_array_equal(
        followed.points, frame_cloud(frame, halves(), config.model_copy(update={"frame_voxel": 0.3})).points
    )
    assert len(followed.points) < len(frame_cloud(frame, halves(), OpenSU3DConfig(border_px=0)).points)
