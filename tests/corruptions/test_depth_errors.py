"""Errors of depth cameras: hand-worked values, and what every error has in common."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from su3d_bench.core.types import Float32Array, Float64Array
from su3d_bench.corruptions.sensors import depth

CAMERA = np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]])
SHAPE = (480, 640)
STEEP = np.array([-0.7, 0.0, -np.sqrt(0.51)])  # from 1.1 m on the right to 9 m on the left, at up to 80 degrees
Error = Callable[[Float32Array, float, np.random.Generator], Float32Array]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def wall(distance_m: float) -> Float32Array:
    return np.full(SHAPE, distance_m, np.float32)


def slanted(normal: Float64Array, distance_m: float) -> Float32Array:
    """Depth of the plane at ``distance_m`` along the optical axis."""
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    rays = np.stack([(u - 319.5) / 400, (v - 239.5) / 400, np.ones(SHAPE)], axis=-1)
    return np.asarray(distance_m * normal[2] / (rays @ normal), np.float32)


def box_before_wall(near_m: float = 1.0, far_m: float = 2.0) -> Float32Array:
    image = wall(far_m)
    image[100:300, 200:400] = near_m
    return image


def angles(image: Float32Array) -> Float32Array:
    return depth.incidence(image, CAMERA)


def room() -> Float32Array:
    image = slanted(STEEP, 2.0)
    image[100:300, 200:400] = 1.0
    image[:50] = 0
    return image


ERRORS: dict[str, Error] = {
    "axial": lambda image, size, r: depth.axial_noise(image, angles(image), r, size, 9),
    "lateral": lambda image, size, r: depth.lateral_noise(image, angles(image), r, size, 9),
    "quantise": lambda image, size, r: depth.quantise(image, size / 4),
    "scale": lambda image, size, r: depth.scale(image, 1 + size / 50),
    "flying": lambda image, size, r: depth.add_flying_pixels(image, depth.edges(image), size / 4, r),
    "shadow": lambda image, size, r: depth.cast_shadow(image, 400.0, size * 0.04),
    "range": lambda image, size, r: depth.limit_range(image, size * 1.3, np.inf),
    "weak": lambda image, size, r: depth.lose_weak(image, angles(image), 0.5, size * 0.07, r, 0.3),
    "glare": lambda image, size, r: depth.lose_glare(image, angles(image), np.ones_like(image), 0.5, size / 20),
    "glass": lambda image, size, r: depth.see_through(image, np.full_like(image, size / 4), r),
    "edges": lambda image, size, r: depth.lose_edges(image, depth.edges(image), 2, size / 4, r),
}
MOVING = ("axial", "lateral", "quantise", "scale", "flying")


@pytest.mark.parametrize("name", ERRORS)
def test_size_zero_changes_nothing_and_missing_stays_missing(name: str) -> None:
    image = room()
    assert ERRORS[name](image, 0, rng()).tobytes() == image.tobytes()
    before = image.tobytes()
    broken = ERRORS[name](image, 2, rng())
    assert image.tobytes() == before and broken.dtype == np.float32
    assert (broken[:50] == 0).all() and np.isfinite(broken).all() and (broken >= 0).all()


@pytest.mark.parametrize("name", ERRORS)
def test_one_seed_gives_the_same_bytes_and_more_is_worse(name: str) -> None:
    image = room()
    assert ERRORS[name](image, 1, rng(3)).tobytes() == ERRORS[name](image, 1, rng(3)).tobytes()
    results = [ERRORS[name](image, size, rng(3)) for size in (1, 2, 3)]
    if name in MOVING:
        harm = [float(np.sqrt(np.mean((result - image) ** 2, dtype=np.float64))) for result in results]
    else:
        harm = [float((result == 0).mean()) for result in results]
    assert 0 < harm[0] < harm[1] < harm[2]


def test_normals_of_a_slanted_plane_are_exact_and_an_edge_does_not_reach_its_neighbours() -> None:
    normal = np.array([-0.6, 0.2, -np.sqrt(0.6)])
    found = depth.normals(slanted(normal, 2.0), CAMERA)
    assert np.abs(found - normal).max() < 2e-3
    facing = depth.normals(box_before_wall(), CAMERA)
    assert np.abs(facing - [0, 0, -1]).max() < 1e-3
    assert depth.incidence(wall(2.0), CAMERA)[239, 319 + 200] == pytest.approx(np.arctan(199.5 / 400), abs=1e-3)


def test_slanted_planes_have_no_edges_and_a_box_has_two_pixels_of_edge_all_around() -> None:
    assert not depth.edges(slanted(STEEP, 2.0)).any()
    found = depth.edges(box_before_wall())
    assert found[200].nonzero()[0].tolist() == [199, 200, 399, 400]


def test_axial_sigma_has_the_values_of_the_paper() -> None:
    image = np.array([[1.0, 3.0, 1.0]], np.float32)
    angle = np.array([[0.0, np.pi / 6, np.deg2rad(75)]], np.float32)
    # 0.0012 + 0.0019 * 0.36; 0.0012 + 0.0019 * 6.76; at 75 degrees + 0.0001 * (75 / 15)^2
    assert depth.axial_sigma(image, angle)[0] == pytest.approx([0.001884, 0.014044, 0.004384], rel=1e-4)


@pytest.mark.parametrize(("distance_m", "sigma_m"), [(1.0, 0.001884), (3.0, 0.014044)])
@pytest.mark.parametrize("grain_px", [1, 9])
def test_noise_on_a_wall_has_the_sigma_of_the_paper_before_and_after_quantisation(
    distance_m: float, sigma_m: float, grain_px: int
) -> None:
    image, angle = wall(distance_m), np.zeros(SHAPE, np.float32)
    noisy = depth.axial_noise(image, angle, rng(), 1.0, grain_px)
    assert np.std(noisy, dtype=np.float64) == pytest.approx(sigma_m, rel=0.05)
    noisy = depth.axial_noise(image, angle, rng(), 1.0, grain_px, depth.STEP_PX)
    assert np.std(depth.quantise(noisy), dtype=np.float64) == pytest.approx(sigma_m, rel=0.05)


def test_grain_is_alike_within_a_window_and_unrelated_beyond() -> None:
    noise = depth.grain((400, 400), 9, rng()).astype(np.float64)
    assert noise.std() == pytest.approx(1, rel=0.03)
    assert (noise[:, :-3] * noise[:, 3:]).mean() == pytest.approx(6 / 9, abs=0.05)  # boxes 3 apart share 6 of 9 columns
    assert (noise[:, :-9] * noise[:, 9:]).mean() == pytest.approx(0, abs=0.05)


def test_quantised_depths_are_multiples_of_an_eighth_of_a_pixel_in_disparity() -> None:
    image = np.linspace(0.6, 4.5, 5000, dtype=np.float32)[None]
    found = np.unique(depth.quantise(image))
    steps = 0.075 * 585 * 8 / found.astype(np.float64)
    assert np.abs(steps - np.rint(steps)).max() < 1e-3
    assert np.diff(found)[np.searchsorted(found, 2.0)] == pytest.approx(
        4 / (0.075 * 585 * 8), rel=0.02
    )  # 11.4 mm at 2 m


def test_lateral_noise_moves_the_outline_by_its_sigma_and_leaves_planes_alone() -> None:
    plane = slanted(STEEP, 2.0)
    moved = depth.lateral_noise(plane, angles(plane), rng(), 1.0, 9)
    assert np.abs(moved - plane).max() < 1e-3
    image = wall(2.0)
    image[:, 320:] = 1.0
    outline = (depth.lateral_noise(image, angles(image), rng(), 1.0, 1) > 1.5).sum(axis=1)
    # Each row moves pixels on both sides of the outline: the share at distance k is P(|0.8 n| >= k - 0.5).
    strayed = (depth.lateral_noise(image, np.zeros_like(image), rng(1), 1.0, 1)[:, 318] < 1.5).mean()
    assert strayed == pytest.approx(0.0304, abs=0.02)  # 0.8 n > 1.5 px
    assert abs(outline.mean() - 320) < 0.5


@pytest.mark.parametrize(("near_m", "far_m"), [(1.0, 2.0), (0.8, 3.0)])
def test_shadow_is_as_wide_as_the_difference_of_disparities_and_left_of_the_object(near_m: float, far_m: float) -> None:
    seen = depth.cast_shadow(box_before_wall(near_m, far_m), 400.0, 0.075)
    lost = np.flatnonzero(seen[200] == 0)
    assert len(lost) == pytest.approx(400 * 0.075 * (1 / near_m - 1 / far_m), abs=1)
    assert lost[-1] == 199 and (np.diff(lost) == 1).all()
    assert (seen[50] > 0).all()
    left = depth.cast_shadow(box_before_wall(near_m, far_m), 400.0, -0.075)
    assert np.flatnonzero(left[200] == 0)[0] == 400


def test_a_pole_casts_a_shadow_of_its_own_width_and_a_slanted_plane_none() -> None:
    image = wall(3.0)
    image[:, 300:306] = 1.0
    assert (depth.cast_shadow(image, 400.0)[200] == 0).sum() == pytest.approx(6, abs=1)
    assert (depth.cast_shadow(slanted(STEEP, 2.0), 400.0) > 0).all()


def test_dark_grazing_and_distant_surfaces_are_lost_at_the_threshold() -> None:
    image = np.array([[3.9, 4.1, 2.0, 2.0]], np.float32)
    albedo = np.array([[0.18, 0.18, 0.05, 0.18]], np.float32)
    angle = np.deg2rad(np.array([[0, 0, 15, 80]], np.float32))
    kept = depth.lose_weak(image, angle, albedo, 0.18 / 16, rng()) > 0
    assert kept.tolist() == [[True, False, True, False]]  # 0.05 cos 15 / 4 = 0.0121; 0.18 cos 80 / 4 = 0.0078


def test_glass_shows_what_is_behind_it_or_nothing() -> None:
    share = np.zeros(SHAPE, np.float32)
    share[:, :320] = 1.0
    seen = depth.see_through(wall(1.0), share, rng(), wall(3.0))
    assert (seen[:, :320] == 3).all() and (seen[:, 320:] == 1).all()
    share[:] = 0.3
    assert (depth.see_through(wall(1.0), share, rng()) == 0).mean() == pytest.approx(0.3, abs=0.03)


def test_glossy_surfaces_are_lost_only_where_they_face_the_sensor() -> None:
    lost = depth.lose_glare(wall(1.0), angles(wall(1.0)), np.ones(SHAPE, np.float32), 0.5, np.deg2rad(4)) == 0
    assert lost.sum() == pytest.approx(np.pi * (400 * np.tan(np.deg2rad(4))) ** 2, rel=0.02)
    assert lost[239, 319] and not lost[239, 400]


def test_flying_pixels_lie_between_both_surfaces_and_only_at_edges() -> None:
    image = box_before_wall()
    result = depth.add_flying_pixels(image, depth.edges(image), 1.0, rng())
    changed = result != image
    assert changed.sum() > 0.9 * depth.edges(image).sum() and not (changed & ~depth.edges(image)).any()
    assert (result >= 1).all() and (result <= 2).all()
    assert result[changed].mean() == pytest.approx(1.5, abs=0.05)
