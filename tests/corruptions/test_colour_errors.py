"""Errors of colour cameras: hand-worked values, and what every error has in common."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.corruptions.sensors import colour

CAMERA = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
SHAPE = (240, 320)
IMAGE: UInt8Array = np.kron(np.random.default_rng(5).integers(0, 256, (15, 20, 3)), np.ones((16, 16, 1))).astype(
    np.uint8
)
DEPTH = np.full(SHAPE, 2.0, np.float32)
Error = Callable[[UInt8Array, float, np.random.Generator], UInt8Array]


def moved(x_m: float) -> Float64Array:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def blurred(image: UInt8Array, size: float, rng: np.random.Generator) -> UInt8Array:
    ends = moved(-size / 100), moved(size / 100)
    return colour.to_srgb(colour.motion_blur(colour.to_linear(image), DEPTH, CAMERA, np.eye(4), *ends))


ERRORS: dict[str, Error] = {
    "blur": blurred,
    "dark": lambda image, size, r: colour.to_srgb(colour.expose(colour.to_linear(image), 2.0**-size)),
    "noise": lambda image, size, r: colour.to_srgb(
        colour.photon_noise(colour.to_linear(image), size / 100, size / 1e5, r)
    ),
    "jpeg": lambda image, size, r: colour.jpeg(image, None if size == 0 else int(80 - 20 * size)),
}


def psnr(image: UInt8Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((image.astype(np.float64) - IMAGE) ** 2)))


@pytest.mark.parametrize("name", ERRORS)
def test_size_zero_changes_nothing_one_seed_repeats_and_more_is_worse(name: str) -> None:
    results = [ERRORS[name](IMAGE, size, np.random.default_rng(1)) for size in (0, 1, 2, 3)]
    assert results[0].tobytes() == IMAGE.tobytes()
    assert results[1].tobytes() == ERRORS[name](IMAGE, 1, np.random.default_rng(1)).tobytes()
    assert results[1].dtype == np.uint8 and results[1].shape == IMAGE.shape
    assert psnr(results[1]) > psnr(results[2]) > psnr(results[3])


def test_every_byte_survives_linear_light_and_middle_grey_is_a_fifth() -> None:
    codes = np.arange(256, dtype=np.uint8)
    assert colour.to_srgb(colour.to_linear(codes)).tolist() == codes.tolist()
    assert colour.to_linear(np.array([119], np.uint8))[0] == pytest.approx(0.184, abs=0.001)  # L* 50
    assert colour.mean_luminance(np.full((2, 2, 3), 119, np.uint8)) == pytest.approx(0.184, abs=0.001)


def test_blur_spreads_an_edge_over_the_motion_of_its_depth() -> None:
    light = np.zeros((*SHAPE, 3), np.float32)
    light[:, 160:] = 1.0
    depth_m = np.full(SHAPE, 1.0, np.float32)
    depth_m[:120] = 4.0
    result = colour.motion_blur(light, depth_m, CAMERA, np.eye(4), moved(-0.02), moved(0.02))
    partly = ((result[..., 0] > 0.01) & (result[..., 0] < 0.99)).sum(axis=1)
    assert partly[200] == pytest.approx(16, abs=2)  # 400 px * 0.04 m / 1 m, in 8 samples
    assert partly[50] == pytest.approx(4, abs=1)
    assert result[200, 160, 0] == pytest.approx(0.5, abs=0.1)


def test_turning_blurs_without_depth_too() -> None:
    turned: Float64Array = np.eye(4)
    turned[:3, :3] = [[np.cos(0.02), 0, np.sin(0.02)], [0, 1, 0], [-np.sin(0.02), 0, np.cos(0.02)]]
    light = np.zeros((*SHAPE, 3), np.float32)
    light[:, 160:] = 1.0
    result = colour.motion_blur(light, np.zeros(SHAPE, np.float32), CAMERA, np.eye(4), turned.T, turned)
    assert ((result[100, :, 0] > 0.01) & (result[100, :, 0] < 0.99)).sum() == pytest.approx(16, abs=2)  # 400 * 0.04


def test_exposure_follows_a_step_of_light_with_a_lag_in_stops() -> None:
    def gain(*luminances: float) -> float:
        return colour.exposure_gain(luminances, target=0.16, speed=0.5, min_ev=-2, max_ev=3)

    assert gain(0.16) == 1.0
    assert gain(0.08) == gain(0.08, 0.08) == 2.0
    assert gain(0.08, 0.32) == 1.0 and gain(0.08, 0.32, 0.32) == pytest.approx(2**-0.5)
    assert gain(1e-9) == 8.0 and gain(1.0) == 0.25
    assert colour.exposure_gain([0.01], 0.16, 0.5, 0, 0) == 1.0


def test_saturated_pixels_stay_saturated_at_a_shorter_exposure() -> None:
    result = colour.expose(np.array([0.0, 0.1, 0.5, 1.0], np.float32), 0.5)
    assert result == pytest.approx([0.0, 0.05, 0.25, 1.0], abs=0.003)


@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_noise_has_the_variance_of_photon_transfer(gain: float) -> None:
    light = np.full((400, 400, 3), 0.25, np.float32)
    noise = colour.photon_noise(light, 1e-3, 1e-5, np.random.default_rng(2), gain).astype(np.float64) - 0.25
    assert noise.std() == pytest.approx(np.sqrt(1e-3 * gain * 0.25 + 1e-5 * gain**2), rel=0.01)
    assert abs(noise.mean()) < 1e-3
