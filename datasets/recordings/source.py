"""A recording of a colour and a depth camera as the device left it: two image sizes, raw depth, poses that may be lost.

Every way in which ScanNet's recordings are stored is read through ``RgbdSource``; what becomes of it (which frames are
used, in which of the two cameras) is the matter of the dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.formats.images import MAX_PIXELS, Size, UInt16Array


@dataclass(frozen=True)
class SensorPair:
    """The two cameras of a recording.

    Intrinsics (3, 3) in pixels of their own image; extrinsics (4, 4): the depth one maps points of the depth camera
    into the colour camera, the colour one is the identity in practice. Metres are depth values / ``depth_shift``.
    ``where`` begins the message of what does not fit.
    """

    colour_size: Size
    depth_size: Size
    colour_intrinsics: Float64Array
    depth_intrinsics: Float64Array
    colour_extrinsic: Float64Array
    depth_extrinsic: Float64Array
    depth_shift: float
    where: InitVar[str] = "camera"

    def __post_init__(self, where: str) -> None:
        for name, (width, height) in (("colour", self.colour_size), ("depth", self.depth_size)):
            if width < 1 or height < 1 or width * height > MAX_PIXELS:
                raise DataError(f"{where}: {name} images of {width}x{height}; expected 1 to {MAX_PIXELS} pixels")
        for name, matrix in (("colour", self.colour_intrinsics), ("depth", self.depth_intrinsics)):
            assert matrix.shape == (3, 3), matrix.shape
            if not np.isfinite(matrix).all() or not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
                raise DataError(
                    f"{where}: the {name} intrinsics have focal lengths {matrix[0, 0]:g} and {matrix[1, 1]:g}; "
                    "expected finite numbers, focal lengths above 0"
                )
        for name, matrix in (("colour", self.colour_extrinsic), ("depth", self.depth_extrinsic)):
            assert matrix.shape == (4, 4), matrix.shape
            if not np.isfinite(matrix).all():
                raise DataError(f"{where}: the {name} extrinsic holds a number that is not finite; expected a 4x4 pose")
        if not (np.isfinite(self.depth_shift) and self.depth_shift > 0):
            raise DataError(f"{where}: the depth shift is {self.depth_shift:g}; expected units per metre, above 0")


class RgbdSource(Protocol):
    """The frame records of one recording in order, those without a usable pose among them; images are read when asked.

    ``where`` (``<dataset>/<scene>``) begins each message; a fault in any file is a ``DataError``.
    """

    @property
    def where(self) -> str: ...

    @property
    def camera(self) -> SensorPair: ...

    def __len__(self) -> int: ...

    def pose(self, i: int) -> Float64Array:
        """Camera-to-world matrix (4, 4) as stored, of the depth camera; not finite where tracking was lost."""
        ...

    def poses(self) -> Float64Array:
        """All poses (n, 4, 4)."""
        ...

    def timestamp_s(self, i: int) -> float:
        """When record ``i`` was taken; at 30 frames a second where the recording has no times that increase."""
        ...

    def colour(self, i: int) -> UInt8Array:
        """Image (H, W, 3) RGB in the colour size of ``camera``."""
        ...

    def depth(self, i: int) -> UInt16Array:
        """Values (H, W) as stored, 0 where invalid, in the depth size of ``camera``."""
        ...

    def frame_number(self, i: int) -> int:
        """The number of record ``i`` at full rate; exports that left frames out keep their numbers."""
        ...

    def files(self) -> Sequence[Path]:
        """The files that the recording consists of."""
        ...
