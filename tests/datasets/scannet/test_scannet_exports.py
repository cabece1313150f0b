"""Exports of ScanNet recordings: each layout matches the recording, and each gap and fault is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scannet_scan import N_FRAMES, RECORDED, SCAN, TOY, WHERE, write_cpp_export, write_python_export

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.recordings.source import ExportedFrames, RgbdSource
from su3d_bench.datasets.scannet.recordings import find_source, open_cpp_export, open_python_export, read_info
from su3d_bench.datasets.scannet.sens import SensFile
from su3d_bench.formats.images import png_bytes


def assert_is_the_toy(source: RgbdSource, digits: float) -> None:
    """The source matches the toy recording; poses and cameras to ``digits``, images exactly."""
    toy = SensFile(TOY, WHERE)
    assert (len(source), source.where) == (N_FRAMES, WHERE)
    np.testing.assert_allclose(source.poses(), toy.poses(), rtol=digits, atol=digits)
    for i in range(N_FRAMES):
        np.testing.assert_array_equal(source.colour(i), toy.colour(i))
        np.testing.assert_array_equal(source.depth(i), toy.depth(i))
    assert np.isneginf(source.poses()[2]).all()
    for name in ("colour_size", "depth_size", "depth_shift"):
        assert getattr(source.camera, name) == getattr(toy.camera, name)
    for name in ("colour_intrinsics", "depth_intrinsics", "colour_extrinsic", "depth_extrinsic"):
        np.testing.assert_allclose(getattr(source.camera, name), getattr(toy.camera, name), rtol=digits, atol=digits)


# ---------------------------------------------------------------- available exports are read


@pytest.mark.parametrize("cameras", ["intrinsic", "intrinsics"])
def test_python_reader_export_matches_the_recording(tmp_path: Path, cameras: str) -> None:
    source = open_python_export(write_python_export(tmp_path, cameras=cameras), WHERE)
    assert_is_the_toy(source, 1e-6)  # six decimals
    files = [file.relative_to(tmp_path).as_posix() for file in source.files()]
    assert sorted(files) == [name.replace("intrinsic/", f"{cameras}/") for name in RECORDED["files_py2"]]
    assert source.timestamp_s(3) == pytest.approx(0.1)


def test_cpp_reader_export_matches_the_recording(tmp_path: Path) -> None:
    source = open_cpp_export(write_cpp_export(tmp_path), WHERE)
    assert_is_the_toy(source, 1e-5)  # six significant digits
    assert sorted(file.name for file in source.files()) == RECORDED["files_cpp"]


def test_cpp_export_cameras_come_from_its_text(tmp_path: Path) -> None:
    (tmp_path / "_info.txt").write_text(RECORDED["info_cpp"])
    camera, n_frames = read_info(tmp_path / "_info.txt", WHERE)
    assert (n_frames, camera.colour_size, camera.depth_size, camera.depth_shift) == (4, (64, 48), (32, 24), 1000.0)
    assert camera.colour_intrinsics.tolist() == [[58.5094, 0, 32.3875], [0, 58.5094, 24.1875], [0, 0, 1]]
    assert camera.depth_intrinsics.tolist() == [[28.5812, 0, 15.975], [0, 28.5812, 11.975], [0, 0, 1]]
    assert camera.depth_extrinsic[:, 3].tolist() == [0.0125, 0, 0, 1]


def test_openmask3d_layouts_match_the_recording(tmp_path: Path) -> None:
    whole = write_python_export(tmp_path / "all", images="data_compressed/", rest="data/")
    assert_is_the_toy(open_python_export(whole, WHERE), 1e-6)
    assert_is_the_toy(find_source(whole, SCAN, WHERE), 1e-6)


def equal_sizes(folder: Path, size: tuple[int, int], matrix: np.ndarray) -> ExportedFrames:
    """OpenMask3D's single scene: images of one size, with intrinsic_color.txt as the only camera file."""
    write_python_export(folder)
    for i in range(N_FRAMES):
        rgb = np.full((size[1], size[0], 3), i, np.uint8)
        (folder / f"color/{i}.jpg").write_bytes(cv2.imencode(".jpg", rgb)[1].tobytes())
        (folder / f"depth/{i}.png").write_bytes(png_bytes(np.full((size[1], size[0]), i + 1, np.uint16)))
    for name in ("intrinsic_depth", "extrinsic_depth", "extrinsic_color"):
        (folder / f"intrinsic/{name}.txt").unlink()
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", matrix)
    return open_python_export(folder, WHERE)


@pytest.mark.parametrize("n", [3, 4])
def test_colour_intrinsics_apply_to_both_images_of_one_size(tmp_path: Path, n: int) -> None:
    matrix = np.eye(4)[:n, :n]
    matrix[:2, :3] = [[60.0, 0.5, 31.5], [0, 61.0, 23.5]]
    source = equal_sizes(tmp_path, (64, 48), matrix)
    np.testing.assert_array_equal(source.camera.colour_intrinsics, matrix[:3, :3])
    np.testing.assert_array_equal(source.camera.depth_intrinsics, matrix[:3, :3])
    np.testing.assert_array_equal(source.camera.depth_extrinsic, np.eye(4))
    assert (source.depth(3) == 4).all()


def test_intrinsics_are_scaled_to_resized_images(tmp_path: Path) -> None:
    # A point at the corner of the full image stays at the corner of the small one.
    matrix = np.array([[1170.0, 0, 647.75, 0], [0, 1171.0, 483.75, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    camera = equal_sizes(tmp_path, (648, 242), matrix).camera
    expected = np.array([[585, 0, (647.75 + 0.5) / 2 - 0.5], [0, 1171 / 4, (483.75 + 0.5) / 4 - 0.5], [0, 0, 1]])
    np.testing.assert_allclose(camera.colour_intrinsics, expected, rtol=1e-12)
    np.testing.assert_array_equal(camera.depth_intrinsics, camera.colour_intrinsics)


def test_intrinsics_that_fit_no_image_are_rejected(tmp_path: Path) -> None:
    matrix = np.array([[1000.0, 0, 2000, 0], [0, 1000.0, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(DataError, match=r"intrinsic_color\.txt has its principal point at \(2000, 24\), outside"):
        equal_sizes(tmp_path, (64, 48), matrix)


def test_skipped_frames_do_not_renumber_the_others(tmp_path: Path) -> None:
    source = open_python_export(write_python_export(tmp_path, frame_skip=20), WHERE)
    assert source.numbers.tolist() == [0, 20, 40, 60]
    assert source.timestamp_s(3) == pytest.approx(2.0)
    assert_is_the_toy(source, 1e-6)


def test_names_are_sorted_numerically_and_may_be_padded(tmp_path: Path) -> None:
    write_python_export(tmp_path)
    for i in range(N_FRAMES, 12):
        for name in ("color/{}.jpg", "depth/{}.png", "pose/{}.txt"):
            shutil.copy(tmp_path / name.format(i % N_FRAMES), tmp_path / name.format(i))
    for i in range(12):
        (tmp_path / f"pose/{i}.txt").rename(tmp_path / f"pose/{i:06d}.txt")
    source = open_python_export(tmp_path, WHERE)
    assert source.numbers.tolist() == list(range(12))
    np.testing.assert_array_equal(source.depth(10), source.depth(2))
    np.testing.assert_array_equal(source.pose(11), source.pose(3))


def test_colour_may_be_png_in_both_exports(tmp_path: Path) -> None:
    toy = SensFile(TOY, WHERE)
    python, cpp = write_python_export(tmp_path / "a"), write_cpp_export(tmp_path / "b")
    for i in range(N_FRAMES):
        content = png_bytes(toy.colour(i))
        (python / f"color/{i}.jpg").unlink()
        (python / f"color/{i}.png").write_bytes(content)
        (cpp / f"frame-{i:06d}.color.jpg").unlink()
        (cpp / f"frame-{i:06d}.color.png").write_bytes(content)
    assert_is_the_toy(open_python_export(python, WHERE), 1e-6)
    assert_is_the_toy(open_cpp_export(cpp, WHERE), 1e-5)
