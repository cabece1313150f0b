"""The TUM RGB-D layout on small sequences: pairing, poses, cameras, each fault once, damaged lists."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_files import HEIGHT, WIDTH, depth_values, write_files

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.tum.dataset import Tum, TumOptions, associate, pose_at, quaternion_poses, read_trajectory

CAMERA = "6.0 6.5 5.5 3.5\n"
SCENE = "rgbd_dataset_freiburg2_xyz"


def write_sequence(root: Path, scene: str = SCENE, n_frames: int = 4) -> Path:
    """Frames 0.1 s apart, depth 0.004 s after colour, a pose at every colour time that moves by 1 m along x."""
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"], "groundtruth": ["# t x y z"]}
    files: dict[str, Any] = {"camera.txt": CAMERA}
    for index in range(n_frames):
        time_s = 100 + index / 10
        colour = np.full((HEIGHT, WIDTH, 3), (200, 120, 30), np.uint8)
        for name, image, late in (("rgb", colour, 0.0), ("depth", depth_values(index), 0.004)):
            file = f"{name}/{time_s + late:.6f}.png"
            files[file] = image
            lists[name].append(f"{time_s + late:.6f} {file}")
        lists["groundtruth"].append(f"{time_s:.4f} {index} 0.5 -1 0 0 0 1")
    write_files(root / scene, files | {f"{name}.txt": "\n".join(lines) + "\n" for name, lines in lists.items()})
    return root / scene


def test_frames_match_the_files(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    frames = Tum(tmp_path).frames(SCENE, 2)
    last = frames[-1]
    assert len(frames) == 2 and (last.index, last.timestamp_s) == (2, 100.2)
    np.testing.assert_allclose(last.camera_to_world[:3, 3], (2, 0.5, -1))
    np.testing.assert_array_equal(last.depth_m, (depth_values(2) / 5000).astype(np.float32))
    np.testing.assert_array_equal(last.intrinsics, [[6, 0, 5.5], [0, 6.5, 3.5], [0, 0, 1]])
    assert (last.rgb == (200, 120, 30)).all()
    with pytest.raises(IndexError):
        frames[2]


@pytest.mark.parametrize("place", [".", "tum", "TUM"])
def test_sequences_are_found_in_the_usual_places(tmp_path: Path, place: str) -> None:
    write_sequence(tmp_path / place)
    (tmp_path / place / "unpacked.tgz").mkdir()
    assert Tum(tmp_path).scenes() == (SCENE,)
    assert Tum(tmp_path).info(SCENE, 3).n_frames == 2


@pytest.mark.parametrize(("scene", "focal"), [("rgbd_dataset_freiburg1_desk", 517.3), ("own", 525.0)])
def test_sequence_name_selects_the_camera_without_a_camera_file(tmp_path: Path, scene: str, focal: float) -> None:
    folder = write_sequence(tmp_path, scene)
    (folder / "camera.txt").unlink()
    large = np.zeros((480, 640), np.uint16)
    for path in folder.glob("*/*.png"):
        cv2.imwrite(str(path), large if path.parent.name == "depth" else np.zeros((480, 640, 3), np.uint8))
    assert Tum(tmp_path).frames(scene, 1)[0].intrinsics[0, 0] == focal
    options = TumOptions(intrinsics=(400, 401, 320, 240))
    assert Tum(tmp_path, options).frames(scene, 1)[0].intrinsics[1, 1] == 401


def test_missing_images_are_counted_once_and_the_others_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_sequence(tmp_path)
    (folder / "rgb/100.100000.png").unlink()
    (folder / "depth/100.304000.png").unlink()
    tum = Tum(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert [frame.index for frame in tum.frames(SCENE, 1)] == [0, 2]
        assert tum.info(SCENE, 1).n_frames == 2
    assert [record.getMessage() for record in caplog.records] == [
        f"tum/{SCENE}: rgb.txt and depth.txt: 2 listed images are missing (the first: rgb/100.100000.png); "
        "excluded, 2 frames are used"
    ]
    assert list(tum.problems(SCENE)) == [record.getMessage() for record in caplog.records]


def test_frames_without_a_pose_in_time_are_excluded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_sequence(tmp_path)
    path = folder / "groundtruth.txt"
    path.write_text(path.read_text().replace("100.1000", "100.1300"))
    with caplog.at_level(logging.WARNING):
        assert [frame.index for frame in Tum(tmp_path).frames(SCENE, 1)] == [0, 2, 3]
    assert "1 colour images have no pose within 0.02 s in groundtruth.txt (the first: rgb/100.1" in caplog.text
    assert len(Tum(tmp_path, TumOptions(max_difference_s=0.04)).frames(SCENE, 1)) == 4


def reference_pairs(first: list[float], second: list[float], limit: float) -> list[tuple[float, float]]:
    """The benchmark's associate.py: two loops over everything."""
    near = sorted((abs(a - b), a, b) for a in first for b in second if abs(a - b) < limit)
    matches = []
    left, right = set(first), set(second)
    for _, a, b in near:
        if a in left and b in right:
            left.remove(a)
            right.remove(b)
            matches.append((a, b))
    return sorted(matches)


stamps = st.lists(st.integers(0, 400).map(lambda k: k / 1000), min_size=1, max_size=12, unique=True)


@settings(max_examples=150, deadline=None)
@given(stamps, stamps)
def test_images_pair_up_as_in_the_benchmark_tool(
    tmp_path_factory: pytest.TempPathFactory, colours: list[float], depths: list[float]
) -> None:
    folder = tmp_path_factory.mktemp("lists")
    (folder / "rgb.txt").write_text("".join(f"{time} rgb/{time}.png\n" for time in colours))
    (folder / "depth.txt").write_text("".join(f"{time},\tdepth/{time}.png\n" for time in depths))
    pairs = [(colour[0], depth[0]) for colour, depth in associate(folder, "tum/x", 0.02)]
    assert pairs == reference_pairs(colours, depths, 0.02)


def test_poses_between_two_rows_are_interpolated() -> None:
    angle = np.radians(80)
    rows = np.array([[0, 0, 0, 0, 0, 0, 1], [4, 2, 0, 0, 0, np.sin(angle / 2), np.cos(angle / 2)]], np.float64)
    for sign in (1, -1):  # a quaternion and its negative are one rotation
        rows[1, 3:] *= sign
        pose = pose_at(10.25, np.array([10.0, 11.0]), rows, 1.0, interpolate=True)
        assert pose is not None
        np.testing.assert_allclose(pose[:3, 3], (1, 0.5, 0))
        np.testing.assert_allclose(pose[:2, 0], (np.cos(angle / 4), np.sin(angle / 4)))
    nearest = pose_at(10.25, np.array([10.0, 11.0]), rows, 1.0, interpolate=False)
    assert nearest is not None
    np.testing.assert_allclose(nearest, np.eye(4), atol=1e-12)


def test_quaternions_of_any_length_become_rotations(tmp_path: Path) -> None:
    quarter = quaternion_poses(np.zeros((1, 3)), np.array([[0, 0, 1, 1]]) / np.sqrt(2))[0]
    np.testing.assert_allclose(quarter[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    (tmp_path / "groundtruth.txt").write_text("2 0 0 0 0 0 3 3\n1 0 0 0 0 0 0 -7\n")
    times_s, rows = read_trajectory(tmp_path / "groundtruth.txt", "x")
    assert times_s.tolist() == [1, 2]
    np.testing.assert_allclose(rows[:, 3:], [[0, 0, 0, -1], [0, 0, 0.5**0.5, 0.5**0.5]])


def test_too_dense_time_stamps_are_rejected_before_pairing(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    lines = "".join(f"{k / 1e6:.6f} a\n" for k in range(2000))
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).write_text(lines)
    with pytest.raises(DataError, match=r"4000000 pairs within 0\.02 s; lower the limit"):
        Tum(tmp_path).info(SCENE, 1)
