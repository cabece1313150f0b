"""``.sens`` files read and written: cameras and compression in the header, then the frames, then motion data.

Little-endian, without padding. Source: ScanNet, SensReader/c++/sensorData.h at commit 3830fce.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError, reading
from su3d_bench.core.files.atomic import replacing
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float64Array, Int64Array, UInt8Array
from su3d_bench.datasets.recordings.source import SensorPair
from su3d_bench.formats.images import (
    JPEG_START,
    MAX_PIXELS,
    PNG_SIGNATURE,
    UInt16Array,
    decode_colour,
    image_size,
    sized,
)

ColourCompression = Literal["raw", "png", "jpeg"]
DepthCompression = Literal["raw", "zlib"]
Name = TypeVar("Name", bound=str)

COLOUR_CODES: dict[int, ColourCompression] = {0: "raw", 1: "png", 2: "jpeg"}
DEPTH_CODES: dict[int, DepthCompression] = {0: "raw", 1: "zlib"}
OCCI = 2  # the depth code of a library that was never published
VERSION = 4
OLDER_VERSIONS = {0: "a .sensor file", 1: "a .sensor file", 2: "a .sensor file", 3: "a .sens file without motion data"}
START = struct.Struct("<IQ")  # version, length of the sensor's name
REST = struct.Struct("<64f2i4If")  # four matrices, two codes, two sizes, depth shift
COUNT = struct.Struct("<Q")
MAX_NAME_BYTES = 4096  # ScanNet has 15, 'StructureSensor'
MAX_FRAMES = 10_000_000  # 92 hours at 30 frames a second
MAX_HEADER_BYTES = START.size + MAX_NAME_BYTES + REST.size + COUNT.size


@dataclass(frozen=True)
class SensHeader:
    """What a ``.sens`` file says before its frames.

    The matrices are (4, 4) float64 and hold float32 values; sizes are in pixels; metres are depth / ``depth_shift``.
    """

    sensor_name: str
    intrinsic_colour: Float64Array
    extrinsic_colour: Float64Array
    intrinsic_depth: Float64Array
    extrinsic_depth: Float64Array
    colour_compression: ColourCompression
    depth_compression: DepthCompression
    colour_width: int
    colour_height: int
    depth_width: int
    depth_height: int
    depth_shift: float
    version: int = VERSION

    def __post_init__(self) -> None:
        for matrix in (self.intrinsic_colour, self.extrinsic_colour, self.intrinsic_depth, self.extrinsic_depth):
            assert matrix.shape == (4, 4), matrix.shape
        assert self.version == VERSION, self.version


def parse_header(start: bytes, where: str) -> tuple[SensHeader, int, int]:
    """The header in the first bytes of a file, how many frames it promises, and where it ends.

    ``start`` needs no more than ``MAX_HEADER_BYTES``; ``where`` begins the message of the ``DataError``.
    """
    if len(start) < START.size:
        raise DataError(f"{where}: has {len(start)} bytes, too few for a .sens file; copy the file again")
    version, n_name = START.unpack_from(start)
    if version != VERSION:
        kind = OLDER_VERSIONS.get(version)
        raise DataError(
            f"{where}: version {version}, {kind}; export it with the program that recorded it"
            if kind
            else f"{where}: not a .sens file, its version would be {version}; expected {VERSION}"
        )
    end = START.size + n_name + REST.size + COUNT.size
    if n_name > MAX_NAME_BYTES or end > len(start):
        raise DataError(
            f"{where}: byte 4: the header with a sensor name of {n_name} bytes does not fit into the file; "
            "it is cut short or damaged"
        )
    try:
        name = start[START.size : START.size + n_name].decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: byte {START.size}: the sensor's name is not text; the file is damaged") from error
    values = REST.unpack_from(start, START.size + n_name)
    colour_compression = _compression(values[64], COLOUR_CODES, "colour", where)
    if values[65] == OCCI:
        raise DataError(
            f"{where}: depth is compressed with OCCI (code {OCCI}), which only the recording program can undo; "
            "export the frames with it and use the export"
        )
    matrices = np.array(values[:64], np.float64).reshape(4, 4, 4)
    colour_width, colour_height, depth_width, depth_height = values[66:70]
    header = SensHeader(
        sensor_name=name,
        intrinsic_colour=matrices[0],
        extrinsic_colour=matrices[1],
        intrinsic_depth=matrices[2],
        extrinsic_depth=matrices[3],
        colour_compression=colour_compression,
        depth_compression=_compression(values[65], DEPTH_CODES, "depth", where),
        colour_width=colour_width,
        colour_height=colour_height,
        depth_width=depth_width,
        depth_height=depth_height,
        depth_shift=values[70],
    )
    _check_images(header, where)
    return header, COUNT.unpack_from(start, end - COUNT.size)[0], end


def _check_images(header: SensHeader, where: str) -> None:
    colour, depth = (header.colour_width, header.colour_height), (header.depth_width, header.depth_height)
    for name, (width, height) in (("colour", colour), ("depth", depth)):
        if not 0 < width * height <= MAX_PIXELS:
            raise DataError(f"{where}: {name} images of {width}x{height}; expected 1 to {MAX_PIXELS} pixels")
    if not (math.isfinite(header.depth_shift) and header.depth_shift > 0):
        raise DataError(f"{where}: the depth shift is {header.depth_shift:g}; expected units per metre, above 0")


def _compression(code: int, names: Mapping[int, Name], what: str, where: str) -> Name:
    if code not in names:
        known = ", ".join(f"{known} ({name})" for known, name in names.items())
        raise DataError(f"{where}: {what} compression {code}; known: {known}")
    return names[code]


def header_bytes(header: SensHeader, n_frames: int) -> bytes:
    """The reverse of ``parse_header``; the file that it begins holds ``n_frames`` frames."""
    name = header.sensor_name.encode()
    assert len(name) <= MAX_NAME_BYTES, len(name)
    matrices = [header.intrinsic_colour, header.extrinsic_colour, header.intrinsic_depth, header.extrinsic_depth]
    codes = [
        next(code for code, name in COLOUR_CODES.items() if name == header.colour_compression),
        next(code for code, name in DEPTH_CODES.items() if name == header.depth_compression),
    ]
    sizes = [header.colour_width, header.colour_height, header.depth_width, header.depth_height]
    values = np.stack(matrices).astype(np.float32).ravel().tolist()
    rest = REST.pack(*values, *codes, *sizes, header.depth_shift)
    return START.pack(header.version, len(name)) + name + rest + COUNT.pack(n_frames)


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
