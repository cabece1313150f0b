"""The phone's recording: colour, depth, confidence and one camera file per image, matched by time stamp."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from su3d_bench.core.errors import DataError, FramesMissing
from su3d_bench.core.types import Float32Array, Float64Array, Frame, Int64Array
from su3d_bench.datasets.recordings import recorded_frames
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.images import Size, decode_colour, decode_depth, read_bytes, sized

N_COLUMNS = 7  # time, rotation axis times angle, translation: DATA.md of apple/ARKitScenes at 7283761
MAX_ROTATION = 1e3  # rad; writers need at most half a turn
# FrameReaderDataLoaderLowRes of opensun3d_challenge_utils.py, OpenSun3D/cvpr24-challenge at 59db30f: an image with no
# pose nearer than this is dropped, and pose times are rounded to milliseconds.
MAX_DIFFERENCE_S = 0.3
MILLISECONDS = 3


@dataclass(frozen=True)
class Trajectory:
    """``times_s`` (n,) ascending, each once; ``poses`` (n, 4, 4) camera-to-world, metres."""

    times_s: Float64Array
    poses: Float64Array

    def nearest(self, times_s: Float64Array, most_s: float = MAX_DIFFERENCE_S) -> Int64Array:
        """The row of the pose nearest to each time, the later of two equally near; -1 if none is within ``most_s``."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 0, len(self.times_s) - 1)
        before = np.maximum(after - 1, 0)
        is_before = np.abs(times_s - self.times_s[before]) < np.abs(times_s - self.times_s[after])
        row = np.where(is_before, before, after)
        return np.where(np.abs(self.times_s[row] - times_s) < most_s, row, -1)


def read_trajectory(path: Path, where: str) -> Trajectory:
    """The poses of a file ``lowres_wide.traj``, whose lines are world-to-camera; for equal times the last counts."""
    rows: dict[float, list[float]] = {}
    for number, line in enumerate(read_text(path, where).split("\n"), start=1):
        words = line.split()
        if not words:
            continue
        at = f"{where} line {number}"
        if len(words) != N_COLUMNS:
            raise DataError(f"{at}: has {len(words)} values; expected time, axis-angle and translation, {N_COLUMNS}")
        time_s, *rest = recorded_frames.numbers(words, at)
        is_usual = 0 <= time_s < 1e12 and max(map(abs, rest[:3])) < MAX_ROTATION and max(map(abs, rest[3:])) < 1e6
        if not is_usual:  # also false for non-finite values
            shown = " ".join(f"{value:g}" for value in (time_s, *rest))
            raise DataError(f"{at}: is {shown}; expected seconds, radians and metres; copy the file again")
        rows[round(time_s, MILLISECONDS)] = rest
    if not rows:
        raise DataError(f"{where}: has no pose; copy the file again")
    times_s = np.array(sorted(rows))
    return Trajectory(times_s, _camera_to_world(np.array([rows[time] for time in times_s.tolist()])))


def _camera_to_world(rows: Float64Array) -> Float64Array:
    """Poses (n, 4, 4) of rows (n, 6) of world-to-camera axis-angle and translation."""
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    turned = Rotation.from_rotvec(rows[:, :3]).inv().as_matrix()
    poses[:, :3, :3] = turned
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", turned, rows[:, 3:])
    return poses


Images = Literal["lowres", "wide"]
TRAJECTORY_NAME = "lowres_wide.traj"
LOWRES, WIDE, DEPTH, FINE_DEPTH, CONFIDENCE = "lowres_wide", "wide", "lowres_depth", "highres_depth", "confidence"
COLOUR_FOLDER: Mapping[Images, str] = {"lowres": LOWRES, "wide": WIDE}
UNITS_PER_METRE = 1000.0  # DATA.md of apple/ARKitScenes at 7283761: millimetres
DEPTH_M_OF_VALUE = recorded_frames.depth_m_of_values(UNITS_PER_METRE)
MAX_CONFIDENCE = 2
# Apple's and the challenge's readers look for a camera file at the exact time, then 1 ms before and after.
NEIGHBOURS_MS = (0, -1, 1)
MAX_DEPTH_AWAY_MS = 5  # depth of a wide image has its own time stamp: half of a sixtieth of a second
LARGEST_SIDE = 16384
ADVICE = "download the scene again"


def camera_folder(colour: str) -> str:
    return f"{colour}_intrinsics"


@dataclass(frozen=True)
class Image:
    """File names of one frame, relative to the folder; ``confidence`` is None if not requested."""

    time_ms: int
    colour: str
    depth: str
    camera: str
    confidence: str | None = None

    @property
    def names(self) -> list[str]:
        return [self.colour, self.depth, self.camera, *([] if self.confidence is None else [self.confidence])]


@dataclass(frozen=True)
class PhoneRecording:
    """The usable images of a scene in temporal order, with the row of the pose of each.

    ``missing``: one line per reason why images were excluded.
    """

    where: str
    folder: Path
    images: tuple[Image, ...]
    rows: tuple[int, ...]
    trajectory: Trajectory
    missing: tuple[str, ...]

    def files(self) -> list[Path]:
        names = [name for image in self.images for name in image.names]
        return [self.folder / TRAJECTORY_NAME, *(self.folder / name for name in names)]


def times_in(folder: Path, scene: str, suffix: str) -> dict[int, str]:
    """Time in milliseconds -> name of each file ``<scene>_<seconds><suffix>`` in a folder; may be empty."""
    form = re.compile(rf"{scene}_(\d{{1,9}}(?:\.\d{{1,9}})?){re.escape(suffix)}")
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    matches = {name: form.fullmatch(name) for name in names}
    return {round(float(match[1]) * 1000): name for name, match in matches.items() if match is not None}


def open_recording(folder: Path, scene: str, images: Images, min_confidence: int, where: str) -> PhoneRecording:
    """The recording of a scene; ``FramesMissing`` if it has no images, ``DataError`` if none can be used."""
    colour_folder = COLOUR_FOLDER[images]
    with recorded_frames.reading(where):
        colours = times_in(folder / colour_folder, scene, ".png")
        depths = times_in(folder / DEPTH, scene, ".png")
        fine = times_in(folder / FINE_DEPTH, scene, ".png") if images == "wide" else {}
        cameras = times_in(folder / camera_folder(colour_folder), scene, ".pincam")
        sure = times_in(folder / CONFIDENCE, scene, ".png") if min_confidence else {}
    kinds = {colour_folder: colours, DEPTH: depths or fine, camera_folder(colour_folder): cameras}
    if empty := [name for name, files in kinds.items() if not files]:
        raise FramesMissing(f"{where}: no files of the scene in {' and '.join(empty)} of {folder}; {ADVICE}")
    if min_confidence and not sure:
        raise DataError(
            f"{where}: option min_confidence needs {CONFIDENCE}/, which is missing; the challenge does not download "
            "it; leave the option at 0 or download it"
        )
    trajectory = read_trajectory(folder / TRAJECTORY_NAME, f"{where}: {TRAJECTORY_NAME}")
    # The challenge iterates over the low-resolution depth images; wide-camera images are fewer.
    times = sorted(depths if images == "lowres" else colours)
    lacking, unposed, found, rows = list[str](), list[str](), list[Image](), list[int]()
    for time_ms, row in zip(times, trajectory.nearest(np.array(times, float) / 1000).tolist(), strict=True):
        named = f"{scene}_{time_ms / 1000:.3f}"
        depth = _depth_of(time_ms, images, depths, fine)
        camera = next((cameras[time_ms + ms] for ms in NEIGHBOURS_MS if time_ms + ms in cameras), None)
        of_confidence = sure.get(time_ms) if min_confidence else ""
        if time_ms not in colours or depth is None or camera is None or of_confidence is None:
            lacking.append(named)
        elif row < 0:
            unposed.append(named)
        else:
            confidence = f"{CONFIDENCE}/{of_confidence}" if of_confidence else None
            colour = f"{colour_folder}/{colours[time_ms]}"
            found.append(Image(time_ms, colour, depth, f"{camera_folder(colour_folder)}/{camera}", confidence))
            rows.append(row)
    what = "images have no matching image or camera file"
    remarks = recorded_frames.left_out(where, lacking, what, len(found))
    no_pose = f"images have no pose nearer than 0.3 s in {TRAJECTORY_NAME}"
    remarks += recorded_frames.left_out(where, unposed, no_pose, len(found))
    if not found:
        raise DataError(remarks[0])
    return PhoneRecording(where, folder, tuple(found), tuple(rows), trajectory, tuple(remarks))


def _depth_of(time_ms: int, images: Images, depths: Mapping[int, str], fine: Mapping[int, str]) -> str | None:
    """The depth image of a time: the laser scanner's for the wide camera, otherwise the phone's nearest."""
    if time_ms in fine:
        return f"{FINE_DEPTH}/{fine[time_ms]}"
    reach = 0 if images == "lowres" else MAX_DEPTH_AWAY_MS
    near = sorted(range(-reach, reach + 1), key=abs)
    return next((f"{DEPTH}/{depths[time_ms + ms]}" for ms in near if time_ms + ms in depths), None)


def read_camera(path: Path, where: str) -> tuple[Size, Float64Array]:
    """Width and height, and the intrinsics (3, 3), of a file ``.pincam``: one line, width height fx fy cx cy."""
    words = read_text(path, where, ADVICE).split()
    if len(words) != 6:
        raise DataError(f"{where}: has {len(words)} values; expected one line 'width height fx fy cx cy'")
    width, height, fx, fy, cx, cy = recorded_frames.numbers(words, where)
    if not all(1 <= side <= LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise DataError(f"{where}: the image has {width:g}x{height:g} pixels; {ADVICE}")
    return (int(width), int(height)), recorded_frames.pinhole(fx, fy, cx, cy, where)


class PhoneFrames(Sequence[Frame]):
    """Every ``stride``-th usable frame, read on access; a file that cannot be used is a ``DataError``.

    Frames have at most ``width`` columns: colour is averaged, depth and confidence are taken from the nearest pixel.
    """

    def __init__(self, recording: PhoneRecording, stride: int, width: int, min_confidence: int) -> None:
        self._recording, self._stride = recording, stride
        self._width, self._least = width, min_confidence
        self._depth = recorded_frames.StoredDepth(recording.where, DEPTH_M_OF_VALUE)

    def __len__(self) -> int:
        return len(self._recording.images[:: self._stride])

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        index = range(len(self._recording.images))[:: self._stride][position]
        image = self._recording.images[index]
        full, intrinsics = read_camera(self._recording.folder / image.camera, self._at(image.camera))
        size = self._size(full)
        rgb = sized(decode_colour, self._content(image.colour), full, self._at(image.colour), "as in its camera file")
        scale = np.array(size) / np.array(full)
        intrinsics[:2, :2] *= scale[:, None]
        intrinsics[:2, 2] = (intrinsics[:2, 2] + 0.5) * scale - 0.5  # the centre of the first pixel is at 0
        return Frame(
            index=index,
            timestamp_s=image.time_ms / 1000,
            rgb=recorded_frames.colour_at(rgb, size),
            depth_m=self._depth_m(image, full, size),
            camera_to_world=self._recording.trajectory.poses[self._recording.rows[index]],
            intrinsics=intrinsics,
        )

    def _size(self, full: Size) -> Size:
        width = min(self._width, full[0])
        return width, max(1, round(full[1] * width / full[0]))

    def _depth_m(self, image: Image, full: Size, size: Size) -> Float32Array:
        values = decode_depth(self._content(image.depth), self._at(image.depth))
        self._check_shape(values.shape[1::-1], full, image.depth, image.colour)
        depth_m = self._depth.depth_m(values)
        if image.confidence is not None:
            confidence = decode_colour(self._content(image.confidence), self._at(image.confidence))[..., 0]
            self._check_shape(confidence.shape[1::-1], full, image.confidence, image.colour)
            if confidence.max(initial=0) > MAX_CONFIDENCE:
                raise DataError(f"{self._at(image.confidence)}: has values up to {confidence.max()}; expected 0 to 2")
            confidence = recorded_frames.nearest_at(confidence, (values.shape[1], values.shape[0]))
            depth_m = np.where(confidence >= self._least, depth_m, np.float32(0))
        return recorded_frames.nearest_at(depth_m, size)

    def _check_shape(self, actual: tuple[int, ...], full: Size, name: str, colour: str) -> None:
        """Depth may be coarser than colour; both must show the same field of view."""
        if abs(actual[0] * full[1] - actual[1] * full[0]) > max(full):
            raise DataError(
                f"{self._at(name)} is {actual[0]}x{actual[1]} and {colour} is {full[0]}x{full[1]}; both must show the "
                f"same view; {ADVICE}"
            )

    def _at(self, name: str) -> str:
        return f"{self._recording.where}: {name}"

    def _content(self, name: str) -> bytes:
        return read_bytes(self._recording.folder / name, self._at(name), ADVICE)
