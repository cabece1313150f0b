"""ScanNet recordings in any form found in a scan's folder: the ``.sens`` file, or an export of a reader.

Finding a recording, opening it, a quick summary, and its key.

Sources: ScanNet, SensReader/python/SensorData.py and SensReader/c++/sensorData.h at commit 3830fce; OpenMask3D, README
and openmask3d/configs at commit 3bc3fc5.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from su3d_bench.core.digests import digest_bytes, digest_file
from su3d_bench.core.errors import DataError, FramesMissing, counted
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int64Array
from su3d_bench.datasets.recordings import source as sensors
from su3d_bench.datasets.recordings.recorded_frames import StoredDepth, depth_m_of_values, numbers, reading, square
from su3d_bench.datasets.scannet.sens import MAX_HEADER_BYTES, SensFile, header_bytes, parse_header
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.images import Size

SourceKind = Literal["auto", "sens", "python", "cpp"]
DEPTH_SHIFT = 1000.0  # of every recording of ScanNet; the Python reader does not export it
COLOUR_SIZE, DEPTH_SIZE = (1296, 968), (640, 480)  # of ScanNet's cameras; OpenMask3D's intrinsic_resolution
OFF_CENTRE = 0.1  # of the image; ScanNet's principal points are within 0.02 of the middle
INFO, TEXT = "_info.txt", ".txt"
COUNT_KEY, SHIFT_KEY = "m_frames.size", "m_depthShift"
SIZE_KEYS = ("m_colorWidth", "m_colorHeight", "m_depthWidth", "m_depthHeight")
MATRIX_KEYS = tuple(
    f"m_calibration{camera}{kind}" for camera in ("Color", "Depth") for kind in ("Intrinsic", "Extrinsic")
)


@dataclass(frozen=True)
class PythonLayout:
    """The folders of an export that has one per kind of file."""

    colour: str = "color"
    depth: str = "depth"
    pose: str = "pose"
    cameras: str = "intrinsic"


PYTHON_LAYOUTS = (
    PythonLayout(),  # ScanNet's Python reader, and OpenMask3D for a single scene
    PythonLayout(cameras="intrinsics"),  # SegmentAnything3D's copy of that reader
    PythonLayout("data_compressed/color", "data_compressed/depth", "data/pose", "data/intrinsic"),  # OpenMask3D, all
)


def find_source(folder: Path, scene: str, where: str, kind: SourceKind = "auto") -> sensors.RgbdSource:
    """The recording in a scan's folder; if there are several, the ``.sens`` file, then the Python reader's export.

    Exports may be in the folder itself, in ``exported/`` or in a folder named after the scene. ``FramesMissing``
    lists everything that was looked for if there is none.
    """
    with reading(where):
        form, place = _find(folder, scene, kind) or (None, folder)
    if form == "sens":
        return SensFile(place, where)
    if form is not None:
        return open_python_export(place, where) if form == "python" else open_cpp_export(place, where)
    looked_for = {
        "sens": f"{scene}.sens",
        "python": "color/, depth/, pose/ and intrinsic/ (or data/ and data_compressed/)",
        "cpp": f"{INFO} and frame-000000.color.jpg and so on",
    }
    wanted = [text for name, text in looked_for.items() if kind in ("auto", name)]
    places = f"exports also in exported/ and {scene}/"
    raise FramesMissing(f"{where}: no recording in {folder}; looked for {'; '.join(wanted)}; {places}")


def _find(folder: Path, scene: str, kind: SourceKind) -> tuple[SourceKind, Path] | None:
    """The form of the recording in a scan's folder, and its location: the ``.sens`` file or the export's folder."""
    sens = folder / f"{scene}.sens"
    if kind in ("auto", "sens") and sens.exists():
        return "sens", sens
    places = [folder / name for name in ("", "exported", scene)]
    for place in places if kind in ("auto", "python") else ():
        if python_layout(place) is not None:
            return "python", place
    for place in places if kind in ("auto", "cpp") else ():
        if (place / INFO).exists():
            return "cpp", place
    return None


def python_layout(folder: Path) -> PythonLayout | None:
    """The layout of the frames in ``folder``; None if there are none."""
    layouts = [
        layout for layout in PYTHON_LAYOUTS if (folder / layout.colour).is_dir() or (folder / layout.pose).is_dir()
    ]
    with_cameras = [layout for layout in layouts if (folder / layout.cameras).is_dir()]
    return next(iter(with_cameras or layouts), None)


def open_python_export(folder: Path, where: str) -> sensors.ExportedFrames:
    """The export of ScanNet's Python reader in ``folder``, or one prepared by OpenMask3D."""
    layout = python_layout(folder) or PYTHON_LAYOUTS[0]
    kinds = {
        f"{name}/{{}}{ending}": sensors.by_number(
            sensors.list_folder(folder, name, where), pattern, f"{where}: {name}/"
        )
        for name, ending, pattern in (
            (layout.colour, ".jpg", r"(\d{1,9})\.(?:jpg|png)"),
            (layout.depth, ".png", r"(\d{1,9})\.png"),
            (layout.pose, ".txt", r"(\d{1,9})\.txt"),
        )
    }
    known = set().union(*kinds.values())
    if not known:
        raise DataError(
            f"{where}: {layout.colour}/, {layout.depth}/ and {layout.pose}/ have no frames; {sensors.EXPORT_AGAIN}"
        )
    expected = sensors.every_kth(known)
    sensors.check_complete(kinds, expected, where)
    colours, depths, poses = kinds.values()
    names = {n: (f"{layout.colour}/{colours[n]}", f"{layout.depth}/{depths[n]}") for n in expected}
    frames = [sensors.FrameFiles(n, *names[n], f"{layout.pose}/{poses[n]}") for n in expected]
    camera, camera_files = _python_camera(folder, layout, frames[0], where)
    return sensors.ExportedFrames(folder, where, camera, frames, camera_files, "as the first frame")


def _python_camera(
    folder: Path, layout: PythonLayout, first: sensors.FrameFiles, where: str
) -> tuple[sensors.SensorPair, list[str]]:
    """The cameras, and the names of their files."""
    colour_size, depth_size = (
        sensors.read_size(folder, first.colour, where),
        sensors.read_size(folder, first.depth, where),
    )
    names = [
        f"{layout.cameras}/{kind}_{camera}.txt" for kind in ("intrinsic", "extrinsic") for camera in ("color", "depth")
    ]
    colour_name, depth_name = names[:2]
    there = [name for name in names if (folder / name).exists()]
    if colour_name not in there:
        raise DataError(f"{where}: {colour_name} is missing; {sensors.EXPORT_AGAIN}")
    if depth_name not in there and depth_size != colour_size:
        raise DataError(
            f"{where}: {depth_name} is missing, and depth images of {depth_size[0]}x{depth_size[1]} cannot use the "
            f"intrinsics of colour images of {colour_size[0]}x{colour_size[1]}; {sensors.EXPORT_AGAIN}"
        )
    colour_intrinsics = _fitted_intrinsics(folder, colour_name, where, colour_size, COLOUR_SIZE)
    depth_intrinsics = colour_intrinsics
    if depth_name in there:
        depth_intrinsics = _fitted_intrinsics(folder, depth_name, where, depth_size, DEPTH_SIZE)
    colour_extrinsic, depth_extrinsic = (
        sensors.read_matrix(folder, name, where) if name in there else np.eye(4) for name in names[2:]
    )
    camera = sensors.SensorPair(
        colour_size=colour_size,
        depth_size=depth_size,
        colour_intrinsics=colour_intrinsics,
        depth_intrinsics=depth_intrinsics,
        colour_extrinsic=colour_extrinsic,
        depth_extrinsic=depth_extrinsic,
        depth_shift=DEPTH_SHIFT,
        where=f"{where}: {layout.cameras}/",
    )
    return camera, there


def _fitted_intrinsics(folder: Path, name: str, where: str, size: Size, full_size: Size) -> Float64Array:
    """The intrinsics (3, 3) of images of ``size``; scaled if images were resized but the file was not updated.

    OpenMask3D's layouts and the Python reader's resizing leave the file as for images of ``full_size``.
    """
    matrix = sensors.read_matrix(folder, name, where, (4, 3))[:3, :3]
    centre, sizes, full_sizes = matrix[:2, 2] + 0.5, np.array(size), np.array(full_size)
    if (np.abs(centre / sizes - 0.5) <= OFF_CENTRE).all():
        return matrix
    if (np.abs(centre / full_sizes - 0.5) <= OFF_CENTRE).all():
        scaled = matrix.copy()
        scaled[:2, 2] += 0.5  # the centre of the first pixel is at 0
        scaled[:2] *= (sizes / full_sizes)[:, None]
        scaled[:2, 2] -= 0.5
        return scaled
    if ((centre >= 0) & (centre <= sizes)).all():
        return matrix
    raise DataError(
        f"{where}: {name} has its principal point at ({matrix[0, 2]:g}, {matrix[1, 2]:g}), outside the images of "
        f"{size[0]}x{size[1]}; it belongs to images of another size"
    )


def open_cpp_export(folder: Path, where: str) -> sensors.ExportedFrames:
    """The export of ScanNet's C++ reader in ``folder``."""
    camera, n_frames = read_info(folder / INFO, where)
    names: dict[str, list[str]] = {"color": [], "depth": [], "pose": []}
    for name in sensors.list_folder(folder, ".", where):
        if name.startswith("frame-"):
            names.get(name.partition(".")[2].partition(".")[0], names["color"]).append(name)
    kinds = {
        f"frame-{{:06d}}.{kind}.{ending.split('|')[0]}": sensors.by_number(
            names[kind], rf"frame-(\d{{6,9}})\.{kind}\.(?:{ending})", f"{where}: the export"
        )
        for kind, ending in (("color", "jpg|png"), ("depth", "pgm"), ("pose", "txt"))
    }
    expected = range(n_frames)
    sensors.check_complete(kinds, expected, where)
    colours, depths, poses = kinds.values()
    frames = [sensors.FrameFiles(n, colours[n], depths[n], poses[n]) for n in expected]
    return sensors.ExportedFrames(folder, where, camera, frames, [INFO], f"as in {INFO}")


def read_info(path: Path, where: str) -> tuple[sensors.SensorPair, int]:
    """The cameras and the number of frames in the ``_info.txt`` of the C++ reader's export."""
    where = f"{where}: {path.name}"
    parts = [line.partition("=") for line in read_text(path, where, sensors.EXPORT_AGAIN).splitlines()]
    table = {key.strip(): value.split() for key, _, value in parts}
    for key in (*SIZE_KEYS, SHIFT_KEY, *MATRIX_KEYS, COUNT_KEY):
        if key not in table:
            raise DataError(f"{where}: has no '{key}'; {sensors.EXPORT_AGAIN}")
    colour_width, colour_height, depth_width, depth_height = (_count(table[key], key, where) for key in SIZE_KEYS)
    shift = numbers(table[SHIFT_KEY], f"{where}: '{SHIFT_KEY}'")
    if len(shift) != 1:
        raise DataError(f"{where}: '{SHIFT_KEY}' has {len(shift)} values; expected 1")
    colour, colour_extrinsic, depth, depth_extrinsic = (square(table[key], f"{where}: '{key}'") for key in MATRIX_KEYS)
    camera = sensors.SensorPair(
        colour_size=(colour_width, colour_height),
        depth_size=(depth_width, depth_height),
        colour_intrinsics=colour[:3, :3],
        depth_intrinsics=depth[:3, :3],
        colour_extrinsic=colour_extrinsic,
        depth_extrinsic=depth_extrinsic,
        depth_shift=shift[0],
        where=where,
    )
    return camera, _count(table[COUNT_KEY], COUNT_KEY, where)


def _count(words: Sequence[str], key: str, where: str) -> int:
    text = " ".join(words)
    if not re.fullmatch(r"[0-9]{1,9}", text) or int(text) == 0:
        raise DataError(f"{where}: '{key}' is {text[:20]!r}; expected a number above 0")
    return int(text)


def folder_of_recording(folders: Sequence[Path], scene: str, kind: SourceKind) -> Path:
    """The first of a scan's folders with a recording of that kind, otherwise the first folder."""
    return next((folder for folder in folders if _find(folder, scene, kind) is not None), folders[0])


def describe_recording(folder: Path, scene: str, where: str, kind: SourceKind) -> str:
    """The number of frames, including lost ones, from a header or a list of names only."""
    form, place = _find(folder, scene, kind) or (None, folder)
    if form is None:
        return "no recording" + (f" ({scene}.sens is missing)" if kind in ("auto", "sens") else "")
    layout = python_layout(place)
    path = place / layout.pose if form == "python" and layout is not None else place
    if path != place and layout and (missing := sensors.missing_parts(place, *astuple(layout))):
        return missing
    with reading(where):
        if form == "sens":
            with opened(path) as stream:
                _, n_frames, _ = parse_header(stream.read(MAX_HEADER_BYTES), f"{where}: {path.name}")
            return counted(n_frames, "frame")
        if form == "cpp":
            return f"{read_info(path / INFO, where)[1]} exported frames"
        return f"{sum(name.endswith(TEXT) for name in os.listdir(path))} exported frames"


def digest_recording(source: sensors.RgbdSource, poses: Float64Array) -> str:
    """A key of a recording's cameras, poses and time stamps, the sizes of all images, and the first and last image."""
    total = hashlib.sha256()
    if isinstance(source, SensFile):
        total.update(header_bytes(source.header, len(source)) + source.records().tobytes())
        for i in (0, len(source) - 1):
            total.update(digest_bytes(source.colour_bytes(i) + source.depth_bytes(i)).encode())
        return f"sens {total.hexdigest()}"
    images = [path for path in source.files() if path.suffix != TEXT]
    camera = source.camera
    matrices = camera.colour_intrinsics, camera.depth_intrinsics, camera.colour_extrinsic, camera.depth_extrinsic
    total.update(f"{camera.colour_size} {camera.depth_size} {camera.depth_shift!r}\n".encode())
    total.update(b"".join(matrix.astype(np.float64).tobytes() for matrix in (*matrices, poses)))
    with reading(source.where):
        for path in source.files():
            total.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
        for path in (*images[:2], *images[-2:]):
            total.update(digest_file(path).encode())
    return f"export {total.hexdigest()}"


@dataclass(frozen=True)
class RecordedPoses:
    """The records of a recording: ``numbers`` (n,) at full rate, ``poses`` (n, 4, 4), which of them are usable (n,)."""

    numbers: Int64Array
    poses: Float64Array
    is_usable: BoolArray

    def every(self, stride: int) -> Int64Array:
        """Usable records among every ``stride``-th frame; one without a pose is not replaced."""
        _, first = np.unique(self.numbers // stride, return_index=True)
        kept: Int64Array = first[self.is_usable[first]]
        return kept

    def missing_frames_remark(self, where: str) -> str | None:
        """A message with the number of records without a usable pose."""
        if self.is_usable.all():
            return None
        n_lost, first = int((~self.is_usable).sum()), int(self.numbers[np.argmin(self.is_usable)])
        return f"{where}: frames without a pose, excluded: {n_lost} of {len(self.numbers)} (the first: {first})"


def read_walk(source: sensors.RgbdSource) -> RecordedPoses:
    """Determine which records are usable.

    A non-finite pose was lost. ScanNet's own reader also treats a first element of 0 as lost, but exact
    quarter turns have it too: here such a pose is lost unless it is a rigid motion. Any other non-rigid pose is a
    ``DataError``, and so is a recording without any pose.
    """
    walk, is_faulty = classify_poses(source)
    if is_faulty.any():
        raise DataError(faulty_pose(source.where, int(walk.numbers[np.argmax(is_faulty)])))
    if not walk.is_usable.any():
        raise DataError(f"{source.where}: none of the {len(walk.poses)} frames has a pose; exclude the scene")
    return walk


def classify_poses(source: sensors.RgbdSource) -> tuple[RecordedPoses, BoolArray]:
    """The records as in ``read_walk``, and which of them (n,) have a pose that is neither lost nor valid."""
    poses = source.poses()
    is_finite = np.isfinite(poses).all(axis=(1, 2))
    is_rigid = np.zeros(len(poses), bool)
    is_rigid[is_finite] = are_rigid(poses[is_finite])
    return RecordedPoses(source.numbers, poses, is_rigid), is_finite & ~is_rigid & (poses[:, 0, 0] != 0)


def faulty_pose(where: str, number: int) -> str:
    return f"{where}: frame {number}: the pose is not a rigid motion; copy the recording again"


class ScannetFrames(Sequence[Frame]):
    """The frames of ``records``, each read and registered on access.

    ``motion`` (4, 4) is applied to the world, None for none.
    """

    def __init__(
        self,
        source: sensors.RgbdSource,
        registration: sensors.Registration,
        walk: RecordedPoses,
        records: Int64Array,
        motion: Float64Array | None,
    ) -> None:
        self._source, self._registration, self._walk = source, registration, walk
        self._records, self._motion = records, motion
        self._depth = StoredDepth(source.where, depth_m_of_values(source.camera.depth_shift))

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, position: int) -> Frame:  # type: ignore[override]
        i = int(self._records[position])
        pose = self._registration.camera_to_world(self._walk.poses[i])
        depth_m = self._depth.depth_m(self._source.depth(i))
        rgb, depth_m = self._registration.images(self._source.colour(i), depth_m)
        return Frame(
            index=int(self._walk.numbers[i]),
            timestamp_s=self._source.timestamp_s(i),
            rgb=rgb,
            depth_m=depth_m,
            camera_to_world=pose if self._motion is None else self._motion @ pose,
            intrinsics=self._registration.intrinsics,
        )
