"""Which scene segment each frame segment is part of, decided by the share of its points that overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import OverlapRule


@dataclass(frozen=True)
class Overlaps:
    """The scene segment that each frame segment shares most points with.

    ``segments`` (F,) the frame segments present, ascending; ``n_frame`` (F,) their points; ``best`` (F,) scene ids, 0
    where nothing overlaps; ``shared`` (F,) matched pairs with that scene segment.
    """

    segments: Int32Array
    n_frame: Int64Array
    best: Int32Array
    shared: Int64Array


def count_overlaps(segment: Int32Array, matched_id: Int32Array) -> Overlaps:
    """Overlaps from the frame segment (N,) of each point and the id (N,) of the scene point it matched, 0 for none.

    Of two scene segments that share equally many points the lower id is the best.
    """
    segments, n_frame = np.unique(segment, return_counts=True)
    best = np.zeros(len(segments), np.int32)
    shared = np.zeros(len(segments), np.int64)
    pairs = matched_id > 0
    keys = (segment[pairs].astype(np.int64) << 32) | matched_id[pairs]
    keys, counts = np.unique(keys, return_counts=True)
    row = np.searchsorted(segments, keys >> 32)
    # By row, then most shared points, then lowest id: the first entry of a row is its best.
    order = np.lexsort((keys & 0xFFFFFFFF, -counts, row))
    rows, first = np.unique(row[order], return_index=True)
    best[rows] = (keys[order][first] & 0xFFFFFFFF).astype(np.int32)
    shared[rows] = counts[order][first]
    return Overlaps(segments.astype(np.int32), n_frame.astype(np.int64), best, shared)


def overlap_ratios(overlaps: Overlaps, n_scene: Int64Array, rule: OverlapRule) -> Float64Array:
    """Overlap ratio (F,) of each frame segment with its best scene segment; 0 where nothing overlaps.

    ``n_scene`` (F,): points of the best scene segment inside the crop. The rule ``as-printed`` is the paper's equation
    to the letter, max(c_s) / min(c_f, max(c_s)), which is never below 1.
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

    A ratio of at least ``threshold`` takes the best scene segment's id (several may take one); the others get new ids
    in the order of the segments.
    """
    joined = (ratios >= threshold) & (overlaps.best > 0)
    n_new = int(np.count_nonzero(~joined))
    ids = overlaps.best.copy()
    ids[~joined] = np.arange(next_id, next_id + n_new, dtype=np.int32)
    return ids, next_id + n_new
