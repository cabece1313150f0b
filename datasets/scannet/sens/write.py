"""``.sens`` files, written frame by frame: as long as a recording may be, one frame is in memory."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import StoreError
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.datasets.scannet.sens.header import COUNT, ColourCompression, DepthCompression, SensHeader, header_bytes
from su3d_bench.datasets.scannet.sens.read import FRAME_RECORD, MOTION_RECORD
from su3d_bench.formats.images import UInt16Array

JPEG_QUALITY = 95  # OpenCV's own choice


@dataclass(frozen=True)
class SensFrame:
    """One frame to write: the pose (4, 4), time stamps in microseconds, and both images as they are to be stored."""

    camera_to_world: Float64Array
    colour_timestamp: int
    depth_timestamp: int
    colour: bytes
    depth: bytes


def colour_content(rgb: UInt8Array, compression: ColourCompression) -> bytes:
    """A colour image (H, W, 3) RGB as a ``.sens`` file stores it."""
    import cv2

    if compression == "raw":
        return rgb.tobytes()
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if compression == "jpeg" else []
    is_done, content = cv2.imencode(".jpg" if compression == "jpeg" else ".png", bgr, options)
    assert is_done
    return content.tobytes()


def depth_content(values: UInt16Array, compression: DepthCompression) -> bytes:
    """A depth image (H, W) as a ``.sens`` file stores it."""
    raw = values.astype("<u2").tobytes()
    return zlib.compress(raw) if compression == "zlib" else raw


def write_sens(path: Path, header: SensHeader, frames: Iterable[SensFrame], motion: NDArray[Any] | None = None) -> None:
    """Write a recording, whole or not at all.

    ``motion`` holds records of ``MOTION_RECORD``; without it the file ends with its last frame, which readers allow.
    """
    with _replacing(path) as stream:
        stream.write(header_bytes(header, 0))
        end_of_header, n_frames = stream.tell(), 0
        for frame in frames:
            n_frames += 1
            fixed = np.zeros((), FRAME_RECORD)
            fixed["camera_to_world"] = frame.camera_to_world
            fixed["colour_timestamp"], fixed["depth_timestamp"] = frame.colour_timestamp, frame.depth_timestamp
            fixed["colour_bytes"], fixed["depth_bytes"] = len(frame.colour), len(frame.depth)
            stream.write(fixed.tobytes())
            stream.write(frame.colour)
            stream.write(frame.depth)
        if motion is not None:
            assert motion.dtype == MOTION_RECORD, motion.dtype
            stream.write(COUNT.pack(len(motion)) + motion.tobytes())
        stream.seek(end_of_header - COUNT.size)
        stream.write(COUNT.pack(n_frames))


@contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file that takes the name ``path`` once it is whole, and leaves nothing behind where it never is."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)
