"""ConceptGraphs' detections (``gsa_detections_*``): one gzipped pickle a frame, read as data.

A dict of ``xyxy`` (N, 4), ``confidence`` (N,), ``class_id`` (N,), ``mask`` (N, H, W) bool, ``classes``, a list of
names, ``image_crops``, which are passed over, ``image_feats`` and ``text_feats`` (N, D), as ``generate_gsa_results.py``
writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Regions, SceneInfo
from su3d_bench.formats.pickles import read_pickle_file
from su3d_bench.perception.stored.source import StoredFrame, check_masks, numbered_files

MAX_NAME_LENGTH = 100
_SKIPPED = ("image_crops",)
# Who made the features in the files, and of which crops: boxes and 20 px on every side.
FEATURES_ENCODER, FEATURES_PADDING_PX = "clip-vit-h-14", 20


class GsaFiles:
    """The detections of a scene; ``files`` are those that a run may read."""

    name = "gsa"

    def __init__(self, folder: Path, pattern: str, scene: SceneInfo) -> None:
        self._where = f"{scene.dataset}/{scene.scene}"
        self._paths = numbered_files(folder, pattern, scene, self._where, "file of detections", "detections")
        self.files = tuple(self._paths.values())

    def frame(self, frame: Frame) -> StoredFrame:
        """The detections of ``frame``; raises ``DataError`` or, for what is no plain pickle, ``PredictionError``."""
        path = self._paths.get(frame.index)
        if path is None:
            raise DataError(
                f"{self._where}: there are no detections of frame {frame.index}; run ConceptGraphs' "
                "generate_gsa_results.py with the stride of this run, or with 1"
            )
        where = f"{self._where}: {path.name}"
        content = read_pickle_file(path, forget=_SKIPPED)
        if not isinstance(content, dict):
            raise DataError(f"{where}: holds a {type(content).__name__}, expected a table of detections")
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
    # As the detector has them: a box may reach beyond the image, by half its size at most. That bounds hostile ones.
    size = np.array([width, height, width, height])
    boxes: Float32Array = np.clip(corners, -size, 2 * size).astype(np.float32)
    names = _names(content, n, where)
    features = _features(content, n, where)
    # SAM's predicted IoU may be a little above 1. A mask without pixels is no region; one that is a pixel wide is one,
    # though SAM's box of it, from the first to the last pixel, has no width.
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
    raise DataError(f"{where}: '{key}' is no array of numbers; it is written by generate_gsa_results.py")


def _masks(content: Mapping[object, object], n: int, shape: tuple[int, int], where: str) -> BoolArray:
    masks = _numbers(content, "mask", where)
    if n == 0:
        return np.zeros((0, *shape), bool)
    if masks.shape != (n, *shape):
        raise DataError(
            f"{where}: masks are {masks.shape}, the frame has height {shape[0]} and width {shape[1]} and {n} "
            "detections; they must be made from the images of the dataset at their own size"
        )
    return masks.astype(bool, copy=False)


def _names(content: Mapping[object, object], n: int, where: str) -> tuple[str, ...]:
    classes, chosen = content.get("classes"), _numbers(content, "class_id", where).reshape(-1)
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise DataError(f"{where}: 'classes' is no list of names")
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
    # Made in half precision in the original, whose lengths are 1 to the third decimal.
    if len(features) != n or features.ndim != 2 or not (np.abs(lengths - 1) < 1e-2).all():
        raise DataError(f"{where}: image_feats are {features.shape}; expected {n} rows of length 1")
    return (features / lengths[:, None]).astype(np.float32)
