"""Image preprocessing for foundation models: per encoder, and one for segmenter, detector and tagger.

Two conventions exist for encoders. ``original`` is what open_clip and OpenAI's CLIP do, through torchvision on PIL
images; ``transformers`` is what that library's PIL image processors do. They only differ in the centre crop: if the
surplus is 3, 7, 11 ... pixels, the windows are one pixel apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeGuard

import numpy as np
from pydantic import ConfigDict, Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.perception.models.files import checked, read_settings

Convention = Literal["original", "transformers"]
Triple = tuple[float, float, float]
# Bounds of a mean or a deviation; real ones are between 0 and 255.
Mean = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Deviation = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]

# OpenAI's CLIP, clip.py, and all models based on it.
CLIP_MEAN: Triple = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD: Triple = (0.26862954, 0.26130258, 0.27577711)
BICUBIC = 3  # PIL.Image.Resampling.BICUBIC, and ``resample`` in transformers' files
TRANSFORM_VERSION = "1"
LARGEST_SIZE = 2048


@dataclass(frozen=True)
class ImageTransform:
    """The preprocessing of an encoder: resize, centre crop, mean and standard deviation of the channels.

    ``fit`` ``shortest``: the shorter side becomes ``size`` and the middle square is cropped; ``squash``: both sides
    become ``size``, regardless of the aspect ratio. ``resample`` is PIL's number of the filter.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    size: Annotated[int, Field(ge=1, le=LARGEST_SIZE)]
    fit: Literal["shortest", "squash"] = "shortest"
    mean: tuple[Mean, Mean, Mean] = CLIP_MEAN
    std: tuple[Deviation, Deviation, Deviation] = CLIP_STD
    resample: Annotated[int, Field(ge=0, le=5)] = BICUBIC
    convention: Convention = "original"

    def settings(self) -> dict[str, Any]:
        """Everything that affects a pixel, as JSON-like values."""
        return {**asdict(self), "version": TRANSFORM_VERSION}

    def pixels(self, images: Sequence[UInt8Array]) -> Float32Array:
        """Pixels (N, 3, size, size) of RGB images (h, w, 3)."""
        rows = np.zeros((len(images), 3, self.size, self.size), np.float32)
        for row, image in enumerate(images):
            rows[row] = self._values(self._square(check_image(image, row))).transpose(2, 0, 1)
        return rows

    def _square(self, image: UInt8Array) -> UInt8Array:
        from PIL import Image

        height, width = image.shape[:2]
        if self.fit == "squash":
            new_height = new_width = self.size
        else:
            # the longer side is truncated to whole pixels, as in torchvision's Resize and transformers
            long = int(self.size * max(height, width) / min(height, width))
            new_height, new_width = (self.size, long) if height <= width else (long, self.size)
        # PIL's filter widens if the image shrinks, which is "antialias" in torchvision
        resized = np.asarray(Image.fromarray(image).resize((new_width, new_height), Image.Resampling(self.resample)))
        top, left = self._offset(new_height - self.size), self._offset(new_width - self.size)
        return np.asarray(resized[top : top + self.size, left : left + self.size], np.uint8)

    def _offset(self, surplus: int) -> int:
        # torchvision's CenterCrop rounds halves to even; transformers truncates
        return round(surplus / 2.0) if self.convention == "original" else surplus // 2

    def _values(self, square: UInt8Array) -> Float32Array:
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        # transformers multiplies by 1/255 in float64 instead, with the same float32 results for all 256 values
        return np.asarray((square.astype(np.float32) / np.float32(255) - mean) / std, np.float32)


def check_image(image: UInt8Array, row: int) -> UInt8Array:
    """``image`` itself, contiguous; raises ``DataError`` if it is not an RGB image with pixels."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise DataError(f"image {row}: {image.shape} {image.dtype}; expected (height, width, 3) uint8, not empty")
    return np.ascontiguousarray(image)


def read_transform(path: Path, convention: Convention) -> ImageTransform:
    """The transform in a ``preprocessor_config.json``; an unusual step is rejected, never skipped."""
    content = read_settings(path)
    for step in ("do_resize", "do_rescale", "do_normalize"):
        if content.get(step, True) is not True:
            raise DataError(f"{path}: {step} is {content[step]!r}; only true is supported")
    factor = content.get("rescale_factor", 1 / 255)
    if not isinstance(factor, float | int) or not 0 <= factor <= 1 or abs(factor - 1 / 255) > 1e-9:
        raise DataError(f"{path}: rescale_factor is {str(factor)[:40]}; expected 1/255")
    fit, size = _size(path, content)
    read = {"mean": content.get("image_mean"), "std": content.get("image_std")}
    read |= {"resample": content.get("resample", BICUBIC), "convention": convention}
    return checked(ImageTransform, {"fit": fit, "size": size, **read}, path)


def _size(path: Path, content: Mapping[str, Any]) -> tuple[Literal["shortest", "squash"], int]:
    """Kind and size of the resize step; older files write a bare number for the shortest side."""
    size = content.get("size")
    does_crop = content.get("do_center_crop", content.get("image_processor_type") != "SiglipImageProcessor") is True
    if isinstance(size, int):
        size = {"shortest_edge": size}
    if isinstance(size, Mapping):
        shortest = size.get("shortest_edge")
        square = size.get("height"), size.get("width")
        if does_crop and _is_size(shortest):
            crop = content.get("crop_size", shortest)
            sides = list(crop.values()) if isinstance(crop, Mapping) else [crop]
            if sides and all(side == shortest for side in sides):
                return "shortest", shortest
        elif not does_crop and square[0] == square[1] and _is_size(square[0]):
            return "squash", square[0]
    raise DataError(
        f"{path}: size {str(size)[:80]} with crop_size {str(content.get('crop_size'))[:80]}; expected a shortest edge "
        "with a crop of the same size, or a square without one"
    )


def _is_size(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= LARGEST_SIZE


# ImageNet's mean and standard deviation of red, green and blue in 0..1, used in training all three models.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
# The same in 0..255 as in SAM (segment-anything dca509f, build_sam.py).
MEAN_OF_BYTES = (123.675, 116.28, 103.53)
STD_OF_BYTES = (58.395, 57.12, 57.375)
Resample = Literal["bilinear", "bicubic"]


def resized(rgb: UInt8Array, height: int, width: int, resample: Resample = "bilinear") -> UInt8Array:
    """``rgb`` (h, w, 3) resized with Pillow's antialiasing, as in the originals."""
    from PIL import Image

    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling[resample.upper()]))


def normalised(rgb: UInt8Array) -> Float32Array:
    """``rgb`` (h, w, 3) as channels first (3, h, w) float32, standardised with ImageNet's mean and deviation.

    Divided by 255 first, as in torchvision's ToTensor and Normalize: the order for the detector and the tagger.
    """
    return _standardised(rgb.astype(np.float32) / np.float32(255), MEAN, STD)


def normalised_bytes(rgb: UInt8Array) -> Float32Array:
    """The same without the division by 255, as in SAM (``Sam.preprocess``), which changes the last bits."""
    return _standardised(rgb.astype(np.float32), MEAN_OF_BYTES, STD_OF_BYTES)


def _standardised(
    values: Float32Array, mean: tuple[float, float, float], std: tuple[float, float, float]
) -> Float32Array:
    standard = (values - np.array(mean, np.float32)) / np.array(std, np.float32)
    return np.ascontiguousarray(standard.transpose(2, 0, 1))


def size_with_longest_side(height: int, width: int, longest_px: int) -> tuple[int, int]:
    """Height and width with the longer side at ``longest_px``, each rounded, halves upwards: SAM's rule."""
    scale = longest_px * 1.0 / max(height, width)
    return int(height * scale + 0.5), int(width * scale + 0.5)


def size_with_shortest_side(height: int, width: int, shortest_px: int, longest_px: int) -> tuple[int, int]:
    """Height and width with the shorter side at ``shortest_px``, or less if the longer would exceed ``longest_px``.

    GroundingDINO's rule (856dde2, datasets/transforms.py, ``resize``): the shorter side is rounded first and the longer
    one computed from it, truncated to whole pixels. If ``longest_px`` is the limit, transformers' longer side differs
    from that by up to half a pixel times the aspect ratio.

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
