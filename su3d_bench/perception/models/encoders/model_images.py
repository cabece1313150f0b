"""Images as the segmenter, the detector and the tagger take them: resized by Pillow, shifted and scaled."""

from __future__ import annotations

from typing import Literal

import numpy as np

from su3d_bench.core.types import Float32Array, UInt8Array

# ImageNet's mean and standard deviation of red, green and blue in 0..1, which all three models were trained with.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
# The same in 0..255 as SAM has them (segment-anything dca509f, build_sam.py).
MEAN_OF_BYTES = (123.675, 116.28, 103.53)
STD_OF_BYTES = (58.395, 57.12, 57.375)
Resample = Literal["bilinear", "bicubic"]


def resized(rgb: UInt8Array, height: int, width: int, resample: Resample = "bilinear") -> UInt8Array:
    """``rgb`` (h, w, 3) at another size, with Pillow's antialiasing: the originals' transform."""
    from PIL import Image

    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling[resample.upper()]))


def normalised(rgb: UInt8Array) -> Float32Array:
    """``rgb`` (h, w, 3) as channels first (3, h, w) float32 with ImageNet's mean taken off, in its deviations.

    Divided by 255 first, as torchvision's ToTensor and Normalize do: the detector's and the tagger's order.
    """
    return _standardised(rgb.astype(np.float32) / np.float32(255), MEAN, STD)


def normalised_bytes(rgb: UInt8Array) -> Float32Array:
    """The same without the division by 255, SAM's order (``Sam.preprocess``): other last bits."""
    return _standardised(rgb.astype(np.float32), MEAN_OF_BYTES, STD_OF_BYTES)


def _standardised(
    values: Float32Array, mean: tuple[float, float, float], std: tuple[float, float, float]
) -> Float32Array:
    standard = (values - np.array(mean, np.float32)) / np.array(std, np.float32)
    return np.ascontiguousarray(standard.transpose(2, 0, 1))


def size_with_longest_side(height: int, width: int, longest_px: int) -> tuple[int, int]:
    """Height and width at which the longer side is ``longest_px``, each rounded, halves upwards: SAM's rule."""
    scale = longest_px * 1.0 / max(height, width)
    return int(height * scale + 0.5), int(width * scale + 0.5)


def size_with_shortest_side(height: int, width: int, shortest_px: int, longest_px: int) -> tuple[int, int]:
    """Height and width with the shorter side at ``shortest_px``, or less where the longer would pass ``longest_px``.

    GroundingDINO's rule (856dde2, datasets/transforms.py, ``resize``): the shorter side is rounded first and the longer
    one follows from it, cut to whole pixels. Where ``longest_px`` binds, transformers' longer side is off from that by
    up to half a pixel times the sides' ratio.

    >>> size_with_shortest_side(680, 1200, 800, 1333)
    (755, 1332)
    """
    short, long = min(height, width), max(height, width)
    if long / short * shortest_px > longest_px:
        shortest_px = round(longest_px * float(short) / long)
    if short == shortest_px:
        return height, width
    other = int(shortest_px * long / short)
    return (other, shortest_px) if width < height else (shortest_px, other)
