"""The table Q: which masks of which images each scene segment was made of, so that all it says can be traced back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.errors import DataError
from su3d_bench.opensu3d.config import Fusion
from su3d_bench.opensu3d.feature_fusion import fuse_scales
from su3d_bench.types import Detections, Float64Array, Int32Array, Int64Array


@dataclass(frozen=True)
class View:
    """One mask of one image: ``position`` counts the images given so far, ``detection`` is the row in that image."""

    position: int
    detection: int


@dataclass(frozen=True)
class ImageRecord:
    """What one image said of its detections, kept for names, captions, scores and features.

    ``multi_scale`` (K, D) are the f_MS of its K detections, ``global_feature`` (D,) is f_G; the map points that
    detection k hit are ``hits[hit_indptr[k]:hit_indptr[k + 1]]``.
    """

    frame_index: int
    scores: Float64Array
    names: tuple[str, ...]
    captions: tuple[str, ...]
    multi_scale: Float64Array
    global_feature: Float64Array
    hit_indptr: Int64Array
    hits: Int64Array

    def hits_of(self, detection: int) -> Int64Array:
        """Map points that the mask of ``detection`` hit."""
        return self.hits[self.hit_indptr[detection] : self.hit_indptr[detection + 1]]


def record_of(detections: Detections, fusion: Fusion, segment: Int32Array, hit: Int64Array) -> ImageRecord:
    """Keeps what one image said; ``segment`` and ``hit`` pair each detection with a map point it hit, -1 for none."""
    columns = [_column(detections, ratio) for ratio in fusion.crop_ratios]
    features = fuse_scales(detections.crop_features[:, columns], fusion.crop_ratios, fusion.multi_scale)
    pairs = np.unique((segment[hit >= 0].astype(np.int64) << 40) | hit[hit >= 0])
    return ImageRecord(
        detections.frame_index,
        detections.scores.astype(np.float64),
        detections.names,
        detections.captions,
        features,
        detections.global_feature.astype(np.float64),
        np.searchsorted(pairs, np.arange(len(detections) + 1) << 40),
        pairs & ((1 << 40) - 1),
    )


def _column(detections: Detections, ratio: float) -> int:
    if ratio not in detections.crop_ratios:
        raise DataError(
            f"frame {detections.frame_index}: features of crop ratio {ratio} are missing; detections have "
            f"{detections.crop_ratios}"
        )
    return detections.crop_ratios.index(ratio)


class TrackingTable:
    """Q: scene id -> the views merged into it, in the order they came."""

    def __init__(self) -> None:
        self._views: dict[int, list[View]] = {}

    def add(self, scene_id: int, view: View) -> None:
        self._views.setdefault(scene_id, []).append(view)

    def views(self, scene_id: int) -> tuple[View, ...]:
        """The views of one scene id; empty where it is not known."""
        return tuple(self._views.get(scene_id, ()))

    def scene_ids(self) -> tuple[int, ...]:
        """Every id, ascending."""
        return tuple(sorted(self._views))
