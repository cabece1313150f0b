"""Which axis of a recording's world points up, guessed from how its cameras were held and from what lies level.

People hold a camera upright, so the mean of what is up in the images leans to the world's up. Looking down from one
side it leans between two axes; then that one is up on which more of what the frames see lies level.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Frame, UpAxis, WorldUp

AXES: tuple[UpAxis, ...] = ("x", "y", "z", "-x", "-y", "-z")
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
MAYBE, UPRIGHT = 0.5, 0.8  # of a metre up the images how much of it is along an axis: 60 and 37 degrees off it
LEVEL = np.cos(np.radians(15))  # of a surface's normal along up: the noise of a depth camera over half a hand's width
LEAST_LEVEL, MORE_LEVEL = 0.05, 2.0  # share of the surfaces that must lie level, and so many times those of the next
N_FRAMES = 6
N_COLUMNS, REACH = 80, 2  # of the grid of pixels looked at; a normal is that of neighbours so many columns away
SMOOTH = 0.1  # of the depth; neighbours farther apart are of two things


def guess_up(poses: Float64Array, frames: Sequence[Frame]) -> WorldUp:
    """The axis that ``poses`` (n, 4, 4), and where they leave a choice some of ``frames``, show to point up."""
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    if not len(poses):
        return WorldUp(None, False, "no frame has a pose")
    along = DIRECTIONS @ -poses[:, :3, 1].mean(axis=0)
    candidates = np.flatnonzero(along >= MAYBE)
    if not len(candidates):
        return WorldUp(None, False, "the cameras were held in no one way")
    if len(candidates) > 1 or along[candidates[0]] < UPRIGHT:
        level = _shares_level(frames)[candidates]
        best, *others = np.sort(level)[::-1]
        if best < LEAST_LEVEL or any(best < MORE_LEVEL * other for other in others):
            return WorldUp(None, False, "the cameras were held aslant and no axis has clearly more level surfaces")
        return WorldUp(AXES[candidates[int(level.argmax())]], False, f"{best:.0%} of what the frames see lies level so")
    return WorldUp(AXES[candidates[0]], False, "the cameras were held so")


def _shares_level(frames: Sequence[Frame]) -> Float64Array:
    """For each of ``AXES`` the share of the surfaces seen whose outer normal is along it."""
    counts, n = np.zeros(len(AXES)), 0
    for position in sorted({int(place) for place in np.linspace(0, len(frames) - 1, min(len(frames), N_FRAMES))}):
        try:
            normals = _normals(frames[position])
        except DataError:  # whoever needs the frame says what is wrong with it
            continue
        counts += (normals @ DIRECTIONS.T >= LEVEL).sum(axis=0)
        n += len(normals)
    return counts / max(n, 1)


def _normals(frame: Frame) -> Float64Array:
    """Unit normals (n, 3) in the world, towards the camera, of smooth places on a grid of pixels."""
    step = max(1, frame.depth_m.shape[1] // N_COLUMNS)
    z = frame.depth_m[::step, ::step].astype(np.float64)
    fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    v, u = np.mgrid[: z.shape[0], : z.shape[1]] * step
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    if min(z.shape) <= 2 * REACH:
        return np.zeros((0, 3))
    middle = points[REACH:-REACH, REACH:-REACH]
    around = (
        points[REACH:-REACH, 2 * REACH :],
        points[REACH:-REACH, : -2 * REACH],
        points[2 * REACH :, REACH:-REACH],
        points[: -2 * REACH, REACH:-REACH],
    )
    depth = middle[..., 2]
    is_smooth = depth > 0
    for side in around:
        is_smooth &= (side[..., 2] > 0) & (np.abs(side[..., 2] - depth) < SMOOTH * depth)
    right, left, below, above = (side[is_smooth] for side in around)
    normals = np.cross(right - left, above - below)
    length = np.linalg.norm(normals, axis=1)
    normals, seen = normals[length > 0] / length[length > 0, None], middle[is_smooth][length > 0]
    towards = np.where((normals * seen).sum(axis=1) > 0, -1.0, 1.0)
    in_world: Float64Array = (normals * towards[:, None]) @ frame.camera_to_world[:3, :3].T
    return in_world
