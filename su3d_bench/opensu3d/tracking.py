"""The table Q: which masks of which images each scene segment was made of, so that all it says can be traced back."""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.scratch import Scratch, StoredRows
from su3d_bench.core.types import Detections, Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import Fusion
from su3d_bench.opensu3d.feature_fusion import fuse_scales


@dataclass(frozen=True, slots=True)
class View:
    """One mask of one image: ``position`` counts the images given so far, ``detection`` is the row in that image."""

    position: int
    detection: int


# Q: scene id -> the views merged into it, in the order they came.
TrackingTable = defaultdict[int, list[View]]


@dataclass(frozen=True, slots=True)
class ImageRecord:
    """What one image said of its detections, kept for names, captions, scores and features.

    ``rows`` (K,) are those of the file or image that they came from.
    What is large lies in a scratch file, so that memory does not grow with the images: ``multi_scale`` (K, D), the f_MS
    of its K detections, ``global_feature`` (1, D), its f_G, and ``hits``, the map points that detections hit, those of
    detection k in rows ``hit_indptr[k]`` to ``hit_indptr[k + 1]``.
    """

    frame_index: int
    rows: Int64Array
    scores: Float64Array
    names: tuple[str, ...]
    captions: tuple[str, ...]
    multi_scale: StoredRows
    global_feature: StoredRows
    hit_indptr: Int64Array
    hits: StoredRows

    @property
    def n_dimensions(self) -> int:
        """D of its features."""
        return self.global_feature.shape[1]

    def source_of(self, detection: int) -> tuple[int, int]:
        """The frame of ``detection`` and its row in the file or image that it came from."""
        return self.frame_index, int(self.rows[detection])

    def feature_of(self, detection: int) -> Float64Array:
        """f_MS (D,) of ``detection``."""
        feature: Float64Array = self.multi_scale.rows(detection, detection + 1)[0]
        return feature

    def feature_of_image(self) -> Float64Array:
        """f_G (D,)."""
        feature: Float64Array = self.global_feature.rows(0, 1)[0]
        return feature

    def hits_of(self, detection: int) -> Int64Array:
        """Map points that the mask of ``detection`` hit, ascending."""
        first, last = (int(end) for end in self.hit_indptr[detection : detection + 2])
        return self.hits.rows(first, last).astype(np.int64)


def record_of(
    detections: Detections, fusion: Fusion, segment: Int32Array, hit: Int64Array, scratch: Scratch
) -> ImageRecord:
    """Keeps what one image said; ``segment`` and ``hit`` pair each detection with a map point it hit, -1 for none."""
    columns = [_column(detections, ratio) for ratio in fusion.crop_ratios]
    features = fuse_scales(detections.crop_features[:, columns], fusion.crop_ratios, fusion.multi_scale)
    is_hit = hit >= 0
    pairs = _distinct((segment[is_hit].astype(np.int64) << 40) | hit[is_hit])
    return ImageRecord(
        detections.frame_index,
        np.array([detections.row_of(k) for k in range(len(detections))], np.int64),
        detections.scores.astype(np.float64),
        # one text a name, not one an image
        tuple(map(sys.intern, map(str, detections.names))),
        tuple(map(sys.intern, map(str, detections.captions))),
        scratch.put(features),
        scratch.put(detections.global_feature.astype(np.float64)[None]),
        np.searchsorted(pairs, np.arange(len(detections) + 1) << 40),
        scratch.put((pairs & ((1 << 40) - 1)).astype(np.int32)),
    )


def _distinct(values: Int64Array) -> Int64Array:
    """The different ``values``, ascending; np.unique takes ten times as long for want of a sort."""
    ordered = np.sort(values)
    is_first = np.ones(len(ordered), np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=is_first[1:])
    return np.asarray(ordered[is_first], np.int64)


def _column(detections: Detections, ratio: float) -> int:
    if ratio not in detections.crop_ratios:
        raise DataError(
            f"frame {detections.frame_index}: features of crop ratio {ratio} are missing; detections have "
            f"{detections.crop_ratios}"
        )
    return detections.crop_ratios.index(ratio)
