"""Errors of a depth camera with a projector, each a pure function of depth images.

Depth images (H, W) are float32 metres along the optical axis, 0 where missing; no function gives depth to a missing
pixel. Angles are radians between a surface normal and the ray to the camera. A parameter of 0 returns the input itself.
The defaults are those of the Kinect, the structured-light camera with the most published measurements.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array

FOCAL_PX = 585.0  # of the infrared camera at 640 px; Nguyen et al. 2012, section 2.2, give lateral noise at this scale
BASELINE_M = (
    0.075  # Konolige and Mihelich, "Technical description of Kinect calibration" (ROS wiki), "Depth calculation"
)
STEP_PX = 1 / 8  # the same page: disparity is interpolated to 1/8 pixel
WINDOW_PX = 9  # the same page: disparity is found by correlating windows of 9x9 pixels
EDGE_PER_M = 1.0 / (FOCAL_PX * BASELINE_M)  # a jump of one pixel in disparity
STEEPEST = np.deg2rad(85.0)  # the formulas diverge towards 90 degrees
TYPICAL_ALBEDO = 0.5  # a painted wall, for callers without materials


@cache
def _quantiles() -> Float32Array:
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(65536) + 0.5) / 65536), np.float32)


def normal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Normal noise of unit variance in 65,536 steps up to 4.3, a third of ``rng.standard_normal``'s time."""
    noise: Float32Array = _quantiles()[rng.integers(0, 65536, shape, np.uint16)]
    return noise


def grain(shape: tuple[int, int], size_px: int, rng: np.random.Generator) -> Float32Array:
    """Normal noise (H, W) of unit variance, averaged over a box of ``size_px`` pixels as by a correlation window."""
    if size_px < 3:
        return normal_noise(shape, rng)
    import cv2

    # sums of 9 or more uniform bytes are normal enough, and faster still to draw
    drawn = rng.integers(0, 256, (shape[0] + size_px - 1, shape[1] + size_px - 1), np.uint8)
    total = cv2.boxFilter(drawn, cv2.CV_32F, (size_px, size_px), anchor=(0, 0), normalize=False)
    variance = size_px**2 * (256**2 - 1) / 12
    noise: Float32Array = total[: shape[0], : shape[1]] - np.float32(127.5 * size_px**2)
    noise *= np.float32(variance**-0.5)
    return noise


def inverse_depth(depth_m: Float32Array) -> Float32Array:
    """1 / depth, 0 where missing. On a plane it is an affine function of the pixel, however slanted the plane is."""
    return np.divide(np.float32(1), depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def _slope(values: Float32Array, axis: int) -> Float32Array:
    """Change per pixel, from the side where it is smaller, so that an edge does not reach its neighbours."""
    slope = np.empty_like(values)
    target, step = (slope, np.diff(values, axis=1)) if axis == 1 else (slope.T, np.diff(values, axis=0).T)
    size = np.abs(step)
    target[:, 0], target[:, -1] = step[:, 0], step[:, -1]
    target[:, 1:-1] = np.where(size[:, :-1] < size[:, 1:], step[:, :-1], step[:, 1:])
    return slope


def _plane(
    depth_m: Float32Array, intrinsics: Float64Array
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array, Float32Array]:
    """x, y and z of the vector whose product with a ray (x, y, 1) is 1 / depth, its length, and that of the ray."""
    inverse = inverse_depth(depth_m)
    u = ((np.arange(depth_m.shape[1]) - intrinsics[0, 2]) / intrinsics[0, 0]).astype(np.float32)
    v = ((np.arange(depth_m.shape[0]) - intrinsics[1, 2]) / intrinsics[1, 1]).astype(np.float32)[:, None]
    x, y = _slope(inverse, 1) * np.float32(intrinsics[0, 0]), _slope(inverse, 0) * np.float32(intrinsics[1, 1])
    z = inverse - u * x - v * y
    return x, y, z, np.sqrt(x * x + y * y + z * z), np.sqrt(u * u + v * v + 1)


def normals(depth_m: Float32Array, intrinsics: Float64Array) -> Float32Array:
    """Unit normals (H, W, 3) towards the camera in its axes; 0 where depth is missing. Exact on planes."""
    x, y, z, length, _ = _plane(depth_m, intrinsics)
    scaling = np.divide(np.float32(-1), length, out=np.zeros_like(length), where=depth_m > 0)
    return np.stack([x * scaling, y * scaling, z * scaling], axis=-1)


def incidence(depth_m: Float32Array, intrinsics: Float64Array) -> Float32Array:
    """Angle (H, W) between normal and ray, 0 to pi / 2; pi / 2 where depth is missing."""
    *_, length, ray = _plane(depth_m, intrinsics)
    product = length * ray * depth_m
    cosine = np.divide(np.float32(1), product, out=np.zeros_like(product), where=depth_m > 0)
    np.arccos(np.minimum(cosine, 1, out=cosine), out=cosine)
    return cosine


def edges(depth_m: Float32Array, min_step_per_m: float = EDGE_PER_M) -> BoolArray:
    """Pixels on both sides of a jump in depth, by second differences of inverse depth; slanted planes have none."""
    inverse = inverse_depth(depth_m)
    found = np.zeros(depth_m.shape, bool)
    found[:, 1:-1] = np.abs(np.diff(inverse, 2, axis=1)) > min_step_per_m
    found[1:-1] |= np.abs(np.diff(inverse, 2, axis=0)) > min_step_per_m
    return found & (depth_m > 0)


def axial_sigma(depth_m: Float32Array, angle: Float32Array) -> Float32Array:
    """Standard deviation of depth in metres: Nguyen, Izadi and Lovell 2012, equations 3 and 4 (from 60 degrees)."""
    theta = np.minimum(angle, np.float32(STEEPEST))
    sigma = np.float32(0.0012) + np.float32(0.0019) * (depth_m - np.float32(0.4)) ** 2
    steep = (angle > np.float32(np.pi / 3)) & (depth_m > 0)
    z, theta = depth_m[steep], theta[steep]
    sigma[steep] += np.float32(0.0001) / np.sqrt(z) * (theta / (np.float32(np.pi / 2) - theta)) ** 2
    return sigma


def axial_noise(
    depth_m: Float32Array, angle: Float32Array, rng: np.random.Generator, strength: float = 1.0, grain_px: int = 1,
    step_m: Float32Array | None = None,
) -> Float32Array:  # fmt: skip
    """Depth with noise of ``strength`` times ``axial_sigma``, alike over ``grain_px`` pixels.

    ``step_m`` is the step of a quantisation that follows: its variance, step^2 / 12, is part of the measured sigma.
    """
    if strength == 0:
        return depth_m
    variance = (np.float32(strength) * axial_sigma(depth_m, angle)) ** 2
    if step_m is not None:
        variance = np.maximum(variance - step_m**2 / np.float32(12), 0)
    noisy = depth_m + np.sqrt(variance) * grain(depth_m.shape, grain_px, rng)
    return np.where(depth_m > 0, np.maximum(noisy, np.float32(0.001)), np.float32(0))


def lateral_noise(
    depth_m: Float32Array, angle: Float32Array, rng: np.random.Generator, strength: float = 1.0, grain_px: int = 1,
    px_per_kinect_px: float = 1.0,
) -> Float32Array:  # fmt: skip
    """Depth sampled beside each pixel: Nguyen et al. 2012, equations 1 and 2, sigma = 0.8 + 0.035 a / (pi/2 - a) px.

    ``px_per_kinect_px`` is the image's focal length over ``FOCAL_PX``. A sample is moved along its own plane, so that
    outlines move while a slanted plane keeps its depth, whose noise equation 3 includes.
    """
    if strength == 0:
        return depth_m
    theta = np.minimum(angle, np.float32(STEEPEST))
    sigma = np.float32(0.8) + np.float32(0.035) * theta / (np.float32(np.pi / 2) - theta)
    sigma *= np.float32(strength * px_per_kinect_px)
    import cv2

    height, width = depth_m.shape
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    at_u = np.clip(columns + np.rint(sigma * grain(depth_m.shape, grain_px, rng)), 0, width - 1)
    at_v = np.clip(rows + np.rint(sigma * grain(depth_m.shape, grain_px, rng)), 0, height - 1)
    inverse = inverse_depth(depth_m)
    image = cv2.merge([inverse, _slope(inverse, 1), _slope(inverse, 0)])
    beside, slope_u, slope_v = cv2.split(cv2.remap(image, at_u, at_v, cv2.INTER_NEAREST))
    sampled = beside + slope_u * (columns - at_u) + slope_v * (rows - at_v)
    usable = (depth_m > 0) & (beside > 0) & (sampled > 0.01) & ((at_u != columns) | (at_v != rows))
    np.divide(np.float32(1), sampled, out=sampled, where=usable)
    return np.where(usable, sampled, depth_m)


def disparity_step(
    depth_m: Float32Array, step_px: float = STEP_PX, baseline_m: float = BASELINE_M, focal_px: float = FOCAL_PX
) -> Float32Array:
    """Distance in metres between neighbouring depths that disparity in steps of ``step_px`` can express."""
    return depth_m**2 * np.float32(step_px / (baseline_m * focal_px))


def quantise(
    depth_m: Float32Array, step_px: float = STEP_PX, baseline_m: float = BASELINE_M, focal_px: float = FOCAL_PX
) -> Float32Array:
    """Depth whose disparity is a multiple of ``step_px``; ``focal_px`` is the sensor's own, at any image size."""
    if step_px == 0:
        return depth_m
    unit = np.float32(baseline_m * focal_px / step_px)
    steps = np.rint(unit * inverse_depth(depth_m))
    return np.divide(unit, steps, out=np.zeros_like(depth_m), where=steps > 0)


def scale(depth_m: Float32Array, factor: float) -> Float32Array:
    """Depth of a camera whose baseline is wrong by ``factor`` - 1."""
    return depth_m if factor == 1 else depth_m * np.float32(factor)


def limit_range(depth_m: Float32Array, near_m: float, far_m: float) -> Float32Array:
    """Depth within [near_m, far_m], missing outside."""
    outside = (depth_m < near_m) | (depth_m > far_m)
    return _without(depth_m, outside)


def cast_shadow(depth_m: Float32Array, focal_px: float, baseline_m: float = BASELINE_M) -> Float32Array:
    """Depth without the pixels that the projector, ``baseline_m`` along the camera's x axis, does not reach.

    The shadow of an edge is focal * baseline * (1/near - 1/far) pixels of the image wide, left of near objects if the
    projector is to the right as in the Kinect. ``focal_px`` is the image's.
    """
    if baseline_m == 0:
        return depth_m
    height, width = depth_m.shape
    disparity = np.clip(inverse_depth(depth_m) * np.float32(focal_px * baseline_m), -width, width)
    column = np.arange(width, dtype=np.float32) - disparity + np.float32(width)
    row = np.arange(height, dtype=np.int32)[:, None] * (3 * width + 2)
    nearness = np.abs(disparity).ravel()
    nearest = np.zeros(height * (3 * width + 2), np.float32)  # a depth buffer of the projector
    np.maximum.at(nearest, (row + column.astype(np.int32)).ravel(), nearness)
    nearest[1:] = np.maximum(nearest[1:], nearest[:-1])  # a surface reaches the column after its own
    hidden = nearest[(row + np.rint(column).astype(np.int32)).ravel()] > nearness + np.float32(1)
    return _without(depth_m, hidden.reshape(depth_m.shape))


def lose_weak(
    depth_m: Float32Array, angle: Float32Array, albedo: Float32Array | float, min_signal: float,
    rng: np.random.Generator, spread: float = 0.0,
) -> Float32Array:  # fmt: skip
    """Depth where enough light returns: albedo * cos(angle) / depth^2 >= ``min_signal`` (1/m^2), else missing.

    Lambert's law and the inverse square, as in Landau, Choo and Beling 2016 ("Simulating Kinect infrared and depth
    images", IEEE Transactions on Cybernetics 46). ``spread`` is the deviation of the signal's logarithm between
    correlation windows.
    """
    if min_signal == 0:
        return depth_m
    needed = np.float32(min_signal) * depth_m**2
    if spread > 0:
        needed *= np.exp(np.float32(spread) * grain(depth_m.shape, WINDOW_PX, rng))
    return _without(depth_m, albedo * np.cos(angle) < needed)


def lose_glare(
    depth_m: Float32Array, angle: Float32Array, gloss: Float32Array, min_gloss: float, lobe_rad: float
) -> Float32Array:
    """Depth without glossy pixels that mirror the projector into the camera beside it: angle < ``lobe_rad``."""
    return depth_m if lobe_rad == 0 else _without(depth_m, (gloss >= min_gloss) & (angle < lobe_rad))


def see_through(
    depth_m: Float32Array, share: Float32Array, rng: np.random.Generator, beyond_m: Float32Array | None = None
) -> Float32Array:
    """Depth with glass and mirrors: a part ``share`` (0..1) of a surface's windows show what is behind or mirrored.

    ``beyond_m`` (H, W) is the depth there; missing where it is 0 or not given.
    """
    if not (share > 0).any():
        return depth_m
    from scipy.special import ndtr

    passed = (ndtr(grain(depth_m.shape, WINDOW_PX, rng)) < share) & (depth_m > 0)
    return np.where(passed, np.float32(0) if beyond_m is None else beyond_m, depth_m)


def lose_edges(
    depth_m: Float32Array, at_edge: BoolArray, width_px: int, share: float, rng: np.random.Generator
) -> Float32Array:
    """Depth without a part ``share`` of the pixels within ``width_px`` of an edge, in patches: where a correlation
    window covers two surfaces it may match neither."""
    if width_px == 0 or share == 0:
        return depth_m
    import cv2

    size = 2 * width_px - 1  # an edge has a pixel on either side already
    near = cv2.dilate(at_edge.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    limit = NormalDist().inv_cdf(min(share, 1 - 1e-9))
    return _without(depth_m, near & (grain(depth_m.shape, WINDOW_PX, rng) < limit))


def add_flying_pixels(
    depth_m: Float32Array, at_edge: BoolArray, share: float, rng: np.random.Generator
) -> Float32Array:
    """Depth where a part ``share`` of edge pixels lie anywhere between the nearest and the farthest of 3x3."""
    if share == 0:
        return depth_m
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), kernel)
    chosen = at_edge & (depth_m > 0)
    chosen[chosen] = rng.random(np.count_nonzero(chosen)) < share
    near, far = near[chosen], cv2.dilate(depth_m, kernel)[chosen]
    result = depth_m.copy()
    result[chosen] = near + (far - near) * rng.random(len(near), np.float32)
    return result


def _without(depth_m: Float32Array, lost: BoolArray) -> Float32Array:
    return np.where(lost, np.float32(0), depth_m)
