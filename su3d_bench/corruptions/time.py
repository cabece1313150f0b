"""Corruptions of time: updates that are lost, repeated or out of order, and images older than their frame.

The order is that of updates; lags are counted in frames of the recording.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from su3d_bench.core.types import Frame, Int64Array
from su3d_bench.corruptions.depth import blobs
from su3d_bench.corruptions.model import Corruption, Recording

BURST_UPDATES = 2.0  # smoothing of the field whose lowest places are lost: bursts of about five updates


def lost_bursts(places: Int64Array, share: float, rng: Generator) -> Int64Array:
    """Places without bursts that are a part ``share`` of them; at least one remains."""
    lost = blobs(places.shape, min(share, 1 - 1 / len(places)), BURST_UPDATES, rng)
    return places[~lost]


def duplicates(places: Int64Array, share: float, rng: Generator) -> Int64Array:
    """Places of which a part ``share`` is fed twice in a row."""
    twice = rng.permutation(len(places))[: round(share * len(places))]
    return np.insert(places, twice, places[twice])


def reordered(places: Int64Array, window: float, rng: Generator) -> Int64Array:
    """Places in the order of arrival, each delayed by a random time of less than ``window`` updates."""
    arrival = np.arange(len(places)) + window * rng.random(len(places))
    return places[np.argsort(arrival, kind="stable")]


def depth_lag(frame: Frame, n_frames: float, rng: Generator, recording: Recording) -> Frame:
    """The frame with the depth of ``n_frames`` frames before it."""
    return replace(frame, depth_m=_before(recording, n_frames).depth_m)


def colour_lag(frame: Frame, n_frames: float, rng: Generator, recording: Recording) -> Frame:
    """The frame with the colour of ``n_frames`` frames before it."""
    return replace(frame, rgb=_before(recording, n_frames).rgb)


def _before(recording: Recording, n_frames: float) -> Frame:
    """The frame ``n_frames`` earlier, or the first."""
    return recording.frames[max(recording.index - int(n_frames), 0)]


LAG = "Xu et al. 2025 (arXiv 2501.14319): 5, 10 and 20 frames between the sensors; ours: 2 and 15."
LAGS = (2.0, 5.0, 10.0, 15.0, 20.0)
ROWS: tuple[Corruption, ...] = (
    Corruption(
        "time", "lost-bursts", "order", lost_bursts, "share of updates", (0.1, 0.2, 0.4, 0.6, 0.8),
        "ours: from an occasional stall to a connection that fails most of the time.",
    ),
    Corruption(
        "time", "duplicates", "order", duplicates, "share of updates", (0.1, 0.25, 0.5, 0.75, 1.0),
        "ours: up to a driver that sends every frame twice.",
    ),
    Corruption(
        "time", "reordered", "order", reordered, "updates", (2.0, 4.0, 8.0, 16.0, 32.0),
        "ours: doubled from 2, where only neighbours change places.", neutral=1.0, is_whole=True,
    ),
    Corruption("time", "depth-lag", "frame", depth_lag, "frames", LAGS, LAG, is_whole=True),
    Corruption("time", "colour-lag", "frame", colour_lag, "frames", LAGS, LAG, is_whole=True),
)  # fmt: skip
