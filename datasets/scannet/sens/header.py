"""The header of a ``.sens`` file: what kind of cameras recorded it, how its images are stored, how many frames follow.

Little-endian, without padding. Source: ScanNet, SensReader/c++/sensorData.h at commit 3830fce.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.images import MAX_PIXELS

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
