"""What a depth camera adds to a perfect picture: quantised, noisy depth, holes at edges, noisy colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, UInt8Array


@dataclass(frozen=True)
class SensorNoise:
    """``depth_per_m2``: standard deviation of depth at 1 m, growing with its square (Khoshelham and Elberink 2012,
    for structured light); ``step_per_m2``: quantisation likewise; ``edge_px``: how far holes reach from a jump of
    depth; ``colour``: standard deviation of a channel in 0..255."""

    depth_per_m2: float
    step_per_m2: float
    edge_px: int
    colour: float


LEVELS = (
    SensorNoise(0.0, 0.0, 0, 0.0),
    SensorNoise(0.0010, 0.0010, 1, 2.0),
    SensorNoise(0.0025, 0.0028, 2, 5.0),
)
JUMP_M = 0.04  # second difference between pixels, so that a slanted plane is no edge


def add_noise(
    rgb: UInt8Array, depth_m: Float32Array, level: int, rng: np.random.Generator
) -> tuple[UInt8Array, Float32Array]:
    """The images as a sensor of noise ``level`` gives them; level 0 changes nothing."""
    noise = LEVELS[level]
    if level == 0:
        return rgb, depth_m
    square = depth_m.astype(np.float64) ** 2
    depth = depth_m + noise.depth_per_m2 * square * rng.standard_normal(depth_m.shape)
    step = np.maximum(noise.step_per_m2 * square, 0.001)
    depth = np.round(depth / step) * step
    hole = _near_jumps(depth_m, noise.edge_px) & (rng.random(depth_m.shape) < 0.7)
    depth[hole | (depth_m <= 0)] = 0.0
    noisy = rgb + noise.colour * rng.standard_normal(rgb.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), np.maximum(depth, 0.0).astype(np.float32)


def _near_jumps(depth_m: Float32Array, reach: int) -> BoolArray:
    from scipy.ndimage import binary_dilation

    jump = np.zeros(depth_m.shape, bool)
    jump[:, 1:-1] = np.abs(np.diff(depth_m, 2, axis=1)) > JUMP_M
    jump[1:-1] |= np.abs(np.diff(depth_m, 2, axis=0)) > JUMP_M
    return np.asarray(binary_dilation(jump, iterations=reach), bool)
