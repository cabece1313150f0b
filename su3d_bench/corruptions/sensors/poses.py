"""Errors of camera poses (N, 4, 4), camera-to-world in metres, and poses between frames.

Errors move the camera centre and turn the camera about it, both in world axes. Sizes are root mean squares of the
length in metres and of the angle in degrees over the trajectory; sizes of 0 return the input.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Float64Array as Poses


def between(start: Poses, end: Poses, share: float) -> Poses:
    """The pose (4, 4) a part ``share`` of the way from ``start`` to ``end``, at constant speed and turn rate."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    pose = start.copy()
    pose[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] += share * (end[:3, 3] - start[:3, 3])
    return pose


def shutter(poses: Poses, index: int, exposure_s: float, frames_per_second: float) -> tuple[Poses, Poses]:
    """Poses (4, 4) at the ends of an exposure of ``exposure_s`` around frame ``index``."""
    share = exposure_s * frames_per_second / 2
    before, after = poses[max(index - 1, 0)], poses[min(index + 1, len(poses) - 1)]
    return between(poses[index], before, share), between(poses[index], after, share)


def drift(poses: Poses, rms_m: float, rms_deg: float, rng: Generator, smooth_frames: float = 30.0) -> Poses:
    """Poses with a smooth random walk of zero mean, as remains after loop closure and alignment of the trajectory."""
    from scipy.ndimage import gaussian_filter1d

    walk = np.cumsum(rng.standard_normal((len(poses), 6)), axis=0)
    return _moved(poses, gaussian_filter1d(walk, smooth_frames, axis=0, mode="nearest"), rms_m, rms_deg)


def jitter(poses: Poses, rms_m: float, rms_deg: float, rng: Generator) -> Poses:
    """Poses with independent normal errors per frame."""
    return _moved(poses, rng.standard_normal((len(poses), 6)), rms_m, rms_deg)


def jump(poses: Poses, n_jumps: int, rms_m: float, rms_deg: float, rng: Generator) -> Poses:
    """Poses whose error grows steadily in a random direction and is corrected at once at ``n_jumps`` loop closures."""
    if n_jumps == 0 or len(poses) <= n_jumps:
        return poses
    at = np.sort(rng.choice(np.arange(1, len(poses)), n_jumps, replace=False))
    ends = np.concatenate([[0], at, [len(poses)]])
    part = np.searchsorted(at, np.arange(len(poses)), side="right")
    grown = (np.arange(len(poses)) - ends[part]) / (ends[part + 1] - ends[part])
    return _moved(poses, grown[:, None] * rng.standard_normal((n_jumps + 1, 6))[part], rms_m, rms_deg)


def _moved(poses: Poses, error: Poses, rms_m: float, rms_deg: float) -> Poses:
    """Poses moved by ``error`` (N, 6), shift and turn, less its mean, as after alignment, and scaled to the sizes."""
    from scipy.spatial.transform import Rotation

    if (rms_m == 0 and rms_deg == 0) or len(poses) < 2:
        return poses
    moved, (shift, turn) = poses.copy(), np.hsplit(error - error.mean(axis=0), 2)
    moved[:, :3, 3] += shift * (rms_m / np.sqrt((shift**2).sum(axis=1).mean()))
    turn = turn * (np.deg2rad(rms_deg) / np.sqrt((turn**2).sum(axis=1).mean()))
    moved[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[:, :3, :3]
    return moved
