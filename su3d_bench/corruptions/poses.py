"""Corruptions of the trajectory. Errors have zero mean, as remains after an alignment to the ground truth.

Sizes are root mean squares over the trajectory, so that they are those of an absolute trajectory error.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Float64Array
from su3d_bench.corruptions.model import Corruption, PosesFunction
from su3d_bench.corruptions.sensors import poses

FRAMES_PER_JUMP = 300  # one loop closure in ten seconds at 30 frames per second


def jitter_rotation(clean: Float64Array, degrees: float, rng: Generator) -> Float64Array:
    """Poses with an independent rotation per frame."""
    return poses.jitter(clean, 0.0, degrees, rng)


def jitter_translation(clean: Float64Array, size_cm: float, rng: Generator) -> Float64Array:
    """Poses with an independent shift per frame."""
    return poses.jitter(clean, size_cm / 100, 0.0, rng)


def drift_rotation(clean: Float64Array, degrees: float, rng: Generator) -> Float64Array:
    """Poses with a smooth random walk of rotations."""
    return poses.drift(clean, 0.0, degrees, rng)


def drift_translation(clean: Float64Array, size_cm: float, rng: Generator) -> Float64Array:
    """Poses with a smooth random walk of shifts."""
    return poses.drift(clean, size_cm / 100, 0.0, rng)


def jumps(clean: Float64Array, size_cm: float, rng: Generator) -> Float64Array:
    """Poses with shifts that grow steadily and are corrected at once at each loop closure, of which at least one."""
    return poses.jump(clean, max(1, round(len(clean) / FRAMES_PER_JUMP)), size_cm / 100, 0.0, rng)


def aligned(function: PosesFunction) -> PosesFunction:
    """``function`` followed by the rigid transform that moves its positions closest to the clean ones.

    Source: Umeyama 1991, equations 40 to 42 without scale, as in the absolute trajectory error of TUM RGB-D.
    """

    def corrupted(clean: Float64Array, size: float, rng: Generator) -> Float64Array:
        if size == 0:
            return clean
        moved = function(clean, size, rng)
        own, true = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (moved, clean))
        u, _, vt = np.linalg.svd(true.T @ own)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        motion = np.eye(4)
        motion[:3, :3] = turn
        motion[:3, 3] = clean[:, :3, 3].mean(axis=0) - turn @ moved[:, :3, 3].mean(axis=0)
        return np.asarray(motion @ moved)

    return corrupted


SLAM = (
    "1.5 cm is the mean error of BundleFusion, ElasticFusion and ORB-SLAM2 on four recordings of TUM RGB-D (the drift "
    "of the sensor track of homes); ours: doubled"
)
ROWS: tuple[Corruption, ...] = (
    Corruption(
        "pose", "jitter-rotation", "poses", jitter_rotation, "degrees RMS", (1.0, 2.0, 3.0, 4.0, 5.0),
        "Xu et al. 2025 (arXiv 2501.14319): 1, 3 and 5 degrees; ours: between them.",
    ),
    Corruption(
        "pose", "jitter-translation", "poses", jitter_translation, "cm RMS", (1.25, 1.875, 2.5, 3.75, 5.0),
        "Xu et al. 2025 (arXiv 2501.14319): 1.25, 2.5 and 5 cm; ours: between them.",
    ),
    Corruption(
        "pose", "drift-rotation", "poses", drift_rotation, "degrees RMS", (0.4, 0.8, 1.6, 3.2, 6.4),
        "ours: moves a point at 2 m as far as drift-translation does, to 7 %.",
    ),
    Corruption(
        "pose", "drift-translation", "poses", drift_translation, "cm RMS", (1.5, 3.0, 6.0, 12.0, 24.0), f"{SLAM}.",
    ),
    Corruption(
        "pose", "jumps", "poses", jumps, "cm RMS", (1.5, 3.0, 6.0, 12.0, 24.0), f"{SLAM}, as drift-translation.",
    ),
    Corruption(
        "pose", "drift-translation-aligned", "poses", aligned(drift_translation), "cm RMS before alignment",
        (1.5, 3.0, 6.0, 12.0, 24.0), f"{SLAM}.",
    ),
    Corruption(
        "pose", "jumps-aligned", "poses", aligned(jumps), "cm RMS before alignment", (1.5, 3.0, 6.0, 12.0, 24.0),
        f"{SLAM}, as drift-translation.",
    ),
)  # fmt: skip
