"""Posed RGB-D frames of the iPhone: available frames, their images, and both registered to one camera.

Colour comes from ``rgb/`` or ``rgb.mkv``, depth from ``depth/`` or ``depth.bin``. Both images show the same
view and differ only in scale. Frames have at most the requested number of columns: colour is
averaged, depth takes the nearest value, as the toolkit's authors advise (scannetpp/scannetpp, issue 140).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from su3d_bench.core.errors import DataError, FramesMissing, counted
from su3d_bench.core.types import Float32Array, Float64Array, Frame, UInt8Array
from su3d_bench.datasets.recordings.recorded_frames import StoredDepth, colour_at, depth_m_of_values, nearest_at
from su3d_bench.datasets.recordings.source import list_folder, missing_parts, read_size
from su3d_bench.datasets.scannetpp import images, poses
from su3d_bench.formats.images import Size, UInt16Array, decode_colour, decode_depth, read_bytes, sized

PoseSource = Literal["auto", "colmap", "tracking"]
COLOUR_FOLDER, DEPTH_FOLDER = "rgb", "depth"
COLOUR_ENDINGS, DEPTH_ENDINGS = (".jpg", ".png"), (".png",)
FRAMES_PER_SECOND = 60.0  # of the iPhone's video
EXTRACT_AGAIN = "extract the frames again with the official toolkit"
DEPTH_M_OF_VALUE = depth_m_of_values(images.UNITS_PER_METRE)


def pose_source(folder: Path, kind: PoseSource) -> PoseSource:
    """The poses to read in the iPhone's ``folder``; COLMAP's if both are available."""
    if kind != "auto":
        return kind
    return (
        "colmap"
        if (folder / poses.COLMAP / poses.IMAGES_NAME).exists() or not (folder / poses.TRACKING_NAME).exists()
        else "tracking"
    )


def describe_recording(folder: Path, kind: PoseSource) -> str:
    """One-line summary of the frames from a quick look at the iPhone's ``folder``."""
    if folder.is_dir() and (missing := missing_parts(folder, "rgb or rgb.mkv", "depth or depth.bin")):
        return missing
    source = pose_source(folder, kind)
    path = folder / poses.COLMAP / poses.IMAGES_NAME if source == "colmap" else folder / poses.TRACKING_NAME
    if not path.is_file():
        return "no frames of the iPhone"
    if source == "tracking":
        return "frames with the phone's poses"
    n = poses.n_registered(path)
    return "frames with COLMAP's poses" if n is None else counted(n, "frame")


@dataclass(frozen=True, eq=False)
class IphoneRecording:
    """A recording with its poses; ``colour_of`` and ``depth_of`` are the extracted files by frame number, None if
    images come out of the video and ``depth.bin``."""

    folder: Path
    where: str
    posed: poses.PosedFrames
    colour_of: Mapping[int, str] | None
    depth_of: Mapping[int, str] | None

    @cached_property
    def usable(self) -> list[int]:
        """The rows of ``posed`` with a usable pose."""
        return np.flatnonzero(np.isfinite(self.posed.poses).all(axis=(1, 2))).tolist()

    def every(self, stride: int) -> list[int]:
        """Usable rows among every ``stride``-th; one without a pose is not replaced."""
        return [row for row in self.usable if row % stride == 0]

    def missing_frames_remark(self) -> str | None:
        """A message with the number of frames without a pose."""
        n, n_usable = len(self.posed.numbers), len(self.usable)
        return None if n == n_usable else f"{self.where}: frames without a pose, excluded: {n - n_usable} of {n}"

    def files(self) -> list[Path]:
        numbers = [int(self.posed.numbers[row]) for row in self.usable]
        paths = list(self.posed.files)
        for name, file_of in ((images.VIDEO_NAME, self.colour_of), (images.DEPTH_NAME, self.depth_of)):
            paths += [self.folder / name] if file_of is None else [self.folder / file_of[n] for n in numbers]
        return paths


def open_recording(folder: Path, where: str, kind: PoseSource = "auto") -> IphoneRecording:
    """The recording in the ``iphone`` folder of a scene."""
    if not folder.is_dir():
        raise FramesMissing(f"{where}: no iphone/ folder; only the iPhone's frames are used, the DSLR's have no depth")
    colour_of = _extracted(folder, COLOUR_FOLDER, COLOUR_ENDINGS, images.VIDEO_NAME, where)
    depth_of = _extracted(folder, DEPTH_FOLDER, DEPTH_ENDINGS, images.DEPTH_NAME, where)
    if pose_source(folder, kind) == "colmap":
        posed = poses.read_colmap(folder / poses.COLMAP, where)
    else:
        posed = poses.read_tracking(folder / poses.TRACKING_NAME, where, _colour_size(folder, colour_of, where))
    recording = IphoneRecording(folder, where, posed, colour_of, depth_of)
    numbers = [int(posed.numbers[row]) for row in recording.usable]
    for name, ending, file_of in (
        (COLOUR_FOLDER, COLOUR_ENDINGS[0], colour_of),
        (DEPTH_FOLDER, DEPTH_ENDINGS[0], depth_of),
    ):
        missing = [] if file_of is None else [number for number in numbers if number not in file_of]
        if missing:
            more = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise DataError(f"{where}: {name}/frame_{missing[0]:06d}{ending} is missing{more}; {EXTRACT_AGAIN}")
    return recording


def _colour_size(folder: Path, colour_of: Mapping[int, str] | None, where: str) -> Size:
    """The size of the colour images, from the first one."""
    if colour_of is None:
        return images.video_size(folder / images.VIDEO_NAME, where)
    if not colour_of:
        raise DataError(f"{where}: {COLOUR_FOLDER}/ has no frames; {EXTRACT_AGAIN}")
    return read_size(folder, colour_of[min(colour_of)], where)


def _extracted(folder: Path, name: str, endings: Sequence[str], packed: str, where: str) -> Mapping[int, str] | None:
    """The extracted files by frame number; None if the ``packed`` file is to be read."""
    if not (folder / name).is_dir():
        if not os.path.lexists(folder / packed):
            raise FramesMissing(f"{where}: neither {name}/ nor {packed} is in {folder}; copy one of them there")
        return None
    file_of: dict[int, str] = {}
    for file in list_folder(folder, name, where):
        match = poses.FRAME_NAME.fullmatch(file)
        if match is not None and file.endswith(tuple(endings)):
            file_of.setdefault(int(match[1]), f"{name}/{file}")
    return file_of


class IphoneFrames(Sequence[Frame]):
    """The frames of ``rows``, at most ``width`` columns wide, each read on access."""

    def __init__(self, recording: IphoneRecording, rows: Sequence[int], width: int) -> None:
        self._recording, self._rows = recording, rows
        full_width, full_height = recording.posed.size
        self.size: Size = min(width, full_width), max(1, round(full_height * min(width, full_width) / full_width))
        self._depth = StoredDepth(recording.where, DEPTH_M_OF_VALUE)
        wanted = frozenset(int(recording.posed.numbers[row]) for row in rows)
        folder, where = recording.folder, recording.where
        if recording.colour_of is None:
            video = folder / images.VIDEO_NAME
            self._video = images.VideoFile(video, where, recording.posed.size, wanted, self._colour_at_size)
        if recording.depth_of is None:
            self._packed = images.DepthFile(folder / images.DEPTH_NAME, where, wanted)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        row, posed = self._rows[position], self._recording.posed
        number = int(posed.numbers[row])
        return Frame(
            index=number,
            timestamp_s=number / FRAMES_PER_SECOND,
            rgb=self._colour(number),
            depth_m=self._at_size(self._depth.depth_m(self._depth_values(number))),
            camera_to_world=posed.poses[row],
            intrinsics=self.intrinsics(row),
        )

    def intrinsics(self, row: int) -> Float64Array:
        """The intrinsics (3, 3) for the frames' size, with the centre of the first pixel at 0."""
        full = self._recording.posed
        matrix: Float64Array = full.intrinsics[row].copy()
        matrix[:2] *= np.array(self.size)[:, None] / np.array(full.size)[:, None]
        matrix[:2, 2] -= 0.5
        return matrix

    def _colour(self, number: int) -> UInt8Array:
        if self._recording.colour_of is None:
            return self._video.image(number)
        where, content = self._content(self._recording.colour_of[number])
        size = self._recording.posed.size
        return self._colour_at_size(sized(decode_colour, content, size, where, "as in the camera file"))

    def _depth_values(self, number: int) -> UInt16Array:
        if self._recording.depth_of is None:
            return self._packed.values(number)
        where, content = self._content(self._recording.depth_of[number])
        return sized(decode_depth, content, images.DEPTH_SIZE, where, "the size of the iPhone's depth")

    def _content(self, name: str) -> tuple[str, bytes]:
        where = f"{self._recording.where}: {name}"
        return where, read_bytes(self._recording.folder / name, where, EXTRACT_AGAIN)

    @cached_property
    def _straightening(self) -> tuple[Float32Array, Float32Array] | None:
        """Column and row in the distorted image for each pixel (H, W); None without distortion.

        If COLMAP gives a distortion, all frames have one camera.
        """
        distortion = self._recording.posed.distortion
        if not distortion.any():
            return None
        import cv2

        matrix = self.intrinsics(0)
        maps = cv2.initUndistortRectifyMap(matrix, distortion, np.eye(3), matrix, self.size, cv2.CV_32FC1)
        return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)

    def _colour_at_size(self, colour: UInt8Array) -> UInt8Array:
        import cv2

        colour = colour_at(colour, self.size)
        if self._straightening is None:
            return colour
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(colour, *self._straightening, cv2.INTER_LINEAR, borderMode=border), np.uint8)

    def _at_size(self, depth_m: Float32Array) -> Float32Array:
        import cv2

        depth_m = nearest_at(depth_m, self.size)
        if self._straightening is None:
            return depth_m
        return np.asarray(cv2.remap(depth_m, *self._straightening, cv2.INTER_NEAREST), np.float32)
