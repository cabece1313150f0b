"""``datasets show``: its data, the picture, and each faulty request in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_room import COLOURS, write_box_room
from painted import Painted

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply
from su3d_bench.reports.pictures.scene import draw_scene_picture, look_at


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shown")
    write_box_room(root, 12)
    write_box_room(root, 7, "room1", with_truth=False)
    return root


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, whole: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(whole))


def pixels(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return np.asarray(picture[..., ::-1])


def n_near(picture: np.ndarray, rgb: tuple[int, int, int] | np.ndarray) -> int:
    return int((np.abs(picture.astype(int) - rgb).max(axis=-1) < 14).sum())


def test_view_has_frames_trajectory_points_and_ground_truth(whole: Path) -> None:
    steps: list[tuple[int, int]] = []
    look = look_at(Replica(whole), "room0", progress=lambda n_done, n: steps.append((n_done, n)))
    assert (look.scene, look.n_frames, look.poses.shape) == ("replica/room0", 12, (12, 4, 4))
    assert [frame.index for frame in look.shown] == [0, 2, 4, 6, 8, 11]
    assert steps == [(n, 12) for n in range(13)]
    assert look.seen.shape == look.seen_rgb.shape == (12 * 48 * 36, 3)
    assert (np.abs(look.seen - np.clip(look.seen, 0, [4, 3, 2.5])) < 1e-3).all()
    assert look.counts == {"n_points": 23_600, "n_objects": 6, "n_classes": 3}
    assert 0.3 < look.depth_m[0] < look.depth_m[1] < 5


def test_damaged_frame_is_an_error_but_missing_ground_truth_is_not(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="class id 777"):
        look_at(Painted(tmp_path, Painted.Options(fault="unknown-class")), "b")
    with pytest.raises(DataError, match="frame 2 is missing"):
        look_at(Painted(tmp_path, Painted.Options(fault="missing-frame")), "b")
    look = look_at(Replica(whole), "room1")
    assert look.truth is None and look.counts == {}
    assert "room_1" in look.no_truth


def test_picture_shows_frames_classes_and_trajectory(whole: Path, tmp_path: Path) -> None:
    draw_scene_picture(look_at(Replica(whole), "room0"), tmp_path / "new" / "room0.png")
    picture = pixels(tmp_path / "new" / "room0.png")
    height, width = picture.shape[:2]
    assert width == 2007 and 900 < height < 1500  # 17 cm at 300 dpi
    assert n_near(picture, (0xD6, 0x24, 0x6E)) > 300  # the trajectory
    assert n_near(picture, (0x1A, 0x98, 0x50)) > 30  # its start
    assert sum(n_near(picture, rgb) > 1000 for rgb in COLOURS) >= 4  # the frames
    assert n_near(picture, (208, 203, 196)) > 20_000  # the floor by class and by instance
    assert (picture == 255).all(axis=-1).mean() < 0.5


def test_command_writes_the_picture_and_prints_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "show", "replica/room0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("replica/room0: 12 frames of 48x36 · depth 1.")
    assert lines[0].endswith("6 objects of 3 classes · 23,600 ground-truth points (mesh-vertices)")
    assert lines[1] == "picture: replica-room0.png"
    assert pixels(Path("replica-room0.png")).shape[1] == 2007


def test_scan_without_recording_shows_its_ground_truth_or_mesh(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(whole, tmp_path / "data")
    (tmp_path / "data/Replica/room0/traj.txt").unlink()
    assert main(["datasets", "show", "replica/room0", "--data", "data"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("replica/room0: no frames") and "traj.txt is missing" in lines[1]
    scan = tmp_path / "data/scans/scene0000_00"
    scan.mkdir(parents=True)
    assert main(["datasets", "show", "scannet/scene0000_00", "--data", "data"]) == 2
    assert "scene0000_00_vh_clean_2.ply is missing" in capsys.readouterr().err
    points = Replica(whole).ground_truth("room0", "mesh-vertices").points
    corners = ListColumn(np.arange(0, len(points), 3), np.arange(len(points) // 3 * 3, dtype=np.int32))
    vertex = PlyElement("vertex", len(points), {axis: points[:, k].copy() for k, axis in enumerate("xyz")})
    face = PlyElement("face", len(points) // 3, {"vertex_indices": corners})
    write_ply(scan / "scene0000_00_vh_clean_2.ply", [vertex, face])
    assert main(["datasets", "show", "scannet/scene0000_00", "--data", "data"]) == 0
    text = capsys.readouterr().out
    assert "no frames" in text and "mesh of 23,600 vertices" in text and "no recording in" in text
    assert n_near(pixels(Path("scannet-scene0000_00.png")), (214, 214, 210)) > 1000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["replica/*"], "datasets show replica/*: 2 scenes match (replica/room0, replica/room1, ...); name one"),
        (["replica/rom0"], "no scene matches 'replica/rom0'; did you mean 'replica/room0'?"),
        (["replica/room0", "--out", "x.jpg"], "x.jpg: unknown format of a figure; use a suffix of pdf"),
    ],
)
def test_each_wrong_request_is_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "show", *words]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"su3d-bench: {message}") and printed.err.count("\n") == 1, (
        printed.err
    )
