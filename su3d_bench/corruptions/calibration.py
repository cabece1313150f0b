"""Corruptions of the calibration: intrinsics, and the pose of the depth camera relative to the colour camera.

The error of a camera does not change while it records: its direction is drawn once per scene.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Float32Array, Float64Array, Frame
from su3d_bench.corruptions.model import Corruption, Recording

REFERENCE_WIDTH = 640  # errors in pixels are those of an image of this width
SAME_SURFACE = 1.05  # ratio of depths up to which two points in one pixel are taken as one slanted surface


def focal(frame: Frame, percent: float, rng: Generator, recording: Recording) -> Frame:
    """Intrinsics whose focal lengths are too long or too short by ``percent``."""
    intrinsics = frame.intrinsics.copy()
    intrinsics[[0, 1], [0, 1]] *= 1 + rng.choice((-1, 1)) * percent / 100
    return replace(frame, intrinsics=intrinsics)


def principal_point(frame: Frame, shift_px: float, rng: Generator, recording: Recording) -> Frame:
    """Intrinsics whose principal point is moved by ``shift_px`` at a width of 640 pixels, in a random direction."""
    angle, intrinsics = rng.uniform(0, 2 * np.pi), frame.intrinsics.copy()
    size_px = shift_px * frame.depth_m.shape[1] / REFERENCE_WIDTH
    intrinsics[:2, 2] += size_px * np.array([np.cos(angle), np.sin(angle)])
    return replace(frame, intrinsics=intrinsics)


def extrinsics_rotation(frame: Frame, degrees: float, rng: Generator, recording: Recording) -> Frame:
    """Depth of a camera that is rotated about its own centre, around a random axis; colour is unchanged."""
    from scipy.spatial.transform import Rotation

    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * _direction(rng)).as_matrix()
    return replace(frame, depth_m=seen_from(frame.depth_m, frame.intrinsics, motion))


def extrinsics_translation(frame: Frame, shift_cm: float, rng: Generator, recording: Recording) -> Frame:
    """Depth of a camera that is moved in a random direction; colour is unchanged."""
    motion = np.eye(4)
    motion[:3, 3] = shift_cm / 100 * _direction(rng)
    return replace(frame, depth_m=seen_from(frame.depth_m, frame.intrinsics, motion))


def _direction(rng: Generator) -> Float64Array:
    """A unit vector (3,), uniform on the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def seen_from(depth_m: Float32Array, intrinsics: Float64Array, motion: Float64Array) -> Float32Array:
    """Depth (H, W) of the same points in the camera into whose axes ``motion`` (4, 4) maps them.

    The nearest point in a pixel counts. Missing pixels contribute none, and places that only the other camera sees
    remain missing. A surface has no gaps where it is enlarged: there, points around the centre of a pixel count too.
    """
    centres = _nearest(depth_m, intrinsics, motion, (0.0,))
    around = _nearest(depth_m, intrinsics, motion, (-0.25, 0.25))
    return np.where(centres < SAME_SURFACE * around, centres, np.where(np.isfinite(around), around, np.float32(0)))


def _nearest(
    depth_m: Float32Array, intrinsics: Float64Array, motion: Float64Array, offsets_px: tuple[float, ...]
) -> Float32Array:
    """A depth buffer (H, W), infinite where it is empty; points are at ``offsets_px`` from the pixels' centres."""
    height, width = depth_m.shape
    nearest = np.full(height * width, np.inf, np.float32)
    rows, columns = np.nonzero(depth_m)
    turn, shift = intrinsics @ motion[:3, :3] @ np.linalg.inv(intrinsics), intrinsics @ motion[:3, 3]
    for down in offsets_px:
        for right in offsets_px:
            pixels = np.stack([columns + right, rows + down, np.ones(len(rows))])
            x, y, z = turn @ pixels * depth_m[rows, columns] + shift[:, None]
            x, y, z = np.stack([x, y, z])[:, z > 0]
            u, v = np.rint(x / z), np.rint(y / z)
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            np.minimum.at(nearest, (v * width + u)[inside].astype(np.int64), z[inside].astype(np.float32))
    return nearest.reshape(height, width)


ROWS: tuple[Corruption, ...] = (
    Corruption(
        "calibration", "focal", "frame", focal, "% of the focal length", (0.5, 1.0, 2.0, 4.0, 8.0),
        "ours: doubled. The three Kinects of TUM RGB-D differ by 0.8 to 2.7 % from the driver's default of 525 px; "
        "the infrared camera's 585 px (Nguyen et al. 2012) would be an error of 11 %.", per_scene=True,
    ),
    Corruption(
        "calibration", "principal-point", "frame", principal_point, "px at a width of 640 px",
        (2.0, 4.0, 8.0, 16.0, 32.0),
        "ours: doubled. The three Kinects of TUM RGB-D are 8, 12 and 16 px from the centre of the image.",
        per_scene=True,
    ),
    Corruption(
        "calibration", "extrinsics-rotation", "frame", extrinsics_rotation, "degrees", (0.25, 0.5, 1.0, 2.0, 4.0),
        "ours: doubled. 0.25 degrees move depth by 2 px at a focal length of 525 px, as principal-point's first "
        "severity does.", per_scene=True,
    ),
    Corruption(
        "calibration", "extrinsics-translation", "frame", extrinsics_translation, "cm", (0.5, 1.0, 2.5, 5.0, 10.0),
        "ours: around 2.5 cm, the distance of the Kinect's infrared camera from its colour camera (Konolige "
        "and Mihelich, ROS wiki): the error of depth that is not registered to colour.", per_scene=True,
    ),
)  # fmt: skip
