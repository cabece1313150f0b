"""What does not fit in an export of ScanNet, or is damaged: each fault is one line that names the file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import N_DAMAGES, damages, outcomes, truncations
from scannet_toy import RECORDED, SCENE, TOY, WHERE, pgm_bytes, png_bytes, write_cpp_export, write_python_export

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.recordings.source import RgbdSource
from su3d_bench.datasets.scannet.recordings import find_source, open_cpp_export, open_python_export
from su3d_bench.datasets.scannet.sens import SensFile


def remove(*names: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return change


def write(name: str, content: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(content)

    return change


def remove_folder(name: str) -> Callable[[Path], None]:
    return lambda folder: shutil.rmtree(folder / name)


GREY = np.zeros((20, 30, 3), np.uint8)


MATRIX = b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove("color/2.jpg"), "color/2.jpg is missing; export the recording again"),
        (remove("depth/0.png"), "depth/0.png is missing; "),
        (remove("pose/3.txt", "pose/1.txt", "color/1.jpg"), "color/1.jpg is missing, and 2 more; "),
        (remove("color/1.jpg", "depth/1.png", "pose/1.txt"), "color/1.jpg is missing, and 2 more; "),
        (write("color/5.jpg", b""), "color/4.jpg is missing, and 4 more; "),
        (write("color/999999999.jpg", b""), "color/4.jpg is missing, and 2999999986 more; "),
        (write("color/notes.txt", b""), "color/ holds 'notes.txt', which belongs to no frame; move it away"),
        (write("depth/0.jpg", b""), "depth/ holds '0.jpg', which belongs to no frame"),
        (write("pose/00.txt", b""), "pose/ holds '00.txt', which belongs to no frame"),
        (write("pose/a\nb.txt", b""), r"pose/ holds 'a\nb.txt', which belongs to no frame"),
        (remove_folder("depth"), "depth/ cannot be read: No such file or directory"),
        (remove_folder("pose"), "pose/ cannot be read: No such file or directory"),
        (remove_folder("intrinsic"), "intrinsic/intrinsic_color.txt is missing"),
        (
            remove("intrinsic/intrinsic_depth.txt"),
            "intrinsic/intrinsic_depth.txt is missing, and depth images of 32x24",
        ),
        (write("intrinsic/intrinsic_depth.txt", b"1 2 3\n"), "intrinsic_depth.txt has 3 values; expected 16, a 4x4"),
        (write("intrinsic/extrinsic_depth.txt", MATRIX + b"5"), "extrinsic_depth.txt has 17 values; expected 16"),
        (
            write("intrinsic/extrinsic_color.txt", MATRIX.replace(b"1", b"nan")),
            "intrinsic/: the colour extrinsic holds",
        ),
        (write("intrinsic/intrinsic_color.txt", MATRIX.replace(b"1", b"q")), "intrinsic_color.txt: 'q' is no number"),
        (
            write("intrinsic/intrinsic_color.txt", MATRIX.replace(b"1 ", b"0 ")),
            "intrinsic/: the colour intrinsics have",
        ),
        (write("color/0.jpg", b"no image"), "color/0.jpg: not a readable image"),
    ],
)
def test_each_fault_of_a_python_export_is_named(tmp_path: Path, change: Callable[[Path], None], message: str) -> None:
    change(write_python_export(tmp_path))
    with pytest.raises(DataError) as caught:
        find_source(tmp_path, SCENE, WHERE)
    assert str(caught.value).startswith(f"{WHERE}: ")
    assert message in str(caught.value), str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove("frame-000002.color.jpg"), "frame-000002.color.jpg is missing; "),
        (remove("frame-000001.depth.pgm", "frame-000003.pose.txt"), "frame-000001.depth.pgm is missing, and 1 more; "),
        (
            write("frame-000004.pose.txt", MATRIX),
            "the recording has 4 frames, but there is also frame-000004.pose.txt; ",
        ),
        (write("frame-000000.label.png", b""), "the export holds 'frame-000000.label.png', which belongs to no frame"),
        (write("_info.txt", b""), "_info.txt: has no 'm_colorWidth'"),
        (write("_info.txt", b"\xff\xfe"), "_info.txt: not a text file"),
    ],
)
def test_each_fault_of_a_cpp_export_is_named(tmp_path: Path, change: Callable[[Path], None], message: str) -> None:
    change(write_cpp_export(tmp_path))
    with pytest.raises(DataError) as caught:
        find_source(tmp_path, SCENE, WHERE)
    assert message in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("m_frames.size = 4", "m_frames.size = 999999999", "frame-000004.color.jpg is missing, and 2999999984 more"),
        ("m_frames.size = 4", "m_frames.size = 1000000000000", "'m_frames.size' is '1000000000000'; expected a number"),
        ("m_frames.size = 4", "m_frames.size = 0", "'m_frames.size' is '0'; expected a number above 0"),
        (
            "m_frames.size = 4",
            "m_frames.size = 3",
            "the recording has 3 frames, but there is also frame-000003.color.jpg, and 2 more",
        ),
        ("m_depthShift = 1000", "m_depthShift = 0", "_info.txt: the depth shift is 0; expected units per metre"),
        ("m_depthShift = 1000", "m_depthShift = 1 2", "'m_depthShift' has 2 values; expected 1"),
        ("m_colorWidth = 64", "m_colorWidth = 6.4", "'m_colorWidth' is '6.4'; expected a number above 0"),
        ("m_colorWidth = 64", "m_colorWidth = 999999999", "_info.txt: colour images of 999999999x48; expected 1 to"),
        ("28.5812 0 15.975", "28.5812 0", "'m_calibrationDepthIntrinsic' has 15 values; expected 16"),
        ("28.5812 0 15.975", "28.5812 0 x", "'m_calibrationDepthIntrinsic': 'x' is no number"),
    ],
)
def test_each_fault_of_an_info_file_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_cpp_export(tmp_path)
    (tmp_path / "_info.txt").write_text(RECORDED["info_cpp"].replace(old, new))
    with pytest.raises(DataError) as caught:
        open_cpp_export(tmp_path, WHERE)
    assert message in str(caught.value), str(caught.value)


def test_an_image_or_pose_that_is_unfit_is_named_when_it_is_read(tmp_path: Path) -> None:
    python = write_python_export(tmp_path / "a")
    cpp = write_cpp_export(tmp_path / "b")
    (python / "color/1.jpg").write_bytes(cv2.imencode(".jpg", GREY)[1].tobytes())
    (python / "depth/1.png").write_bytes(png_bytes(GREY[:, :, 0].astype(np.uint16)))
    (python / "pose/1.txt").write_text("1 2 3")
    (cpp / "frame-000001.depth.pgm").write_bytes(pgm_bytes(np.zeros((20, 30), np.uint16)))
    a, b = open_python_export(python, WHERE), open_cpp_export(cpp, WHERE)
    with pytest.raises(DataError, match=r"color/1\.jpg is 30x20; expected 64x48, as the first frame"):
        a.colour(1)
    with pytest.raises(DataError, match=r"depth/1\.png is 30x20; expected 32x24, as the first frame"):
        a.depth(1)
    bad_pose = rf"^{WHERE}: pose/1\.txt has 3 values; expected 16"
    with pytest.raises(DataError, match=bad_pose):
        a.pose(1)
    with pytest.raises(DataError, match=bad_pose):
        a.poses()
    with pytest.raises(DataError, match=r"frame-000001\.depth\.pgm is 30x20; expected 32x24, as _info\.txt says"):
        b.depth(1)
    assert a.colour(0).shape == b.colour(1).shape == (48, 64, 3)


def test_a_file_that_goes_after_opening_is_a_data_error(tmp_path: Path) -> None:
    source = open_python_export(write_python_export(tmp_path), WHERE)
    (tmp_path / "color/1.jpg").unlink()
    (tmp_path / "pose/1.txt").unlink()
    with pytest.raises(DataError, match=r"color/1\.jpg is missing; export the recording again"):
        source.colour(1)
    with pytest.raises(DataError, match=r"pose/1\.txt is missing; export the recording again"):
        source.poses()


def test_what_is_no_image_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    source = open_python_export(write_python_export(tmp_path), WHERE)
    for i in range(3):
        (tmp_path / f"color/{i}.jpg").unlink()
    os.mkfifo(tmp_path / "color/0.jpg")
    (tmp_path / "color/1.jpg").mkdir()
    with (tmp_path / "color/2.jpg").open("wb") as stream:
        stream.truncate(1 << 40)  # sparse: takes no space on the disk
    for i, message in enumerate(("is not a file", "is not a file", "has 1099511627776 bytes")):
        with pytest.raises(DataError, match=rf"^{WHERE}: color/{i}\.jpg {message}"):
            source.colour(i)


def test_a_folder_that_cannot_be_looked_into_is_a_data_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read: File name too long"):
        find_source(tmp_path, "s" * 300, WHERE)


# each file, whether every proper beginning of it must be refused, and what reads it
DAMAGED: dict[str, tuple[bool, Callable[[RgbdSource], object] | None]] = {
    "color/1.jpg": (True, lambda source: source.colour(1)),
    "depth/1.png": (True, lambda source: source.depth(1)),
    "pose/1.txt": (False, lambda source: source.pose(1)),
    "intrinsic/intrinsic_color.txt": (False, None),
    "intrinsic/extrinsic_depth.txt": (False, None),
    "frame-000001.depth.pgm": (True, lambda source: source.depth(1)),
    "frame-000001.pose.txt": (False, lambda source: source.pose(1)),
    "frame-000001.color.png": (True, lambda source: source.colour(1)),
    "_info.txt": (False, None),
}


@pytest.mark.parametrize("name", list(DAMAGED))
def test_every_truncation_and_damage_of_a_file_is_read_or_refused_with_its_name(tmp_path: Path, name: str) -> None:
    is_python = "/" in name
    (write_python_export if is_python else write_cpp_export)(tmp_path)
    if name == "frame-000001.color.png":
        (tmp_path / "frame-000001.color.jpg").unlink()
        (tmp_path / name).write_bytes(png_bytes(SensFile(TOY, WHERE).colour(1)[:, :, ::-1]))
    content = (tmp_path / name).read_bytes()
    all_cut_are_refused, read_one = DAMAGED[name]
    opened = find_source(tmp_path, SCENE, WHERE)

    def read(copy: bytes) -> None:
        (tmp_path / name).unlink()  # some file systems wait for the disk where a file is overwritten
        (tmp_path / name).write_bytes(copy)
        if read_one is None:
            find_source(tmp_path, SCENE, WHERE)
        else:
            read_one(opened)

    where = "scannet/scene0000_00: "
    must_name = f"{where}intrinsic/" if name.startswith("intrinsic/") else f"{where}{name}"
    if name == "_info.txt":
        must_name = where  # a number of frames that is another number makes a frame be missing
    n_read, n_refused = outcomes(read, truncations(content), must_name=must_name)
    assert n_refused > 0.9 * len(content) if all_cut_are_refused else n_refused > len(content) / 2
    assert n_read <= (2 if all_cut_are_refused else 10)
    n_read, n_refused = outcomes(read, damages(content), must_name=must_name)
    assert n_read + n_refused == N_DAMAGES and n_refused > 0.05 * N_DAMAGES
