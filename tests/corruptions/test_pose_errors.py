"""Errors of poses: their size, their smoothness, and zero."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array
from su3d_bench.corruptions.sensors import poses

N = 600


def trajectory() -> Float64Array:
    walk = np.tile(np.eye(4), (N, 1, 1))
    turn = np.linspace(0, np.pi, N)
    walk[:, 0, 0], walk[:, 0, 1], walk[:, 1, 0], walk[:, 1, 1] = np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)
    walk[:, 0, 3] = np.linspace(0, 6, N)
    return walk


def errors(found: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Shift (N, 3) in metres and angle (N,) in degrees."""
    turn = found[:, :3, :3] @ trajectory()[:, :3, :3].transpose(0, 2, 1)
    cosine = (np.trace(turn, axis1=1, axis2=2) - 1) / 2
    return found[:, :3, 3] - trajectory()[:, :3, 3], np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


KINDS: dict[str, Callable[[float, float, int], Float64Array]] = {
    "drift": lambda m, deg, seed: poses.drift(trajectory(), m, deg, np.random.default_rng(seed)),
    "jitter": lambda m, deg, seed: poses.jitter(trajectory(), m, deg, np.random.default_rng(seed)),
    "jump": lambda m, deg, seed: poses.jump(trajectory(), 3, m, deg, np.random.default_rng(seed)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_errors_have_the_given_size_and_poses_stay_rigid(kind: str) -> None:
    found = KINDS[kind](0.015, 0.4, 0)
    shift, angle = errors(found)
    assert np.sqrt((shift**2).sum(axis=1).mean()) == pytest.approx(0.015)
    assert np.sqrt((angle**2).mean()) == pytest.approx(0.4, rel=1e-4)
    assert np.abs(found[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert found.tobytes() == KINDS[kind](0.015, 0.4, 0).tobytes() != KINDS[kind](0.015, 0.4, 1).tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_size_zero_changes_nothing(kind: str) -> None:
    assert KINDS[kind](0.0, 0.0, 0).tobytes() == trajectory().tobytes()
    assert poses.jump(trajectory(), 0, 1.0, 1.0, np.random.default_rng(0)).tobytes() == trajectory().tobytes()


def test_drift_is_smooth_jitter_is_not_and_jumps_are_few() -> None:
    steps = {
        kind: np.linalg.norm(np.diff(errors(make(0.015, 0.0, 0))[0], axis=0), axis=1) for kind, make in KINDS.items()
    }
    assert steps["drift"].max() < 0.002 < 0.015 < np.median(steps["jitter"])
    assert (steps["jump"] > 0.005).sum() == 3 and np.median(steps["jump"]) < 0.001


def test_shutter_covers_the_exposure_on_both_sides_of_a_frame() -> None:
    opened, closed = poses.shutter(trajectory(), 300, 1 / 60, 30.0)
    step = 6 / (N - 1)
    assert closed[0, 3] - opened[0, 3] == pytest.approx(step / 2)
    assert (closed[0, 3] + opened[0, 3]) / 2 == pytest.approx(trajectory()[300, 0, 3])
    halfway = poses.between(trajectory()[0], trajectory()[-1], 0.5)
    assert halfway[:2, 0] == pytest.approx([0, 1], abs=1e-6) and halfway[0, 3] == pytest.approx(3)
    assert np.array_equal(*poses.shutter(trajectory(), 300, 0.0, 30.0))
