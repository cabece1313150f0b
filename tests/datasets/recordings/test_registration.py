"""Registration of colour and depth cameras: worked by hand, and against the exact picture of a slanted wall."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array
from su3d_bench.datasets.recordings.source import Grid, Registration, SensorPair, make_registration


def intrinsics(focal: float, size: tuple[int, int]) -> Float64Array:
    return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])


def motion(angle: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64Array:
    """A rotation about the vertical axis and a translation, both in camera axes."""
    matrix = np.eye(4)
    matrix[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    matrix[:3, 3] = x, y, z
    return matrix


def pair(
    colour_size: tuple[int, int] = (8, 6),
    depth_size: tuple[int, int] = (4, 3),
    extrinsic: Float64Array | None = None,
    colour_extrinsic: Float64Array | None = None,
    colour_focal: float = 8.0,
    depth_focal: float = 4.0,
) -> SensorPair:
    return SensorPair(
        colour_size=colour_size,
        depth_size=depth_size,
        colour_intrinsics=intrinsics(colour_focal, colour_size),
        depth_intrinsics=intrinsics(depth_focal, depth_size),
        colour_extrinsic=np.eye(4) if colour_extrinsic is None else colour_extrinsic,
        depth_extrinsic=np.eye(4) if extrinsic is None else extrinsic,
        depth_shift=1000.0,
    )


def register(camera: SensorPair, grid: Grid = "depth") -> Registration:
    return make_registration(camera, grid, "scannet/x")


def columns(size: tuple[int, int], step: int = 20) -> UInt8Array:
    """Red counts columns, green rows, blue is even."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([u * step, v * step, np.full_like(u, 7)], axis=-1).astype(np.uint8)


def test_two_image_sizes_of_one_view_by_hand() -> None:
    """Colour has twice the pixels: a depth pixel is centred on four colour pixels."""
    camera = pair()
    depth_m = np.full((3, 4), 2, np.float32)
    colour, depth = register(camera).images(columns((8, 6)), depth_m)
    assert depth is depth_m
    assert colour[1].tolist() == [[20 * u, 50, 7] for u in (0.5, 2.5, 4.5, 6.5)]
    # conversely a depth pixel falls on the corner of four and, by rounding to even, on one of them
    colour_8, spread = register(camera, "colour").images(columns((8, 6)), depth_m)
    assert colour_8.shape == (6, 8, 3)
    assert np.count_nonzero(spread) == 12 and spread.max() == 2
    assert spread[0].tolist() == [2, 0, 2, 0, 2, 0, 2, 0]


def test_baseline_shifts_near_pixels_further_by_hand() -> None:
    """Colour camera 1 m to the left: its points are 1 m further right; focal length 4 px: 4 px / depth."""
    camera = pair((8, 3), (8, 3), motion(x=1.0), colour_focal=4.0)
    depth_m = np.full((3, 8), 4, np.float32)
    depth_m[:, 2:4] = 2  # two pixels at 2 m
    colour, _ = register(camera).images(columns((8, 3)), depth_m)
    assert (colour[0, :, 0] / 20).tolist() == [1, 2, 4, 5, 5, 6, 7, 7]  # the last is outside the image: border colour
    seen, depth = register(camera, "colour").images(columns((8, 3)), depth_m)
    np.testing.assert_array_equal(seen, columns((8, 3)))
    # 2 and 3 land on 4 and 5, before 4, which lands on 5 too; nothing lands on 0 and 3
    assert depth[0].tolist() == [0, 4, 4, 0, 2, 2, 4, 4]


def test_points_behind_the_colour_camera_are_dropped() -> None:
    camera = pair((4, 3), (4, 3), motion(z=-3.0), colour_focal=4.0)
    depth_m = np.full((3, 4), 2, np.float32)
    _, depth = register(camera, "colour").images(columns((4, 3)), depth_m)
    assert not depth.any()
    colour, _ = register(camera).images(columns((4, 3)), depth_m)
    assert (colour == columns((4, 3))[0, 0]).all()


@pytest.mark.parametrize("grid", ["depth", "colour"])
def test_poses_of_both_grids_map_a_pixel_to_the_same_point(grid: Grid) -> None:
    extrinsic = motion(0.2, 0.1, -0.05, 0.02)
    registration = register(pair(extrinsic=extrinsic), grid)
    pose = motion(1.0, 3, 4, 5)
    point = np.array([0.3, -0.2, 2.0, 1.0])  # in the depth camera
    in_grid = point if grid == "depth" else extrinsic @ point
    np.testing.assert_allclose(registration.camera_to_world(pose) @ in_grid, pose @ point, atol=1e-12)


def test_colour_extrinsic_maps_to_the_same_frame_as_depth_extrinsic() -> None:
    both = motion(0.3, 1, 2, 3)
    camera = pair((4, 3), (4, 3), both, both, colour_focal=4.0)
    assert register(camera).is_identity


def test_equal_sizes_with_different_focal_lengths_are_registered() -> None:
    assert not register(pair((640, 480), (640, 480), colour_focal=577.9, depth_focal=577.8)).is_identity
    assert register(pair((640, 480), (640, 480), colour_focal=577.870605, depth_focal=577.8706054688)).is_identity
    assert not register(pair((4, 3), (4, 3), motion(x=1e-4), colour_focal=4.0)).is_identity


# A slanted wall in front of the depth camera: points X with normal . X = 2, coloured by position.
NORMAL = np.array([0.3, -0.2, 1.0])
DISTANCE_M = 2.0
COLOUR_SIZE, DEPTH_SIZE = (324, 242), (160, 120)


def wall_colour(points: Float64Array) -> Float64Array:
    """A smooth pattern on the wall (..., 3), 0 to 255; it changes by at most 6 grey levels per colour pixel."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([127 + 120 * np.sin(2 * x), 127 + 120 * np.cos(2 * y), 127 + 120 * np.sin(x + y)], axis=-1)


def wall_points(matrix: Float64Array, size: tuple[int, int], to_depth_camera: np.ndarray) -> Float64Array:
    """Where the rays (H, W, 3) of a camera meet the wall, in the depth camera's axes."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(matrix).T @ to_depth_camera[:3, :3].T
    origin = to_depth_camera[:3, 3]
    reach = (DISTANCE_M - origin @ NORMAL) / (rays @ NORMAL)
    points: Float64Array = origin + reach[..., None] * rays
    return points


@pytest.fixture(scope="module")
def wall() -> tuple[SensorPair, UInt8Array, Float32Array]:
    extrinsic = motion(0.03, 0.04, -0.01, 0.02)
    camera = pair(COLOUR_SIZE, DEPTH_SIZE, extrinsic, colour_focal=290.0, depth_focal=141.0)
    seen = wall_points(camera.colour_intrinsics, COLOUR_SIZE, np.linalg.inv(extrinsic))
    depth_m = wall_points(camera.depth_intrinsics, DEPTH_SIZE, np.eye(4))[..., 2].astype(np.float32)
    return camera, np.rint(wall_colour(seen)).astype(np.uint8), depth_m


def test_colour_on_the_depth_grid_is_that_of_the_point(wall: tuple[SensorPair, UInt8Array, Float32Array]) -> None:
    camera, colour, depth_m = wall
    found, depth = register(camera).images(colour, depth_m)
    assert depth is depth_m
    points = wall_points(camera.depth_intrinsics, DEPTH_SIZE, np.eye(4))
    in_colour = points @ register(camera).depth_to_colour[:3, :3].T + register(camera).depth_to_colour[:3, 3]
    place = in_colour @ camera.colour_intrinsics.T
    place = place[..., :2] / place[..., 2:]
    is_inside = ((place >= 0) & (place <= np.array(COLOUR_SIZE) - 1)).all(axis=-1)
    assert 0.9 < is_inside.mean() < 1
    error = np.abs(found.astype(float) - wall_colour(points))[is_inside]
    assert error.max() < 1.5  # rounding of both images, and cv2.remap's 1/32 of a pixel
    # without the step between the cameras the same pixels are off by far more
    still = register(pair(COLOUR_SIZE, DEPTH_SIZE, None, colour_focal=290.0, depth_focal=141.0))
    assert np.abs(still.images(colour, depth_m)[0].astype(float) - wall_colour(points))[is_inside].max() > 10


def test_depth_on_the_colour_grid_is_that_of_the_wall(wall: tuple[SensorPair, UInt8Array, Float32Array]) -> None:
    camera, colour, depth_m = wall
    registration = register(camera, "colour")
    found, depth = registration.images(colour, depth_m)
    assert found is colour
    extrinsic = registration.depth_to_colour
    points = wall_points(camera.colour_intrinsics, COLOUR_SIZE, np.linalg.inv(extrinsic))
    true_m = (points @ extrinsic[:3, :3].T + extrinsic[:3, 3])[..., 2]
    is_hit = depth > 0
    assert 0.2 < is_hit.mean() < 0.3  # a quarter: colour has four times the pixels
    # half a pixel of rounding on a wall that recedes by less than 4 mm per pixel
    assert np.abs(depth - true_m)[is_hit].max() < 0.004
    # each depth pixel that the colour camera sees is somewhere
    assert is_hit.sum() > 0.9 * depth_m.size


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (pair(extrinsic=np.full((4, 4), 1e300)), "the depth extrinsic is not a rigid motion; expected a 4x4 pose"),
        (pair(colour_focal=1e30), "the colour intrinsics are no camera matrix; expected fx 0 cx / 0 fy cy / 0 0 1"),
    ],
)
def test_invalid_camera_pair_is_one_line(camera: SensorPair, message: str) -> None:
    with pytest.raises(DataError, match=f"^scannet/x: {message}"):
        register(camera)
