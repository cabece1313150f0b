"""Which axis of a recording points up: guessed from cameras and level surfaces, set in rgbd.toml, rotated to z."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.config import write_toml
from su3d_bench.core.geometry import turn_to_z
from su3d_bench.core.types import Float64Array, Frame, UpAxis
from su3d_bench.datasets.recordings.pose_convention import guess_up, judge_scene
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms
from su3d_bench.reports.pictures.scene import look_at

UP_AXES: tuple[UpAxis, ...] = ("x", "-x", "y", "-y", "z", "-z")
TILTED = np.array([[1, 0, 0, 0], [0, 0.6, 0.8, 0], [0, -0.8, 0.6, 0], [0, 0, 0, 1]])  # looks down by 53 degrees


@cache
def walk() -> tuple[Frame, ...]:
    frames = Rooms(Path("unused"), RoomOptions(width=96, height=72, n_frames=1600)).frames("living0", 80)
    return tuple(frames[position] for position in range(12))


def with_up(pose: Float64Array, axis: UpAxis) -> Float64Array:
    """A pose in the z-up world as stored in a file whose world has another axis up."""
    stored = pose.copy()
    stored[:3] = turn_to_z(axis).T @ pose[:3]
    return stored


def write_recording(root: Path, axis: UpAxis, **keys: str) -> Path:
    folder = root / "rgbd" / "walk"
    folder.mkdir(parents=True, exist_ok=True)
    for frame in walk():
        name = str(folder / f"frame-{frame.index}")
        cv2.imwrite(f"{name}.color.png", frame.rgb[..., ::-1])
        cv2.imwrite(f"{name}.depth.png", (frame.depth_m * 1000).round().astype(np.uint16))
        np.savetxt(f"{name}.pose.txt", with_up(frame.camera_to_world, axis), fmt="%.17g")
    np.savetxt(folder / "K.txt", walk()[0].intrinsics, fmt="%.17g")
    table = {"colour": "frame-{index}.color.png", "depth": "frame-{index}.depth.png", "pose": "frame-{index}.pose.txt",
             "intrinsics_file": "K.txt", "depth_unit_m": 0.001, **keys}  # fmt: skip
    (folder / "rgbd.toml").write_text(write_toml([((key,), value, "") for key, value in table.items()]))
    return folder


@pytest.mark.parametrize("axis", UP_AXES)
def test_up_axis_is_guessed_from_upright_cameras(axis: UpAxis) -> None:
    poses = np.array([with_up(frame.camera_to_world, axis) for frame in walk()])
    guess = guess_up(poses, ())
    assert (guess.axis, guess.reason, guess.is_turned) == (axis, "by camera orientation", False)


def test_cameras_looking_down_from_one_side_need_level_surfaces() -> None:
    """A floor seen at an angle: the image's up is nearer to a horizontal axis than to the world's up."""
    rows, columns = np.mgrid[:72, :96]
    intrinsics = np.array([[80.0, 0, 47.5], [0, 80, 35.5], [0, 0, 1]])
    rays = np.stack([(columns - 47.5) / 80, (rows - 35.5) / 80, np.ones((72, 96))], axis=-1)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ TILTED[:3, :3]  # y ahead, z up, then down
    pose[2, 3] = 1.5
    depth_m = (-1.5 / (rays @ pose[:3, :3].T)[..., 2]).astype(np.float32)
    frame = Frame(0, 0.0, np.zeros((72, 96, 3), np.uint8), depth_m, pose, intrinsics)
    assert -pose[1, 1] > -pose[2, 1]
    assert guess_up(pose[None], [frame]).axis == "z"
    assert guess_up(pose[None], [replace(frame, depth_m=np.zeros_like(depth_m))]).axis is None


@pytest.mark.parametrize("axis", UP_AXES)
def test_described_up_axis_is_rotated_to_z(tmp_path: Path, axis: UpAxis) -> None:
    write_recording(tmp_path, axis, up=axis)
    rgbd = Rgbd(tmp_path)
    for frame, made in zip(rgbd.frames("walk", 1), walk(), strict=True):
        np.testing.assert_array_equal(frame.camera_to_world, made.camera_to_world)
    assert rgbd.up("walk").is_turned and judge_scene(rgbd, "walk") is None


def test_mesh_is_rotated_with_the_poses(tmp_path: Path) -> None:
    folder = write_recording(tmp_path, "-y", up="-y", mesh="mesh.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "mesh.ply").write_text(header + faces + "0 -2 0\n1 0 0\n0 0 1\n3 0 1 2\n")
    assert Rgbd(tmp_path).surface("walk").vertices.tolist() == [[0, 0, 2], [1, 0, 0], [0, 1, 0]]


def test_without_up_the_world_is_unchanged_and_the_guess_is_reported_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path, "y")
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    printed = 'z is assumed to be up, but y seems to be (by camera orientation); set up = "y" in rgbd.toml, or up = "z"'
    main(["datasets", "check", "rgbd/walk", "--quiet"])
    out = capsys.readouterr().out
    assert "  up            assumed z, but probably y: by camera orientation" in out and printed in out
    assert main(["datasets", "show", "rgbd/walk", "--quiet", "--out", str(tmp_path / "walk.png"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["up"]["axis"] == "y"
    look = look_at(Rgbd(tmp_path), "walk")
    np.testing.assert_allclose(look.poses, [frame.camera_to_world for frame in walk()], atol=1e-12)
    np.testing.assert_array_equal(look.shown[0].camera_to_world, with_up(walk()[0].camera_to_world, "y"))
    height = np.percentile(look.seen[:, 2], [1, 99])
    assert -0.1 < height[0] < 0.2 and 1.5 < height[1] < 3.0
    write_recording(tmp_path, "y", up="y")
    main(["datasets", "check", "rgbd/walk", "--quiet"])
    out = capsys.readouterr().out
    assert "  up            y, set in rgbd.toml; rotated to z" in out and "seems to be" not in out
