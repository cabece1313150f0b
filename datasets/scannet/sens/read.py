"""ScanNet's ``.sens`` recordings, read where they lie: any frame at once, in the memory of that frame.

A file is a header, frame records (a pose, two time stamps, the sizes of two images, the images), and perhaps a block
of motion data. Opening reads the 96 fixed bytes of each record and steps over the images; each promise of a size is
held against the size of the file first. Source: ScanNet, SensReader/c++/sensorData.h at commit 3830fce.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float64Array, Int64Array, UInt8Array
from su3d_bench.datasets.recordings.source import SensorPair
from su3d_bench.datasets.scannet.sens.header import COUNT, MAX_FRAMES, MAX_HEADER_BYTES, SensHeader, parse_header
from su3d_bench.formats.images import JPEG_START, PNG_SIGNATURE, UInt16Array, decode_colour, image_size, sized

FRAME_RECORD = np.dtype(
    [
        ("camera_to_world", "<f4", (4, 4)),
        ("colour_timestamp", "<u8"),
        ("depth_timestamp", "<u8"),
        ("colour_bytes", "<u8"),
        ("depth_bytes", "<u8"),
    ]
)
MOTION_RECORD = np.dtype(
    [
        *((name, "<f8", 3) for name in ("rotation_rate", "acceleration", "magnetic_field", "attitude", "gravity")),
        ("timestamp", "<u8"),
    ]
)
FRAME_SIZES = struct.Struct("<2Q")  # the last two of a record
BYTES_PER_PIXEL, BYTES_AROUND = 8, 1 << 20  # more than any stored image has
FRAMES_PER_SECOND = 30.0  # of ScanNet's recordings
MICROSECONDS = 1e6


@dataclass(frozen=True)
class SensRecord:
    """One frame record without its images; the pose (4, 4) is as stored, -inf where tracking was lost.

    Time stamps are microseconds by convention; many recordings have 0 or random numbers there.
    """

    camera_to_world: Float64Array
    colour_timestamp: int
    depth_timestamp: int


class SensFile:
    """The header and the index of a ``.sens`` file of version 4; images are read and decoded when they are asked for.

    No file stays open: it may be read by many threads, and pickled to other processes. A ``DataError`` begins with
    ``where`` and the name of the file, and says frame and byte.
    """

    def __init__(self, path: Path, where: str) -> None:
        self.path, self.where, self.place = path, where, f"{where}: {path.name}"
        with _opened(path, self.place) as handle:
            n_bytes = os.fstat(handle).st_size
            self.header, n_frames, at = parse_header(os.pread(handle, MAX_HEADER_BYTES, 0), self.place)
            _check_promise(n_frames, n_bytes - at, self.place)
            most = _most_bytes(self.header)
            self._records, self._starts, at = _read_records(handle, n_bytes, n_frames, at, most, self.place)
            self.has_motion = n_bytes > at
            self.n_imu = _count_motion(handle, n_bytes, at, self.place) if self.has_motion else 0
        self._motion_start = at + COUNT.size

    def __len__(self) -> int:
        return len(self._records)

    def record(self, i: int) -> SensRecord:
        """Pose and time stamps of frame ``i``."""
        stored = self._records[i]
        pose = stored["camera_to_world"].astype(np.float64)
        return SensRecord(pose, int(stored["colour_timestamp"]), int(stored["depth_timestamp"]))

    def poses(self) -> Float64Array:
        """The poses (n, 4, 4) of all frames, as stored."""
        return self._records["camera_to_world"].astype(np.float64)

    def records(self) -> NDArray[Any]:
        """The fixed parts of all frame records (n,) of ``FRAME_RECORD``, as stored."""
        return self._records.copy()

    def colour_bytes(self, i: int) -> bytes:
        """The colour image of frame ``i`` as stored."""
        return self._read(i, *self._colour_span(i))

    def depth_bytes(self, i: int) -> bytes:
        """The depth image of frame ``i`` as stored."""
        return self._read(i, *self._depth_span(i))

    def colour(self, i: int) -> UInt8Array:
        """The colour image (H, W, 3) RGB of frame ``i``."""
        content, header = self.colour_bytes(i), self.header
        size = header.colour_width, header.colour_height
        where = f"{self._place(i, self._colour_span(i)[0])}: colour"
        if header.colour_compression == "raw":
            _check_length(content, 3 * size[0] * size[1], where)
            return np.frombuffer(content, np.uint8).reshape(size[1], size[0], 3)
        signature = PNG_SIGNATURE if header.colour_compression == "png" else JPEG_START
        if not content.startswith(signature) or image_size(content) is None:
            raise DataError(f"{where}: not a {header.colour_compression.upper()} image; copy the file again")
        return sized(decode_colour, content, size, where, "as the header says")

    def depth(self, i: int) -> UInt16Array:
        """The depth image (H, W) of frame ``i`` in raw units, 0 where invalid."""
        content, header = self.depth_bytes(i), self.header
        where = f"{self._place(i, self._depth_span(i)[0])}: depth"
        n_bytes = 2 * header.depth_width * header.depth_height
        if header.depth_compression == "zlib":
            content = _inflate(content, n_bytes, where)
        _check_length(content, n_bytes, where)
        values = np.frombuffer(content, "<u2").reshape(header.depth_height, header.depth_width)
        return values.astype(np.uint16, copy=False)

    def motion(self) -> NDArray[Any]:
        """The motion data: (n_imu,) of ``MOTION_RECORD``."""
        with _opened(self.path, self.place) as handle:
            content = os.pread(handle, self.n_imu * MOTION_RECORD.itemsize, self._motion_start)
        _check_length(content, self.n_imu * MOTION_RECORD.itemsize, f"{self.place}: motion data")
        return np.frombuffer(content, MOTION_RECORD)

    def _colour_span(self, i: int) -> tuple[int, int]:
        return int(self._starts[i]) + FRAME_RECORD.itemsize, int(self._records[i]["colour_bytes"])

    def _depth_span(self, i: int) -> tuple[int, int]:
        start, n_bytes = self._colour_span(i)
        return start + n_bytes, int(self._records[i]["depth_bytes"])

    def _place(self, i: int, at: int) -> str:
        return f"{self.place}: frame {range(len(self))[i]} at byte {at}"

    def _read(self, i: int, at: int, n_bytes: int) -> bytes:
        with _opened(self.path, self.place) as handle:
            content = os.pread(handle, n_bytes, at)
        if len(content) != n_bytes:
            raise DataError(f"{self._place(i, at)}: the file became shorter while it was read; copy it again")
        return content


@contextmanager
def _opened(path: Path, where: str) -> Iterator[int]:
    """A descriptor of the file; what goes wrong with it is a ``DataError``."""
    with reading(where, DataError):
        try:
            stream = opened(path)
        except FileNotFoundError as error:
            raise DataError(f"{where} is missing; copy the recording into {path.parent}") from error
        with stream:
            yield stream.fileno()


def _check_promise(n_frames: int, n_left: int, where: str) -> None:
    if n_frames > MAX_FRAMES or n_frames * FRAME_RECORD.itemsize > n_left:
        raise DataError(
            f"{where}: the header promises {n_frames} frames of {FRAME_RECORD.itemsize} or more bytes, but only "
            f"{n_left} bytes are left; the file is cut short or damaged"
        )


def _most_bytes(header: SensHeader) -> tuple[int, int]:
    """Bytes that no colour and no depth image exceeds: 16-bit RGBA of noise would need 8 a pixel and a few behind."""
    sizes = (header.colour_width, header.colour_height), (header.depth_width, header.depth_height)
    colour, depth = (BYTES_PER_PIXEL * width * height + BYTES_AROUND for width, height in sizes)
    return colour, depth


def _read_records(
    handle: int, n_bytes: int, n_frames: int, at: int, most: tuple[int, int], where: str
) -> tuple[NDArray[Any], Int64Array, int]:
    """The fixed part of each record, where each begins, and where the last one ends."""
    if hasattr(os, "posix_fadvise"):  # not on macOS; reading ahead would fetch the images between the records
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_RANDOM)
    records = np.zeros(n_frames, FRAME_RECORD)
    raw, starts = records.view(np.uint8).data, np.zeros(n_frames, np.int64)
    step, sizes = FRAME_RECORD.itemsize, FRAME_SIZES.unpack_from
    for i in range(n_frames):
        row = raw[i * step : (i + 1) * step]
        n_read = os.preadv(handle, [row], at)
        colour, depth = sizes(row, step - FRAME_SIZES.size)
        end = at + step + colour + depth
        if n_read < step or end > n_bytes:
            raise DataError(
                f"{where}: frame {i} of {n_frames} at byte {at}: its images of {colour} and {depth} bytes do not fit "
                f"into the {max(0, n_bytes - at - step)} bytes left; the file is cut short or damaged"
            )
        if colour > most[0] or depth > most[1]:
            raise DataError(
                f"{where}: frame {i} of {n_frames} at byte {at}: images of {colour} and {depth} bytes; "
                f"with the sizes in the header at most {most[0]} and {most[1]} are possible, the file is damaged"
            )
        starts[i], at = at, end
    return records, starts, at


def _count_motion(handle: int, n_bytes: int, at: int, where: str) -> int:
    """Records of motion data in the block that begins behind the frames and must fill the rest of the file."""
    n_left = n_bytes - at
    n = COUNT.unpack(os.pread(handle, COUNT.size, at))[0] if n_left >= COUNT.size else 0
    n_needed = COUNT.size + n * MOTION_RECORD.itemsize
    if n_left != n_needed:
        raise DataError(
            f"{where}: the file goes on for {n_left} bytes behind the last frame, from byte {at}; expected nothing or "
            f"motion data, of which {n} records take {n_needed}; it is longer than it should be, cut short or damaged"
        )
    return int(n)


def _check_length(content: bytes, n_bytes: int, where: str) -> None:
    if len(content) != n_bytes:
        raise DataError(f"{where}: has {len(content)} bytes, expected {n_bytes}; the file is damaged")


def _inflate(content: bytes, n_bytes: int, where: str) -> bytes:
    """The bytes that ``content`` unpacks to; no more than ``n_bytes`` + 1 are ever made."""
    unpacking = zlib.decompressobj()
    try:
        values = unpacking.decompress(content, n_bytes + 1)
    except zlib.error as error:
        raise DataError(f"{where}: does not unpack ({error}); the file is damaged") from error
    if len(values) > n_bytes:
        raise DataError(f"{where}: unpacks to more than the {n_bytes} bytes of an image; the file is damaged")
    if not unpacking.eof:
        raise DataError(f"{where}: unpacks to {len(values)} bytes and breaks off; the file is damaged")
    return values


class SensSource(SensFile):
    """A ``.sens`` file as an ``RgbdSource``."""

    def __init__(self, path: Path, where: str) -> None:
        super().__init__(path, where)
        header = self.header
        self.camera = SensorPair(
            colour_size=(header.colour_width, header.colour_height),
            depth_size=(header.depth_width, header.depth_height),
            colour_intrinsics=header.intrinsic_colour[:3, :3],
            depth_intrinsics=header.intrinsic_depth[:3, :3],
            colour_extrinsic=header.extrinsic_colour,
            depth_extrinsic=header.extrinsic_depth,
            depth_shift=header.depth_shift,
            where=self.place,
        )
        stamps = self.records()["colour_timestamp"]
        # Many recordings have zeros or random numbers there.
        self._has_times = len(stamps) > 1 and bool((stamps[1:] > stamps[:-1]).all())

    def pose(self, i: int) -> Float64Array:
        return self.record(i).camera_to_world

    def timestamp_s(self, i: int) -> float:
        if self._has_times:
            return self.record(i).colour_timestamp / MICROSECONDS
        return self.frame_number(i) / FRAMES_PER_SECOND

    def frame_number(self, i: int) -> int:
        return range(len(self))[i]

    def files(self) -> Sequence[Path]:
        return [self.path]
