"""Exports of ScanNet recordings: each layout gives what the recording holds, and each gap and fault is named."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import damages, outcomes, truncations

from su3d_bench.datasets.exported_frames import ExportedFrames
from su3d_bench.datasets.rgbd_source import RgbdSource
from su3d_bench.datasets.scannet_exports import find_source, open_cpp_export, open_python_export, read_info
from su3d_bench.datasets.sens import SensFile, SensSource
from su3d_bench.errors import DataError

CASES = Path(__file__).parent / "cases"
TOY = CASES / "sens01_toy.sens"
SCENE = "scene0000_00"
WHERE = f"scannet/{SCENE}"
RECORDED = json.loads((CASES / "sens01_toy.json").read_text())
N_FRAMES = 4
ONE_KIND = ("color", "depth", "pose")


def png_bytes(values: np.ndarray) -> bytes:
    return cv2.imencode(".png", values)[1].tobytes()


def pgm_bytes(values: np.ndarray) -> bytes:
    """A PGM as the C++ reader writes it, big-endian."""
    return b"P5\n%d %d\n65535\n" % (values.shape[1], values.shape[0]) + values.astype(">u2").tobytes()


def write_python_export(
    folder: Path, *, images: str = "", rest: str = "", cameras: str = "intrinsic", frame_skip: int = 1
) -> Path:
    """The toy recording as ScanNet's Python reader exports it, colour as in the recording; returns ``folder``."""
    toy = SensFile(TOY, WHERE)
    for base, name in ((images, "color"), (images, "depth"), (rest, "pose"), (rest, cameras)):
        (folder / base / name).mkdir(parents=True)
    for i in range(N_FRAMES):
        (folder / images / f"color/{i * frame_skip}.jpg").write_bytes(toy.colour_bytes(i))
        (folder / images / f"depth/{i * frame_skip}.png").write_bytes(png_bytes(toy.depth(i)))
        (folder / rest / f"pose/{i * frame_skip}.txt").write_text(RECORDED["pose_txt_py2"][str(i)])
    for name, text in RECORDED["intrinsic_py2"].items():
        (folder / rest / cameras / name).write_text(text)
    return folder


def write_cpp_export(folder: Path) -> Path:
    """The toy recording as ScanNet's C++ reader exports it; returns ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    toy = SensFile(TOY, WHERE)
    for i in range(N_FRAMES):
        (folder / f"frame-{i:06d}.color.jpg").write_bytes(toy.colour_bytes(i))
        (folder / f"frame-{i:06d}.depth.pgm").write_bytes(pgm_bytes(toy.depth(i)))
        (folder / f"frame-{i:06d}.pose.txt").write_text(RECORDED["pose_txt_cpp"][str(i)])
    (folder / "_info.txt").write_text(RECORDED["info_cpp"])
    return folder


def assert_is_the_toy(source: RgbdSource, digits: float) -> None:
    """The source gives what the toy recording gives; poses and cameras to ``digits``, images exactly."""
    toy = SensSource(TOY, WHERE)
    assert (len(source), source.where) == (N_FRAMES, WHERE)
    np.testing.assert_allclose(source.poses(), toy.poses(), rtol=digits, atol=digits)
    for i in range(N_FRAMES):
        np.testing.assert_array_equal(source.pose(i), source.poses()[i])
        np.testing.assert_array_equal(source.colour(i), toy.colour(i))
        np.testing.assert_array_equal(source.depth(i), toy.depth(i))
    assert np.isneginf(source.pose(2)).all()
    ours, theirs = source.camera, toy.camera
    assert (ours.colour_size, ours.depth_size, ours.depth_shift) == (
        theirs.colour_size,
        theirs.depth_size,
        theirs.depth_shift,
    )
    for name in ("colour_intrinsics", "depth_intrinsics", "colour_extrinsic", "depth_extrinsic"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=digits, atol=digits)


# ---------------------------------------------------------------- what lies there is read


@pytest.mark.parametrize("cameras", ["intrinsic", "intrinsics"])
def test_the_export_of_the_python_reader_is_the_recording(tmp_path: Path, cameras: str) -> None:
    source = open_python_export(write_python_export(tmp_path, cameras=cameras), WHERE)
    assert_is_the_toy(source, 1e-6)  # six decimals
    files = [file.relative_to(tmp_path).as_posix() for file in source.files()]
    assert sorted(files) == [name.replace("intrinsic/", f"{cameras}/") for name in RECORDED["files_py2"]]
    assert source.timestamp_s(3) == pytest.approx(0.1)


def test_the_export_of_the_cpp_reader_is_the_recording(tmp_path: Path) -> None:
    source = open_cpp_export(write_cpp_export(tmp_path), WHERE)
    assert_is_the_toy(source, 1e-5)  # six significant digits
    assert sorted(file.name for file in source.files()) == RECORDED["files_cpp"]


def test_poses_are_those_in_the_text_of_both_readers(tmp_path: Path) -> None:
    for source, key in (
        (open_python_export(write_python_export(tmp_path / "a"), WHERE), "pose_txt_py2"),
        (open_cpp_export(write_cpp_export(tmp_path / "b"), WHERE), "pose_txt_cpp"),
    ):
        for i, text in RECORDED[key].items():
            assert source.pose(int(i)).ravel().tolist() == [float(word) for word in text.split()]


def test_the_cameras_of_the_cpp_export_are_those_in_its_text(tmp_path: Path) -> None:
    (tmp_path / "_info.txt").write_text(RECORDED["info_cpp"])
    camera, n_frames = read_info(tmp_path / "_info.txt", WHERE)
    assert (n_frames, camera.colour_size, camera.depth_size, camera.depth_shift) == (4, (64, 48), (32, 24), 1000.0)
    assert camera.colour_intrinsics.tolist() == [[58.5094, 0, 32.3875], [0, 58.5094, 24.1875], [0, 0, 1]]
    assert camera.depth_intrinsics.tolist() == [[28.5812, 0, 15.975], [0, 28.5812, 11.975], [0, 0, 1]]
    assert camera.depth_extrinsic[:, 3].tolist() == [0.0125, 0, 0, 1]


def test_openmask3d_layouts_are_the_recording(tmp_path: Path) -> None:
    whole = write_python_export(tmp_path / "all", images="data_compressed", rest="data")
    assert_is_the_toy(open_python_export(whole, WHERE), 1e-6)
    assert_is_the_toy(find_source(whole, SCENE, WHERE), 1e-6)


def equal_sizes(folder: Path, size: tuple[int, int], matrix: np.ndarray) -> ExportedFrames:
    """OpenMask3D's single scene: images of one size, and of the cameras intrinsic_color.txt alone."""
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
def test_colour_intrinsics_serve_both_images_where_they_have_one_size(tmp_path: Path, n: int) -> None:
    matrix = np.eye(4)[:n, :n]
    matrix[:2, :3] = [[60.0, 0.5, 31.5], [0, 61.0, 23.5]]
    source = equal_sizes(tmp_path, (64, 48), matrix)
    np.testing.assert_array_equal(source.camera.colour_intrinsics, matrix[:3, :3])
    np.testing.assert_array_equal(source.camera.depth_intrinsics, matrix[:3, :3])
    np.testing.assert_array_equal(source.camera.depth_extrinsic, np.eye(4))
    assert (source.depth(3) == 4).all()


def test_intrinsics_of_the_full_images_are_scaled_to_images_made_smaller(tmp_path: Path) -> None:
    # A point at the corner of the full image stays at the corner of the small one.
    matrix = np.array([[1170.0, 0, 647.75, 0], [0, 1171.0, 483.75, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    camera = equal_sizes(tmp_path, (648, 242), matrix).camera
    expected = np.array([[585, 0, (647.75 + 0.5) / 2 - 0.5], [0, 1171 / 4, (483.75 + 0.5) / 4 - 0.5], [0, 0, 1]])
    np.testing.assert_allclose(camera.colour_intrinsics, expected, rtol=1e-12)
    np.testing.assert_array_equal(camera.depth_intrinsics, camera.colour_intrinsics)


def test_intrinsics_that_fit_no_image_are_refused(tmp_path: Path) -> None:
    matrix = np.array([[1000.0, 0, 2000, 0], [0, 1000.0, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(DataError, match=r"intrinsic_color\.txt has its principal point at \(2000, 24\), outside"):
        equal_sizes(tmp_path, (64, 48), matrix)


def test_a_principal_point_off_the_centre_is_taken_as_it_is(tmp_path: Path) -> None:
    matrix = np.array([[60.0, 0, 50, 0], [0, 60.0, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert equal_sizes(tmp_path, (64, 48), matrix).camera.colour_intrinsics[0, 2] == 50


def test_frames_that_were_left_out_keep_the_numbers_of_the_others(tmp_path: Path) -> None:
    source = open_python_export(write_python_export(tmp_path, frame_skip=20), WHERE)
    assert [source.frame_number(i) for i in range(N_FRAMES)] == [0, 20, 40, 60]
    assert source.timestamp_s(3) == pytest.approx(2.0)
    assert_is_the_toy(source, 1e-6)


def test_names_are_sorted_as_numbers_and_may_be_padded(tmp_path: Path) -> None:
    write_python_export(tmp_path)
    for i in range(N_FRAMES, 12):
        for name in ("color/{}.jpg", "depth/{}.png", "pose/{}.txt"):
            shutil.copy(tmp_path / name.format(i % N_FRAMES), tmp_path / name.format(i))
    for i in range(12):
        (tmp_path / f"pose/{i}.txt").rename(tmp_path / f"pose/{i:06d}.txt")
    source = open_python_export(tmp_path, WHERE)
    assert [source.frame_number(i) for i in range(12)] == list(range(12))
    np.testing.assert_array_equal(source.depth(10), source.depth(2))
    np.testing.assert_array_equal(source.pose(11), source.pose(3))


def test_hidden_files_are_no_frames(tmp_path: Path) -> None:
    write_python_export(tmp_path)
    (tmp_path / "color/.DS_Store").write_bytes(b"")
    assert len(open_python_export(tmp_path, WHERE)) == N_FRAMES


def test_colour_may_be_png_in_both_exports(tmp_path: Path) -> None:
    toy = SensFile(TOY, WHERE)
    python, cpp = write_python_export(tmp_path / "a"), write_cpp_export(tmp_path / "b")
    for i in range(N_FRAMES):
        content = png_bytes(toy.colour(i)[:, :, ::-1])
        (python / f"color/{i}.jpg").unlink()
        (python / f"color/{i}.png").write_bytes(content)
        (cpp / f"frame-{i:06d}.color.jpg").unlink()
        (cpp / f"frame-{i:06d}.color.png").write_bytes(content)
    assert_is_the_toy(open_python_export(python, WHERE), 1e-6)
    assert_is_the_toy(open_cpp_export(cpp, WHERE), 1e-5)


# ---------------------------------------------------------------- which recording a folder holds


@pytest.mark.parametrize("place", ["", "exported", SCENE])
def test_an_export_is_found_in_the_folder_and_below(tmp_path: Path, place: str) -> None:
    write_python_export(tmp_path / "python" / place)
    write_cpp_export(tmp_path / "cpp" / place)
    assert_is_the_toy(find_source(tmp_path / "python", SCENE, WHERE), 1e-6)
    assert_is_the_toy(find_source(tmp_path / "cpp", SCENE, WHERE), 1e-5)


def test_the_recording_itself_wins_unless_an_export_is_asked_for(tmp_path: Path) -> None:
    write_python_export(tmp_path)
    write_cpp_export(tmp_path / "exported")
    shutil.copy(TOY, tmp_path / f"{SCENE}.sens")
    assert isinstance(find_source(tmp_path, SCENE, WHERE), SensSource)
    assert isinstance(find_source(tmp_path, SCENE, WHERE, "sens"), SensSource)
    assert find_source(tmp_path, SCENE, WHERE, "python").files()[-1] == tmp_path / "pose/3.txt"
    assert find_source(tmp_path, SCENE, WHERE, "cpp").files()[0] == tmp_path / "exported/_info.txt"
    (tmp_path / f"{SCENE}.sens").unlink()
    assert find_source(tmp_path, SCENE, WHERE).files()[-1] == tmp_path / "pose/3.txt"


def test_a_folder_without_a_recording_is_an_error_that_names_all_that_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        find_source(tmp_path, SCENE, WHERE)
    for word in (WHERE, str(tmp_path), f"{SCENE}.sens", "color/", "data_compressed/", "_info.txt", "exported/"):
        assert word in str(caught.value)
    with pytest.raises(DataError, match=f"looked for {SCENE}.sens$"):
        find_source(tmp_path, SCENE, WHERE, "sens")
    with pytest.raises(DataError, match=r"looked for _info\.txt"):
        find_source(tmp_path, SCENE, WHERE, "cpp")
    with pytest.raises(DataError, match="looked for color/"):
        find_source(tmp_path, SCENE, WHERE, "python")


# ---------------------------------------------------------------- what does not fit


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


# ---------------------------------------------------------------- damage

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
    assert n_read + n_refused == 2000 and n_refused > 100
