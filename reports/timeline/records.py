"""What stands on the timeline of a scene: plain values, each at a place and a moment, whoever draws them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import Float32Array, Float64Array, UInt8Array
from su3d_bench.reports.pictures.canvas import Colour

UInt16Array = NDArray[np.uint16]
# A place is a path through these; names of methods stand below them and so can take no other's place.
CAMERA = ("world", "camera")
MASKS, TRUE_MASKS = (*CAMERA, "masks"), (*CAMERA, "truth")
MAP, TRUTH, GROWTH, ABOUT = ("world", "map"), ("world", "truth"), ("growth",), ("about",)
INSTANCES, CLASSES, BOXES = "instances", "classes", "boxes"
ROOM, TOP = "room", "ceiling"  # parts of a cloud: what is below the ceiling, and the rest
CURVES = ("instances", "points", "milliseconds an update")


@dataclass(frozen=True)
class Moment:
    """When a frame was taken: its index at full rate, and seconds since the first frame that is shown."""

    frame: int
    seconds: float


@dataclass(frozen=True)
class CameraPose:
    """Where the camera is: ``camera_to_world`` (4, 4), OpenCV's axes; ``intrinsics`` (3, 3) of images of this size."""

    camera_to_world: Float64Array
    intrinsics: Float64Array
    width: int
    height: int


@dataclass(frozen=True)
class ColourImage:
    """What the camera saw: (h, w, 3) RGB."""

    rgb: UInt8Array


@dataclass(frozen=True)
class DepthImage:
    """How far it was: (h, w) m, 0 where nobody knows."""

    depth_m: Float32Array


@dataclass(frozen=True)
class IdImage:
    """Whose each pixel is: (h, w) ids of the ``Names`` there, 0 for nobody's."""

    ids: UInt16Array


@dataclass(frozen=True)
class Names:
    """What ids mean at a place and below it: name and colour of each; id 0 has ``nothing``, or cannot be seen."""

    entries: tuple[tuple[int, str, Colour], ...]
    nothing: Colour | None = None


@dataclass(frozen=True)
class Points:
    """Points (n, 3) m of the world and whose they are: (n,) ids of the ``Names`` above."""

    points: Float32Array
    ids: UInt16Array
    radius_m: float


@dataclass(frozen=True)
class Boxes:
    """Boxes along the axes: lowest and highest corners (k, 2, 3) m, and what is written at each."""

    corners: Float32Array
    labels: tuple[str, ...]
    colours: tuple[Colour, ...]


@dataclass(frozen=True)
class Number:
    """A value of a curve."""

    value: float


@dataclass(frozen=True)
class Text:
    """Words about all of it, plain."""

    text: str


Content = CameraPose | ColourImage | DepthImage | IdImage | Names | Points | Boxes | Number | Text


@dataclass(frozen=True)
class Record:
    """``content`` at ``place`` from ``moment`` on; at every moment where there is none."""

    place: tuple[str, ...]
    content: Content
    moment: Moment | None = None
