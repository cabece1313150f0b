"""Colours of similarity: the paper's dark blue to dark red, and one that people with any colour vision can read."""

from __future__ import annotations

from typing import Literal

import numpy as np

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.reports.pictures.maps import HEAT_STOPS

Scale = Literal["paper", "cividis"]
SCALES: tuple[Scale, ...] = ("paper", "cividis")
STEPS = 256


def scale_stops(scale: Scale) -> UInt8Array:
    """The colours (256, 3) of a scale, the least similar first."""
    if scale == "cividis":  # Nunez, Anderton, Renslow 2018
        from matplotlib import colormaps

        colours: UInt8Array = (colormaps["cividis"](np.arange(STEPS), bytes=True))[:, :3].astype(np.uint8)
        return colours
    places, stops = np.linspace(0.0, 1.0, STEPS), np.linspace(0.0, 1.0, len(HEAT_STOPS))
    channels = [np.rint(np.interp(places, stops, HEAT_STOPS[:, c])) for c in range(3)]
    return np.stack(channels, axis=1).astype(np.uint8)


def similarity_colours(similarity: Float64Array, scale: Scale = "paper") -> UInt8Array:
    """A colour (K, 3) a value, from the least to the greatest of them; all alike: the middle.

    >>> similarity_colours(np.array([0.2, 0.1, 0.3]))[1:].tolist()
    [[0, 0, 128], [128, 0, 0]]
    """
    if len(similarity) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = float(similarity.min()), float(similarity.max())
    place = np.full(len(similarity), 0.5) if high == low else (similarity - low) / (high - low)
    colours: UInt8Array = scale_stops(scale)[np.rint(place * (STEPS - 1)).astype(np.int64)]
    return colours
