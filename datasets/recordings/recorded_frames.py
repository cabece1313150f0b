"""Shared by readers of loose recordings: size-limited text files, confined paths, rigid poses, and frames
that are each read from one colour and one depth file.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float32Array, Float64Array, Frame, UInt8Array
from su3d_bench.formats.images import Size, UInt16Array, decode_colour, decode_depth, read_bytes

MAX_NAME_LENGTH = 255  # of a path component, in all current file systems
N_DEPTH_VALUES = 1 << 16
LARGEST_DEPTH_VALUE = N_DEPTH_VALUES - 1
# Required empty range below the largest value: 6.6 m in millimetres, 1 m in Replica's unit.
STANDS_APART = 0.1
logger = logging.getLogger(__name__)


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Turn failures to read a file in the block into ``DataError``."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{where}: {error.filename} cannot be read: {error.strerror}") from error


def depth_m_of_values(units_per_metre: float) -> Float32Array:
    """Metres (65536,) of every possible value of a depth image."""
    return (np.arange(N_DEPTH_VALUES) / units_per_metre).astype(np.float32)


class StoredDepth:
    """Depth images in metres; 65535 counts as no depth if it is far from all other values of the image.

    7-Scenes and many other recorders write "no depth" this way; if depths come near it, it is a real depth.
    ``metres`` (65536,) float32 map every value, 0 if it means no depth. Unless ``is_quiet``, dropped depth is
    logged once, with the same text whichever image is read first.
    """

    def __init__(self, where: str, metres: Float32Array, *, is_quiet: bool = False) -> None:
        self._where = where
        self._metres = metres
        self._is_said = is_quiet
        self._saying = Lock()  # frames are read by several threads

    def depth_m(self, values: UInt16Array) -> Float32Array:
        """Depth (H, W) m of an image with these ``values``, 0 for no depth."""
        depth_m = self._metres.take(values)  # twice as fast as indexing
        far_m = float(self._metres[LARGEST_DEPTH_VALUE])
        if far_m > 0 and values.max() == LARGEST_DEPTH_VALUE:
            is_largest = values == LARGEST_DEPTH_VALUE
            others_m = float(depth_m.max(initial=0.0, where=~is_largest))
            if others_m < (1 - STANDS_APART) * far_m:
                depth_m[is_largest] = 0
                self._say(far_m)
        return depth_m

    def _say(self, far_m: float) -> None:
        with self._saying:
            was_said, self._is_said = self._is_said, True
        if not was_said:
            apart = f"depth {LARGEST_DEPTH_VALUE} ({far_m:.4g} m) counts as no depth"
            logger.warning("%s: %s if it is far from all other depths of its image", self._where, apart)


def numbers(words: Sequence[str], where: str) -> list[float]:
    """The words as numbers, which may be non-finite."""
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            raise DataError(f"{where}: {word[:20]!r} is not a number") from None
    return values


def square(words: Sequence[str], where: str, sides: Sequence[int] = (4,)) -> Float64Array:
    """The words as a square matrix, row by row."""
    for side in sides:
        if len(words) == side * side:
            return np.array(numbers(words, where)).reshape(side, side)
    expected = " or ".join(f"{side * side}, a {side}x{side} matrix" for side in sides)
    raise DataError(f"{where} has {len(words)} values; expected {expected}")


class Folder:
    """A folder whose files are named by other files; a name that points outside is a ``DataError``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._resolved = path.resolve()
        self._is_inside: dict[Path, bool] = {}

    def file(self, name: str, where: str) -> Path:
        """The path of ``name``, which may be missing; symbolic links in it must end inside the folder too."""
        parts = PurePosixPath(name).parts
        if not name.isprintable() or not parts or max(map(len, parts)) > MAX_NAME_LENGTH:
            raise DataError(f"{where}: {name[:40]!r} is not a file name")
        path = self.path / name
        if ".." in parts or name.startswith("/") or not self._leads_inside(path):
            raise DataError(f"{where}: {name[:80]!r} leads out of the folder; name files inside it")
        return path

    def _leads_inside(self, path: Path) -> bool:
        parent = path.parent
        try:
            if parent not in self._is_inside:
                self._is_inside[parent] = parent.resolve().is_relative_to(self._resolved)
            return self._is_inside[parent] and (not path.is_symlink() or path.resolve().is_relative_to(self._resolved))
        except (OSError, RuntimeError):  # name too long, or circular links
            return False


@dataclass(frozen=True)
class RecordedFrame:
    """Source of a frame: names of its colour and depth file in the folder, camera-to-world pose (4, 4)."""

    index: int
    timestamp_s: float
    colour: str
    depth: str
    pose: Float64Array


@dataclass(frozen=True)
class Recording:
    """The usable frames of a scene; ``metres`` (65536,) map every depth value, 0 for no depth.

    ``files``: all files read besides the images; ``image_size``: from the camera file, if stated there;
    ``missing``: one line per reason why frames were excluded.
    """

    where: str
    folder: Folder
    frames: tuple[RecordedFrame, ...]
    intrinsics: Float64Array
    metres: Float32Array
    files: tuple[Path, ...]
    image_size: Size | None = None
    missing: tuple[str, ...] = ()

    def images(self) -> list[Path]:
        return [self.folder.path / name for frame in self.frames for name in (frame.colour, frame.depth)]

    def digest(self) -> str:
        """A key of the content of ``files``, the names and sizes of all images, and the content of the first and
        last frame; a changed image in the middle is not detected if its size is unchanged."""
        total = hashlib.sha256()
        images = self.images()
        with reading(self.where):
            for path in (*self.files, *images[:2], *images[-2:]):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
            for path in images:
                total.update(f"{path.name} {path.stat().st_size}\n".encode())
        return total.hexdigest()


class RecordedFrames(Sequence[Frame]):
    """Every ``stride``-th usable frame, read on access; a file that cannot be used is a ``DataError``.

    ``is_quiet``: do not log depth that counts as none, because the frames are read elsewhere too.
    """

    advice = "copy the recording again"

    def __init__(self, recording: Recording, stride: int = 1, *, is_quiet: bool = False) -> None:
        self._recording = recording
        self._frames = recording.frames[::stride]
        self._depth = StoredDepth(recording.where, recording.metres, is_quiet=is_quiet)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        frame, recording = self._frames[position], self._recording
        where, content = self._read(frame.colour)
        rgb = decode_colour(content, where)
        self.check_size(rgb.shape[1], rgb.shape[0], where)
        depth_m = self._depth.depth_m(self._depth_values(frame, rgb))
        return Frame(frame.index, frame.timestamp_s, rgb, depth_m, frame.pose, recording.intrinsics)

    def check_size(self, width: int, height: int, where: str) -> None:
        """Raise ``DataError`` if a colour image of this size does not fit the recording's camera."""
        expected, (cx, cy) = self._recording.image_size, self._recording.intrinsics[:2, 2]
        if expected is not None and expected != (width, height):
            raise DataError(
                f"{where} is {width}x{height}, the camera file has {expected[0]}x{expected[1]}; intrinsics belong to "
                "one image size"
            )
        if not (0 <= cx <= width and 0 <= cy <= height):
            raise DataError(
                f"{where} is {width}x{height} but the principal point is ({cx:g}, {cy:g}); intrinsics belong to one "
                "image size"
            )

    def check_depth(self, values: UInt16Array, where: str) -> None:
        """Raise ``DataError`` if a depth image cannot be right."""

    def _depth_values(self, frame: RecordedFrame, rgb: UInt8Array) -> UInt16Array:
        where, content = self._read(frame.depth)
        values = decode_depth(content, where)
        if values.shape != rgb.shape[:2]:
            raise DataError(
                f"{where} is {values.shape[1]}x{values.shape[0]} and {frame.colour} is {rgb.shape[1]}x{rgb.shape[0]}; "
                "both must have one size, the depth registered to the colour"
            )
        self.check_depth(values, where)
        return values

    def _read(self, name: str) -> tuple[str, bytes]:
        where = f"{self._recording.where}: {name}"
        return where, read_bytes(self._recording.folder.path / name, where, self.advice)


def colour_at(colour: UInt8Array, size: Size) -> UInt8Array:
    """The image resized to ``size`` (width, height) by averaging."""
    import cv2

    is_same = colour.shape[1::-1] == size
    return colour if is_same else np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), np.uint8)


def nearest_at(image: NDArray[Any], size: Size) -> NDArray[Any]:
    """The image resized to ``size`` (width, height) by nearest neighbour."""
    import cv2

    is_same = image.shape[1::-1] == size
    return image if is_same else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT), image.dtype)


def left_out(where: str, names: Sequence[str], what: str, n_used: int) -> list[str]:
    """The line (if any) with the number excluded and the first; logged when frames are used without them."""
    if not names:
        return []
    line = f"{where}: {len(names)} {what} (the first: {names[0][:80]}); excluded, {n_used} frames are used"
    if n_used:
        logger.warning("%s", line)
    return [line]


def pinhole(fx: float, fy: float, cx: float, cy: float, where: str) -> Float64Array:
    """Intrinsics (3, 3); impossible values are a ``DataError``."""
    values = (fx, fy, cx, cy)
    # 1e6 pixels: beyond any lens on an image of MAX_PIXELS
    if not all(np.isfinite(value) and abs(value) < 1e6 for value in values) or min(fx, fy) <= 0:
        shown = " ".join(f"{value:g}" for value in values)
        raise DataError(f"{where}: fx fy cx cy are {shown}; expected pixels, focal lengths above 0")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
