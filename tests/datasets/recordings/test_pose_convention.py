"""The check of poses against depth: wrong conventions are named, right ones are never rejected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array, Frame
from su3d_bench.datasets.recordings.pose_convention import FLIP, Finding, _best_other, _shares
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms

Reading = Callable[[Float64Array], Float64Array]
N_FRAMES = 45


def inverse(pose: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.inv(pose), np.float64)


@cache
def walk(scene: str, noise: int) -> tuple[Frame, ...]:
    options = RoomOptions(width=96, height=72, n_frames=1600, noise=noise)
    frames = Rooms(Path("unused"), options).frames(scene, 10)
    return tuple(frames[position] for position in range(N_FRAMES))


def judge_convention(frames: Sequence[Frame]) -> Finding | None:
    return _best_other(_shares(frames))


def read_as(frames: Sequence[Frame], reading: Reading, depth_factor: float = 1.0) -> list[Frame]:
    """The frames that result if poses and depth are misread."""
    return [
        replace(f, camera_to_world=reading(f.camera_to_world), depth_m=f.depth_m * np.float32(depth_factor))
        for f in frames
    ]


@pytest.mark.parametrize(("scene", "noise"), [("living0", 0), ("bathroom0", 2)])
def test_right_convention_is_never_rejected(scene: str, noise: int) -> None:
    frames = walk(scene, noise)
    for stride in (1, 4, 15):
        assert judge_convention(frames[::stride]) is None


@pytest.mark.parametrize(("scene", "noise"), [("living0", 0), ("living0", 2), ("bathroom0", 2)])
@pytest.mark.parametrize(
    ("reading", "motion"),
    [
        (inverse, "inverse"),
        (lambda pose: pose @ FLIP, "other axes"),
        (lambda pose: inverse(pose @ FLIP), "inverse and other axes"),
    ],
    ids=["inverse", "axes", "both"],
)
def test_wrong_pose_convention_is_named(scene: str, noise: int, reading: Reading, motion: str) -> None:
    finding = judge_convention(read_as(walk(scene, noise), reading))
    assert finding is not None
    assert (finding.motion, finding.depth_factor) == (motion, 1.0)
    assert finding.share_otherwise > finding.share_as_read + 0.2


@pytest.mark.parametrize("factor", [0.001, 0.125, 8.0, 1000.0])
def test_wrong_depth_unit_is_named(factor: float) -> None:
    finding = judge_convention(read_as(walk("living0", 2), lambda pose: pose, factor))
    assert finding is not None and finding.motion == "as read"
    if factor < 1:  # too large depths make every motion small, so several smaller units agree
        assert finding.depth_factor == pytest.approx(1 / factor)
    else:
        assert finding.depth_factor < 1


@pytest.mark.parametrize("reading", [lambda pose: pose, inverse, lambda pose: pose @ FLIP])
def test_static_camera_decides_nothing(reading: Reading) -> None:
    frame = walk("living0", 2)[0]
    still = [replace(frame, index=index) for index in range(10)]
    assert judge_convention(read_as(still, reading)) is None


def test_frames_without_overlap_decide_nothing() -> None:
    frames = walk("living0", 0)
    turned = replace(frames[1], camera_to_world=frames[1].camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert judge_convention([frames[0], turned]) is None
