"""Images as the segmenter, the detector and the tagger take them: resized by Pillow, shifted and scaled."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import Float32Array, UInt8Array

# ImageNet's mean and standard deviation of red, green and blue in 0..1, which all three models were trained with.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


def resized(rgb: UInt8Array, height: int, width: int) -> UInt8Array:
    """``rgb`` (h, w, 3) at another size, bilinear with Pillow's antialiasing: the originals' transform."""
    from PIL import Image

    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR))


def normalised(rgb: UInt8Array) -> Float32Array:
    """``rgb`` (h, w, 3) as channels first (3, h, w) float32 with ImageNet's mean taken off, in its deviations."""
    shares = rgb.astype(np.float32) / np.float32(255)
    values = (shares - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return np.ascontiguousarray(values.transpose(2, 0, 1))


def size_with_longest_side(height: int, width: int, longest_px: int) -> tuple[int, int]:
    """Height and width at which the longer side is ``longest_px``, each rounded, halves upwards: SAM's rule."""
    scale = longest_px * 1.0 / max(height, width)
    return int(height * scale + 0.5), int(width * scale + 0.5)


def size_with_shortest_side(height: int, width: int, shortest_px: int, longest_px: int) -> tuple[int, int]:
    """Height and width with the shorter side at ``shortest_px``, or less where the longer would pass ``longest_px``.

    DETR's rule as transformers has it: the longer side is cut to whole pixels. The original GroundingDINO rounds the
    shorter side first, so its longer side is up to a pixel or two smaller where ``longest_px`` binds.
    """
    short, long = min(height, width), max(height, width)
    exact = float(shortest_px)
    if long / short * shortest_px > longest_px:
        exact = longest_px * float(short) / long
    rounded = round(exact)
    if short == rounded:
        return height, width
    other = int(exact * long / short)
    return (rounded, other) if height <= width else (other, rounded)
