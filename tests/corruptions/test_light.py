"""Corruptions of colour by light and motion: what all have in common, and hand-worked values of each."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest
from recordings import SCENES, recording

from su3d_bench.core.types import Frame, UInt8Array
from su3d_bench.corruptions import light
from su3d_bench.corruptions.model import Corruption, Recording, generator
from su3d_bench.corruptions.sensors.colour import to_linear

ROWS = {row.name: row for row in light.ROWS}
INDEX = 9


@cache
def wide(scene: str = SCENES[0]) -> Recording:
    """The recording at four times its resolution, 640 px wide: less is moved by no pixel in 5 ms."""
    source = recording(scene, INDEX)
    return replace(source, frames=[enlarged(frame) for frame in source.frames])


def enlarged(frame: Frame) -> Frame:
    rgb, depth_m = (np.repeat(np.repeat(image, 4, axis=0), 4, axis=1) for image in (frame.rgb, frame.depth_m))
    rgb.setflags(write=False)
    return replace(frame, rgb=rgb, depth_m=depth_m, intrinsics=np.diag([4.0, 4, 1]) @ frame.intrinsics)


def changed(row: Corruption, source: Recording, value: float, seed: int = 3, scene: str = SCENES[0]) -> Frame:
    rng = generator(row, seed, scene, source.index)
    return cast(Frame, row.function(source.frames[source.index], value, rng, source))


def grey(byte: int, size: int = 200) -> Recording:
    """One frame of one grey, twice."""
    rgb = np.full((size, size, 3), byte, np.uint8)
    frame = Frame(0, 0.0, rgb, np.ones((size, size), np.float32), np.eye(4), np.eye(3))
    return Recording((frame, frame), np.stack([np.eye(4)] * 2), 0)


def psnr(one: UInt8Array, other: UInt8Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(np.float64) - other) ** 2)))


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("row", light.ROWS, ids=lambda row: row.name)
def test_each_severity_is_further_from_the_clean_image(row: Corruption, scene: str) -> None:
    source = wide(scene)
    clean = source.frames[INDEX].rgb
    before = clean.tobytes()
    values = [psnr(changed(row, source, row.value_at(s), scene=scene).rgb, clean) for s in range(1, 6)]
    assert all(np.diff(values) < 0), values
    assert clean.tobytes() == before


@pytest.mark.parametrize("row", light.ROWS, ids=lambda row: row.name)
def test_one_seed_repeats_and_nothing_but_colour_changes(row: Corruption) -> None:
    source = wide()
    clean, first = source.frames[INDEX], changed(row, source, row.value_at(3))
    assert first.rgb.tobytes() == changed(row, source, row.value_at(3)).rgb.tobytes()
    assert first.rgb.dtype == np.uint8 and first.rgb.shape == clean.rgb.shape
    assert first.depth_m is clean.depth_m and first.camera_to_world is clean.camera_to_world
    assert (first.index, first.timestamp_s) == (clean.index, clean.timestamp_s)
    is_random = row.name == "low-light"
    for other in (
        changed(row, source, row.value_at(3), seed=4),
        changed(row, source, row.value_at(3), scene=SCENES[1]),
    ):
        assert (first.rgb.tobytes() != other.rgb.tobytes()) == is_random


def test_low_light_keeps_brightness_and_quadruples_the_noise_in_four_stops() -> None:
    # photon noise has a variance of 1e-4 * light, which 2^stops of gain multiply
    noisy = {stops: to_linear(changed(ROWS["low-light"], grey(188), stops).rgb) for stops in (2, 6)}
    clean = float(to_linear(np.array([188], np.uint8))[0])
    assert noisy[2].mean() == pytest.approx(clean, rel=0.01) and noisy[6].mean() == pytest.approx(clean, rel=0.01)
    assert noisy[2].std() == pytest.approx(np.sqrt(1e-4 * 4 * clean), rel=0.05)
    assert noisy[6].std() == pytest.approx(np.sqrt(1e-4 * 64 * clean), rel=0.05)


def test_low_light_gets_dark_beyond_the_highest_gain() -> None:
    dark = to_linear(changed(ROWS["low-light"], grey(188), 8).rgb).mean()
    assert dark == pytest.approx(float(to_linear(np.array([188], np.uint8))[0]) / 4, rel=0.03)  # two stops over six


def test_read_noise_is_that_of_the_published_line() -> None:
    assert np.log(light.READ) == pytest.approx(2.18 * np.log(light.SHOT) + 1.2, abs=0.01)


def test_over_exposure_doubles_light_per_stop_and_saturates() -> None:
    assert changed(ROWS["exposure"], grey(119), 1).rgb[0, 0, 0] == 164  # 18.4 % of light becomes 36.9 %
    assert changed(ROWS["exposure"], grey(188), 1).rgb[0, 0, 0] in (254, 255)  # a half becomes all
    assert changed(ROWS["exposure"], grey(200), 3).rgb[0, 0, 0] == 255
    assert changed(ROWS["exposure"], grey(0), 3).rgb[0, 0, 0] == 0


def walking(step_m: float) -> Recording:
    """A white line on a wall 2 m away, seen by a camera of 100 px focal length that moves right at each frame."""
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[:, 30] = 255
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = step_m * np.arange(3)
    camera = np.array([[100.0, 0, 30], [0, 100.0, 20], [0, 0, 1]])
    frames = [Frame(k, k / 30, rgb, np.full((40, 60), 2.0, np.float32), poses[k], camera) for k in range(3)]
    return Recording(frames, poses, 1)


def test_motion_blur_spreads_a_line_over_the_way_during_the_exposure() -> None:
    # 0.2 m per frame at 2 m and 100 px are 10 px; half a frame's exposure is 5 px
    line = to_linear(changed(ROWS["motion-blur"], walking(0.2), 1000 / 60).rgb[20, :, 0])
    reached = np.flatnonzero(line > 0.02)
    assert reached.min() >= 27 and reached.max() <= 33 and len(reached) in (5, 6, 7)
    assert line.sum() == pytest.approx(1, rel=0.05)
    still = changed(ROWS["motion-blur"], walking(0.0), 1000 / 60).rgb
    assert still.tobytes() == walking(0.0).frames[1].rgb.tobytes()


def test_motion_blur_uses_the_recording_and_not_the_frames_own_pose() -> None:
    source = walking(0.2)
    elsewhere = replace(source.frames[1], camera_to_world=np.diag([1.0, -1, -1, 1]))  # a pose that was changed before
    rng = generator(ROWS["motion-blur"], 0, "scene")
    other = cast(Frame, ROWS["motion-blur"].function(elsewhere, 16.0, rng, source))
    assert other.rgb.tobytes() == changed(ROWS["motion-blur"], source, 16.0).rgb.tobytes()


def test_video_codes_a_frame_as_changes_from_the_frames_before_it() -> None:
    row, rng = ROWS["compressed-video"], np.random.default_rng(0)
    noise = np.kron(rng.integers(0, 256, (12, 16, 3), np.uint8), np.ones((4, 4, 1), np.uint8))[:47, :63]  # odd sides
    frame = Frame(0, 0.0, noise, np.ones(noise.shape[:2], np.float32), np.eye(4), np.eye(3))
    other = replace(frame, rgb=np.roll(noise, 20, axis=1))
    received = {
        name: changed(row, Recording((*before, frame), np.stack([np.eye(4)] * 20), len(before)), 35.0).rgb
        for name, before in {
            "first": (),
            "still": (frame,) * 11,
            "moving": (other,) * 11,
            "longer": (other,) * 19,
        }.items()
    }
    assert received["first"].shape == noise.shape
    assert psnr(received["still"], noise) > psnr(received["first"], noise)  # refined by each frame
    assert received["moving"].tobytes() != received["still"].tobytes()
    assert received["longer"].tobytes() == received["moving"].tobytes()  # the last 12 count


def test_video_keeps_a_grey_image() -> None:
    assert np.abs(changed(ROWS["compressed-video"], grey(119), 47).rgb.astype(int) - 119).max() <= 2
