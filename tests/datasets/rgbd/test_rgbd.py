"""The dataset of described folders: frames match what rgbd.toml describes."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recording_files import HEIGHT, WIDTH, depth_values, text_of
from recording_files import turn as pose
from rgbd_scene import NUMBERED, describe, log_of, open_scene, write_scene

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.datasets.recordings.pose_convention import FLIP, judge_scene
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.rgbd.files import direction_in
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms


def test_frames_match_the_files(tmp_path: Path) -> None:
    write_scene(tmp_path)
    rgbd = Rgbd(tmp_path)
    assert rgbd.scenes() == ("desk",) and rgbd.info("desk", 2).n_frames == 2
    last = rgbd.frames("desk", 2)[-1]
    assert (last.index, last.timestamp_s) == (2, 2 / 30)
    np.testing.assert_array_equal(last.camera_to_world, pose(2))
    np.testing.assert_array_equal(last.depth_m, (depth_values(2) * 0.001).astype(np.float32))
    np.testing.assert_array_equal(last.intrinsics, [[6, 0, 5.5], [0, 6.5, 3.5], [0, 0, 1]])
    assert (last.rgb == (200, 120, 30)).all()


def write_depth(folder: Path, index: int, values: np.ndarray) -> None:
    cv2.imwrite(str(folder / f"data/depth/frame-{index}.png"), values.astype(np.uint16))


def test_isolated_largest_value_is_no_depth_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_scene(tmp_path)
    near = np.linspace(810, 4000, WIDTH * HEIGHT).astype(np.uint16).reshape(HEIGHT, WIDTH)
    far = np.linspace(60_000, 65_535, WIDTH * HEIGHT).astype(np.uint16).reshape(HEIGHT, WIDTH)
    lone = near.copy()
    lone[0] = 65535
    for index, values in enumerate((lone, far, np.where(near > 2000, 65535, near))):
        write_depth(folder, index, values)
    with caplog.at_level(logging.WARNING, "su3d_bench"):
        apart, among, again = (frame.depth_m for frame in open_scene(tmp_path))
    assert (apart[0] == 0).all()
    np.testing.assert_array_equal(apart[1:], (near[1:] * 0.001).astype(np.float32))
    np.testing.assert_array_equal(among, (far * 0.001).astype(np.float32))
    assert (again[near > 2000] == 0).all() and again.max() < 2.01
    (printed,) = (record.getMessage() for record in caplog.records)
    assert printed == (
        "rgbd/desk: depth 65535 (65.54 m) counts as no depth if it is far from all other depths of its image"
    )


def test_unscored_run_needs_no_ground_truth_and_qualifies_its_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    words = ["run", "--scenes", "rgbd/desk", "--stride", "1", "--no-pictures", "--jobs", "1"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr()
    assert "no protocol applies to these scenes" in printed.out
    assert "names and labels are unreliable here" in printed.err and "ceiling" not in printed.err
    assert main([*words, "--methods", "oracle", "--out", str(tmp_path / "other")]) == 3
    assert "rgbd/desk: oracle needs ground truth, the dataset has none" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changes",
    [
        {"intrinsics": None, "intrinsics_file": "camera.json"},
        {"intrinsics": None, "intrinsics_file": "intrinsics.txt"},
        {"pose": None, "trajectory": "trajectory.log"},
        {"pose": None, "trajectory": "lines.tum", "trajectory_format": "tum"},
        {"pose": None, "trajectory": "lines.kitti", "trajectory_format": "kitti"},
        {"pose": None, "trajectory": "lines.matrix", "trajectory_format": "matrix"},
        {"colour": "colour/*.png", "depth": "depth/frame-?.png", "pose": "*.pose.txt"},
        {"folder": "../desk/data"},
    ],
    ids=lambda changes: next(reversed(changes)),
)
def test_all_ways_to_name_the_same_files_give_the_same_frames(tmp_path: Path, changes: dict[str, Any]) -> None:
    folder = write_scene(tmp_path / "plain")
    expected = open_scene(tmp_path / "plain")
    folder = write_scene(tmp_path, **changes)
    kitti = [" ".join(map(repr, pose(k)[:3].reshape(-1).tolist())) for k in range(3)]
    (folder / "data/lines.kitti").write_text("\n".join(kitti))
    rows = [" ".join(map(repr, pose(k).reshape(-1).tolist())) for k in range(3)]
    (folder / "data/lines.matrix").write_text("\n".join(rows))
    half = [0.05 * k for k in range(3)]
    tum = [f"{k / 30} {k} {1 / 3} {-k} 0 0 {np.sin(a)} {np.cos(a)}" for k, a in enumerate(half)]
    (folder / "data/lines.tum").write_text("# time x y z\n" + "\n".join(tum))
    found = open_scene(tmp_path)
    assert len(found) == len(expected) == 3
    for one, other in zip(found, expected, strict=True):
        assert (one.index, one.timestamp_s) == (other.index, pytest.approx(other.timestamp_s))
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=1e-15)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)


def test_rotated_bits_are_restored_and_invalid_values_have_no_depth(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, depth_rotated_bits=3, depth_unit_m=1e-4, depth_invalid=[1, 8191])
    stored = np.arange(WIDTH * HEIGHT, dtype=np.uint32).reshape(HEIGHT, WIDTH) * 680
    stored[0, 0] = 8 * 8191
    cv2.imwrite(str(folder / "data/depth/frame-0.png"), stored.astype(np.uint16))
    units = ((stored >> 3) | (stored << 13)) & 0xFFFF
    expected = np.where(units == 8191, 0, units * 1e-4).astype(np.float32)
    np.testing.assert_array_equal(open_scene(tmp_path)[0].depth_m, expected)
    assert expected[0, 0] == 0 and (expected > 0).sum() > 90


@pytest.mark.parametrize("intrinsics", ["intrinsics", "intrinsics_file"])
def test_negative_fy_and_poses_without_time_as_in_icl_nuim(tmp_path: Path, intrinsics: str) -> None:
    write_scene(tmp_path / "plain")
    expected = open_scene(tmp_path / "plain")
    (fx, _, cx), (_, fy, cy), _ = expected[0].intrinsics.tolist()
    values: dict[str, Any] = {"intrinsics": [fx, -fy, cx, cy]}
    if intrinsics == "intrinsics_file":
        values = {"intrinsics": None, "intrinsics_file": "negative.txt"}
    folder = write_scene(tmp_path, pose=None, trajectory="lines.txt", trajectory_format="tum", **values)
    (folder / "data/negative.txt").write_text(f"{fx} 0 {cx}\n0 {-fy} {cy}\n0 0 1")
    half = [0.05 * k for k in range(3)]  # y negated: angle around z, too
    lines = [f"{k} {-1 / 3} {-k} 0 0 {-np.sin(a)} {np.cos(a)}" for k, a in enumerate(half)]
    (folder / "data/lines.txt").write_text("\n".join(lines))
    for one, other in zip(open_scene(tmp_path), expected, strict=True):
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=1e-15)
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
    (folder / "data/lines.txt").write_text("\n".join([lines[0], "0 " + lines[1], lines[2]]))
    with pytest.raises(DataError, match="line 2: has 8 values"):
        open_scene(tmp_path)


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
@pytest.mark.parametrize("direction", ["camera_to_world", "world_to_camera"])
def test_direction_and_axes_are_undone(tmp_path: Path, direction: str, axes: str) -> None:
    folder = write_scene(tmp_path, pose_direction=direction, camera_axes=axes)
    for index in range(3):
        stored: np.ndarray = pose(index) @ FLIP if axes == "opengl" else pose(index)
        stored = np.linalg.inv(stored) if direction == "world_to_camera" else stored
        (folder / f"data/frame-{index}.pose.txt").write_text(text_of(stored))
    for index, frame in enumerate(open_scene(tmp_path)):
        np.testing.assert_allclose(frame.camera_to_world, pose(index), atol=1e-12)


def test_incomplete_frames_are_reported_once_and_excluded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_scene(tmp_path, n_frames=5)
    (folder / "data/colour/frame-1.png").unlink()
    (folder / "data/frame-1.pose.txt").unlink()
    (folder / "data/depth/frame-3.png").unlink()
    (folder / "data/frame-4.pose.txt").write_text(text_of(np.full((4, 4), -np.inf)))
    rgbd = Rgbd(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert [frame.index for frame in rgbd.frames("desk", 1)] == [0, 2]
        assert rgbd.info("desk", 1).n_frames == 2
    assert [record.getMessage() for record in caplog.records] == [
        "rgbd/desk: 3 frames lack an image or a usable pose (the first: frame 1, no colour and no pose); excluded, "
        "2 frames are used"
    ]
    assert list(rgbd.problems("desk")) == [record.getMessage() for record in caplog.records]


def test_trajectory_counts_or_skips_missing_images(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, n_frames=4, pose=None, trajectory="trajectory.log")
    for name in ("colour", "depth"):
        (folder / f"data/{name}/frame-1.png").unlink()
    assert [frame.camera_to_world[0, 3] for frame in open_scene(tmp_path)] == [0, 2, 3]
    (folder / "data/trajectory.log").write_text(log_of(range(3)))
    assert [(frame.index, frame.camera_to_world[0, 3]) for frame in open_scene(tmp_path)] == [(0, 0), (2, 1), (3, 2)]
    (folder / "data/trajectory.log").write_text(log_of(range(5)))
    with pytest.raises(DataError, match=r"\.log has 5 poses; expected 3, one per image, or 4, one per number"):
        open_scene(tmp_path)


TRUE_AND_DESCRIBED = [
    (("camera_to_world", "opencv"), ("world_to_camera", "opencv"), 'with pose_direction = "camera_to_world"; set'),
    (("world_to_camera", "opencv"), ("camera_to_world", "opengl"),
     'with pose_direction = "world_to_camera" and camera_axes = "opencv"; set that'),
    (("world_to_camera", "opengl"), ("world_to_camera", "opengl"), None),
]  # fmt: skip


@pytest.mark.parametrize(("true", "described", "message"), TRUE_AND_DESCRIBED)
def test_description_contradicted_by_depth_is_rejected_and_corrected(
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


def test_wrong_depth_unit_is_rejected_and_corrected(tmp_path: Path) -> None:
    folder = write_room(tmp_path, "camera_to_world", "opencv")
    describe(folder, {**NUMBERED, "intrinsics": None, "intrinsics_file": "intrinsics.txt", "depth_unit_m": 1e-4})
    assert "% with depth_unit_m = 0.001; set that in rgbd.toml, or check_convention = false" in contradiction(tmp_path)
    describe(folder, {**NUMBERED, "intrinsics": None, "intrinsics_file": "intrinsics.txt", "depth_unit_m": 1e-3})
    for path in folder.glob("data/depth/*.png"):
        units = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint16)
        cv2.imwrite(str(path), (units << 3) | (units >> 13))
    assert "% with depth_rotated_bits = 3; set that" in contradiction(tmp_path)


def write_room(root: Path, direction: str, axes: str) -> Path:
    """Eight frames of a room as files, with poses stored in the given convention."""
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
    ("header", "printed"),
    [("World2CamPose", "world_to_camera"), ("# camera-to-world", "camera_to_world"), ("pose", None)],
)
def test_pose_header_is_skipped_and_a_contradicting_one_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, header: str, printed: str | None
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
        "rgbd/desk: rgbd.toml: the poses are read as camera_to_world, but 3 of their files have another header "
        f"(the first: frame-0.pose.txt begins with {header!r}); only the depth images can decide"
    )
    assert (warning in caplog.text) == (printed == "world_to_camera")
    assert direction_in(header) == printed
