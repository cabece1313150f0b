"""Corruptions of colour images from ImageNet-C: Hendrycks and Dietterich, "Benchmarking neural network robustness to
common corruptions and perturbations", ICLR 2019.

Ten of its fifteen: those that a camera indoors may meet. Fog, frost and snow are weather, glass blur is a pane of
frosted glass, and motion blur follows the camera's own motion in the family ``light``.

The constants are the published ones as generalised to any image size in imagecorruptions 1.1.2 (Michaelis et al.,
"Benchmarking robustness in object detection", 2019), whose bytes these functions return for the same random numbers.
Values are floats in 0..1; bytes are cut off, not rounded, as there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Float32Array, Float64Array, FloatArray, Frame, UInt8Array
from su3d_bench.corruptions.model import Corruption, FrameFunction, Recording
from su3d_bench.corruptions.sensors import colour

ImageFunction = Callable[[UInt8Array, float, Generator], UInt8Array]
DEFOCUS = ((3, 0.1), (4, 0.5), (6, 0.5), (8, 0.5), (10, 0.5))  # radius of the disc, sigma that smooths its edge; px
ZOOM = ((1.11, 0.01), (1.16, 0.01), (1.21, 0.02), (1.26, 0.02), (1.31, 0.03))  # up to this factor, in such steps


def gaussian_noise(rgb: UInt8Array, sigma: float, rng: Generator) -> UInt8Array:
    return _bytes(rgb / 255.0 + sigma * rng.standard_normal(rgb.shape))


def shot_noise(rgb: UInt8Array, variance: float, rng: Generator) -> UInt8Array:
    """Counts of photons, of which white has 1 / ``variance`` on average."""
    n_photons = 1.0 / variance
    return _bytes(rng.poisson(rgb / 255.0 * n_photons) / n_photons)


def impulse_noise(rgb: UInt8Array, share: float, rng: Generator) -> UInt8Array:
    """A part ``share`` of the samples black or white, each colour on its own."""
    is_changed, is_white = rng.random(rgb.shape) <= share, rng.random(rgb.shape) <= 0.5
    return np.where(is_changed, is_white * np.uint8(255), rgb)


def defocus_blur(rgb: UInt8Array, severity: float, rng: Generator) -> UInt8Array:
    """The image convolved with a disc."""
    import cv2

    radius, sigma = DEFOCUS[round(severity) - 1]
    reach, width = (8, 3) if radius <= 8 else (radius, 5)
    squares = np.arange(-reach, reach + 1) ** 2
    disc = (squares + squares[:, None] <= radius**2).astype(np.float32)
    kernel = cv2.GaussianBlur(disc / disc.sum(), (width, width), sigma)
    image = rgb / 255.0
    return _bytes(np.stack([cv2.filter2D(image[..., channel], -1, kernel) for channel in range(3)], axis=-1))


def zoom_blur(rgb: UInt8Array, severity: float, rng: Generator) -> UInt8Array:
    """The mean of the image and of enlargements of its middle, each aligned at the top left corner."""
    from scipy.ndimage import zoom

    image = (rgb / 255.0).astype(np.float32)
    end, step = ZOOM[round(severity) - 1]
    factors = np.arange(1, end, step)
    total = np.zeros_like(image)
    for factor in factors:
        height, width = (int(np.ceil(side / float(factor))) for side in rgb.shape[:2])
        top, left = (rgb.shape[0] - height) // 2, (rgb.shape[1] - width) // 2
        layer = zoom(image[top : top + height, left : left + width], (factor, factor, 1), order=1)
        layer = layer[: rgb.shape[0], : rgb.shape[1]]
        total[: layer.shape[0], : layer.shape[1]] += layer  # rounding may leave it a pixel short
    return _bytes((image + total) / (len(factors) + 1))


def brightness(rgb: UInt8Array, added: float, rng: Generator) -> UInt8Array:
    """The value of HSV raised by ``added``, up to 1, at the same hue and saturation."""
    from matplotlib.colors import hsv_to_rgb, rgb_to_hsv

    hsv = rgb_to_hsv(rgb / 255.0)
    hsv[..., 2] = np.minimum(hsv[..., 2] + added, 1)
    return _bytes(hsv_to_rgb(hsv))


def contrast(rgb: UInt8Array, factor: float, rng: Generator) -> UInt8Array:
    """Differences from the mean of each colour, times ``factor``."""
    image = rgb / 255.0
    means = image.mean(axis=(0, 1), keepdims=True)
    return _bytes((image - means) * factor + means)


def elastic_transform(rgb: UInt8Array, strength: float, rng: Generator) -> UInt8Array:
    """The image sampled beside each pixel, by smooth random distances of about ``strength`` times the height."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    height, width = rgb.shape[:2]
    reach, sigma = height * 0.005, (height * 0.01, width * 0.01)

    def distances() -> Float32Array:
        drawn = -reach + (reach - -reach) * rng.random((height, width))
        smooth: Float64Array = gaussian_filter(drawn, sigma, mode="reflect", truncate=3)
        return (smooth * (250 * strength)).astype(np.float32)

    to_u, to_v = np.arange(width) + distances(), np.arange(height)[:, None] + distances()
    image = rgb.astype(np.float32) / np.float32(255)
    channels = [map_coordinates(image[..., k], (to_v, to_u), order=1, mode="reflect") for k in range(3)]
    return _bytes(np.stack(channels, axis=-1))


def pixelate(rgb: UInt8Array, factor: float, rng: Generator) -> UInt8Array:
    """The image reduced by ``factor`` and enlarged again, in visible squares."""
    from PIL import Image  # installed with matplotlib; OpenCV's areas weight pixels at their rims otherwise

    height, width = rgb.shape[:2]
    small = Image.fromarray(rgb).resize((int(width * factor), int(height * factor)), Image.Resampling.BOX)
    return np.asarray(small.resize((width, height), Image.Resampling.NEAREST))


def jpeg(rgb: UInt8Array, quality: float, rng: Generator) -> UInt8Array:
    return colour.jpeg(rgb, round(quality))


def _bytes(image: FloatArray) -> UInt8Array:
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def _of_frame(function: ImageFunction) -> FrameFunction:
    @wraps(function)
    def of_frame(frame: Frame, value: float, rng: Generator, recording: Recording) -> Frame:
        return replace(frame, rgb=function(frame.rgb, value, rng))

    return of_frame


def _row(
    function: ImageFunction, unit: str, values: tuple[float, float, float, float, float], neutral: float = 0.0,
    is_whole: bool = False,
) -> Corruption:  # fmt: skip
    name = function.__name__.replace("_", "-")
    source = (
        f"ImageNet-C (Hendrycks and Dietterich 2019), {'jpeg_compression' if name == 'jpeg' else function.__name__}"
    )
    return Corruption("image", name, "frame", _of_frame(function), unit, values, source, neutral, is_whole)


ROWS: tuple[Corruption, ...] = (
    _row(gaussian_noise, "standard deviation, white = 1", (0.08, 0.12, 0.18, 0.26, 0.38)),
    _row(shot_noise, "variance at white = 1 / photons", (1 / 60, 1 / 25, 1 / 12, 1 / 5, 1 / 3)),
    _row(impulse_noise, "share of samples", (0.03, 0.06, 0.09, 0.17, 0.27)),
    _row(defocus_blur, "severity of ImageNet-C", (1, 2, 3, 4, 5), is_whole=True),
    _row(zoom_blur, "severity of ImageNet-C", (1, 2, 3, 4, 5), is_whole=True),
    _row(brightness, "added value of HSV", (0.1, 0.2, 0.3, 0.4, 0.5)),
    _row(contrast, "factor of contrast", (0.4, 0.3, 0.2, 0.1, 0.05), neutral=1.0),
    _row(elastic_transform, "strength alpha / 250", (0.05, 0.065, 0.085, 0.1, 0.12)),
    _row(pixelate, "factor of resolution", (0.6, 0.5, 0.4, 0.3, 0.25), neutral=1.0),
    _row(jpeg, "JPEG quality", (25, 18, 15, 10, 7), neutral=100.0, is_whole=True),
)
