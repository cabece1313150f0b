"""Faults of a described folder: each is one clear line, whatever is damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from damage import damages, outcomes, truncations
from rgbd_scene import CAMERA, NUMBERED, Change, describe, log_of, open_scene, pose, text_of, write_scene

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.recordings.pose_convention import FLIP, judge_scene
from su3d_bench.datasets.recordings.recorded_frames import square
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.rgbd.files import (
    RgbdDescription,
    camera_to_world,
    direction_in,
    read_intrinsics,
    read_trajectory_file,
)
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms
from su3d_bench.formats.text_files import read_text


def keys(**changes: Any) -> Change:
    return lambda folder: describe(folder, {**NUMBERED, **changes})


def file(name: str, text: str, **changes: Any) -> Change:
    def change(folder: Path) -> None:
        describe(folder, {**NUMBERED, "check_convention": False, **changes})
        (folder / "data" / name).write_text(text)

    return change


def log_with(line: int, text: str) -> Change:
    lines = log_of(range(3)).split("\n")
    lines[line - 1] = text
    return file("trajectory.log", "\n".join(lines), pose=None, trajectory="trajectory.log")


def camera_with(**values: Any) -> Change:
    return file("camera.json", json.dumps(CAMERA | values), intrinsics=None, intrinsics_file="camera.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (keys(depth=None, dept="a"), "rgbd.toml:6: unknown key 'dept'; did you mean 'depth'?"),
        (keys(color="a"), "rgbd.toml:7: unknown key 'color'; did you mean 'colour'?"),
        (keys(colour=None), "rgbd.toml: the key 'colour' is missing; needed: colour, depth"),
        (keys(depth_unit_m=None), "rgbd.toml: the key 'depth_unit_m' is missing"),
        (keys(depth_unit_m=0.0), "rgbd.toml:6: depth_unit_m = 0.0: input should be greater than or equal to 0.0000001"),
        (keys(depth_unit_m=float("nan")), "rgbd.toml:6: depth_unit_m = nan: input should be a finite number"),
        (keys(depth_unit_m="mm"), "rgbd.toml:6: depth_unit_m = 'mm': input should be a valid number"),
        (keys(depth_rotated_bits=16), "rgbd.toml:7: depth_rotated_bits = 16: input should be less than or equal to 15"),
        (keys(pose_direction="c2w"), "pose_direction = 'c2w': input should be 'camera_to_world' or 'world_to_camera'"),
        (keys(pose=None), "rgbd.toml: give 'pose' or 'trajectory', one of the two"),
        (keys(trajectory="t.log"), "rgbd.toml: give 'pose' or 'trajectory', one of the two"),
        (keys(intrinsics=None), "give 'intrinsics' or 'intrinsics_file', one of the two"),
        (keys(colour="colour/frame.png"), "expected a pattern with one {index}, or with * or ?"),
        (keys(colour="**/*.png"), "expected a pattern with one {index}, or with * or ?"),
        (keys(colour="colour/*.png"), "some patterns have {index} and some have not; give it to all"),
        (keys(colour="../desk/data/colour/frame-{index}.png"), "rgbd.toml: '../desk/data/colour' leads out"),
        (keys(colour="/etc/{index}"), "rgbd.toml: '/etc' leads out of the folder"),
        (keys(colour="*/frame-{index}.png"), "the folder of a pattern is fixed; *, ? and {index} stand in file names"),
        (keys(colour="color/{index}.png"), "'color/{index}.png': color/ cannot be read: No such file"),
        (keys(colour="colour/{index}.jpg"), "rgbd.toml: no file matches 'colour/{index}.jpg'"),
        (keys(folder="dato"), "folder = 'dato': there is no such folder beside rgbd.toml"),
        (keys(folder="a" * 3000), "there is no such folder beside rgbd.toml"),
        (keys(intrinsics=[6.0, 0.0, 5.5, 3.5]), "rgbd.toml: fx fy cx cy are 6 0 5.5 3.5; expected pixels"),
        (keys(intrinsics=[6.0, 6.5, 55.0, 3.5]), "is 12x8 but the principal point is (55, 3.5)"),
        (keys(pose=None, trajectory="../../x.log"), "rgbd.toml: '../../x.log' leads out of the folder"),
        (keys(intrinsics=None, intrinsics_file="none.txt"), "none.txt is missing; copy the file again"),
        (lambda folder: (folder / "rgbd.toml").write_text("colour = "), "rgbd.toml: not valid TOML: Invalid value"),
        (lambda folder: (folder / "rgbd.toml").write_text("a = " + "[" * 9_000), "Cannot be read"),
        (lambda folder: (folder / "rgbd.toml").write_text("a" + ".a" * 8_000 + " = 1"), "rgbd.toml"),
        (lambda folder: (folder / "rgbd.toml").write_text("a = 1" + "0" * 9000), "rgbd.toml"),
        (lambda folder: (folder / "rgbd.toml").write_text("#" * 70_000), "has 70000 characters; expected a"),
        (lambda folder: (folder / "data/colour/frame-2147483648.png").touch(), "the number is above 2147483647"),
        (lambda folder: (folder / "data/colour/frame-01.png").touch(), "frame-01.png and frame-1.png have one number"),
        (
            lambda folder: [p.rename(p.with_stem(f"frame-9{k}")) for k, p in enumerate(folder.glob("data/depth/*"))],
            "rgbd.toml: no frame has colour, depth and a pose (the first: frame 0, no depth)",
        ),
        (file("frame-1.pose.txt", "1 0 0"), "frame-1.pose.txt has 3 values; expected 16, a 4x4 matrix"),
        (file("frame-1.pose.txt", "x" + " 0" * 15), "frame-1.pose.txt: 'x' is no number"),
        (file("frame-1.pose.txt", text_of(2 * pose(1))), "frame-1.pose.txt: not a rigid motion in metres"),
        (file("frame-1.pose.txt", text_of(pose(1)).replace("-1.0", "-1e9", 1)), "frame-1.pose.txt: not a rigid motion"),
        (log_with(1, " ".join("0" * 16)), 'expected three integers, or set trajectory_format = "matrix"'),
        (log_with(6, "1 1"), "trajectory.log line 6: '1 1'; expected three integers"),
        (log_with(7, "1 0 0"), "trajectory.log line 7 has 3 values; expected 4, a row of a 4x4 matrix"),
        (log_with(7, "1 0 0 x"), "trajectory.log line 7: 'x' is no number"),
        (log_with(7, "3 0 0 0"), "trajectory.log, pose 1: not a rigid motion in metres"),
        (log_with(15, "0 0 0 1\n9 9 9"), "trajectory.log has 16 lines; expected blocks of five"),
        (camera_with(width=1.5), "camera.json: width and height are (1.5, 8); expected whole pixels"),
        (camera_with(width=640), "frame-0.png is 12x8, the camera file says 640x8; intrinsics"),
        (camera_with(intrinsic_matrix=[1, 2]), "camera.json: 'intrinsic_matrix' is not a list of 9 numbers"),
        (camera_with(intrinsic_matrix=[True] * 9), "camera.json: 'intrinsic_matrix' is not a list of 9 numbers"),
        (camera_with(intrinsic_matrix=[10**400] * 9), "camera.json: 'intrinsic_matrix' is not a list of 9 numbers"),
        (camera_with(intrinsic_matrix=[6, 0, 5, 0, 6, 3, 0, 0, 1]), "camera.json: not a pinhole camera; expected fx"),
        (file("camera.json", "[" * 10**5, intrinsics=None, intrinsics_file="camera.json"), "camera.json: not JSON"),
        (file("intrinsics.txt", "6 0 5", intrinsics=None, intrinsics_file="intrinsics.txt"), "has 3 values; expected"),
    ],
)  # fmt: skip
def test_each_fault_is_one_clear_line(tmp_path: Path, change: Change, message: str) -> None:
    change(write_scene(tmp_path))
    with pytest.raises(DataError) as caught:
        open_scene(tmp_path)
    line = str(caught.value)
    assert line.startswith("rgbd/desk: ") and line.isprintable() and len(line) < 600
    assert message in line


@pytest.mark.parametrize("name", ["colour/frame-0.png", "frame-1.pose.txt"])
def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path, name: str) -> None:
    folder = write_scene(tmp_path)
    (folder / "data" / name).rename(tmp_path / "outside")
    (folder / "data" / name).symlink_to(tmp_path / "outside")
    with pytest.raises(DataError, match=rf"'{name}' leads out of the folder"):
        open_scene(tmp_path)


TRUE_AND_DESCRIBED = [
    (("camera_to_world", "opencv"), ("world_to_camera", "opencv"), 'with pose_direction = "camera_to_world"; set'),
    (("camera_to_world", "opencv"), ("camera_to_world", "opengl"), 'with camera_axes = "opencv"; set that in'),
    (("world_to_camera", "opengl"), ("camera_to_world", "opengl"), 'with pose_direction = "world_to_camera"; set'),
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
    folder = write_scene(root, n_frames=0)
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


def read_pose(path: Path, where: str) -> None:
    camera_to_world(square(read_text(path, where).split(), where), DESCRIPTION, where)


def read_log(path: Path, where: str) -> None:
    for values in read_trajectory_file(path, "open3d", where)[0]:
        camera_to_world(values, DESCRIPTION, where)


DESCRIPTION = RgbdDescription.model_validate({**NUMBERED, "intrinsics": (6.0, 6.5, 5.5, 3.5)})


READERS: dict[str, Callable[[Path, str], object]] = {
    "frame-1.pose.txt": read_pose,
    "trajectory.log": read_log,
    "camera.json": read_intrinsics,
    "intrinsics.txt": read_intrinsics,
}


@pytest.mark.parametrize("name", READERS)
def test_every_damaged_file_is_read_or_refused_with_one_line(tmp_path: Path, name: str) -> None:
    path = write_scene(tmp_path, n_frames=2) / "data" / name
    content = path.read_bytes()

    def read(damaged: bytes) -> None:
        path.write_bytes(damaged)
        READERS[name](path, f"rgbd/desk: {name}")

    for copies in (truncations(content), damages(content)):
        n_read, n_refused = outcomes(read, copies, must_name=f"rgbd/desk: {name}")
        assert n_read > 0 and n_refused > 0


def test_every_damaged_description_is_read_or_refused_with_one_line(tmp_path: Path) -> None:
    path = write_scene(tmp_path, n_frames=2, camera_axes="opengl", depth_invalid=[3]) / "rgbd.toml"
    content = path.read_bytes()

    def read(damaged: bytes) -> None:
        path.write_bytes(damaged)
        Rgbd(tmp_path).frames("desk", 1)

    for copies in (truncations(content), damages(content)):
        n_read, n_refused = outcomes(read, copies, must_name="rgbd/desk: rgbd.toml")
        assert n_read > 0 and n_refused > 0


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("World2CamPose", "world_to_camera"),
        ("# camera-to-world", "camera_to_world"),
        ("T_w2c", "world_to_camera"),
        ("Cam2World matrix of frame 7", "camera_to_world"),
        ("pose", None),
    ],
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


def test_numbers_that_are_not_finite_are_no_header(tmp_path: Path) -> None:
    folder = write_scene(tmp_path)
    (folder / "data/frame-1.pose.txt").write_text("nan nan nan nan\n" + "-inf inf nan 0\n" * 3)
    assert [frame.index for frame in open_scene(tmp_path)] == [0, 2]
