"""Regions from label images: one image a frame, each value above 0 one region of it.

``pattern`` names the image of a frame below ``folder``: ``{index}`` stands for the frame's number with any zeros before
it, ``{dataset}`` and ``{scene}`` for the scene. Images are PNG with one channel of 8 or 16 bits, of the frame's size.
``names``, a TOML or JSON file, maps values to names (``48 = "book"``); a region without one is named by the encoder.
"""

from __future__ import annotations

import json
import re
import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.types import BoolArray, Float32Array, Frame, SceneInfo

INDEX = "{index}"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_NAMES_BYTES = 1 << 20
MAX_NAME_LENGTH = 100
MAX_REGIONS = 1_000  # masks take an image of memory each; no image has more things in it


@dataclass(frozen=True)
class LabelledRegions:
    """Regions of one image by ascending value: masks (K, H, W), boxes (K, 4) as in ``Regions``, names where given."""

    values: tuple[int, ...]
    masks: BoolArray
    boxes: Float32Array
    names: tuple[str | None, ...]


class LabelImages:
    """The label images of a scene; ``files`` are those that a run reads, the names' file first."""

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
        if len(values) > MAX_REGIONS:
            raise DataError(f"{self._where}: {path.name} holds {len(values)} values; expected one a region")
        masks = np.array([labels == value for value in values], bool).reshape(-1, *labels.shape)
        boxes = np.array([_box(mask) for mask in masks], np.float32).reshape(-1, 4)
        return LabelledRegions(tuple(values), masks, boxes, tuple(self._name_of.get(value) for value in values))


def _box(mask: BoolArray) -> tuple[int, int, int, int]:
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _inside(folder: Path, name: str, where: str, key: str) -> Path:
    """``folder / name``, unless that leads out of the folder."""
    path = folder / name
    is_plain = name.isprintable() and bool(name) and not name.startswith("/") and ".." not in PurePosixPath(name).parts
    try:
        if is_plain and path.resolve().is_relative_to(folder.resolve()):
            return path
    except (OSError, RuntimeError):  # a name too long for the file system, or links in a circle
        pass
    raise ConfigError(f"{where}: {key}: {name[:80]!r} leads out of {folder}; name files inside it")


def numbered_files(
    folder: Path, pattern: str, scene: SceneInfo, where: str, what: str = "label image", key: str = "images"
) -> dict[int, Path]:
    """Frame number -> file; ``what`` such a file is, and the ``key`` of the configuration that holds ``pattern``."""
    key = f"perception.stored.{key}"
    filled = pattern.replace("{dataset}", scene.dataset).replace("{scene}", scene.scene)
    directory, _, name_pattern = filled.rpartition("/")
    if INDEX not in name_pattern or filled.count(INDEX) > 1 or "{" in filled.replace(INDEX, ""):
        raise ConfigError(
            f"{key} = {pattern[:80]!r}: expected one {{index}} in the file's name, such as 'frame{{index}}.png', and "
            "no other braces but {dataset} and {scene}"
        )
    parent = _inside(folder, directory or ".", where, key)
    before, _, behind = name_pattern.partition(INDEX)
    form = re.compile(re.escape(before) + r"(\d{1,18})" + re.escape(behind), re.ASCII)
    found: dict[int, Path] = {}
    try:
        for path in sorted(parent.iterdir()):
            if match := form.fullmatch(path.name):
                number = int(match[1])
                if number in found:
                    raise DataError(
                        f"{where}: {found[number].name} and {path.name} are of one frame; expected one file"
                    )
                found[number] = _inside(folder, path.relative_to(folder).as_posix(), where, key)
    except OSError as error:
        raise DataError(f"{where}: {parent}: cannot be read: {error.strerror}; it should hold {what}s") from error
    if not found:
        raise DataError(f"{where}: no {what} in {parent} matches {pattern!r}")
    return dict(sorted(found.items()))


def decode_labels(path: Path, shape: tuple[int, ...], where: str) -> NDArray[Any]:
    """Values (H, W) of a label image of this ``shape``; its header is believed before anything is decoded."""
    import cv2

    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{where} cannot be read: {error.strerror}") from error
    if not _is_whole_png(content):
        raise DataError(f"{where}: not a readable PNG image; write it again")
    width, height = int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    bits, colour_type = content[24], content[25]
    if bits not in (8, 16) or colour_type != 0:
        raise DataError(
            f"{where}: not a label image: {bits} bits, PNG colour type {colour_type}; expected one grey channel of 8 "
            "or 16 bits"
        )
    if (height, width) != tuple(shape):
        raise DataError(f"{where} is {width}x{height}, the frame has width {shape[1]} and height {shape[0]}")
    try:
        labels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        labels = None
    if labels is None or labels.shape != (height, width):
        raise DataError(f"{where}: not a readable PNG image; write it again")
    return np.asarray(labels)


def _is_whole_png(content: bytes) -> bool:
    """Whether every chunk is there with its checksum right; decoders pass over damage."""
    if not content.startswith(PNG_SIGNATURE) or len(content) < 33 or content[12:16] != b"IHDR":
        return False
    at, kind = len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(content) or zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return False
        at = end + 4
    return True


def read_names(path: Path, where: str) -> dict[int, str]:
    """Value -> name out of a TOML or JSON table whose keys are the values."""
    where = f"{where}: {path.name}"
    try:
        if path.stat().st_size > MAX_NAMES_BYTES:
            raise DataError(f"{where} has {path.stat().st_size} bytes; expected a table of names")
        text = path.read_text(encoding="utf-8")
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
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
