"""How axis-aligned boxes (2, 3), lowest and highest corner in metres, z up, lie to one another.

The built-in rooms are labelled by these thresholds, and questions on maps are answered by the same ones.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.types import Float64Array

Point = Float64Array | tuple[float, ...]

NEXT_TO_M = 0.3
NEXT_TO_SMALL_M = 0.12  # things that share a support are small
LEVEL_M = 0.15  # neighbours may miss one another in height by this much
ABOVE_SHARE, ABOVE_PAD_M, ABOVE_M = 0.15, 0.1, 2.2  # share of the padded footprints, reach of a ceiling
UNDER_SHARE = 0.2  # of the smaller footprint: a rug and what stands on it
MIN_BEARING_RAD = 0.05  # two things nearer to one line of sight are neither left nor right of each other


def _apart(a: Float64Array, b: Float64Array) -> Float64Array:
    apart: Float64Array = np.clip(np.maximum(a[0] - b[1], b[0] - a[1]), 0.0, None)
    return apart


def gap_m(a: Float64Array, b: Float64Array) -> float:
    """The shortest way between two boxes; 0 where they touch."""
    return float(np.linalg.norm(_apart(a, b)))


def ground_gap_m(a: Float64Array, b: Float64Array) -> float:
    """The shortest way between two footprints."""
    return float(np.linalg.norm(_apart(a, b)[:2]))


def ground_area(a: Float64Array) -> float:
    """Square metres of the footprint, above 0 so that one can divide by it."""
    return max(float(np.prod((a[1] - a[0])[:2])), 1e-9)


def shared_area(a: Float64Array, b: Float64Array) -> float:
    """Square metres that two footprints share."""
    return float(np.prod(np.clip(np.minimum(a[1], b[1])[:2] - np.maximum(a[0], b[0])[:2], 0.0, None)))


def shared_ground(a: Float64Array, b: Float64Array, pad_m: float = 0.0) -> float:
    """Overlap of two footprints, each grown by ``pad_m``, as a share of the smaller one."""
    pad = np.array([[-pad_m, -pad_m, 0.0], [pad_m, pad_m, 0.0]])
    wide_a, wide_b = a + pad, b + pad
    return shared_area(wide_a, wide_b) / min(ground_area(wide_a), ground_area(wide_b))


def are_side_by_side(a: Float64Array, b: Float64Array, within_m: float) -> bool:
    """Whether the footprints are no farther apart than ``within_m``, at about one height."""
    overlap_z = float(min(a[1][2], b[1][2]) - max(a[0][2], b[0][2]))
    return ground_gap_m(a, b) <= within_m and overlap_z > -LEVEL_M


def is_over(a: Float64Array, b: Float64Array, more_than_m: float, less_than_m: float) -> bool:
    """Whether ``a`` begins so much higher than ``b`` ends, over its footprint."""
    return more_than_m < float(a[0][2] - b[1][2]) < less_than_m and shared_ground(a, b, ABOVE_PAD_M) > ABOVE_SHARE


def bearing_rad(eye: Point, a: Point, b: Point) -> float:
    """The angle, seen from above, by which point ``a`` stands left of ``b`` for who looks at them from ``eye``."""
    angle_a = math.atan2(float(a[1] - eye[1]), float(a[0] - eye[0]))
    angle_b = math.atan2(float(b[1] - eye[1]), float(b[0] - eye[0]))
    return math.remainder(angle_a - angle_b, math.tau)


def is_left_of(a: Point, b: Point, eye: Point) -> bool:
    """Whether point ``a`` stands left of ``b`` for who looks at both from ``eye``."""
    return bearing_rad(eye, a, b) > MIN_BEARING_RAD
