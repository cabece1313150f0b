"""Applies corruptions to the small recordings, and measures how far their results are from the clean input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from recordings import INTRINSICS, N_FRAMES, SCENES, recording

from su3d_bench.core.types import Float32Array, Float64Array, Frame, Int64Array
from su3d_bench.corruptions.model import Corruption, Recording, generator

PLACES = np.arange(0, 4 * N_FRAMES, 4)  # the frames of the updates, at a stride of 4
PLACES.setflags(write=False)
AHEAD = np.array([0, 0, 2.0, 1])  # a point 2 m in front of the camera


def recorded(scene: str, index: int = 0) -> Recording:
    """A scene's recording; scenes of other names differ from the first by their random numbers only."""
    return recording(scene if scene in SCENES else SCENES[0], index)


def apply_to_frame(
    row: Corruption, value: float, scene: str = SCENES[0], index: int = 0, seed: int = 0, clean: Recording | None = None
) -> Frame:
    """Frame ``index`` of a scene, or of ``clean``, after a corruption of ``value``."""
    around = clean or recorded(scene, index)
    found = row.function(around.frames[around.index], value, generator(row, seed, scene, index), around)
    assert isinstance(found, Frame)
    return found


def apply_to_poses(row: Corruption, value: float, scene: str = SCENES[0], seed: int = 0) -> Float64Array:
    found = row.function(recorded(scene).poses, value, generator(row, seed, scene))
    assert isinstance(found, np.ndarray)
    return found


def apply_to_order(row: Corruption, value: float, scene: str = SCENES[0], seed: int = 0) -> Int64Array:
    found = row.function(PLACES, value, generator(row, seed, scene))
    assert isinstance(found, np.ndarray)
    return found


def result_bytes(row: Corruption, value: float, scene: str = SCENES[0], index: int = 5, seed: int = 0) -> bytes:
    """Everything that a corruption may have changed."""
    if row.stage == "poses":
        return apply_to_poses(row, value, scene, seed).tobytes()
    if row.stage == "order":
        return apply_to_order(row, value, scene, seed).tobytes()
    frame = apply_to_frame(row, value, scene, index, seed)
    return b"".join(array.tobytes() for array in (frame.rgb, frame.depth_m, frame.camera_to_world, frame.intrinsics))


def damage(row: Corruption, value: float, scene: str) -> float:
    """How far the result is from the clean input, by the measure of the corruption's family and stage."""
    if row.stage == "poses":
        return point_error_m(apply_to_poses(row, value, scene), recording(scene).poses)
    if row.stage == "order":
        return n_order_errors(apply_to_order(row, value, scene))
    if row.family == "calibration":
        return reprojection_px(row, value, scene)
    measure = age_frames if row.family == "time" else depth_error
    frames = recording(scene).frames
    found = [measure(apply_to_frame(row, value, scene, k), frames[k], scene) for k in range(2, N_FRAMES, 3)]
    return float(np.mean(found))


def point_error_m(found: Float64Array, clean: Float64Array) -> float:
    """Root mean square distance of a point 2 m ahead, without an alignment: covers shifts and rotations."""
    return float(np.sqrt((((found - clean) @ AHEAD) ** 2).sum(axis=1).mean()))


def n_order_errors(found: Int64Array) -> float:
    """Number of places that are lost or repeated, and of pairs in the wrong order."""
    n_lost, n_inverted = len(np.setdiff1d(PLACES, found)), (np.tril(found[:, None] < found)).sum()
    return float(n_lost + len(found) - len(np.unique(found)) + n_inverted)


def depth_error(found: Frame, clean: Frame, scene: str) -> float:
    """Root mean square error in metres where both have depth, plus the share of pixels that lost theirs."""
    both = (found.depth_m > 0) & (clean.depth_m > 0)
    error = (found.depth_m - clean.depth_m)[both]
    return float(np.sqrt((error**2).mean()) + ((clean.depth_m > 0) & ~both).mean())


def age_frames(found: Frame, clean: Frame, scene: str) -> float:
    """By how many frames the oldest of colour and depth is older than the pose."""
    for k, frame in enumerate(recording(scene).frames):
        if np.array_equal(found.rgb, frame.rgb) or np.array_equal(found.depth_m, frame.depth_m):
            return float(clean.index - k)
    raise AssertionError("neither colour nor depth is of any frame")


def marks() -> tuple[Recording, Float64Array, Float64Array]:
    """A frame of 640x480 whose only depth is that of twelve pixels, their columns and rows (2, 12), and depths."""
    columns, rows = np.meshgrid(np.arange(4) * 120 + 140, np.arange(3) * 120 + 120)
    depths_m, intrinsics = 2 * np.power(1.15, np.arange(12)), INTRINSICS * [[4], [4], [1]]
    depth_m: Float32Array = np.zeros((480, 640), np.float32)
    depth_m[rows.ravel(), columns.ravel()] = depths_m
    clean = recording().frames[0]
    frame = replace(clean, rgb=np.zeros((480, 640, 3), np.uint8), depth_m=depth_m, intrinsics=intrinsics)
    pixels = np.stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    return Recording((frame,), clean.camera_to_world[None], 0), pixels, np.asarray(depths_m, np.float64)


def marks_after(row: Corruption, value: float, scene: str) -> Float64Array:
    """Points (3, 12) in camera axes that a method computes from the marks: each is where its depth is found."""
    clean, _, depths_m = marks()
    found = apply_to_frame(row, value, scene, clean=clean)
    rows, columns = np.nonzero(found.depth_m)
    depth_m = found.depth_m[rows, columns].astype(np.float64)
    nearest = np.abs(np.log(depth_m[:, None] / depths_m)).argmin(axis=1)
    rays = np.linalg.inv(found.intrinsics) @ np.stack([columns, rows, np.ones(len(rows))])
    points = rays * depth_m
    return np.stack([points[:, nearest == k].mean(axis=1) for k in range(12)], axis=1)


def reprojection_px(row: Corruption, value: float, scene: str) -> float:
    """Mean distance of the marks' points in the true colour camera from the pixels where colour shows them."""
    clean, pixels, _ = marks()
    seen = clean.frames[0].intrinsics @ marks_after(row, value, scene)
    return float(np.linalg.norm(seen[:2] / seen[2] - pixels, axis=0).mean())
