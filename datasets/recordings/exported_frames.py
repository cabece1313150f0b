"""Frames whose colour, depth and pose lie in one file each: which files belong together, and reading them.

A frame that lost a file, or a file that no frame needs, is an error, because a program that only counts files would
pair the wrong ones.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.datasets.recordings.recorded_frames import square
from su3d_bench.datasets.recordings.source import SensorPair
from su3d_bench.formats.images import Size, UInt16Array, decode_colour, decode_depth, image_size, read_bytes, sized
from su3d_bench.formats.text_files import read_text

FRAMES_PER_SECOND = 30.0  # of ScanNet's recordings; the exports have no times
EXPORT_AGAIN = "export the recording again"
NumberedNames = Mapping[int, str]  # the number of a frame to the name of its file


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame, below the folder of the export, and its number at full rate."""

    number: int
    colour: str
    depth: str
    pose: str


@dataclass(frozen=True, eq=False)
class ExportedFrames:
    """An export as an ``RgbdSource``; each file is read when it is asked for.

    ``camera_files`` are the names of the files that describe the cameras; ``size_reason`` says in the message about an
    image of another size why it should have that of ``camera``.
    """

    folder: Path
    where: str
    camera: SensorPair
    frames: Sequence[FrameFiles]
    camera_files: Sequence[str]
    size_reason: str

    def __len__(self) -> int:
        return len(self.frames)

    def pose(self, i: int) -> Float64Array:
        return read_matrix(self.folder, self.frames[i].pose, self.where)

    def poses(self) -> Float64Array:
        return self._poses.copy()

    @cached_property
    def _poses(self) -> Float64Array:
        return np.array([self.pose(i) for i in range(len(self))]).reshape(-1, 4, 4)

    def timestamp_s(self, i: int) -> float:
        return self.frame_number(i) / FRAMES_PER_SECOND

    def colour(self, i: int) -> UInt8Array:
        where, content = self._read(self.frames[i].colour)
        return sized(decode_colour, content, self.camera.colour_size, where, self.size_reason)

    def depth(self, i: int) -> UInt16Array:
        where, content = self._read(self.frames[i].depth)
        return sized(decode_depth, content, self.camera.depth_size, where, self.size_reason)

    def frame_number(self, i: int) -> int:
        return self.frames[i].number

    def files(self) -> Sequence[Path]:
        images = (name for frame in self.frames for name in (frame.colour, frame.depth, frame.pose))
        return [self.folder / name for name in (*self.camera_files, *images)]

    def _read(self, name: str) -> tuple[str, bytes]:
        where = f"{self.where}: {name}"
        return where, read_bytes(self.folder / name, where, EXPORT_AGAIN)


def read_matrix(folder: Path, name: str, where: str, sides: Sequence[int] = (4,)) -> Float64Array:
    """The square matrix, of as many rows as one of ``sides``, in a text file; its numbers may be not finite."""
    where = f"{where}: {name}"
    return square(read_text(folder / name, where, EXPORT_AGAIN).split(), where, sides)


def read_size(folder: Path, name: str, where: str) -> Size:
    """Width and height of an image file by its header."""
    size = image_size(read_bytes(folder / name, f"{where}: {name}", EXPORT_AGAIN))
    if size is None:
        raise DataError(f"{where}: {name}: not a readable image; {EXPORT_AGAIN}")
    return size


def list_folder(folder: Path, name: str, where: str) -> list[str]:
    """The names in a folder, sorted; without hidden ones, which systems leave behind."""
    try:
        return sorted(entry.name for entry in os.scandir(folder / name) if not entry.name.startswith("."))
    except OSError as error:
        raise DataError(f"{where}: {name}/ cannot be read: {error.strerror}; {EXPORT_AGAIN}") from error


def by_number(names: Sequence[str], pattern: str, where: str) -> NumberedNames:
    """The names that match ``pattern`` by its first group, the number of the frame; another name is an error."""
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
    """The numbers of an export from 0 that left out all but every k-th frame, as far as ``known`` tells."""
    return range(0, max(known) + 1, math.gcd(*known) or 1)


def check_complete(kinds: Mapping[str, NumberedNames], expected: range, where: str) -> None:
    """Raise ``DataError`` unless each kind of file is there for exactly the ``expected`` frames.

    The keys are what the name of a missing file would be, with {} in place of its number.
    """
    there = {name: {number for number in files if number in expected} for name, files in kinds.items()}
    n_missing = sum(len(expected) - len(known) for known in there.values())
    if n_missing:
        first = next(name.format(n) for name, known in there.items() for n in expected if n not in known)
        raise DataError(f"{where}: {first} is missing{_more(n_missing)}; {EXPORT_AGAIN}")
    extra = [name for files in kinds.values() for number, name in files.items() if number not in expected]
    if extra:
        raise DataError(
            f"{where}: the recording has {len(expected)} frames, but there is also {extra[0][:60]}{_more(len(extra))}; "
            f"{EXPORT_AGAIN}"
        )


def _more(n: int) -> str:
    return f", and {n - 1} more" if n > 1 else ""
