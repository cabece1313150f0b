"""Corruptions of depth images; a missing pixel never gains depth.

The families are those of Xu et al. 2025 (arXiv 2501.14319) and of the Kinect's error models. In the public code of Xu
et al., noise turns holes into points, every edge is lost at every severity, one mode draws without a seed, and the
severity of random masks is computed but not used; here each severity extends the error of the one below it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import BoolArray, Frame
from su3d_bench.corruptions.model import Corruption, Recording
from su3d_bench.corruptions.sensors import depth
from su3d_bench.corruptions.sensors.colour import LUMINANCE, to_linear

HOLE_SHARE = 1 / 40  # smoothing of the field whose lowest places become holes, as a share of the image's width


def noise(frame: Frame, strength: float, rng: Generator, recording: Recording) -> Frame:
    """Lateral and axial noise of ``strength`` times the deviation that Nguyen et al. 2012 measured."""
    angle, (side, front) = depth.incidence(frame.depth_m, frame.intrinsics), rng.spawn(2)
    focal_px = float(frame.intrinsics[0, 0])
    moved = depth.lateral_noise(frame.depth_m, angle, side, strength, depth.WINDOW_PX, focal_px)
    return replace(frame, depth_m=depth.axial_noise(moved, angle, front, strength, depth.WINDOW_PX))


def quantisation(frame: Frame, step_px: float, rng: Generator, recording: Recording) -> Frame:
    """Depth whose disparity in a Kinect is a multiple of ``step_px``."""
    return replace(frame, depth_m=depth.quantise(frame.depth_m, step_px))


def edge_loss(frame: Frame, width_px: float, rng: Generator, recording: Recording) -> Frame:
    """Depth without all pixels within ``width_px`` of a jump in depth."""
    at_edge = depth.edges(frame.depth_m)
    return replace(frame, depth_m=depth.lose_edges(frame.depth_m, at_edge, int(width_px), 1.0, rng))


def flying_pixels(frame: Frame, share: float, rng: Generator, recording: Recording) -> Frame:
    """Depth where a part ``share`` of the pixels at jumps lie anywhere between the two surfaces."""
    mixture, choice = rng.spawn(2)
    mixed = depth.add_flying_pixels(frame.depth_m, depth.edges(frame.depth_m), 1.0, mixture)
    return replace(frame, depth_m=np.where(choice.random(mixed.shape) < share, mixed, frame.depth_m))


def holes(frame: Frame, share: float, rng: Generator, recording: Recording) -> Frame:
    """Depth without connected areas that cover a part ``share`` of the image."""
    lost = blobs(frame.depth_m.shape, share, frame.depth_m.shape[1] * HOLE_SHARE, rng)
    return replace(frame, depth_m=np.where(lost, np.float32(0), frame.depth_m))


def blobs(shape: tuple[int, ...], share: float, smoothing: float, rng: Generator) -> BoolArray:
    """Connected places that cover a part ``share`` of an array: the lowest of a smooth random field.

    The areas of a larger share contain those of a smaller one. ``smoothing``: deviation of the Gaussian in places.
    """
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(rng.standard_normal(shape), smoothing, mode="nearest", truncate=3.0)
    lost = np.zeros(field.size, bool)
    lost[np.argsort(field, axis=None, kind="stable")[: round(share * field.size)]] = True
    return lost.reshape(shape)


def dark_holes(frame: Frame, min_luminance: float, rng: Generator, recording: Recording) -> Frame:
    """Depth without pixels whose luminance (0..1, linear light) is lower: black surfaces return too little light.

    The colour image is used instead of the material, which is known only in rendered scenes.
    """
    lost = to_linear(frame.rgb) @ LUMINANCE < min_luminance
    return replace(frame, depth_m=np.where(lost, np.float32(0), frame.depth_m))


def limited_range(frame: Frame, inverse_far: float, rng: Generator, recording: Recording) -> Frame:
    """Depth up to 1 / ``inverse_far`` metres. The inverse is linear in disparity, and 0 is an unlimited range."""
    far_m = 1 / inverse_far if inverse_far else np.inf
    return replace(frame, depth_m=depth.limit_range(frame.depth_m, 0.0, far_m))


def scale(frame: Frame, percent: float, rng: Generator, recording: Recording) -> Frame:
    """Depth that is too far or too near by ``percent``."""
    return replace(frame, depth_m=depth.scale(frame.depth_m, 1 + float(rng.choice((-1, 1))) * percent / 100))


ROWS: tuple[Corruption, ...] = (
    Corruption(
        "depth", "noise", "frame", noise, "times the Kinect's deviation", (0.5, 1.0, 2.0, 4.0, 8.0),
        "1 is the Kinect's (Nguyen, Izadi and Lovell 2012), 2.6 cm at 4 m; ours: halved and doubled.",
    ),
    Corruption(
        "depth", "quantisation", "frame", quantisation, "px of disparity", (0.125, 0.25, 0.5, 1.0, 2.0),
        "1/8 px is the Kinect's (Konolige and Mihelich, ROS wiki); ours: doubled. 1 px is stereo matching without "
        "interpolation.",
    ),
    Corruption(
        "depth", "edge-loss", "frame", edge_loss, "px from an edge", (1.0, 2.0, 4.0, 6.0, 8.0),
        "4 px: all pixels whose window of 9 px (Konolige and Mihelich, ROS wiki) covers two surfaces; ours: halved "
        "and doubled.", is_whole=True,
    ),
    Corruption(
        "depth", "flying-pixels", "frame", flying_pixels, "share of edge pixels", (0.1, 0.25, 0.5, 0.75, 1.0),
        "ours: from the 0.1 of the sensor track of homes, where most mixed pixels are rejected, to none rejected.",
    ),
    Corruption(
        "depth", "holes", "frame", holes, "share of the image", (0.1, 0.15, 0.2, 0.25, 0.3),
        "Xu et al. 2025: 10 to 30 rectangles of 1 % each, as listed in their code.",
    ),
    Corruption(
        "depth", "dark-holes", "frame", dark_holes, "luminance", (0.01, 0.02, 0.04, 0.08, 0.16),
        "ours: doubled up to just below a grey card (0.18), which the Kinect still sees at 4 m; a black surface "
        "reflects 0.04 or less.",
    ),
    Corruption(
        "depth", "range", "frame", limited_range, "1/m", (1 / 5.46, 1 / 4.5, 1 / 3.86, 1 / 2.88, 1 / 2.21),
        "The farthest depths of real cameras: Azure Kinect's four modes 5.46, 3.86, 2.88 and 2.21 m and Kinect v2's "
        "4.5 m (Microsoft, hardware specifications).",
    ),
    Corruption(
        "depth", "scale", "frame", scale, "% of depth", (1.0, 2.0, 3.5, 5.0, 7.0),
        "3.5 % is TUM RGB-D's correction of its first camera (page on intrinsic calibration); ours: around it, up to "
        "twice as much.", per_scene=True,
    ),
)  # fmt: skip
