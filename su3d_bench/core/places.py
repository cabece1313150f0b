"""What a building's graph holds above its objects: floors and rooms, in a world whose y points up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
UP = 1  # the axis of heights, as Habitat has it


@dataclass(frozen=True)
class Floor:
    """A storey from ``lowest_m`` to ``highest_m``."""

    lowest_m: float
    highest_m: float


@dataclass(frozen=True)
class Room:
    """A room: ``points`` (K, 3) m that lie in it, its heights, and the mean of these or of its points.

    ``category`` is its name, '' where it has none.
    """

    points: Float64Array
    lowest_m: float
    highest_m: float
    middle_m: float
    category: str = ""


@dataclass(frozen=True)
class Places:
    """Floors and rooms; of a truth also ``object_boxes``: instance id -> centre and sides (2, 3) m."""

    floors: tuple[Floor, ...]
    rooms: tuple[Room, ...]
    object_boxes: Mapping[int, Float64Array] = field(default_factory=dict)
