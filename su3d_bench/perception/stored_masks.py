"""Stored detections in external formats: label images and ConceptGraphs detections.

A label image is a PNG with one channel of 8 or 16 bits and the frame's size; each value above 0 is one region.
``pattern`` names the image of a frame below ``folder``: ``{index}`` stands for the frame's number with any zeros before
it, ``{dataset}`` and ``{scene}`` for the scene. ``names``, a TOML or JSON file, maps values to names (``48 = "book"``);
a region without one is named by the encoder.

ConceptGraphs' ``gsa_detections_*`` are one gzipped pickle per frame, read as data: a dict of ``xyxy`` (N, 4),
``confidence`` (N,), ``class_id`` (N,), ``mask`` (N, H, W) bool, ``classes``, a list of names, ``image_crops``, which
are ignored, ``image_feats`` and ``text_feats`` (N, D), as written by ``generate_gsa_results.py``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.system.files import file_bytes, file_text, parse_toml
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Regions, SceneInfo
from su3d_bench.formats.images import decoded, whole_png_header
from su3d_bench.formats.pickles import read_pickle_file
from su3d_bench.perception.cache import mask_boxes
from su3d_bench.perception.stored import StoredFrame, check_masks, numbered_files

MAX_NAMES_BYTES = 1 << 20
MAX_NAME_LENGTH = 100


class LabelImages:
    """The label images of a scene; ``files`` are those that a run reads, the file of names first."""

    name = "label images"

    def __init__(self, folder: Path, pattern: str, names: Path | None, scene: SceneInfo) -> None:
        self._where = f"{scene.dataset}/{scene.scene}"
        self._pattern = pattern
        self._images = numbered_files(folder, pattern, scene, self._where)
        self._name_of = {} if names is None else read_names(names, self._where)
        self.files = (*(() if names is None else (names,)), *self._images.values())

    def frame(self, frame: Frame) -> StoredFrame:
        """Regions by ascending value, "" for a missing name, all scores equal; raises ``DataError``."""
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
        names = tuple(self._name_of.get(value, "") for value in values)
        return StoredFrame(Regions(masks, mask_boxes(masks), np.ones(len(names), np.float32), names))


def decode_labels(path: Path, shape: tuple[int, ...], where: str) -> NDArray[Any]:
    """Values (H, W) of a label image of this ``shape``; its header is checked before anything is decoded."""
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
    """Value -> name from a TOML or JSON table whose keys are the values."""
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
            raise DataError(f"{where}: {key[:20]!r} is not a label value; expected 1 to 65535")
        if not (isinstance(name, str) and name.strip() and name.isprintable() and len(name) <= MAX_NAME_LENGTH):
            raise DataError(f"{where}: the name of {key} is {str(name)[:40]!r}; expected a short text")
        names[int(key)] = name.strip()
    return names


_SKIPPED = ("image_crops",)
# The encoder of the features in the files, and the padding of their crops: 20 px on every side of the box.
FEATURES_ENCODER, FEATURES_PADDING_PX = "clip-vit-h-14", 20


class GsaFiles:
    """The detections of a scene; ``files`` are those that a run may read."""

    name = "gsa"

    def __init__(self, folder: Path, pattern: str, scene: SceneInfo) -> None:
        self._where = f"{scene.dataset}/{scene.scene}"
        self._paths = numbered_files(folder, pattern, scene, self._where, "file of detections", "detections")
        self.files = tuple(self._paths.values())

    def frame(self, frame: Frame) -> StoredFrame:
        """The detections of ``frame``; raises ``DataError``, or ``PredictionError`` if the pickle is not plain data."""
        path = self._paths.get(frame.index)
        if path is None:
            raise DataError(
                f"{self._where}: missing detections of frame {frame.index}; run ConceptGraphs' "
                "generate_gsa_results.py with the stride of this run, or with 1"
            )
        where = f"{self._where}: {path.name}"
        content = read_pickle_file(path, forget=_SKIPPED)
        if not isinstance(content, dict):
            raise DataError(f"{where}: contains a {type(content).__name__}; expected a dict of detections")
        return _frame(content, frame, where)


def _frame(content: Mapping[object, object], frame: Frame, where: str) -> StoredFrame:
    height, width = frame.depth_m.shape
    scores = _numbers(content, "confidence", where).reshape(-1)
    n = len(scores)
    check_masks(n, (height, width), where)
    if not np.isfinite(scores).all():
        raise DataError(f"{where}: a confidence is not finite")
    masks = _masks(content, n, (height, width), where)
    corners = _numbers(content, "xyxy", where).astype(np.float64).reshape(-1, 4) if n else np.zeros((0, 4))
    if corners.shape != (n, 4) or not np.isfinite(corners).all():
        raise DataError(f"{where}: xyxy is {corners.shape}; expected {n} boxes of finite numbers")
    # As from the detector: a box may extend beyond the image, by at most half its size. This bounds hostile ones.
    size = np.array([width, height, width, height])
    boxes: Float32Array = np.clip(corners, -size, 2 * size).astype(np.float32)
    names = _names(content, n, where)
    features = _features(content, n, where)
    # SAM's predicted IoU may be slightly above 1. A mask without pixels is not a region; one that is one pixel wide is,
    # although SAM's box of it, from the first to the last pixel, has no width.
    kept = np.flatnonzero(masks.any(axis=(1, 2)) & (boxes[:, 2:] >= boxes[:, :2]).all(axis=1))
    scores = np.clip(scores[kept], 0, 1).astype(np.float32)
    regions = Regions(masks[kept], boxes[kept], scores, tuple(names[k] for k in kept), rows=kept.astype(np.int64))
    of_ratio = {} if features is None else {1.0: features[kept]}
    return StoredFrame(regions, of_ratio, made_by=FEATURES_ENCODER, made_at_px=FEATURES_PADDING_PX)


def _numbers(content: Mapping[object, object], key: str, where: str) -> NDArray[Any]:
    value = content.get(key)
    if isinstance(value, np.ndarray) and value.dtype.kind in "buif":
        return value
    if isinstance(value, list) and not value:
        return np.zeros(0)
    raise DataError(f"{where}: '{key}' is not a numeric array; write it with generate_gsa_results.py")


def _masks(content: Mapping[object, object], n: int, shape: tuple[int, int], where: str) -> BoolArray:
    masks = _numbers(content, "mask", where)
    if n == 0:
        return np.zeros((0, *shape), bool)
    if masks.shape != (n, *shape):
        raise DataError(
            f"{where}: masks are {masks.shape}, the frame has height {shape[0]} and width {shape[1]} and {n} "
            "detections; compute them from the dataset images at full resolution"
        )
    return masks.astype(bool, copy=False)


def _names(content: Mapping[object, object], n: int, where: str) -> tuple[str, ...]:
    classes, chosen = content.get("classes"), _numbers(content, "class_id", where).reshape(-1)
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise DataError(f"{where}: 'classes' is not a list of names")
    if len(chosen) != n or (chosen.dtype.kind not in "iu" and n):
        raise DataError(f"{where}: {len(chosen)} class numbers of type {chosen.dtype} for {n} detections")
    outside = chosen[(chosen < 0) | (chosen >= len(classes))]
    if len(outside):
        raise DataError(f"{where}: class number {int(outside[0])}; 'classes' has {len(classes)} names")
    names = tuple(printable(classes[int(k)].strip(), MAX_NAME_LENGTH) for k in chosen)
    if not all(names):
        raise DataError(f"{where}: a class has an empty name")
    return names


def _features(content: Mapping[object, object], n: int, where: str) -> Float32Array | None:
    if n == 0 or "image_feats" not in content:
        return None
    features = _numbers(content, "image_feats", where)
    lengths = np.linalg.norm(features.astype(np.float64), axis=-1) if features.ndim == 2 else np.zeros(0)
    # Computed in half precision in the original, so that lengths are 1 to the third decimal.
    if len(features) != n or features.ndim != 2 or not (np.abs(lengths - 1) < 1e-2).all():
        raise DataError(f"{where}: image_feats are {features.shape}; expected {n} rows of length 1")
    return (features / lengths[:, None]).astype(np.float32)
