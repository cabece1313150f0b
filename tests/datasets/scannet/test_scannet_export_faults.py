"""What does not fit in an export of ScanNet, or is damaged: each fault is one line that names the file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scannet_toy import RECORDED, SCENE, WHERE, pgm_bytes, png_bytes, write_cpp_export, write_python_export

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.scannet.recordings import find_source, open_cpp_export, open_python_export


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
        (write("depth/0.jpg", b""), "depth/ holds '0.jpg', which belongs to no frame"),
        (remove_folder("intrinsic"), "intrinsic/intrinsic_color.txt is missing"),
        (write("intrinsic/intrinsic_depth.txt", b"1 2 3\n"), "intrinsic_depth.txt has 3 values; expected 16, a 4x4"),
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
        (
            write("frame-000004.pose.txt", MATRIX),
            "the recording has 4 frames, but there is also frame-000004.pose.txt; ",
        ),
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
        ("m_colorWidth = 64", "m_colorWidth = 999999999", "_info.txt: colour images of 999999999x48; expected 1 to"),
        ("28.5812 0 15.975", "28.5812 0", "'m_calibrationDepthIntrinsic' has 15 values; expected 16"),
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
        a.poses()
    with pytest.raises(DataError, match=r"frame-000001\.depth\.pgm is 30x20; expected 32x24, as _info\.txt says"):
        b.depth(1)
    assert a.colour(0).shape == b.colour(1).shape == (48, 64, 3)
