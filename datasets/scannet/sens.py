"""Read and write ``.sens`` files: cameras and compression in the header, then the frames, then motion data.

Little-endian, without padding. Source: ScanNet, SensReader/c++/sensorData.h at commit 3830fce.
"""

from __future__ import annotations

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
from su3d_bench.formats import images

ColourCompression = Literal["raw", "png", "jpeg"]
DepthCompression = Literal["raw", "zlib"]
Name = TypeVar("Name", bound=str)

COLOUR_CODES: dict[int, ColourCompression] = {0: "raw", 1: "png", 2: "jpeg"}
DEPTH_CODES: dict[int, DepthCompression] = {0: "raw", 1: "zlib"}
VERSION = 4
START = struct.Struct("<IQ")  # version, length of the sensor's name
REST = struct.Struct("<64f2i4If")  # four matrices, two codes, two sizes, depth shift
COUNT = struct.Struct("<Q")
MAX_NAME_BYTES = 4096  # ScanNet has 15, 'StructureSensor'
MAX_FRAMES = 10_000_000  # 92 hours at 30 frames per second
MAX_HEADER_BYTES = START.size + MAX_NAME_BYTES + REST.size + COUNT.size


@dataclass(frozen=True)
class SensHeader:
    """The header of a ``.sens`` file.

    The matrices are (4, 4) float64 with float32 values; sizes are in pixels; metres are depth / ``depth_shift``.
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

    def camera(self, where: str) -> SensorPair:
        """The two cameras; a ``DataError`` if they are invalid."""
        return SensorPair(
            colour_size=(self.colour_width, self.colour_height),
            depth_size=(self.depth_width, self.depth_height),
            colour_intrinsics=self.intrinsic_colour[:3, :3],
            depth_intrinsics=self.intrinsic_depth[:3, :3],
            colour_extrinsic=self.extrinsic_colour,
            depth_extrinsic=self.extrinsic_depth,
            depth_shift=self.depth_shift,
            where=where,
        )


def parse_header(start: bytes, where: str) -> tuple[SensHeader, int, int]:
    """The header at the start of a file, its stated number of frames, and where it ends.

    ``start`` needs no more than ``MAX_HEADER_BYTES``; ``where`` begins the message of the ``DataError``.
    """
    if len(start) < START.size:
        raise DataError(f"{where}: has {len(start)} bytes, too few for a .sens file; copy the file again")
    version, n_name = START.unpack_from(start)
    if version != VERSION:
        raise DataError(f"{where}: not a .sens file of version {VERSION} (version field: {version})")
    end = START.size + n_name + REST.size + COUNT.size
    if n_name > MAX_NAME_BYTES or end > len(start):
        raise DataError(
            f"{where}: byte 4: the header with a sensor name of {n_name} bytes does not fit into the file; "
            "it is truncated or damaged"
        )
    values = REST.unpack_from(start, START.size + n_name)
    matrices = np.array(values[:64], np.float64).reshape(4, 4, 4)
    header = SensHeader(
        start[START.size : START.size + n_name].decode("utf-8", "replace"),
        *(matrices[0], matrices[1], matrices[2], matrices[3]),
        _compression(values[64], COLOUR_CODES, "colour", where),
        _compression(values[65], DEPTH_CODES, "depth", where),
        *values[66:],
    )
    return header, COUNT.unpack_from(start, end - COUNT.size)[0], end


def _compression(code: int, names: Mapping[int, Name], what: str, where: str) -> Name:
    if code not in names:
        known = ", ".join(f"{known} ({name})" for known, name in names.items())
        raise DataError(f"{where}: {what} compression {code}; known: {known}")
    return names[code]


def header_bytes(header: SensHeader, n_frames: int) -> bytes:
    """The reverse of ``parse_header``, for a file with ``n_frames`` frames."""
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
    return START.pack(VERSION, len(name)) + name + rest + COUNT.pack(n_frames)


FRAME_RECORD = np.dtype(
    [
        ("camera_to_world", "<f4", (4, 4)),
        ("colour_timestamp", "<u8"),
        ("depth_timestamp", "<u8"),
        ("colour_bytes", "<u8"),
        ("depth_bytes", "<u8"),
    ]
)
MOTION_BYTES = 128  # a motion data record: five vectors and a time stamp
FRAME_SIZES = struct.Struct("<2Q")  # the last two fields of a record
BYTES_PER_PIXEL, BYTES_AROUND = 8, 1 << 20  # more than any stored image needs
FRAMES_PER_SECOND = 30.0  # of ScanNet's recordings
MICROSECONDS = 1e6


class SensFile:
    """A ``.sens`` file of version 4 as an ``RgbdSource``; images are read and decoded on access.

    No file stays open: threads may share it, and it can be pickled. A ``DataError`` begins with
    ``where`` and the file name, and gives frame and byte. Many recordings have zero or random time stamps.
    """

    def __init__(self, path: Path, where: str) -> None:
        self.path, self.where, self.place = path, where, f"{where}: {path.name}"
        with _opened(path, self.place) as handle:
            n_bytes = os.fstat(handle).st_size
            self.header, n_frames, at = parse_header(os.pread(handle, MAX_HEADER_BYTES, 0), self.place)
            self.camera = self.header.camera(self.place)
            if n_frames > MAX_FRAMES or n_frames * FRAME_RECORD.itemsize > n_bytes - at:
                raise DataError(
                    f"{self.place}: the header states {n_frames} frames of {FRAME_RECORD.itemsize} or more bytes, "
                    f"but only {n_bytes - at} bytes remain; the file is truncated or damaged"
                )
            self._records, self._starts, at = _read_records(handle, n_bytes, n_frames, at, self.header, self.place)
            _check_end(handle, n_bytes, at, self.place)
        self.numbers = np.arange(n_frames)
        stamps = self._records["colour_timestamp"]
        self._has_times = len(stamps) > 1 and bool((stamps[1:] > stamps[:-1]).all())

    def __len__(self) -> int:
        return len(self._records)

    def poses(self) -> Float64Array:
        """The poses (n, 4, 4) of all frames, as stored."""
        return self._records["camera_to_world"].astype(np.float64)

    def timestamp_s(self, i: int) -> float:
        if self._has_times:
            return int(self._records[i]["colour_timestamp"]) / MICROSECONDS
        return range(len(self))[i] / FRAMES_PER_SECOND

    def files(self) -> Sequence[Path]:
        return [self.path]

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
        content, header, size = self.colour_bytes(i), self.header, self.camera.colour_size
        where = f"{self._place(i, self._colour_span(i)[0])}: colour"
        if header.colour_compression == "raw":
            _check_length(content, 3 * size[0] * size[1], where)
            return np.frombuffer(content, np.uint8).reshape(size[1], size[0], 3)
        signature = images.PNG_SIGNATURE if header.colour_compression == "png" else images.JPEG_START
        if not content.startswith(signature) or images.image_size(content) is None:
            raise DataError(f"{where}: not a {header.colour_compression.upper()} image; copy the file again")
        return images.sized(images.decode_colour, content, size, where, "as in the header")

    def depth(self, i: int) -> images.UInt16Array:
        """The depth image (H, W) of frame ``i`` in raw units, 0 if invalid."""
        content, header = self.depth_bytes(i), self.header
        where = f"{self._place(i, self._depth_span(i)[0])}: depth"
        n_bytes = 2 * header.depth_width * header.depth_height
        if header.depth_compression == "zlib":
            content = _inflate(content, n_bytes, where)
        _check_length(content, n_bytes, where)
        values = np.frombuffer(content, "<u2").reshape(header.depth_height, header.depth_width)
        return values.astype(np.uint16, copy=False)

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
            raise DataError(f"{self._place(i, at)}: the file was shortened while being read; copy it again")
        return content


@contextmanager
def _opened(path: Path, where: str) -> Iterator[int]:
    """A descriptor of the file; failures are a ``DataError``."""
    with reading(where, DataError), opened(path) as stream:
        yield stream.fileno()


def _read_records(
    handle: int, n_bytes: int, n_frames: int, at: int, header: SensHeader, where: str
) -> tuple[NDArray[Any], Int64Array, int]:
    """The fixed part of each record, the start of each, and the end of the last one."""
    if hasattr(os, "posix_fadvise"):  # not on macOS; read-ahead would fetch the images between the records
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_RANDOM)
    # Upper bound of an image: 16-bit RGBA noise needs 8 bytes per pixel and a small trailer.
    most_colour = BYTES_PER_PIXEL * header.colour_width * header.colour_height + BYTES_AROUND
    most_depth = BYTES_PER_PIXEL * header.depth_width * header.depth_height + BYTES_AROUND
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
                f"into the {max(0, n_bytes - at - step)} bytes left; the file is truncated or damaged"
            )
        if colour > most_colour or depth > most_depth:
            raise DataError(
                f"{where}: frame {i} of {n_frames} at byte {at}: images of {colour} and {depth} bytes; "
                f"the image sizes in the header allow at most {most_colour} and {most_depth}; the file is damaged"
            )
        starts[i], at = at, end
    return records, starts, at


def _check_end(handle: int, n_bytes: int, at: int, where: str) -> None:
    """Raise ``DataError`` unless the file ends after the frames or after the motion data announced there."""
    n_left = n_bytes - at
    n = COUNT.unpack(os.pread(handle, COUNT.size, at))[0] if n_left >= COUNT.size else 0
    n_needed = COUNT.size + n * MOTION_BYTES
    if n_left not in (0, n_needed):
        raise DataError(
            f"{where}: {n_left} bytes follow the last frame, from byte {at}; expected none or "
            f"{n_needed} bytes of motion data in {n} records; the file is too long, truncated or damaged"
        )


def _check_length(content: bytes, n_bytes: int, where: str) -> None:
    if len(content) != n_bytes:
        raise DataError(f"{where}: has {len(content)} bytes, expected {n_bytes}; the file is damaged")


def _inflate(content: bytes, n_bytes: int, where: str) -> bytes:
    """The decompressed ``content``; at most ``n_bytes`` + 1 are produced."""
    unpacking = zlib.decompressobj()
    try:
        values = unpacking.decompress(content, n_bytes + 1)
    except zlib.error as error:
        raise DataError(f"{where}: cannot be decompressed ({error}); the file is damaged") from error
    if len(values) > n_bytes:
        raise DataError(f"{where}: decompresses to more than the {n_bytes} bytes of an image; the file is damaged")
    if not unpacking.eof:
        raise DataError(f"{where}: decompression stops after {len(values)} bytes; the file is damaged")
    return values


@dataclass(frozen=True)
class SensFrame:
    """A frame to write: the pose (4, 4), time stamps in microseconds, both images in their stored form."""

    camera_to_world: Float64Array
    colour_timestamp: int
    depth_timestamp: int
    colour: bytes
    depth: bytes

    @property
    def stored(self) -> bytes:
        """The frame record and its images as bytes of the file."""
        record = np.zeros((), FRAME_RECORD)
        record["camera_to_world"] = self.camera_to_world
        record["colour_timestamp"], record["depth_timestamp"] = self.colour_timestamp, self.depth_timestamp
        record["colour_bytes"], record["depth_bytes"] = len(self.colour), len(self.depth)
        return record.tobytes() + self.colour + self.depth


def write_sens(path: Path, header: SensHeader, frames: Iterable[bytes], end: bytes = COUNT.pack(0)) -> None:
    """Write a recording atomically; ``frames`` are the results of ``SensFrame.stored``.

    ``end`` follows the frames: the number of motion data records, and the records.
    """
    with replacing(path) as stream:
        stream.write(header_bytes(header, 0))
        end_of_header, n_frames = stream.tell(), 0
        for frame in frames:
            n_frames += 1
            stream.write(frame)
        stream.write(end)
        stream.seek(end_of_header - COUNT.size)
        stream.write(COUNT.pack(n_frames))
