"""A recording of a colour and a depth camera as the device stored it: two image sizes, raw depth, poses possibly lost.

All storage forms of ScanNet's recordings are read as ``RgbdSource``; the dataset decides which frames are
used and in which of the two cameras.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import InitVar, dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from su3d_bench.core.errors import DataError, FramesMissing
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array, UInt8Array
from su3d_bench.datasets.recordings.recorded_frames import square
from su3d_bench.formats import images
from su3d_bench.formats.arrays import read_text


@dataclass(frozen=True)
class SensorPair:
    """The two cameras of a recording.

    Intrinsics (3, 3) in pixels of their own image; extrinsics (4, 4): that of depth maps points of the depth camera
    into the colour camera, that of colour is the identity in practice. Metres are depth values / ``depth_shift``.
    ``where`` begins the message on inconsistent values.
    """

    colour_size: images.Size
    depth_size: images.Size
    colour_intrinsics: Float64Array
    depth_intrinsics: Float64Array
    colour_extrinsic: Float64Array
    depth_extrinsic: Float64Array
    depth_shift: float
    where: InitVar[str] = "camera"

    def __post_init__(self, where: str) -> None:
        for name, (width, height) in (("colour", self.colour_size), ("depth", self.depth_size)):
            if width < 1 or height < 1 or width * height > images.MAX_PIXELS:
                raise DataError(f"{where}: {name} images of {width}x{height}; expected 1 to {images.MAX_PIXELS} pixels")
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
                raise DataError(f"{where}: the {name} extrinsic has a non-finite value; expected a 4x4 pose")
        if not (np.isfinite(self.depth_shift) and self.depth_shift > 0):
            raise DataError(f"{where}: the depth shift is {self.depth_shift:g}; expected units per metre, above 0")


class RgbdSource(Protocol):
    """The frame records of a recording in order, including those without a usable pose; images are read on access.

    ``where`` (``<dataset>/<scene>``) begins each message; a fault in any file is a ``DataError``.
    """

    where: str
    camera: SensorPair
    numbers: Int64Array  # of the records at full rate; kept by exports that skip frames

    def __len__(self) -> int: ...

    def poses(self) -> Float64Array:
        """Camera-to-world matrices (n, 4, 4) as stored, of the depth camera; non-finite if tracking was lost."""
        ...

    def timestamp_s(self, i: int) -> float:
        """Time of record ``i``; assumes 30 frames per second if the recording has no increasing times."""
        ...

    def colour(self, i: int) -> UInt8Array:
        """Image (H, W, 3) RGB at the colour size of ``camera``."""
        ...

    def depth(self, i: int) -> images.UInt16Array:
        """Values (H, W) as stored, 0 if invalid, at the depth size of ``camera``."""
        ...

    def files(self) -> Sequence[Path]:
        """The files of the recording."""
        ...


Grid = Literal["depth", "colour"]
SAME_RAY_PX = 0.01  # images whose rays differ by less count as aligned; text files keep six digits
IDENTITY_TOLERANCE = 1e-6
MAX_INTRINSIC = 1e6  # pixels; beyond any lens, and safe from overflow


@dataclass(frozen=True)
class Registration:
    """Registers a pair of cameras: both images in the size of the ``grid`` camera.

    ``depth``, the default: depth is unchanged; each of its pixels gets the colour (bilinear) at which
    its point is seen by the colour camera. A pixel without depth uses the nearest depth. A point
    outside the colour image or behind its camera gets the nearest border colour. A point that is occluded for the
    colour camera gets the colour of the occluder.

    ``colour``: colour is unchanged; depth is that of the points seen by the colour camera, each at its nearest
    pixel, the nearest point if several fall on one. Other pixels have no depth: if the colour image
    is larger, most of them.
    """

    camera: SensorPair
    grid: Grid

    @cached_property
    def depth_to_colour(self) -> Float64Array:
        """Transform (4, 4) from the depth camera to the colour camera."""
        # The colour extrinsic is the identity in all of ScanNet; otherwise both map to a common frame.
        matrix: Float64Array = np.linalg.solve(self.camera.colour_extrinsic, self.camera.depth_extrinsic).astype(
            np.float64
        )
        return matrix

    @property
    def intrinsics(self) -> Float64Array:
        """Intrinsics (3, 3) of the registered images."""
        return self.camera.depth_intrinsics if self.grid == "depth" else self.camera.colour_intrinsics

    @cached_property
    def is_identity(self) -> bool:
        """Whether both images have the same size and each pixel the same ray."""
        if self.camera.colour_size != self.camera.depth_size:
            return False
        if np.abs(self.depth_to_colour - np.eye(4)).max() > IDENTITY_TOLERANCE:
            return False
        width, height = self.camera.depth_size
        corners = np.array([[u, v, 1.0] for u in (0, width - 1) for v in (0, height - 1)])
        seen = corners @ np.linalg.inv(self.camera.depth_intrinsics).T @ self.camera.colour_intrinsics.T
        return bool(np.abs(seen[:, :2] / seen[:, 2:] - corners[:, :2]).max() < SAME_RAY_PX)

    @cached_property
    def _from_pose(self) -> Float64Array | None:
        """What a pose of the depth camera is multiplied by; None if poses are unchanged."""
        if self.grid == "depth" or self.is_identity:
            return None
        return np.linalg.inv(self.depth_to_colour).astype(np.float64)

    def camera_to_world(self, depth_camera_to_world: Float64Array) -> Float64Array:
        """The pose of the registered images."""
        return depth_camera_to_world if self._from_pose is None else depth_camera_to_world @ self._from_pose

    def images(self, colour: UInt8Array, depth_m: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Colour (H, W, 3) and depth in metres (H, W) on the grid; 0 is no depth."""
        if self.is_identity:
            return colour, depth_m
        if self.grid == "depth":
            return self._colour_at_depth(colour, depth_m), depth_m
        return colour, self._depth_at_colour(depth_m)

    @cached_property
    def _rays(self) -> Float32Array:
        """The ray of each depth pixel in homogeneous coordinates of the colour image (3, H, W), at depth 1."""
        width, height = self.camera.depth_size
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        pixels = np.stack([u, v, np.ones_like(u)])
        turn = (
            self.camera.colour_intrinsics @ self.depth_to_colour[:3, :3] @ np.linalg.inv(self.camera.depth_intrinsics)
        )
        return np.tensordot(turn, pixels, axes=1).astype(np.float32)

    @cached_property
    def _shift(self) -> Float32Array:
        """Offset (3,) from the distance of the two cameras, added to ``_rays`` times depth."""
        return (self.camera.colour_intrinsics @ self.depth_to_colour[:3, 3]).astype(np.float32)

    def _seen_at(self, depth_m: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Column, row and depth in the colour camera of each depth pixel; column and row are -1 behind it."""
        z = self._rays[2] * depth_m + self._shift[2]
        divisor = np.where(z > 0, z, 1)
        x = np.where(z > 0, (self._rays[0] * depth_m + self._shift[0]) / divisor, -1)
        y = np.where(z > 0, (self._rays[1] * depth_m + self._shift[1]) / divisor, -1)
        return x, y, z

    @cached_property
    def _fixed_places(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows for cameras with the same centre: independent of depth."""
        return self._seen_at(np.ones(self._rays.shape[1:], np.float32))[:2]

    def _colour_at_depth(self, colour: UInt8Array, depth_m: Float32Array) -> UInt8Array:
        import cv2

        x, y = self._seen_at(filled(depth_m))[:2] if self._shift.any() else self._fixed_places
        seen = cv2.remap(colour, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, np.uint8)

    def _depth_at_colour(self, depth_m: Float32Array) -> Float32Array:
        width, height = self.camera.colour_size
        x, y, z_m = self._seen_at(depth_m)
        x, y = np.rint(x), np.rint(y)
        is_seen = (depth_m > 0) & (z_m > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        nearest = np.full(width * height, np.inf, np.float32)
        at = y[is_seen].astype(np.int64) * width + x[is_seen].astype(np.int64)
        np.minimum.at(nearest, at, z_m[is_seen])
        nearest[np.isinf(nearest)] = 0
        return nearest.reshape(height, width)


def filled(depth_m: Float32Array) -> Float32Array:
    """Depth with gaps filled by the nearest pixel that has some; 1 m if none has any."""
    is_empty = depth_m <= 0
    if not is_empty.any():
        return depth_m
    if is_empty.all():
        return np.ones_like(depth_m)
    import cv2

    _, source = cv2.distanceTransformWithLabels(
        is_empty.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels count the pixels with depth in row-major order, from 1.
    return np.asarray(depth_m[~is_empty][source - 1], np.float32)


def make_registration(camera: SensorPair, grid: Grid, where: str) -> Registration:
    """The registration of a pair of cameras; a ``DataError`` unless they are pinhole cameras a rigid motion apart."""
    for name, matrix in (("colour", camera.colour_extrinsic), ("depth", camera.depth_extrinsic)):
        if not are_rigid(matrix[None])[0]:
            raise DataError(f"{where}: the {name} extrinsic is not a rigid motion; expected a 4x4 pose, metres")
    for name, matrix in (("colour", camera.colour_intrinsics), ("depth", camera.depth_intrinsics)):
        is_upper = matrix[1, 0] == 0 and (matrix[2] == (0, 0, 1)).all()
        if not is_upper or np.abs(matrix).max() > MAX_INTRINSIC:
            raise DataError(f"{where}: the {name} intrinsics are no camera matrix; expected fx 0 cx / 0 fy cy / 0 0 1")
    return Registration(camera, grid)


FRAMES_PER_SECOND = 30.0  # of ScanNet's recordings; the exports have no times
EXPORT_AGAIN = "export the recording again"
NumberedNames = Mapping[int, str]  # the number of a frame to the name of its file


@dataclass(frozen=True)
class FrameFiles:
    """Files of one frame, relative to the export folder, and its number at full rate."""

    number: int
    colour: str
    depth: str
    pose: str


@dataclass(eq=False)
class ExportedFrames:
    """An export as an ``RgbdSource``; files are read on access.

    ``camera_files`` describe the cameras; ``size_reason`` explains, in the message on an
    image of another size, why it should have the size of ``camera``.
    """

    folder: Path
    where: str
    camera: SensorPair
    frames: Sequence[FrameFiles]
    camera_files: Sequence[str]
    size_reason: str

    def __post_init__(self) -> None:
        self.numbers: Int64Array = np.array([frame.number for frame in self.frames], np.int64)

    def __len__(self) -> int:
        return len(self.frames)

    def pose(self, i: int) -> Float64Array:
        return read_matrix(self.folder, self.frames[i].pose, self.where)

    def poses(self) -> Float64Array:
        return np.array([self.pose(i) for i in range(len(self))]).reshape(-1, 4, 4)

    def timestamp_s(self, i: int) -> float:
        return int(self.numbers[i]) / FRAMES_PER_SECOND

    def colour(self, i: int) -> UInt8Array:
        where, content = self._read(self.frames[i].colour)
        return images.sized(images.decode_colour, content, self.camera.colour_size, where, self.size_reason)

    def depth(self, i: int) -> images.UInt16Array:
        where, content = self._read(self.frames[i].depth)
        return images.sized(images.decode_depth, content, self.camera.depth_size, where, self.size_reason)

    def files(self) -> Sequence[Path]:
        images = (name for frame in self.frames for name in (frame.colour, frame.depth, frame.pose))
        return [self.folder / name for name in (*self.camera_files, *images)]

    def _read(self, name: str) -> tuple[str, bytes]:
        where = f"{self.where}: {name}"
        return where, images.read_bytes(self.folder / name, where, EXPORT_AGAIN)


def read_matrix(folder: Path, name: str, where: str, sides: Sequence[int] = (4,)) -> Float64Array:
    """The square matrix in a text file, with a number of rows in ``sides``; values may be non-finite."""
    where = f"{where}: {name}"
    return square(read_text(folder / name, where, EXPORT_AGAIN).split(), where, sides)


def read_size(folder: Path, name: str, where: str) -> images.Size:
    """Width and height of an image file, from its header."""
    size = images.image_size(images.read_bytes(folder / name, f"{where}: {name}", EXPORT_AGAIN))
    if size is None:
        raise DataError(f"{where}: {name}: not a readable image; {EXPORT_AGAIN}")
    return size


def list_folder(folder: Path, name: str, where: str) -> list[str]:
    """The sorted names in a folder, except hidden ones."""
    try:
        return sorted(entry.name for entry in os.scandir(folder / name) if not entry.name.startswith("."))
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            raise FramesMissing(f"{where}: {name}/ is missing; {EXPORT_AGAIN}") from error
        raise DataError(f"{where}: {name}/ cannot be read: {error.strerror}; {EXPORT_AGAIN}") from error


def missing_parts(folder: Path, *names: str) -> str:
    """A clause on the files and folders that ``folder`` lacks; '' if none. A name may have an alternative: ``a or b``.

    >>> missing_parts(Path("nowhere"), "rgb or rgb.mkv", "depth")
    'rgb or rgb.mkv, depth are missing'
    """
    absent = [name for name in names if not any((folder / one).exists() for one in name.split(" or "))]
    return f"{', '.join(absent)} {'is' if len(absent) == 1 else 'are'} missing" if absent else ""


def by_number(names: Sequence[str], pattern: str, where: str) -> NumberedNames:
    """The names that match ``pattern``, by frame number (its first group); any other name is an error."""
    name_of: dict[int, str] = {}
    extra = []
    for name in names:
        match = re.fullmatch(pattern, name, re.ASCII)
        if match is None or int(match[1]) in name_of:
            extra.append(name)
        else:
            name_of[int(match[1])] = name
    if extra:
        raise DataError(f"{where} holds {extra[0][:60]!r}{_more(len(extra))}, which belongs to no frame; move it away")
    return name_of


def every_kth(known: set[int]) -> range:
    """The frame numbers of an export that kept every k-th frame, starting at 0, inferred from ``known``."""
    return range(0, max(known) + 1, math.gcd(*known) or 1)


def check_complete(kinds: Mapping[str, NumberedNames], expected: range, where: str, advice: str = EXPORT_AGAIN) -> None:
    """Raise ``DataError`` unless each kind of file exists for exactly the ``expected`` frames.

    The keys are file names with {} in place of the number, for messages.
    """
    there = {name: {number for number in files if number in expected} for name, files in kinds.items()}
    n_missing = sum(len(expected) - len(known) for known in there.values())
    if n_missing:
        first = next(name.format(n) for name, known in there.items() for n in expected if n not in known)
        raise DataError(f"{where}: {first} is missing{_more(n_missing)}; {advice}")
    extra = [name for files in kinds.values() for number, name in files.items() if number not in expected]
    if extra:
        raise DataError(
            f"{where}: the recording has {len(expected)} frames, but there is also {extra[0][:60]}{_more(len(extra))}; "
            f"{advice}"
        )


def _more(n: int) -> str:
    return f", and {n - 1} more" if n > 1 else ""
