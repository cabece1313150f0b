"""Errors of a depth camera with a projector, each a pure function of depth images.

Depth images (H, W) are float32 metres along the optical axis, 0 where missing; no function gives depth to a missing
pixel. Angles are radians between a surface normal and the ray to the camera. A parameter of 0 returns the input itself.
The defaults are those of the Kinect, the structured-light camera with the most published measurements.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.core.types import Float32Array as Image

FOCAL_PX = 585.0  # of the infrared camera at 640 px, by which Nguyen et al. 2012 convert lateral noise
BASELINE_M = 0.075  # Konolige and Mihelich, "Technical description of Kinect calibration", ROS wiki
STEP_PX = 1 / 8  # the same page: disparity is interpolated to 1/8 pixel
WINDOW_PX = 9  # the same page: disparity is found by correlating windows of 9x9 pixels
PX_PER_M = FOCAL_PX * BASELINE_M  # disparity in pixels is this over depth
STEEPEST = np.deg2rad(85.0)  # the formulas diverge towards 90 degrees


@cache
def _quantiles() -> Image:
    from scipy.special import ndtri

    return np.asarray(ndtri((np.arange(65536) + 0.5) / 65536), np.float32)


def normal_noise(shape: tuple[int, ...], rng: Generator) -> Image:
    """Normal noise of unit variance in 65,536 steps up to 4.3, a third of ``rng.standard_normal``'s time."""
    return np.asarray(_quantiles()[rng.integers(0, 65536, shape, np.uint16)])


def grain(shape: tuple[int, int], size_px: int, rng: Generator) -> Image:
    """Normal noise (H, W) of unit variance, averaged over a box of ``size_px`` pixels as by a correlation window."""
    if size_px < 3:
        return normal_noise(shape, rng)
    import cv2

    # sums of 9 or more uniform bytes are normal enough, and faster still to draw
    drawn = rng.integers(0, 256, (shape[0] + size_px - 1, shape[1] + size_px - 1), np.uint8)
    total = cv2.boxFilter(drawn, cv2.CV_32F, (size_px, size_px), anchor=(0, 0), normalize=False)
    centred = total[: shape[0], : shape[1]] - np.float32(127.5 * size_px**2)
    return np.asarray(centred * np.float32((size_px**2 * (256**2 - 1) / 12) ** -0.5))


def inverse_depth(depth_m: Image) -> Image:
    """1 / depth, 0 where missing. On a plane it is an affine function of the pixel, however slanted the plane is."""
    return np.divide(np.float32(1), depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def _slope(values: Image, axis: int) -> Image:
    """Change per pixel, from the side where it is smaller, so that an edge does not reach its neighbours."""
    slope = np.empty_like(values)
    target, step = (slope, np.diff(values, axis=1)) if axis == 1 else (slope.T, np.diff(values, axis=0).T)
    size = np.abs(step)
    target[:, 0], target[:, -1] = step[:, 0], step[:, -1]
    target[:, 1:-1] = np.where(size[:, :-1] < size[:, 1:], step[:, :-1], step[:, 1:])
    return slope


def _plane(depth_m: Image, intrinsics: Float64Array) -> tuple[Image, Image, Image, Image, Image]:
    """x, y and z of the vector whose product with a ray (x, y, 1) is 1 / depth, its length, and that of the ray."""
    inverse = inverse_depth(depth_m)
    u = ((np.arange(depth_m.shape[1]) - intrinsics[0, 2]) / intrinsics[0, 0]).astype(np.float32)
    v = ((np.arange(depth_m.shape[0]) - intrinsics[1, 2]) / intrinsics[1, 1]).astype(np.float32)[:, None]
    x, y = _slope(inverse, 1) * np.float32(intrinsics[0, 0]), _slope(inverse, 0) * np.float32(intrinsics[1, 1])
    z = inverse - u * x - v * y
    return x, y, z, np.sqrt(x * x + y * y + z * z), np.sqrt(u * u + v * v + 1)


def normals(depth_m: Image, intrinsics: Float64Array) -> Image:
    """Unit normals (H, W, 3) towards the camera in its axes; 0 where depth is missing. Exact on planes."""
    x, y, z, length, _ = _plane(depth_m, intrinsics)
    scaling = np.divide(np.float32(-1), length, out=np.zeros_like(length), where=depth_m > 0)
    return np.stack([x * scaling, y * scaling, z * scaling], axis=-1)


def incidence(depth_m: Image, intrinsics: Float64Array) -> Image:
    """Angle (H, W) between normal and ray, 0 to pi / 2; pi / 2 where depth is missing."""
    *_, length, ray = _plane(depth_m, intrinsics)
    product = length * ray * depth_m
    cosine = np.divide(np.float32(1), product, out=np.zeros_like(product), where=depth_m > 0)
    return np.asarray(np.arccos(np.minimum(cosine, 1)))


def edges(depth_m: Image, min_step_px: float = 1.0) -> BoolArray:
    """Pixels on both sides of a jump in depth, by second differences of disparity; slanted planes have none."""
    disparity = inverse_depth(depth_m) * np.float32(PX_PER_M)
    found = np.zeros(depth_m.shape, bool)
    found[:, 1:-1] = np.abs(np.diff(disparity, 2, axis=1)) > min_step_px
    found[1:-1] |= np.abs(np.diff(disparity, 2, axis=0)) > min_step_px
    return found & (depth_m > 0)


def axial_sigma(depth_m: Image, angle: Image) -> Image:
    """Standard deviation of depth in metres: Nguyen, Izadi and Lovell 2012, equations 3 and 4 (from 60 degrees)."""
    theta = np.where(angle < np.pi / 3, np.float32(0), np.minimum(angle, np.float32(STEEPEST)))
    steep = np.float32(0.0001) * (theta / (np.float32(np.pi / 2) - theta)) ** 2 * np.sqrt(inverse_depth(depth_m))
    return np.asarray(np.float32(0.0012) + np.float32(0.0019) * (depth_m - np.float32(0.4)) ** 2 + steep, np.float32)


def axial_noise(
    depth_m: Image, angle: Image, rng: Generator, strength: float = 1.0, grain_px: int = 1, step_px: float = 0.0
) -> Image:
    """Depth with noise of ``strength`` times ``axial_sigma``, alike over ``grain_px`` pixels.

    ``step_px`` is that of a quantisation that follows: its variance, step^2 / 12, is part of the measured sigma.
    """
    step_m = depth_m**2 * np.float32(step_px / PX_PER_M)
    variance = (np.float32(strength) * axial_sigma(depth_m, angle)) ** 2 - step_m**2 / np.float32(12)
    noisy = depth_m + np.sqrt(np.maximum(variance, 0)) * grain(depth_m.shape, grain_px, rng)
    return _without(np.maximum(noisy, np.float32(0.001)), depth_m <= 0)


def lateral_noise(
    depth_m: Image, angle: Image, rng: Generator, strength: float = 1.0, grain_px: int = 1, focal_px: float = FOCAL_PX
) -> Image:
    """Depth sampled beside each pixel: Nguyen et al. 2012, equations 1 and 2, sigma = 0.8 + 0.035 a / (pi/2 - a) px.

    ``focal_px`` is the image's. A sample is moved along its own plane, so that outlines move while a slanted plane
    keeps its depth, whose noise equation 3 includes.
    """
    import cv2

    near = cv2.dilate(edges(depth_m).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0  # elsewhere nothing changes
    rows, columns = np.nonzero(near)
    theta = np.minimum(angle[near], STEEPEST)
    sigma = (0.8 + 0.035 * theta / (np.pi / 2 - theta)) * (strength * focal_px / FOCAL_PX)
    at_u = columns + np.rint(sigma * grain(depth_m.shape, grain_px, rng)[near]).astype(np.int64)
    at_v = rows + np.rint(sigma * grain(depth_m.shape, grain_px, rng)[near]).astype(np.int64)
    at = np.clip(at_v, 0, depth_m.shape[0] - 1), np.clip(at_u, 0, depth_m.shape[1] - 1)
    inverse, result = inverse_depth(depth_m), depth_m.copy()
    sampled = inverse[at] + _slope(inverse, 1)[at] * (columns - at[1]) + _slope(inverse, 0)[at] * (rows - at[0])
    usable = (depth_m[near] > 0) & (inverse[at] > 0) & (sampled > 0.01) & ((at[1] != columns) | (at[0] != rows))
    result[near] = np.where(usable, 1 / np.maximum(sampled, 0.01), depth_m[near])
    return result


def quantise(depth_m: Image, step_px: float = STEP_PX, px_per_m: float = PX_PER_M) -> Image:
    """Depth whose disparity, ``px_per_m`` / depth, is a multiple of ``step_px``.

    ``px_per_m`` is the sensor's own focal length times baseline, at any image size.
    """
    if step_px == 0:
        return depth_m
    unit = np.float32(px_per_m / step_px)
    steps = np.rint(unit * inverse_depth(depth_m))
    return np.asarray(np.divide(unit, steps, out=np.zeros_like(depth_m), where=steps > 0))


def scale(depth_m: Image, factor: float) -> Image:
    """Depth of a camera whose baseline is wrong by ``factor`` - 1."""
    return depth_m if factor == 1 else depth_m * np.float32(factor)


def limit_range(depth_m: Image, near_m: float, far_m: float) -> Image:
    """Depth within [near_m, far_m], missing outside."""
    return _without(depth_m, (depth_m < near_m) | (depth_m > far_m))


def cast_shadow(depth_m: Image, focal_px: float, baseline_m: float = BASELINE_M) -> Image:
    """Depth without the pixels that the projector, ``baseline_m`` along the camera's x axis, does not reach.

    The shadow of an edge is focal * baseline * (1/near - 1/far) pixels of the image wide, left of near objects if the
    projector is to the right as in the Kinect. ``focal_px`` is the image's.
    """
    height, width = depth_m.shape
    disparity = np.clip(inverse_depth(depth_m) * np.float32(focal_px * baseline_m), -width, width)
    row = np.arange(height, dtype=np.int32)[:, None] * (3 * width + 2) + width
    column = np.arange(width, dtype=np.float32) - disparity
    nearest = np.zeros(height * (3 * width + 2), np.float32)  # a depth buffer of the projector
    np.maximum.at(nearest, (row + np.floor(column).astype(np.int32)).ravel(), np.abs(disparity).ravel())
    nearest[1:] = np.maximum(nearest[1:], nearest[:-1])  # a surface reaches the column after its own
    return _without(depth_m, nearest[row + np.rint(column).astype(np.int32)] > np.abs(disparity) + 1)


def lose_weak(
    depth_m: Image, angle: Image, albedo: Image | float, min_signal: float, rng: Generator, spread: float = 0.0
) -> Image:
    """Depth where enough light returns: albedo * cos(angle) / depth^2 >= ``min_signal`` (1/m^2), else missing.

    Lambert's law and the inverse square, as in Landau, Choo and Beling 2016 ("Simulating Kinect infrared and depth
    images", IEEE Transactions on Cybernetics 46). ``spread`` is the deviation of the signal's logarithm between
    correlation windows.
    """
    needed = np.float32(min_signal) * depth_m**2 * np.exp(np.float32(spread) * grain(depth_m.shape, WINDOW_PX, rng))
    return _without(depth_m, albedo * np.cos(angle) < needed)


def lose_glare(depth_m: Image, angle: Image, gloss: Image, min_gloss: float, lobe_rad: float) -> Image:
    """Depth without glossy pixels that mirror the projector into the camera beside it: angle < ``lobe_rad``."""
    return _without(depth_m, (gloss >= min_gloss) & (angle < lobe_rad))


def see_through(depth_m: Image, share: Image, rng: Generator, beyond_m: Image | None = None) -> Image:
    """Depth with glass and mirrors: a part ``share`` (0..1) of a surface's windows show what is behind or mirrored.

    ``beyond_m`` (H, W) is the depth there; missing where it is 0 or not given.
    """
    if not (share > 0).any():
        return depth_m
    from scipy.special import ndtr

    passed = (ndtr(grain(depth_m.shape, WINDOW_PX, rng)) < share) & (depth_m > 0)
    return np.where(passed, np.float32(0) if beyond_m is None else beyond_m, depth_m)


def lose_edges(depth_m: Image, at_edge: BoolArray, width_px: int, share: float, rng: Generator) -> Image:
    """Depth without a part ``share`` of the pixels within ``width_px`` of an edge, in patches: where a correlation
    window covers two surfaces it may match neither."""
    if width_px == 0 or share == 0:
        return depth_m
    import cv2

    kernel = np.ones((2 * width_px - 1, 2 * width_px - 1), np.uint8)  # an edge has a pixel on either side already
    lost = grain(depth_m.shape, WINDOW_PX, rng) < NormalDist().inv_cdf(min(share, 1 - 1e-9))
    return _without(depth_m, lost & (cv2.dilate(at_edge.astype(np.uint8), kernel) > 0))


def add_flying_pixels(depth_m: Image, at_edge: BoolArray, share: float, rng: Generator) -> Image:
    """Depth where a part ``share`` of edge pixels lie anywhere between the nearest and the farthest of 3x3."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), kernel)
    chosen = at_edge & (depth_m > 0)
    chosen[chosen] = rng.random(np.count_nonzero(chosen)) < share
    result, near, far = depth_m.copy(), near[chosen], cv2.dilate(depth_m, kernel)[chosen]
    result[chosen] = near + (far - near) * rng.random(len(near), np.float32)
    return result


def _without(depth_m: Image, lost: BoolArray) -> Image:
    return np.where(lost, np.float32(0), depth_m)
