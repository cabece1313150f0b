"""Regions from label images: one image a frame, each value above 0 one region of it.

``pattern`` names the image of a frame below ``folder``: ``{index}`` stands for the frame's number with any zeros before
it, ``{dataset}`` and ``{scene}`` for the scene. Images are PNG with one channel of 8 or 16 bits, of the frame's size.
``names``, a TOML or JSON file, maps values to names (``48 = "book"``); a region without one is named by the encoder.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_bytes, file_text
from su3d_bench.core.toml import parse_toml
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Regions, SceneInfo
from su3d_bench.formats.images import decoded, whole_png_header
from su3d_bench.perception.crops import mask_boxes
from su3d_bench.perception.stored.source import StoredFrame, check_masks, numbered_files

MAX_NAMES_BYTES = 1 << 20
MAX_NAME_LENGTH = 100


@dataclass(frozen=True)
class LabelledRegions:
    """Regions of one image by ascending value: masks (K, H, W), boxes (K, 4) as in ``Regions``, names where given."""

    values: tuple[int, ...]
    masks: BoolArray
    boxes: Float32Array
    names: tuple[str | None, ...]


class LabelImages:
    """The label images of a scene; ``files`` are those that a run reads, the names' file first."""

    name = "label images"

    def __init__(self, folder: Path, pattern: str, names: Path | None, scene: SceneInfo) -> None:
        self._where = f"{scene.dataset}/{scene.scene}"
        self._pattern = pattern
        self._images = numbered_files(folder, pattern, scene, self._where)
        self._name_of = {} if names is None else read_names(names, self._where)
        self.files = (*(() if names is None else (names,)), *self._images.values())

    def regions(self, frame: Frame) -> LabelledRegions:
        """What the image of ``frame`` shows; raises ``DataError``."""
        path = self._images.get(frame.index)
        if path is None:
            raise DataError(
                f"{self._where}: no label image for frame {frame.index} matches {self._pattern!r}; a frame without "
                "regions has an image of zeros"
            )
        labels = decode_labels(path, frame.depth_m.shape, f"{self._where}: {path.name}")
        values = [int(value) for value in np.unique(labels) if value > 0]
        check_masks(len(values), labels.shape, f"{self._where}: {path.name}")
        masks = np.empty((len(values), *labels.shape), np.bool_)
        for mask, value in zip(masks, values, strict=True):
            np.equal(labels, value, out=mask)
        return LabelledRegions(
            tuple(values), masks, mask_boxes(masks), tuple(self._name_of.get(value) for value in values)
        )

    def frame(self, frame: Frame) -> StoredFrame:
        """The same with "" for a name that is not given, and no score below another."""
        labelled = self.regions(frame)
        names = tuple(name or "" for name in labelled.names)
        return StoredFrame(Regions(labelled.masks, labelled.boxes, np.ones(len(names), np.float32), names))


def decode_labels(path: Path, shape: tuple[int, ...], where: str) -> NDArray[Any]:
    """Values (H, W) of a label image of this ``shape``; its header is believed before anything is decoded."""
    import cv2

    try:
        content = file_bytes(path)
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}") from error
    header = whole_png_header(content)
    if header is None:
        raise DataError(f"{where}: not a readable PNG image; write it again")
    width, height, bits, colour_type = header
    if bits not in (8, 16) or colour_type != 0:
        raise DataError(
            f"{where}: not a label image: {bits} bits, PNG colour type {colour_type}; expected one grey channel of 8 "
            "or 16 bits"
        )
    if (height, width) != tuple(shape):
        raise DataError(f"{where} is {width}x{height}, the frame has width {shape[1]} and height {shape[0]}")
    labels = decoded(content, cv2.IMREAD_UNCHANGED)
    if labels is None or labels.shape != (height, width):
        raise DataError(f"{where}: not a readable PNG image; write it again")
    return np.asarray(labels)


def read_names(path: Path, where: str) -> dict[int, str]:
    """Value -> name out of a TOML or JSON table whose keys are the values."""
    where = f"{where}: {path.name}"
    try:
        if path.stat().st_size > MAX_NAMES_BYTES:
            raise DataError(f"{where} has {path.stat().st_size} bytes; expected a table of names")
        text = file_text(path)
        table = json.loads(text) if path.suffix == ".json" else parse_toml(text)
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f'{where}: not a TOML or JSON table of names by value, such as 48 = "book"') from error
    if not isinstance(table, dict):
        raise DataError(f'{where}: not a table; expected names by value, such as {{"48": "book"}}')
    names: dict[int, str] = {}
    for key, name in table.items():
        if not re.fullmatch(r"[0-9]{1,5}", key) or not 0 < int(key) < 1 << 16:
            raise DataError(f"{where}: {key[:20]!r} is no value of a label image; expected 1 to 65535")
        if not (isinstance(name, str) and name.strip() and name.isprintable() and len(name) <= MAX_NAME_LENGTH):
            raise DataError(f"{where}: the name of {key} is {str(name)[:40]!r}; expected a short text")
        names[int(key)] = name.strip()
    return names
