"""Any folder of colour, depth and pose files, described by one ``rgbd.toml`` (see ``description.py``).

A scene is ``rgbd/<scene>/rgbd.toml`` below the data root, or a TOML file or a folder with ``rgbd.toml`` that the option
``files`` names. Frames without an image or a pose are reported once and excluded. There is no ground truth.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, field_validator

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.geometry import turn_to_z
from su3d_bench.core.types import (
    Float32Array,
    Float64Array,
    Surface,
    WorldUp,
)
from su3d_bench.datasets.recordings import recorded_frames
from su3d_bench.datasets.recordings.file_dataset import RecordedDataset, SceneTree, keeps_last
from su3d_bench.datasets.recordings.meshes import read_surface
from su3d_bench.datasets.recordings.pose_convention import ROTATED, Finding, guess_up
from su3d_bench.datasets.rgbd import files

logger = logging.getLogger(__name__)
OTHER = {"camera_to_world": "world_to_camera", "world_to_camera": "camera_to_world"}
OTHER |= {"opencv": "opengl", "opengl": "opencv"}


class RgbdOptions(BaseModel):
    """``files``: descriptions outside the data root, each a TOML file or a folder with ``rgbd.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    files: tuple[Path, ...] = ()

    @field_validator("files", mode="before")
    @classmethod
    def _one_is_a_list_of_one(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value


class Rgbd(RecordedDataset[RgbdOptions]):
    """Any folder of colour, depth and pose files that an rgbd.toml describes; unscored, without ground truth.

    ``folders`` are the description of each scene: those of the option ``files`` in order, then those below the
    data root. A scene is named after its file or, for an ``rgbd.toml``, after its folder.
    """

    name = "rgbd"
    reader_version = 3
    places_of_scenes = ("rgbd",)
    how_to_get = (
        f"/rgbd (a scene is a folder with {files.FILE_NAME}); describe a folder of images in such a file there, or "
        "name the file: --set rgbd.files=path/to/rgbd.toml"
    )
    label_space = "none"
    no_mesh = "folders of images have none"
    Options = RgbdOptions

    def find_tree(self) -> SceneTree:
        place = self.root / "rgbd"
        below = [folder / files.FILE_NAME for folder in (sorted(place.iterdir()) if place.is_dir() else ())]
        named = [path / files.FILE_NAME if path.is_dir() else path for path in self.options.files]
        path_of: dict[str, Path] = {}
        for path in (*named, *(path for path in below if path.is_file())):
            name = path.resolve().parent.name if path.name == files.FILE_NAME else path.stem
            if path_of.setdefault(name, path) != path:
                raise DataError(f"rgbd: scene '{name}' is described twice, in {path_of[name]} and {path}; rename one")
        return SceneTree(self.root, (*self.options.files, place), {name: (path,) for name, path in path_of.items()})

    def is_reading_checked(self, scene: str) -> bool:
        """Whether the description allows checking depth against the poses."""
        return self._open(scene)[0].check_convention

    def correction_of_reading(self, scene: str, finding: Finding) -> str:
        """The keys of the description to change so that the files are read as ``finding`` suggests."""
        description = self._open(scene)[0]
        changes = [f'{key} = "{OTHER[getattr(description, key)]}"' for key in finding.changes(description.camera_axes)]
        if finding.depth_factor == ROTATED and description.depth_rotated_bits == 0:
            changes.append("depth_rotated_bits = 3")
        elif finding.depth_factor != 1:
            changes.append(f"depth_unit_m = {description.depth_unit_m * finding.depth_factor:g}")
        return (
            f"with {' and '.join(changes)}; set that in {self.folder(scene).name}, or check_convention = false "
            "to read the files as described"
        )

    def surface(self, scene: str) -> Surface:
        """The mesh in the description."""
        description, recording = self._open(scene)
        place = f"{recording.where}: {self.folder(scene).name}"
        if description.mesh is None:
            raise DataError(f'{place} has no mesh; add one in the world of the poses: mesh = "mesh.ply"')
        surface = read_surface(recording.folder.file(description.mesh, place), f"{recording.where}: {description.mesh}")
        if description.up is None:
            return surface
        turned = (surface.vertices @ turn_to_z(description.up).T).astype(np.float32)
        return replace(surface, vertices=turned)

    def up(self, scene: str) -> WorldUp:
        """The world's up axis from the description, otherwise as the frames show it."""
        description, recording = self._open(scene)
        name = self.folder(scene).name
        if description.up is not None:
            return WorldUp(description.up, True, f"set in {name}")
        guess = guess_up(
            np.array([frame.pose for frame in recording.frames]),
            recorded_frames.RecordedFrames(recording, is_quiet=True),
        )
        return replace(guess, remedy=f'set up = "{guess.axis}" in {name}, or up = "z"')

    def recording(self, scene: str) -> recorded_frames.Recording:
        return self._open(scene)[1]

    @keeps_last
    def _open(self, scene: str) -> tuple[files.RgbdDescription, recorded_frames.Recording]:
        path, where = self.folder(scene), self.where(scene)
        description = files.read_description(path, where)
        return description, open_recording(path, description, where)


def open_recording(path: Path, description: files.RgbdDescription, where: str) -> recorded_frames.Recording:
    """The usable frames described by the TOML file ``path``; missing parts are reported once, as a warning."""
    place = f"{where}: {path.name}"
    folder = _folder(path, description, place)
    colours, depths = (files.files_of(folder, name, place) for name in (description.colour, description.depth))
    intrinsics, size, camera_files = _intrinsics(folder, description, where, place)
    is_mirrored = bool(intrinsics[1, 1] < 0)
    if is_mirrored and description.mesh is not None:
        raise DataError(f"{place}: fy is negative: the world is left-handed, which is not supported with a mesh")
    poses = _poses(folder, description, sorted(colours.keys() | depths.keys()), where, place, is_mirrored=is_mirrored)
    if files.INDEX not in description.colour and not len(colours) == len(depths) == len(poses.of_number):
        raise DataError(
            f"{place}: {len(colours)} colour files, {len(depths)} depth files and {len(poses.of_number)} poses match; "
            f"files pair up in order only if the counts are equal; otherwise use {files.INDEX}"
        )
    frames, missing = [], []
    for number in sorted(colours.keys() | depths.keys() | poses.of_number.keys()):
        colour, depth, pose = colours.get(number), depths.get(number), poses.of_number.get(number)
        if colour is None or depth is None or pose is None:
            parts = zip(("colour", "depth", "pose"), (colour, depth, pose), strict=True)
            missing.append(f"frame {number}, no {' and no '.join(name for name, part in parts if part is None)}")
        else:
            time_s = poses.times_s.get(number, number / description.frames_per_second)
            frames.append(recorded_frames.RecordedFrame(number, time_s, colour, depth, pose))
    if not frames:
        raise DataError(f"{place}: no frame has colour, depth and a pose (the first: {missing[0]})")
    what = "frames lack an image or a usable pose"
    remarks = recorded_frames.left_out(where, missing, what, len(frames))
    mesh = () if description.mesh is None else (folder.file(description.mesh, place),)
    sources = (path, *camera_files, *poses.files, *mesh)
    return recorded_frames.Recording(
        where, folder, tuple(frames), np.abs(intrinsics), depth_table(description), sources, size, tuple(remarks)
    )


def _folder(path: Path, description: files.RgbdDescription, place: str) -> recorded_frames.Folder:
    try:
        if (path.parent / description.folder).is_dir():
            return recorded_frames.Folder(path.parent / description.folder)
    except OSError:  # the name is too long
        pass
    raise DataError(f"{place}: folder = {description.folder[:80]!r}: no such folder next to {path.name}")


@dataclass(frozen=True)
class _Poses:
    """Poses and, if available, times in seconds by frame number, and the files they come from."""

    of_number: dict[int, files.Pose]
    times_s: dict[int, float]
    files: tuple[Path, ...]


def _poses(
    folder: recorded_frames.Folder,
    description: files.RgbdDescription,
    images: list[int],
    where: str,
    place: str,
    *,
    is_mirrored: bool,
) -> _Poses:
    if description.pose is not None:
        pose_of, contradicting = {}, []
        names = files.files_of(folder, description.pose, place)
        for number, name in names.items():
            matrix, header = files.read_pose(folder.path, name, where)
            pose_of[number] = files.camera_to_world(matrix, description, f"{where}: {name}", is_mirrored=is_mirrored)
            if files.direction_in(header) not in (None, description.pose_direction):
                contradicting.append(f"{name} begins with {printable(header, 40)!r}")
        if contradicting:
            logger.warning(
                "%s: the poses are read as %s, but %d of their files have another header (the first: %s); only the "
                "depth images can decide",
                *(place, description.pose_direction, len(contradicting), contradicting[0]),
            )
        return _Poses(pose_of, {}, tuple(folder.path / name for name in names.values()))
    assert description.trajectory is not None
    path, where = folder.file(description.trajectory, place), f"{where}: {description.trajectory}"
    matrices, times_s = files.read_trajectory_file(path, description.trajectory_format, where)
    numbers = images if len(matrices) == len(images) else range(images[0], images[-1] + 1)
    if len(matrices) != len(numbers):
        raise DataError(
            f"{where} has {len(matrices)} poses; expected {len(images)}, one per image"
            + (
                f", or {len(numbers)}, one per number from {images[0]} to {images[-1]}"
                if len(numbers) > len(images)
                else ""
            )
        )
    rows = zip(numbers, matrices, strict=True)
    pose_of = {
        n: files.camera_to_world(matrix, description, f"{where}, pose {k}", is_mirrored=is_mirrored)
        for k, (n, matrix) in enumerate(rows)
    }
    return _Poses(pose_of, dict(zip(numbers, times_s or (), strict=False)), (path,))


def _intrinsics(
    folder: recorded_frames.Folder, description: files.RgbdDescription, where: str, place: str
) -> tuple[Float64Array, tuple[int, int] | None, tuple[Path, ...]]:
    """Intrinsics, the image size if a file states it, and that file."""
    if description.intrinsics is not None:
        return files.signed_pinhole(description.intrinsics, place), None, ()
    assert description.intrinsics_file is not None
    path = folder.file(description.intrinsics_file, place)
    return *files.read_intrinsics(path, f"{where}: {description.intrinsics_file}"), (path,)


@lru_cache(maxsize=8)
def depth_table(description: files.RgbdDescription) -> Float32Array:
    """Metres (65536,) of every possible value of a depth image, 0 if it means no depth."""
    stored = np.arange(recorded_frames.N_DEPTH_VALUES, dtype=np.uint32)
    bits = description.depth_rotated_bits
    values = ((stored >> bits) | (stored << (16 - bits))) & 0xFFFF
    depth_m = (values * description.depth_unit_m).astype(np.float32)
    depth_m[np.isin(values, description.depth_invalid)] = 0
    depth_m.setflags(write=False)
    return depth_m
