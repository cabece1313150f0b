"""From a crop of any size to the pixels that an encoder was trained on.

Two conventions exist for the same recipe. ``original`` is what open_clip and OpenAI's CLIP do, through torchvision on
PIL images; ``transformers`` is what that library's PIL image processors do. They differ in the centre crop alone:
where the surplus is 3, 7, 11 ... pixels, the windows lie one pixel apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard

import numpy as np
from pydantic import ConfigDict

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.perception.models.files import read_settings

Convention = Literal["original", "transformers"]
Triple = tuple[float, float, float]

# OpenAI's CLIP, clip.py, and everything that was trained after it.
CLIP_MEAN: Triple = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD: Triple = (0.26862954, 0.26130258, 0.27577711)
BICUBIC = 3  # PIL.Image.Resampling.BICUBIC, and ``resample`` in transformers' files
TRANSFORM_VERSION = "1"
LARGEST_SIZE = 2048
LARGEST_VALUE = 1e6  # of a mean or a deviation; real ones lie between 0 and 255


@dataclass(frozen=True)
class ImageTransform:
    """The recipe of an encoder: resize, centre crop, mean and standard deviation of the channels.

    ``fit`` ``shortest``: the shorter side becomes ``size`` and the middle square is cut out; ``squash``: both sides
    become ``size``, whatever the aspect. ``resample`` is PIL's number of the filter.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    size: int
    fit: Literal["shortest", "squash"] = "shortest"
    mean: Triple = CLIP_MEAN
    std: Triple = CLIP_STD
    resample: int = BICUBIC
    convention: Convention = "original"

    def settings(self) -> dict[str, Any]:
        """All that moves a pixel, as JSON-like values."""
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
            # the longer side is cut to whole pixels, as torchvision's Resize and transformers both have it
            long = int(self.size * max(height, width) / min(height, width))
            new_height, new_width = (self.size, long) if height <= width else (long, self.size)
        # PIL's filter widens where the image shrinks, which is what "antialias" means in torchvision
        resized = np.asarray(Image.fromarray(image).resize((new_width, new_height), Image.Resampling(self.resample)))
        top, left = self._offset(new_height - self.size), self._offset(new_width - self.size)
        return np.asarray(resized[top : top + self.size, left : left + self.size], np.uint8)

    def _offset(self, surplus: int) -> int:
        # torchvision's CenterCrop rounds the half, to the even neighbour; transformers cuts it off
        return round(surplus / 2.0) if self.convention == "original" else surplus // 2

    def _values(self, square: UInt8Array) -> Float32Array:
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        # transformers multiplies by 1/255 in float64 instead, which gives the same float32 for all 256 values
        return np.asarray((square.astype(np.float32) / np.float32(255) - mean) / std, np.float32)


def check_image(image: UInt8Array, row: int) -> UInt8Array:
    """``image`` itself, contiguous; raises ``DataError`` where it is no RGB image with pixels."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise DataError(f"image {row}: {image.shape} {image.dtype}; expected (height, width, 3) uint8, not empty")
    return np.ascontiguousarray(image)


def read_transform(path: Path, convention: Convention) -> ImageTransform:
    """The transform in a ``preprocessor_config.json``; a step that is not the usual one is refused, never skipped."""
    content = read_settings(path)
    for step in ("do_resize", "do_rescale", "do_normalize"):
        if content.get(step, True) is not True:
            raise DataError(f"{path}: {step} is {content[step]!r}; only true is supported")
    factor = content.get("rescale_factor", 1 / 255)
    if not isinstance(factor, float | int) or not 0 <= factor <= 1 or abs(factor - 1 / 255) > 1e-9:
        raise DataError(f"{path}: rescale_factor is {str(factor)[:40]}; expected 1/255")
    fit, size = _size(path, content)
    resample = content.get("resample", BICUBIC)
    if resample not in range(6):
        raise DataError(f"{path}: resample is {str(resample)[:40]}; expected a number of PIL's filters, 0 to 5")
    return ImageTransform(
        size, fit, _triple(path, content, "image_mean"), _triple(path, content, "image_std"), resample, convention
    )


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


def _triple(path: Path, content: Mapping[str, Any], key: str) -> Triple:
    values: Any = content.get(key)
    is_triple = isinstance(values, list) and len(values) == 3
    # The bound comes first: an integer of any length is compared, but not made a float.
    if is_triple and all(isinstance(value, float | int) and abs(value) <= LARGEST_VALUE for value in values):
        red, green, blue = (float(value) for value in values)
        if key == "image_mean" or min(red, green, blue) > 0:
            return red, green, blue
    raise DataError(f"{path}: {key} is {str(values)[:80]}; expected three numbers, those of a deviation above 0")
