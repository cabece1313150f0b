"""Faults of a described folder: each is one clear line, whatever is damaged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from recording_files import text_of
from rgbd_scene import NUMBERED, describe, open_scene, write_scene

from su3d_bench.datasets.recordings.pose_convention import FLIP, judge_scene
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.rgbd.files import (
    direction_in,
)
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms

TRUE_AND_DESCRIBED = [
    (("camera_to_world", "opencv"), ("world_to_camera", "opencv"), 'with pose_direction = "camera_to_world"; set'),
    (("world_to_camera", "opencv"), ("camera_to_world", "opengl"),
     'with pose_direction = "world_to_camera" and camera_axes = "opencv"; set that'),
    (("world_to_camera", "opengl"), ("world_to_camera", "opengl"), None),
]  # fmt: skip


@pytest.mark.parametrize(("true", "described", "message"), TRUE_AND_DESCRIBED)
def test_a_description_that_the_depth_contradicts_is_refused_and_corrected(
    tmp_path: Path, true: tuple[str, str], described: tuple[str, str], message: str | None
) -> None:
    folder = write_room(tmp_path, *true)
    table = {**NUMBERED, "intrinsics": None, "intrinsics_file": "intrinsics.txt"}
    describe(folder, {**table, "pose_direction": described[0], "camera_axes": described[1]})
    if message is None:
        assert judge_scene(Rgbd(tmp_path), "desk") is None
        return
    line = contradiction(tmp_path)
    assert line.startswith("rgbd/desk: poses and depth contradict each other") and message in line
    describe(folder, {**table, "pose_direction": described[0], "camera_axes": described[1], "check_convention": False})
    assert judge_scene(Rgbd(tmp_path), "desk") is None


def contradiction(root: Path) -> str:
    verdict = judge_scene(Rgbd(root), "desk")
    assert verdict is not None and verdict.is_wrong
    return verdict.line


def test_a_wrong_unit_of_depth_is_refused_and_corrected(tmp_path: Path) -> None:
    folder = write_room(tmp_path, "camera_to_world", "opencv")
    describe(folder, {**NUMBERED, "intrinsics": None, "intrinsics_file": "intrinsics.txt", "depth_unit_m": 1e-4})
    assert "% with depth_unit_m = 0.001; set that in rgbd.toml, or check_convention = false" in contradiction(tmp_path)
    describe(folder, {**NUMBERED, "intrinsics": None, "intrinsics_file": "intrinsics.txt", "depth_unit_m": 1e-3})
    for path in folder.glob("data/depth/*.png"):
        units = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint16)
        cv2.imwrite(str(path), (units << 3) | (units >> 13))
    assert "% with depth_rotated_bits = 3; set that" in contradiction(tmp_path)


def write_room(root: Path, direction: str, axes: str) -> Path:
    """Eight frames of a room as files, poses stored in the given way."""
    folder = write_scene(root)
    frames = Rooms(root, RoomOptions(width=64, height=48, n_frames=400)).frames("living0", 5)
    for index in range(8):
        frame = frames[index]
        cv2.imwrite(str(folder / f"data/colour/frame-{index}.png"), frame.rgb[..., ::-1])
        cv2.imwrite(str(folder / f"data/depth/frame-{index}.png"), (frame.depth_m * 1000).round().astype(np.uint16))
        stored = frame.camera_to_world @ FLIP if axes == "opengl" else frame.camera_to_world
        stored = np.asarray(np.linalg.inv(stored) if direction == "world_to_camera" else stored, np.float64)
        (folder / f"data/frame-{index}.pose.txt").write_text(text_of(stored))
    (folder / "data/intrinsics.txt").write_text(text_of(frames[0].intrinsics))
    return folder


@pytest.mark.parametrize(
    ("header", "said"),
    [("World2CamPose", "world_to_camera"), ("# camera-to-world", "camera_to_world"), ("pose", None)],
)
def test_a_header_before_a_pose_is_no_number_and_one_that_says_otherwise_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, header: str, said: str | None
) -> None:
    folder = write_scene(tmp_path)
    plain = open_scene(tmp_path)
    for index in range(3):
        path = folder / f"data/frame-{index}.pose.txt"
        path.write_text(f"{header}\n{path.read_text()}")
    caplog.clear()
    for frame, before in zip(open_scene(tmp_path), plain, strict=True):
        np.testing.assert_array_equal(frame.camera_to_world, before.camera_to_world)
    warning = (
        "rgbd/desk: rgbd.toml: the poses are read as camera_to_world, and 3 of their files say otherwise (the first: "
        f"frame-0.pose.txt begins with {header!r}); what they are is told by the depth alone"
    )
    assert (warning in caplog.text) == (said == "world_to_camera")
    assert direction_in(header) == said
