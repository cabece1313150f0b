"""Corruptions of the trajectory, by their size and shape."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import recording
from scipy.spatial.transform import Rotation

from su3d_bench.core.types import Float64Array
from su3d_bench.corruptions.model import Corruption, generator
from su3d_bench.corruptions.poses import ROWS, aligned

JITTER_ROTATION, JITTER_TRANSLATION, DRIFT_ROTATION, DRIFT_TRANSLATION, JUMPS = ROWS[:5]
LONG = np.tile(np.eye(4), (900, 1, 1))


def by_name(row: Corruption) -> str:
    return row.name


def errors(row: Corruption, value: float, clean: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Shift (N, 3) in metres and angle (N,) in degrees."""
    found = row.function(clean, value, generator(row, 0, "scene"))
    assert isinstance(found, np.ndarray)
    turn = found[:, :3, :3] @ clean[:, :3, :3].transpose(0, 2, 1)
    sine = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]]) / 2
    return found[:, :3, 3] - clean[:, :3, 3], np.rad2deg(np.arcsin(np.linalg.norm(sine, axis=0)))


@pytest.mark.parametrize("row", [JITTER_ROTATION, DRIFT_ROTATION], ids=by_name)
def test_a_rotation_of_5_degrees_leaves_the_camera_in_its_place(row: Corruption) -> None:
    shift, angle = errors(row, 5.0, recording().poses)
    assert not shift.any() and np.sqrt((angle**2).mean()) == pytest.approx(5.0)


@pytest.mark.parametrize("row", [JITTER_TRANSLATION, DRIFT_TRANSLATION, JUMPS], ids=by_name)
def test_a_shift_of_5_cm_does_not_turn_the_camera(row: Corruption) -> None:
    shift, angle = errors(row, 5.0, recording().poses)
    assert np.sqrt((shift**2).sum(axis=1).mean()) == pytest.approx(0.05) and angle.max() < 1e-6
    assert shift.mean(axis=0) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("drift", "jitter"), [(DRIFT_ROTATION, JITTER_ROTATION), (DRIFT_TRANSLATION, JITTER_TRANSLATION)], ids=by_name
)
def test_drift_is_smooth_and_jitter_is_not(drift: Corruption, jitter: Corruption) -> None:
    def largest_step(row: Corruption) -> float:
        shift, angle = errors(row, 5.0, LONG)  # cm or degrees
        return float(np.abs(np.diff(np.column_stack([100 * shift, angle]), axis=0)).max())

    assert largest_step(drift) < 0.5 < 5 < largest_step(jitter)


@pytest.mark.parametrize(("n_frames", "n_jumps"), [(24, 1), (300, 1), (900, 3)])
def test_there_is_one_jump_for_every_300_frames(n_frames: int, n_jumps: int) -> None:
    step = np.linalg.norm(np.diff(errors(JUMPS, 5.0, LONG[:n_frames])[0], axis=0), axis=1)
    # between jumps the error grows by equal steps: all others are those of n_jumps + 1 straight lines
    assert len(np.unique(np.round(step, 9))) <= 2 * n_jumps + 1
    assert np.count_nonzero(step > 3 * np.median(step)) == n_jumps


def test_alignment_undoes_a_rigid_motion_of_the_trajectory() -> None:
    clean, motion = recording().poses, np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    motion[:3, 3] = 1.0, 2.0, 3.0
    found = aligned(lambda given, size, rng: motion @ given)(clean, 1.0, np.random.default_rng(0))
    assert found == pytest.approx(clean, abs=1e-9)
