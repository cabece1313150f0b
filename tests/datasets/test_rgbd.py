"""The adapter of described folders: what rgbd.toml says is what comes out, each fault once, damaged files."""

from __future__ import annotations

import json
import logging
import shutil
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from damage import damages, outcomes, truncations

from su3d_bench.cli.main import main
from su3d_bench.core.config import write_toml
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.datasets.recordings.pose_convention import FLIP, judge_scene
from su3d_bench.datasets.recordings.recorded_frames import read_text, square
from su3d_bench.datasets.rgbd.dataset import Rgbd, RgbdOptions
from su3d_bench.datasets.rgbd.description import RgbdDescription
from su3d_bench.datasets.rgbd.files import camera_to_world, direction_in, read_intrinsics, read_trajectory_file
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms

WIDTH, HEIGHT = 12, 8
CAMERA = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [6.0, 0, 0, 0, 6.5, 0, 5.5, 3.5, 1]}
NUMBERED: dict[str, Any] = {
    "folder": "data",
    "colour": "colour/frame-{index}.png",
    "depth": "depth/frame-{index}.png",
    "pose": "frame-{index}.pose.txt",
    "intrinsics": [6.0, 6.5, 5.5, 3.5],
    "depth_unit_m": 0.001,
}
Change = Callable[[Path], object]


def pose(index: int) -> np.ndarray:
    matrix = np.eye(4)
    angle = 0.1 * index
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = index, 1 / 3, -index
    return matrix


def depth_values(index: int) -> np.ndarray:
    return np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 600 + index


def text_of(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in matrix) + "\n"


def log_of(indices: range) -> str:
    return "".join(f"{k} {k} {k + 1}\n{text_of(pose(k))}" for k in indices)


def write_scene(root: Path, n_frames: int = 3, description: dict[str, Any] | None = None, **changes: Any) -> Path:
    """A scene 'desk' with images, pose files and every kind of trajectory and camera file; None drops a key."""
    folder = root / "rgbd" / "desk"
    for name in ("colour", "depth"):
        (folder / "data" / name).mkdir(parents=True, exist_ok=True)
    for index in range(n_frames):
        colour = np.full((HEIGHT, WIDTH, 3), (30, 120, 200), np.uint8)
        cv2.imwrite(str(folder / f"data/colour/frame-{index}.png"), colour)
        cv2.imwrite(str(folder / f"data/depth/frame-{index}.png"), depth_values(index))
        (folder / f"data/frame-{index}.pose.txt").write_text(text_of(pose(index)))
    (folder / "data/trajectory.log").write_text(log_of(range(n_frames)))
    (folder / "data/camera.json").write_text(json.dumps(CAMERA) + "\n")
    (folder / "data/intrinsics.txt").write_text("6 0 5.5\n0 6.5 3.5\n0 0 1\n")
    describe(folder, {**(description or NUMBERED), "check_convention": False, **changes})
    return folder


def describe(folder: Path, keys: dict[str, Any]) -> None:
    leaves = [((key,), value, "") for key, value in keys.items() if value is not None]
    (folder / "rgbd.toml").write_text(write_toml(leaves))


def open_scene(root: Path) -> list[Any]:
    return list(Rgbd(root).frames("desk", 1))


def test_frames_hold_what_the_files_hold(tmp_path: Path) -> None:
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


def test_the_largest_value_is_no_depth_where_it_stands_apart_and_that_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
    (said,) = (record.getMessage() for record in caplog.records)
    assert said == (
        "rgbd/desk: depth 65535 (65.54 m) counts as no depth where it stands apart from all other depths of its image"
    )


def test_every_reading_of_a_scene_says_that_and_none_of_them_twice(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each method of a run has a record of its own."""
    folder = write_scene(tmp_path)
    for index in range(3):
        write_depth(folder, index, np.where(np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) < 9, 65535, 900 + index))
    dataset = Rgbd(tmp_path)
    for n_readings in (1, 2):
        with caplog.at_level(logging.WARNING, "su3d_bench"):
            assert all((frame.depth_m == 0).sum() == 9 for frame in dataset.frames("desk", 1))
        assert [record.getMessage().count("65535") for record in caplog.records] == [1] * n_readings


def test_what_check_and_show_say_of_depth_survives_a_lone_largest_value_and_any_other_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_scene(tmp_path)
    for index in range(3):
        values = np.full((HEIGHT, WIDTH), 900 + index)
        values[:2] = 65535
        write_depth(folder, index, values)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    main(["datasets", "check", "rgbd/desk", "--quiet"])
    said = capsys.readouterr().out
    assert "0.90 to 0.90 m" in said and said.count("depth 65535 (65.54 m) counts as no depth") == 1
    assert main(["datasets", "show", "rgbd/desk", "--quiet", "--json", "--out", str(tmp_path / "desk.png")]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["depth_m"] == pytest.approx([0.9, 0.902])
    values[:2] = 60000
    write_depth(folder, 1, values)
    main(["datasets", "check", "rgbd/desk", "--quiet"])
    assert "in 1 of 3 frames depth reaches 60 m, first frame 1; indoors" in capsys.readouterr().out
    keys = {**NUMBERED, "check_convention": False, "depth_invalid": [60000]}
    describe(folder, keys)
    main(["datasets", "check", "rgbd/desk", "--quiet"])
    assert "depth reaches" not in capsys.readouterr().out


def test_an_unscored_run_says_what_its_labels_are_worth_and_needs_no_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    words = ["run", "--scenes", "rgbd/desk", "--stride", "1", "--no-pictures", "--jobs", "1"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    assert "no protocol scores these scenes" in said.out
    assert "names and labels mean little here" in said.err and "ceiling" not in said.err
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
def test_every_way_to_name_the_same_files_gives_the_same_frames(tmp_path: Path, changes: dict[str, Any]) -> None:
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


def test_globs_pair_up_in_numeric_order(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, n_frames=12, colour="colour/*.png", depth="depth/*.png", pose="*.pose.txt")
    assert [frame.camera_to_world[0, 3] for frame in open_scene(tmp_path)] == list(range(12))
    (folder / "data/depth/frame-5.png").unlink()
    with pytest.raises(DataError, match=r"12 colour files, 11 depth files and 12 poses match; files pair up in order"):
        open_scene(tmp_path)


def test_rotated_bits_are_turned_back_and_invalid_values_have_no_depth(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, depth_rotated_bits=3, depth_unit_m=1e-4, depth_invalid=[1, 8191])
    stored = np.arange(WIDTH * HEIGHT, dtype=np.uint32).reshape(HEIGHT, WIDTH) * 680
    stored[0, 0] = 8 * 8191
    cv2.imwrite(str(folder / "data/depth/frame-0.png"), stored.astype(np.uint16))
    units = ((stored >> 3) | (stored << 13)) & 0xFFFF
    expected = np.where(units == 8191, 0, units * 1e-4).astype(np.float32)
    np.testing.assert_array_equal(open_scene(tmp_path)[0].depth_m, expected)
    assert expected[0, 0] == 0 and (expected > 0).sum() > 90


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
@pytest.mark.parametrize("direction", ["camera_to_world", "world_to_camera"])
def test_direction_and_axes_are_undone(tmp_path: Path, direction: str, axes: str) -> None:
    folder = write_scene(tmp_path, pose_direction=direction, camera_axes=axes)
    for index in range(3):
        stored = pose(index) @ FLIP if axes == "opengl" else pose(index)
        stored = np.linalg.inv(stored) if direction == "world_to_camera" else stored
        (folder / f"data/frame-{index}.pose.txt").write_text(text_of(stored))
    for index, frame in enumerate(open_scene(tmp_path)):
        np.testing.assert_allclose(frame.camera_to_world, pose(index), atol=1e-12)


def test_frames_that_lack_a_part_are_said_once_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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
        "rgbd/desk: 3 frames lack an image or a usable pose (the first: frame 1, no colour and no pose); left out, "
        "2 frames are used"
    ]
    assert list(rgbd.problems("desk")) == [record.getMessage() for record in caplog.records]


def test_a_trajectory_counts_missing_images_or_leaves_them_out(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, n_frames=4, pose=None, trajectory="trajectory.log")
    for name in ("colour", "depth"):
        (folder / f"data/{name}/frame-1.png").unlink()
    assert [frame.camera_to_world[0, 3] for frame in open_scene(tmp_path)] == [0, 2, 3]
    (folder / "data/trajectory.log").write_text(log_of(range(3)))
    assert [(frame.index, frame.camera_to_world[0, 3]) for frame in open_scene(tmp_path)] == [(0, 0), (2, 1), (3, 2)]
    (folder / "data/trajectory.log").write_text(log_of(range(5)))
    with pytest.raises(DataError, match=r"trajectory\.log has 5 poses; expected 3, one an image, or 4, one a number"):
        open_scene(tmp_path)


def test_of_many_scenes_one_is_in_memory(tmp_path: Path) -> None:
    shutil.copytree(write_scene(tmp_path), tmp_path / "rgbd" / "chair")
    rgbd = Rgbd(tmp_path)
    first = weakref.ref(rgbd._recording("desk"))
    assert first() is rgbd._recording("desk")
    assert rgbd.digest("chair") != rgbd.digest("desk")
    assert first() is None


def test_descriptions_anywhere_can_be_named(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "elsewhere")
    (folder / "rgbd.toml").rename(folder / "shelf.toml")
    rgbd = Rgbd(tmp_path, RgbdOptions(files=(folder / "shelf.toml",)))
    assert rgbd.scenes() == ("shelf",) and len(rgbd.frames("shelf", 1)) == 3
    assert RgbdOptions.model_validate_json('{"files": "a.toml"}').files == (Path("a.toml"),)
    (folder / "shelf.toml").rename(folder / "rgbd.toml")
    assert Rgbd(tmp_path, RgbdOptions(files=(folder,))).scenes() == ("desk",)
    write_scene(tmp_path)
    with pytest.raises(DataError, match="rgbd: scene 'desk' is described twice"):
        Rgbd(tmp_path, RgbdOptions(files=(folder,))).scenes()


def test_there_is_no_ground_truth_and_no_scene_without_description(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"rgbd: no scene in .*--set rgbd\.files=path/to/rgbd\.toml"):
        Rgbd(tmp_path).scenes()
    write_scene(tmp_path)
    with pytest.raises(DataError, match="no scene 'dusk'; did you mean 'desk'"):
        Rgbd(tmp_path).info("dusk", 1)
    with pytest.raises(GroundTruthMissing):
        Rgbd(tmp_path).ground_truth("desk", "mesh-vertices")
    with pytest.raises(GroundTruthMissing):
        Rgbd(tmp_path).instance_mesh("desk")


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
        (lambda folder: (folder / "rgbd.toml").write_text("a = " + "[" * 9_000), "Nested more than 64 deep"),
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


def test_the_digest_moves_with_every_file_that_is_read(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, intrinsics=None, intrinsics_file="camera.json")
    seen = {Rgbd(tmp_path).digest("desk")}
    unused = {"trajectory.log", "intrinsics.txt"}
    expected = {path for path in folder.rglob("*") if path.is_file() and path.name not in unused}
    assert {path.resolve() for path in Rgbd(tmp_path).files("desk")} == expected
    for path in (folder / "rgbd.toml", folder / "data/camera.json", folder / "data/frame-1.pose.txt"):
        path.write_text(path.read_text() + "\n")
        seen.add(Rgbd(tmp_path).digest("desk"))
    cv2.imwrite(str(folder / "data/depth/frame-2.png"), depth_values(3))
    assert len(seen | {Rgbd(tmp_path).digest("desk")}) == 5


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
