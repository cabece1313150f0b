"""Two small recordings for tests of corruptions: a slanted wall, a floor and boxes, seen by a moving camera.

Their arrays are read-only, so that a corruption that modifies its input fails.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Frame
from su3d_bench.corruptions.model import Recording

WIDTH, HEIGHT, N_FRAMES = 160, 120, 24
INTRINSICS = np.array([[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]])
FARTHEST_M = 8.5  # depth is missing beyond: a strip of the wall in most frames
SCENES = ("first", "second")
BOXES = {  # lowest and highest corner in metres, colour; the world is z up and the camera looks along y
    "first": (
        ((-1.3, 1.6, 0.0), (-0.7, 2.1, 1.1), (20, 18, 16)),  # nearly black
        ((-0.1, 2.8, 0.0), (0.7, 3.4, 1.5), (200, 60, 40)),
        ((1.0, 4.0, 0.0), (1.9, 4.6, 0.9), (60, 160, 220)),
    ),
    "second": (
        ((-0.5, 1.9, 0.0), (0.1, 2.4, 0.8), (230, 210, 90)),
        ((0.9, 2.6, 0.0), (1.5, 3.1, 1.6), (26, 24, 30)),  # nearly black
        ((-1.9, 4.4, 0.0), (-0.9, 5.0, 1.3), (70, 120, 50)),
    ),
}
WALL = {"first": (0.45, 6.3), "second": (-0.4, 6.1)}  # y = slope * x + offset


def pose(scene: str, index: int) -> Float64Array:
    """Camera-to-world of a camera that walks sideways while it turns, without a stop."""
    sign, part = (1 if scene == "first" else -1), index / (N_FRAMES - 1)
    yaw = sign * np.deg2rad(14 - 28 * part)
    forward = np.array([np.sin(yaw), np.cos(yaw), -0.12])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = sign * (0.5 * part - 0.6), 0.3 * part, 1.3 + 0.1 * np.sin(3 * part)
    return matrix


def _hit_box(eye: Float64Array, rays: Float64Array, low: Float64Array, high: Float64Array) -> Float64Array:
    """Distance (H, W) along ``rays`` (H, W, 3) to a box, infinite where it is missed."""
    near, far = np.sort(np.stack([(low - eye) / rays, (high - eye) / rays]), axis=0)
    entry, leave = near.max(axis=-1), far.min(axis=-1)
    distance: Float64Array = np.where((entry < leave) & (entry > 0), entry, np.inf)
    return distance


def _frame(scene: str, index: int) -> Frame:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    camera = pose(scene, index)
    in_camera = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(INTRINSICS).T
    eye, rays = camera[:3, 3], in_camera @ camera[:3, :3].T + 1e-9
    slope, offset = WALL[scene]
    depths = [(slope * eye[0] + offset - eye[1]) / (rays[..., 1] - slope * rays[..., 0]), -eye[2] / rays[..., 2]]
    depths += [_hit_box(eye, rays, np.array(low), np.array(high)) for low, high, _ in BOXES[scene]]
    stack = np.stack([np.where(depth > 0, depth, np.inf) for depth in depths])
    colours = np.array([(180, 175, 160), (120, 90, 70), *(colour for *_, colour in BOXES[scene])], np.float64)
    distance, surface = stack.min(axis=0), stack.argmin(axis=0)
    points = eye + rays * distance[..., None]
    stripes = np.sin(points @ [9.0, 4.0, 2.0]) * np.sin(points @ [1.0, 3.0, 11.0])
    rgb = np.clip(colours[surface] * (1 + 0.45 * stripes[..., None]), 0, 255).astype(np.uint8)
    seen: BoolArray = distance < FARTHEST_M
    depth_m = np.where(seen, distance, 0).astype(np.float32)
    frame = Frame(index, index / 30, rgb, depth_m, camera, INTRINSICS.copy())
    for array in (frame.rgb, frame.depth_m, frame.camera_to_world, frame.intrinsics):
        array.setflags(write=False)
    return frame


@cache
def recording(scene: str = SCENES[0], index: int = 0) -> Recording:
    """The clean recording around a frame."""
    if index:
        return replace(recording(scene), index=index)
    frames = tuple(_frame(scene, k) for k in range(N_FRAMES))
    poses = np.stack([frame.camera_to_world for frame in frames])
    poses.setflags(write=False)
    return Recording(frames, poses, 0)
