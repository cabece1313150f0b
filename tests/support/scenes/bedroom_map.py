"""A bedroom of boxes, small enough to answer questions about by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.questions.scene_map import MapObject, SceneMap


def box(x: float, y: float, z: float, dx: float, dy: float, dz: float) -> Float64Array:
    """A box by its lowest corner and its sizes."""
    return np.array([[x, y, z], [x + dx, y + dy, z + dz]])


def thing(object_id: int, name: str, bounds: Float64Array, caption: str = "") -> MapObject:
    return MapObject(object_id, name, caption, bounds.mean(axis=0), bounds)


def placed(number: int, name: str, low: Sequence[float], sizes: Sequence[float], caption: str = "") -> MapObject:
    """An object by its lowest corner and its sizes."""
    return thing(number, name, np.array([low, np.add(low, sizes)], np.float64), caption)


def bedroom() -> SceneMap:
    """A bed along a wall, a nightstand with a lamp beside it, a table with two cups on a rug, two sinks, a shelf."""
    return SceneMap(
        (
            thing(1, "bed", box(0, 0, 0, 2, 1.6, 0.5)),
            thing(2, "nightstand", box(2.1, 0, 0, 0.4, 0.4, 0.5)),
            thing(3, "lamp", box(2.2, 0.1, 0.5, 0.2, 0.2, 0.4), "a red lamp in a scene"),
            thing(4, "lamp", box(5.8, 4.8, 0, 0.3, 0.3, 1.6), "a white lamp in a scene"),
            thing(5, "rug", box(2.5, 2.5, 0, 2, 2, 0.01)),
            thing(6, "table", box(3, 3, 0.01, 1, 1, 0.7)),
            thing(7, "cup", box(3.2, 3.2, 0.71, 0.1, 0.1, 0.1)),
            thing(8, "cup", box(3.7, 3.7, 0.71, 0.1, 0.1, 0.12)),
            thing(9, "sink", box(0, 4, 0.8, 0.5, 0.5, 0.2)),
            thing(10, "sink", box(6, 0, 0.8, 0.5, 0.5, 0.2)),
            thing(11, "shelf", box(0, 5.5, 0, 1, 0.3, 1.8)),
            thing(12, "book", box(0.2, 5.55, 0.9, 0.2, 0.2, 0.3)),
            thing(13, "basket", box(5, 5.5, 0, 0.5, 0.5, 0.3)),
            thing(14, "blanket", box(5.1, 5.6, 0.02, 0.3, 0.3, 0.5)),
            thing(15, "picture", box(0.5, 0, 1.2, 1, 0.05, 0.6)),
            thing(16, "floor", box(0, 0, -0.02, 7, 6, 0.02)),
            thing(17, "paper-towel", box(0.6, 4.1, 0.8, 0.1, 0.1, 0.25)),
            thing(18, "towel", box(6.1, 0.6, 0.9, 0.3, 0.05, 0.4)),
        )
    )
