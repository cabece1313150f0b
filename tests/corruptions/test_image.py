"""Corruptions of ImageNet-C: the bytes of imagecorruptions 1.1.2, hand-worked values, and what all have in common.

imagecorruptions.npz holds an image, random numbers, and the package's answers for severities 1 to 5; it is written by
benchmarks/originals/imagecorruptions_answers.py.
"""

from __future__ import annotations

from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from recordings import SCENES, recording

from su3d_bench.core.types import Frame, UInt8Array
from su3d_bench.corruptions import image
from su3d_bench.corruptions.model import Corruption, generator

CASES = Path(__file__).with_name("imagecorruptions.npz")
ROWS = {row.name: row for row in image.ROWS}
ORIGINAL = {name: "jpeg_compression" if name == "jpeg" else name.replace("-", "_") for name in ROWS}


@cache
def cases() -> dict[str, Any]:
    with np.load(CASES) as file:
        return dict(file)


class KeptDraws:
    """The random numbers that the package was given, in the form of a generator."""

    def __init__(self) -> None:
        self.uniform = (cases()["uniform"] + 0.5) / 2**16
        self.order = cycle(self.uniform)

    def standard_normal(self, shape: tuple[int, ...]) -> Any:
        return cases()["normal"].astype(np.float64)

    def random(self, shape: tuple[int, ...]) -> Any:
        return next(self.order)[..., 0] if len(shape) == 2 else next(self.order)

    def poisson(self, mean: Any) -> Any:
        from scipy.stats import poisson

        return poisson.ppf(self.uniform[0], mean).astype(np.int64)


def changed(row: Corruption, rgb: UInt8Array, value: float, rng: Any = None) -> UInt8Array:
    clean = Frame(0, 0.0, rgb, np.ones(rgb.shape[:2], np.float32), np.eye(4), np.eye(3))
    rng = generator(row, 0, "scene") if rng is None else rng
    return cast(Frame, row.function(clean, value, rng, recording())).rgb


def psnr(one: UInt8Array, other: UInt8Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(np.float64) - other) ** 2)))


def test_ten_of_the_original_corruptions_are_there_and_none_is_weather() -> None:
    assert set(ORIGINAL.values()) == cases().keys() - {"image", "normal", "uniform"} and len(ROWS) == 10


@pytest.mark.parametrize("severity", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("name", ROWS)
def test_every_byte_is_that_of_imagecorruptions(name: str, severity: int) -> None:
    row = ROWS[name]
    ours = changed(row, cases()["image"], row.value_at(severity), KeptDraws())
    expected = cases()[ORIGINAL[name]][severity - 1]
    assert int((ours != expected).sum()) == 0, np.abs(ours.astype(int) - expected).max()


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("row", image.ROWS, ids=lambda row: row.name)
def test_each_severity_is_further_from_the_clean_image(row: Corruption, scene: str) -> None:
    source = recording(scene, 7)
    clean = source.frames[7]
    before = clean.rgb.tobytes()
    values = [psnr(_frame(row, scene, severity).rgb, clean.rgb) for severity in range(1, 6)]
    assert all(np.diff(values) < 0), values
    assert clean.rgb.tobytes() == before


def _frame(row: Corruption, scene: str, severity: float, seed: int = 3) -> Frame:
    source = recording(scene, 7)
    rng = generator(row, seed, scene, 7)
    return cast(Frame, row.function(source.frames[7], row.value_at(severity), rng, source))


@pytest.mark.parametrize("row", image.ROWS, ids=lambda row: row.name)
def test_one_seed_repeats_and_nothing_but_colour_changes(row: Corruption) -> None:
    clean, first = recording(SCENES[0], 7).frames[7], _frame(row, SCENES[0], 3)
    assert first.rgb.tobytes() == _frame(row, SCENES[0], 3).rgb.tobytes()
    assert first.rgb.dtype == np.uint8 and first.rgb.shape == clean.rgb.shape
    assert first.depth_m is clean.depth_m and first.camera_to_world is clean.camera_to_world
    assert (first.index, first.timestamp_s) == (clean.index, clean.timestamp_s)
    is_random = row.name.endswith("noise") or row.name == "elastic-transform"
    assert (first.rgb.tobytes() != _frame(row, SCENES[0], 3, seed=4).rgb.tobytes()) == is_random


@pytest.mark.parametrize("name", ["gaussian-noise", "impulse-noise", "elastic-transform"])
def test_a_higher_severity_is_the_same_error_made_larger(name: str) -> None:
    clean = recording(SCENES[0], 7).frames[7].rgb.astype(int)
    low, high = (_frame(ROWS[name], SCENES[0], severity).rgb.astype(int) - clean for severity in (1, 5))
    if name == "impulse-noise":
        assert (low[high == 0] == 0).all()
    else:
        assert np.corrcoef(low.ravel(), high.ravel())[0, 1] > 0.6


GREY = np.full((40, 40, 3), 100, np.uint8)
WIDE: UInt8Array = np.random.default_rng(2).integers(0, 256, (200, 300, 3), dtype=np.uint8)


def test_gaussian_noise_has_the_standard_deviation_of_its_value() -> None:
    grey = np.full((200, 300, 3), 128, np.uint8)
    assert changed(ROWS["gaussian-noise"], grey, 0.08).astype(float).std() / 255 == pytest.approx(0.08, rel=0.02)


def test_shot_noise_has_the_variance_of_photons_and_leaves_black_alone() -> None:
    grey = np.full((200, 300, 3), 51, np.uint8)  # a fifth of white: 12 of 60 photons
    noisy = changed(ROWS["shot-noise"], grey, 1 / 60).astype(float) / 255
    assert noisy.var() == pytest.approx(12 / 60**2, rel=0.03)
    assert not changed(ROWS["shot-noise"], 0 * grey, 1 / 3).any()


def test_impulse_noise_turns_its_share_of_samples_black_or_white_in_equal_parts() -> None:
    noisy = changed(ROWS["impulse-noise"], np.full((200, 300, 3), 100, np.uint8), 0.27)
    assert np.mean(noisy == 0) == pytest.approx(0.135, abs=0.004)
    assert np.mean(noisy == 255) == pytest.approx(0.135, abs=0.004)
    assert np.isin(noisy, (0, 100, 255)).all()


def test_defocus_spreads_a_point_over_a_disc_of_its_radius() -> None:
    point = np.zeros((61, 61, 3), np.uint8)
    point[30, 30] = 255
    reached = np.flatnonzero(changed(ROWS["defocus-blur"], np.where(point > 0, point, 0), 1)[30, :, 0])
    assert (reached.min(), reached.max()) == (27, 33)  # severity 1 has radius 3


def test_zoom_blur_mixes_the_enlarged_middle_into_the_image() -> None:
    half = np.zeros((40, 60, 3), np.uint8)
    half[:, 40:] = 255  # 10 px right of the middle: enlarged by up to 1.1, its edge is up to 1 px further right
    row = changed(ROWS["zoom-blur"], half, 1)[20, :, 0]
    assert row[38] == 0 and 0 < row[40] < 254 and row[43] >= 254


def test_brightness_scales_all_channels_with_the_largest() -> None:
    rgb = np.full((4, 4, 3), (102, 51, 0), np.uint8)  # value 0.4, to 0.6 = 153: half again as large
    assert changed(ROWS["brightness"], rgb, 0.2)[0, 0].tolist() in ([153, 76, 0], [152, 76, 0])
    assert changed(ROWS["brightness"], 0 * rgb, 0.5)[0, 0].tolist() == [127, 127, 127]


def test_contrast_pulls_values_towards_the_mean() -> None:
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[0] = 200  # the mean is 100: 200 becomes 140 and 0 becomes 60
    assert np.abs(changed(ROWS["contrast"], rgb, 0.4)[:, 0, 0] - np.array([140, 60])).max() <= 1


def test_elastic_transform_moves_pixels_smoothly_and_by_no_colour_of_its_own() -> None:
    ramp = np.broadcast_to(np.arange(0, 240, 4, dtype=np.uint8)[None, :, None], (50, 60, 3)).copy()
    moved = (changed(ROWS["elastic-transform"], ramp, 0.12)[..., 0].astype(float) - ramp[..., 0]) / 4  # pixels
    assert 0.1 < np.abs(moved).mean() < 0.12 * 250 * 0.005 * 50
    assert np.ptp(changed(ROWS["elastic-transform"], GREY, 0.12)) == 0


def test_pixelate_leaves_squares_of_four_pixels_at_a_quarter() -> None:
    squares = changed(ROWS["pixelate"], WIDE, 0.25)
    blocks = squares.reshape(50, 4, 75, 4, 3)
    assert (np.ptp(blocks, axis=(1, 3)) == 0).all()
    assert np.abs(blocks[:, 0, :, 0] - WIDE.reshape(50, 4, 75, 4, 3).mean(axis=(1, 3))).max() <= 1


def test_jpeg_keeps_a_grey_image_and_blurs_colour_more_than_light() -> None:
    assert np.abs(changed(ROWS["jpeg"], GREY, 7).astype(int) - 100).max() <= 2
    stripes = np.zeros((32, 32, 3), np.uint8)
    stripes[:, ::2] = (255, 0, 0)
    stripes[:, 1::2] = (0, 130, 0)  # of about the same luma
    assert np.abs(np.diff(changed(ROWS["jpeg"], stripes, 25)[..., 0].astype(int), axis=1)).mean() < 100
