"""Posed RGB-D frames of a scan, from a recording whose two cameras differ and whose poses may be lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import BoolArray, Float64Array, Frame, Int64Array
from su3d_bench.datasets.recordings.recorded_frames import StoredDepth, depth_m_of_values
from su3d_bench.datasets.recordings.registration import Registration
from su3d_bench.datasets.recordings.source import RgbdSource


@dataclass(frozen=True)
class Walk:
    """The records of a recording: ``numbers`` (n,) at full rate, ``poses`` (n, 4, 4), which of them are usable (n,)."""

    numbers: Int64Array
    poses: Float64Array
    is_usable: BoolArray

    def every(self, stride: int) -> Int64Array:
        """Usable records among the first of every ``stride`` frames; one without a pose is not replaced."""
        _, first = np.unique(self.numbers // stride, return_index=True)
        kept: Int64Array = first[self.is_usable[first]]
        return kept

    def say_what_is_lost(self, where: str) -> str | None:
        """A line that counts the records without a usable pose."""
        if self.is_usable.all():
            return None
        n_lost, first = int((~self.is_usable).sum()), int(self.numbers[np.argmin(self.is_usable)])
        return f"{where}: frames without a pose, left out: {n_lost} of {len(self.numbers)} (the first: {first})"


def read_walk(source: RgbdSource) -> Walk:
    """Which records can be used.

    A pose that is not finite was lost. ScanNet's own reader also takes 0 in the first element for lost, but an exact
    quarter turn has it too: here such a pose is lost unless it is a rigid motion. Any other pose that is none is a
    ``DataError``, and so is a recording without any pose.
    """
    walk, is_faulty = classify_poses(source)
    if is_faulty.any():
        raise DataError(faulty_pose(source.where, int(walk.numbers[np.argmax(is_faulty)])))
    if not walk.is_usable.any():
        raise DataError(f"{source.where}: none of the {len(walk.poses)} frames has a pose; leave the scene out")
    return walk


def classify_poses(source: RgbdSource) -> tuple[Walk, BoolArray]:
    """The records as ``read_walk`` has them, and which of them (n,) have a pose that is neither lost nor right."""
    poses = source.poses()
    numbers = np.array([source.frame_number(i) for i in range(len(poses))], np.int64)
    is_finite = np.isfinite(poses).all(axis=(1, 2))
    is_rigid = np.zeros(len(poses), bool)
    is_rigid[is_finite] = are_rigid(poses[is_finite])
    return Walk(numbers, poses, is_rigid), is_finite & ~is_rigid & (poses[:, 0, 0] != 0)


def faulty_pose(where: str, number: int) -> str:
    return f"{where}: frame {number}: the pose is not a rigid motion; copy the recording again"


class ScannetFrames(Sequence[Frame]):
    """The frames of ``records``, each read and registered when it is asked for.

    ``motion`` (4, 4) is applied to the world, None for none.
    """

    def __init__(
        self,
        source: RgbdSource,
        registration: Registration,
        walk: Walk,
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
