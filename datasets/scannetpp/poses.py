"""Cameras and poses of ScanNet++'s iPhone, in the coordinates of the aligned mesh, metres.

- ``colmap/cameras.txt`` and ``images.txt``: used by the official toolkit; a subset of the video's frames, one camera
  with distortion. Poses are world-to-camera, quaternions w x y z.
- ``pose_intrinsic_imu.json``: every frame of the video, from the phone's own tracking; ``aligned_pose`` is in
  the world of the mesh, camera-to-world; intrinsics per frame, without distortion.

Both have OpenCV's camera axes. Both files put the corner of an image at 0, ``Frame`` the centre of its first
pixel.

Source: scannetpp/scannetpp at commit f3b4712, common/utils/colmap.py, common/scene_release.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import are_rigid, rotations_of
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.datasets.recordings.recorded_frames import numbers, pinhole, reading
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.images import MAX_PIXELS, Size
from su3d_bench.formats.json_models import FileModel, read_json

COLMAP, CAMERAS_NAME, IMAGES_NAME = "colmap", "cameras.txt", "images.txt"
TRACKING_NAME = "pose_intrinsic_imu.json"
OFF_CENTRE = 0.1  # of the image; an iPhone's principal point is within 0.02 of the middle
FRAME_NAME = re.compile(r"frame_([0-9]{1,9})(?:\.[A-Za-z]{1,4})?")
# Position of fx fy cx cy and k1 k2 p1 p2 for each COLMAP model: src/colmap/sensor/models.h.
MODELS = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
}
N_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}
MAX_DISTORTION = 10.0  # an iPhone has 0.2
MAX_LINE_BYTES = 16 << 20  # the points of one image, a few thousand
HEAD_BYTES = 4096
Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """Frames of the video by ``numbers`` (n,), ascending, each with its camera-to-world pose (n, 4, 4), non-finite
    if lost, and its intrinsics (n, 3, 3) for images of ``size``, the corner at 0.

    ``distortion``: k1 k2 p1 p2 of all frames, zeros for none. ``files``: the source files.
    """

    numbers: Int64Array
    poses: Float64Array
    intrinsics: Float64Array
    size: Size
    distortion: Float64Array
    files: tuple[Path, ...]


def read_colmap(folder: Path, where: str) -> PosedFrames:
    """The frames registered by COLMAP; ``folder`` has ``cameras.txt`` and ``images.txt``."""
    cameras, images = folder / CAMERAS_NAME, folder / IMAGES_NAME
    intrinsics, size, distortion = _read_camera(cameras, f"{where}: {COLMAP}/{CAMERAS_NAME}")
    pose_of = _read_images(images, f"{where}: {COLMAP}/{IMAGES_NAME}")
    order = sorted(pose_of)
    return PosedFrames(
        np.array(order, np.int64),
        np.array([pose_of[number] for number in order]),
        np.broadcast_to(intrinsics, (len(order), 3, 3)),
        size,
        distortion,
        (cameras, images),
    )


def _read_camera(path: Path, where: str) -> tuple[Float64Array, Size, Float64Array]:
    lines = [line.split() for line in read_text(path, where).splitlines() if line.strip() and line.strip()[0] != "#"]
    if len(lines) != 1:
        raise DataError(f"{where}: has {len(lines)} cameras; expected the iPhone's only")
    words = lines[0]
    model = words[1] if len(words) > 1 else ""
    if model not in MODELS:
        raise DataError(f"{where}: the camera's model is {model[:40]!a}; expected {', '.join(MODELS)}")
    if len(words) != 4 + N_PARAMETERS[model] or not all(re.fullmatch(r"[0-9]{1,6}", word) for word in words[2:4]):
        raise DataError(f"{where}: expected one line 'id {model} width height' and {N_PARAMETERS[model]} numbers")
    values = numbers(words[4:], where)
    (fx, fy, cx, cy), bent = MODELS[model]
    distortion = np.array([*(values[i] for i in bent), *[0.0] * (4 - len(bent))])
    if not (np.isfinite(distortion).all() and np.abs(distortion).max() < MAX_DISTORTION):
        raise DataError(f"{where}: the distortion is {' '.join(f'{v:g}' for v in distortion)}; copy the file again")
    return pinhole(values[fx], values[fy], values[cx], values[cy], where), _size(words[2:4], where), distortion


def _size(words: Sequence[str], where: str) -> Size:
    width, height = int(words[0]), int(words[1])
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise DataError(f"{where}: images of {width}x{height}; expected 1 to {MAX_PIXELS} pixels")
    return width, height


def _read_images(path: Path, where: str) -> dict[int, Float64Array]:
    """Camera-to-world pose of each frame. Every second line lists points and may be empty."""
    pose_of: dict[int, Float64Array] = {}
    uses_points = False
    for at, line in enumerate(_lines(path, where), 1):
        if uses_points or not line.strip() or line.startswith(b"#"):
            uses_points = False
            continue
        uses_points = True
        words, place = line.decode("ascii", "replace").split(), f"{where} line {at}"
        if len(words) != 10:
            raise DataError(f"{place}: has {len(words)} words; expected 'id qw qx qy qz tx ty tz camera name'")
        number = frame_number(words[9].rpartition("/")[2], place)
        if number in pose_of:
            raise DataError(f"{place}: frame {number} is listed twice; copy the file again")
        pose_of[number] = _inverse_pose(numbers(words[1:8], place), place)
    if not pose_of:
        raise DataError(f"{where}: has no frames; copy the file again")
    return pose_of


def _lines(path: Path, where: str) -> Iterator[bytes]:
    """The lines of a file that may have hundreds of megabytes, because it lists every point of every image."""
    with reading(where), opened(path) as stream:
        while line := stream.readline(MAX_LINE_BYTES):
            if len(line) == MAX_LINE_BYTES:
                raise DataError(f"{where}: a line has more than {MAX_LINE_BYTES >> 20} MiB; copy the file again")
            yield line


def n_registered(path: Path) -> int | None:
    """The number of images stated at the top of ``images.txt``; None if missing."""
    with opened(path) as stream:
        match = re.search(rb"^# Number of images: ([0-9]{1,7})\b", stream.read(HEAD_BYTES), re.MULTILINE)
    return None if match is None else int(match[1])


def frame_number(name: str, where: str) -> int:
    """The frame number in a name such as ``frame_000010.jpg``."""
    match = FRAME_NAME.fullmatch(name)
    if match is None:
        raise DataError(f"{where}: {name[:40]!a} is not a frame of the iPhone; expected a name such as frame_000010")
    return int(match[1])


def _inverse_pose(values: Sequence[float], where: str) -> Float64Array:
    length = math.hypot(*values[:4])
    if not all(math.isfinite(value) and abs(value) < 1e9 for value in values) or abs(length - 1) > 1e-2:
        raise DataError(f"{where}: expected a unit quaternion qw qx qy qz and a translation (m); copy the file again")
    w, x, y, z = (value / length for value in values[:4])
    to_camera = rotations_of(np.array([[x, y, z, w]]))[0]
    pose = np.eye(4)
    pose[:3, :3] = to_camera.T
    pose[:3, 3] = -to_camera.T @ np.array(values[4:7])
    return pose


class TrackedFrame(FileModel):
    """The fields read of a frame; pose values are non-finite if tracking was lost."""

    aligned_pose: Annotated[list[Row4], Field(min_length=4, max_length=4)]
    intrinsic: Annotated[list[Row3], Field(min_length=3, max_length=3)]


def read_tracking(path: Path, where: str, size: Size) -> PosedFrames:
    """Every frame of the video, with images of that ``size``, and its ``aligned_pose``."""
    where = f"{where}: {path.name}"
    entries = read_json(path, where, dict[str, TrackedFrame])
    entry_of = {frame_number(name, where): entry for name, entry in entries.items()}
    if not entry_of or len(entry_of) != len(entries):
        raise DataError(f"{where}: has no frames, or duplicates; copy the file again")
    order = sorted(entry_of)
    poses = np.array([entry_of[n].aligned_pose for n in order], np.float64)
    cameras = [(entry_of[n].intrinsic, f"{where}: frame {n}: 'intrinsic'") for n in order]
    intrinsics = np.array([pinhole(k[0][0], k[1][1], k[0][2], k[1][2], place) for k, place in cameras])
    is_elsewhere = np.abs(intrinsics[:, :2, 2] / np.array(size) - 0.5).max(axis=1) > OFF_CENTRE
    if is_elsewhere.any():
        row = int(is_elsewhere.argmax())
        raise DataError(
            f"{where}: frame {order[row]}: 'intrinsic' has its principal point at ({intrinsics[row, 0, 2]:g}, "
            f"{intrinsics[row, 1, 2]:g}), the images have {size[0]}x{size[1]}; it belongs to images of another size"
        )
    is_finite = np.isfinite(poses).all(axis=(1, 2))
    faulty = [
        n for n, pose in zip(order, poses, strict=True) if np.isfinite(pose).all() and not are_rigid(pose[None])[0]
    ]
    if faulty:
        raise DataError(f"{where}: frame {faulty[0]}: 'aligned_pose' is not a rigid motion; copy the file again")
    if not is_finite.any():
        raise DataError(f"{where}: none of the {len(order)} frames has a pose; exclude the scene")
    return PosedFrames(np.array(order, np.int64), poses, intrinsics, size, np.zeros(4), (path,))
