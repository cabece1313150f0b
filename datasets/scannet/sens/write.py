"""``.sens`` files, written frame by frame: as long as a recording may be, one frame is in memory."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.files.atomic import replacing
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.scannet.sens.header import COUNT, SensHeader, header_bytes
from su3d_bench.datasets.scannet.sens.read import FRAME_RECORD, MOTION_RECORD


@dataclass(frozen=True)
class SensFrame:
    """One frame to write: the pose (4, 4), time stamps in microseconds, and both images as they are to be stored."""

    camera_to_world: Float64Array
    colour_timestamp: int
    depth_timestamp: int
    colour: bytes
    depth: bytes

    @property
    def stored(self) -> bytes:
        """The frame record and its images, as the file holds them."""
        record = np.zeros((), FRAME_RECORD)
        record["camera_to_world"] = self.camera_to_world
        record["colour_timestamp"], record["depth_timestamp"] = self.colour_timestamp, self.depth_timestamp
        record["colour_bytes"], record["depth_bytes"] = len(self.colour), len(self.depth)
        return record.tobytes() + self.colour + self.depth


def write_sens(path: Path, header: SensHeader, frames: Iterable[bytes], motion: NDArray[Any] | None = None) -> None:
    """Write a recording, whole or not at all; ``frames`` are what ``SensFrame.stored`` gives of each.

    ``motion`` holds records of ``MOTION_RECORD``; without it the file ends with its last frame, which readers allow.
    """
    with replacing(path) as stream:
        stream.write(header_bytes(header, 0))
        end_of_header, n_frames = stream.tell(), 0
        for frame in frames:
            n_frames += 1
            stream.write(frame)
        if motion is not None:
            assert motion.dtype == MOTION_RECORD, motion.dtype
            stream.write(COUNT.pack(len(motion)) + motion.tobytes())
        stream.seek(end_of_header - COUNT.size)
        stream.write(COUNT.pack(n_frames))
