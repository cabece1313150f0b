"""Mask ids by overlap with the map, the detection table Q, and feature fusion per instance."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.atomic import Scratch, StoredRows
from su3d_bench.core.types import Detections, Float32Array, Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import BEST_FIT_RATIO, Fusion, MultiScale, MultiView, OverlapRule


@dataclass(frozen=True)
class Overlaps:
    """The scene segment with which each frame segment shares most points.

    ``segments`` (F,) the frame segments present, ascending; ``n_frame`` (F,) their points; ``best`` (F,) scene ids, 0
    if nothing overlaps; ``shared`` (F,) matched pairs with that scene segment.
    """

    segments: Int32Array
    n_frame: Int64Array
    best: Int32Array
    shared: Int64Array


def count_overlaps(segment: Int32Array, matched_id: Int32Array) -> Overlaps:
    """Overlaps from the frame segment (N,) of each point and the id (N,) of the scene point it matched, 0 for none.

    Of two scene segments that share equally many points, the lower id is best.
    """
    segments, n_frame = np.unique(segment, return_counts=True)
    best = np.zeros(len(segments), np.int32)
    shared = np.zeros(len(segments), np.int64)
    pairs = matched_id > 0
    keys = (segment[pairs].astype(np.int64) << 32) | matched_id[pairs]
    keys, counts = np.unique(keys, return_counts=True)
    row = np.searchsorted(segments, keys >> 32)
    # Sorted by row, most shared points, lowest id: the first entry of a row is its best.
    order = np.lexsort((keys & 0xFFFFFFFF, -counts, row))
    rows, first = np.unique(row[order], return_index=True)
    best[rows] = (keys[order][first] & 0xFFFFFFFF).astype(np.int32)
    shared[rows] = counts[order][first]
    return Overlaps(segments.astype(np.int32), n_frame.astype(np.int64), best, shared)


def overlap_ratios(overlaps: Overlaps, n_scene: Int64Array, rule: OverlapRule) -> Float64Array:
    """Overlap ratio (F,) of each frame segment with its best scene segment; 0 if nothing overlaps.

    ``n_scene`` (F,): points of the best scene segment inside the crop. The rule ``as-printed`` is the paper's equation
    verbatim, max(c_s) / min(c_f, max(c_s)), which is never below 1.
    """
    if rule == "as-printed":
        denominator = np.minimum(overlaps.n_frame, overlaps.shared)
    elif rule == "frame-segment":
        denominator = overlaps.n_frame
    else:
        denominator = np.minimum(overlaps.n_frame, n_scene)
    return np.where(overlaps.shared > 0, overlaps.shared / np.maximum(denominator, 1), 0.0)


def assign_ids(overlaps: Overlaps, ratios: Float64Array, threshold: float, next_id: int) -> tuple[Int32Array, int]:
    """Scene id (F,) of each frame segment and the next unused id.

    A segment with a ratio of at least ``threshold`` gets the id of its best scene segment (ids may repeat); others get
    new ids in segment order.
    """
    joined = (ratios >= threshold) & (overlaps.best > 0)
    n_new = int(np.count_nonzero(~joined))
    ids = overlaps.best.copy()
    ids[~joined] = np.arange(next_id, next_id + n_new, dtype=np.int32)
    return ids, next_id + n_new


EPSILON = 1e-8  # as in the paper: the cosine of a zero vector is 0


def cosine(a: Float64Array, b: Float64Array) -> NDArray[np.float64]:
    """a . b / max(|a| |b|, 1e-8) along the last axis."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray((a * b).sum(axis=-1) / np.maximum(norms, EPSILON), np.float64)


def fuse_scales(
    crops: Float32Array | Float64Array, crop_ratios: tuple[float, ...], equation: MultiScale
) -> Float64Array:
    """f_MS (K, D) of the features (K, R, D) of R crops.

    ``direct`` is (1/k) sum_i f_i; ``weighted`` is (1/k) sum_i cos(f_1, f_i) f_i, where f_1 is the best-fit crop: the
    one at ratio 1.0, at any position in ``crop_ratios``.
    """
    features = np.asarray(crops, np.float64)
    if equation == "direct":
        return np.asarray(features.mean(axis=1), np.float64)
    best_fit = features[:, [crop_ratios.index(BEST_FIT_RATIO)]]
    return np.asarray((cosine(best_fit, features)[..., None] * features).mean(axis=1), np.float64)


def fuse_views(multi_scale: Float64Array, global_features: Float64Array, equation: MultiView) -> Float64Array:
    """f_MV (D,) of m views, from their f_MS (m, D) and the f_G (m, D) of their images.

    ``direct`` is (1/m) sum_i f_MS_i; ``global`` is (1/m) sum_i (f_MS_i + cos(f_MS_i, f_G_i) f_G_i).
    """
    if equation == "direct":
        return np.asarray(multi_scale.mean(axis=0), np.float64)
    similarity = cosine(multi_scale, global_features)[:, None]
    return np.asarray((multi_scale + similarity * global_features).mean(axis=0), np.float64)


@dataclass(frozen=True, slots=True)
class View:
    """One mask of one image: ``position`` is the index of the image, ``detection`` the row in that image."""

    position: int
    detection: int


# Q: scene id -> views merged into it, in order.
TrackingTable = defaultdict[int, list[View]]


# K detections with features of F dimensions, H hits.
FORMS = {
    "rows": "i8 K", "scores": "f8 K", "multi_scale": "f8 K F", "global_feature": "f8 1 F", "hit_indptr": "i8 K+1",
    "hits": "i4 H",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ImageRecord:
    """Names, captions, scores and features of the detections of one image.

    ``rows`` (K,) are the rows in the source file or image. Large arrays are in a scratch file, so that memory does not
    grow with the number of images: ``multi_scale`` (K, D), the f_MS of the K detections, ``global_feature`` (1, D),
    the f_G, and ``hits``, the map points hit, those of detection k in rows ``hit_indptr[k]`` to
    ``hit_indptr[k + 1]``.
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

    def content(self) -> dict[str, Any]:
        """Its fields, with the arrays in the scratch file."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: v.rows(0, v.shape[0]) if isinstance(v, StoredRows) else v for name, v in values.items()}

    @property
    def n_dimensions(self) -> int:
        """Feature dimension D."""
        return self.global_feature.shape[1]

    def source_of(self, detection: int) -> tuple[int, int]:
        """The frame of ``detection`` and its row in the source file or image."""
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
        """Map points hit by the mask of ``detection``, ascending."""
        first, last = (int(end) for end in self.hit_indptr[detection : detection + 2])
        return self.hits.rows(first, last).astype(np.int64)


def image_of(content: Mapping[str, Any], scratch: Scratch) -> ImageRecord:
    """The image with this ``content``, whose arrays have the forms ``FORMS``."""
    starts, names = content["hit_indptr"], content["names"]
    if (
        starts[0] != 0
        or starts[-1] != len(content["hits"])
        or {len(names), len(content["captions"])} != {len(starts) - 1}
    ):
        raise StoreError("saved state: hits, names and captions of an image do not fit")
    large = {name: scratch.put(content[name]) for name in ("multi_scale", "global_feature", "hits")}
    texts = {name: tuple(map(sys.intern, content[name])) for name in ("names", "captions")}
    return ImageRecord(**{**content, **large, **texts})


def record_of(
    detections: Detections, fusion: Fusion, segment: Int32Array, hit: Int64Array, scratch: Scratch
) -> ImageRecord:
    """Store the detections of one image; ``segment`` and ``hit`` pair each with a map point hit, -1 for none."""
    columns = [_column(detections, ratio) for ratio in fusion.crop_ratios]
    features = fuse_scales(detections.crop_features[:, columns], fusion.crop_ratios, fusion.multi_scale)
    is_hit = hit >= 0
    pairs = _distinct((segment[is_hit].astype(np.int64) << 40) | hit[is_hit])
    return ImageRecord(
        detections.frame_index,
        np.array([detections.row_of(k) for k in range(len(detections))], np.int64),
        detections.scores.astype(np.float64),
        # one string per name, not per image
        tuple(map(sys.intern, map(str, detections.names))),
        tuple(map(sys.intern, map(str, detections.captions))),
        scratch.put(features),
        scratch.put(detections.global_feature.astype(np.float64)[None]),
        np.searchsorted(pairs, np.arange(len(detections) + 1) << 40),
        scratch.put((pairs & ((1 << 40) - 1)).astype(np.int32)),
    )


def _distinct(values: Int64Array) -> Int64Array:
    """The distinct ``values``, ascending; ten times faster than np.unique."""
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
