"""ScanNet++ scenes from raw files: both kinds of poses, extracted and packed images, lists, splits, rejected input."""

from __future__ import annotations

import shutil
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scannetpp_scene as pp
from recording_files import write_files

from su3d_bench.core.errors import GroundTruthMissing
from su3d_bench.datasets.checks import inspect
from su3d_bench.datasets.scannetpp.dataset import ScanNetPP

# The files count from the corner of the image, frames from the centre of the first pixel.
CAMERA = np.array([[64.0, 0.0, 31.5], [0.0, 64.0, 23.5], [0.0, 0.0, 1.0]])
LISTS = "metadata/semantic_benchmark"


def dataset(root: Path, **options: Any) -> ScanNetPP:
    return ScanNetPP(root, ScanNetPP.Options(**options))


def packed(values: np.ndarray) -> bytes:
    """A depth image in metres, slightly above whole millimetres, as in ``depth.bin``."""
    pack = zlib.compressobj(wbits=-15)
    content = pack.compress(((values.astype(np.float32) + 0.01) / 1000).astype("<f4").tobytes()) + pack.flush()
    return len(content).to_bytes(4, "little") + content


def grey(number: int) -> np.ndarray:
    return np.full((pp.HEIGHT, pp.WIDTH, 3), 60 + 6 * number, np.uint8)


def write_packed(root: Path) -> Path:
    """A scene whose images are packed: ``depth.bin`` and a Matroska video whose grey levels encode frame numbers."""
    import cv2

    folder = pp.write_scene(root) / "iphone"
    for name in ("rgb", "depth"):
        shutil.rmtree(folder / name)
    numbers = range(pp.NUMBERS[-1] + 1)
    (folder / "depth.bin").write_bytes(b"".join(packed(pp.depth_values(number)) for number in numbers))
    video = cv2.VideoWriter(str(folder / "rgb.mkv"), cv2.VideoWriter.fourcc(*"MJPG"), 60.0, pp.COLOUR_SIZE)
    assert video.isOpened()
    for number in numbers:
        video.write(grey(number))
    video.release()
    return folder.parent


@pytest.mark.parametrize("kind", ["colmap", "tracking"])
def test_both_kinds_of_poses_are_camera_to_world_in_mesh_coordinates(tmp_path: Path, kind: str) -> None:
    pp.write_scene(tmp_path)
    frames = list(dataset(tmp_path, poses=kind).frames(pp.SCENE, 1))
    assert [frame.index for frame in frames] == list(pp.NUMBERS)
    for frame, expected in zip(frames, pp.POSES, strict=True):
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-12)
        np.testing.assert_allclose(frame.intrinsics, CAMERA)


def test_colmap_is_preferred_and_tracking_is_the_fallback(tmp_path: Path) -> None:
    folder = pp.write_scene(tmp_path)
    entries = pp.tracking(aligned_pose=np.full((4, 4), np.nan).tolist())
    write_files(folder, {"iphone/pose_intrinsic_imu.json": entries})
    assert len(dataset(tmp_path).frames(pp.SCENE, 1)) == 3
    shutil.rmtree(folder / "iphone/colmap")
    assert [frame.index for frame in dataset(tmp_path).frames(pp.SCENE, 1)] == list(pp.NUMBERS[1:])


def test_packed_files_give_frames_by_number_in_any_order(tmp_path: Path) -> None:
    write_packed(tmp_path)
    frames = dataset(tmp_path).frames(pp.SCENE, 1)
    for position in (0, 2, 1, 0):
        frame, number = frames[position], pp.NUMBERS[position]
        assert frame.rgb.shape == (48, 64, 3)
        assert abs(int(np.median(frame.rgb)) - int(grey(number)[0, 0, 0])) <= 2  # what the codec keeps
        assert frame.depth_m[0, 0] == np.float32((number + 1) / 1000) and frame.depth_m[-1, -1] == 2


def test_extracted_and_packed_depth_are_identical(tmp_path: Path) -> None:
    extracted, packed = tmp_path / "a", tmp_path / "b"
    pp.write_scene(extracted)
    write_packed(packed)
    for ours, theirs in zip(dataset(extracted).frames(pp.SCENE, 1), dataset(packed).frames(pp.SCENE, 1), strict=True):
        np.testing.assert_array_equal(ours.depth_m, theirs.depth_m)


def test_frames_have_at_most_the_requested_columns_and_the_same_rays(tmp_path: Path) -> None:
    pp.write_scene(tmp_path)
    small = dataset(tmp_path, width=32).frames(pp.SCENE, 1)[0]
    assert small.rgb.shape == (24, 32, 3) and small.depth_m.shape == (24, 32)
    corners = np.array([[-0.5, -0.5, 1], [31.5, 23.5, 1]])
    rays = np.array([[-0.5, -0.375, 1], [0.5, 0.375, 1]])
    np.testing.assert_allclose(corners @ np.linalg.inv(small.intrinsics).T, rays)
    whole = dataset(tmp_path, width=4096).frames(pp.SCENE, 1)[0]
    assert whole.rgb.shape[:2] == pp.COLOUR_SIZE[::-1]


def test_lens_distortion_is_removed_from_colour_and_depth(tmp_path: Path) -> None:
    import cv2

    folder = pp.write_scene(tmp_path)
    straight = dataset(tmp_path).frames(pp.SCENE, 1)[0]
    pp.write_colmap(folder / "iphone/colmap", (0.2, -0.05, 0.01, -0.01))
    frame = dataset(tmp_path).frames(pp.SCENE, 1)[0]
    expected = cv2.undistort(straight.rgb, frame.intrinsics, np.array([0.2, -0.05, 0.01, -0.01]))
    inner = slice(8, -8)
    assert np.abs(frame.rgb[inner, inner].astype(int) - np.asarray(expected)[inner, inner]).max() <= 3
    assert np.abs(frame.rgb.astype(int) - straight.rgb).max() > 20
    assert set(np.unique(frame.depth_m).tolist()) <= {0.0, *np.unique(straight.depth_m).tolist()}


@pytest.mark.parametrize(("model", "bent"), [("PINHOLE", ""), ("SIMPLE_RADIAL", " 0"), ("RADIAL", " 0 0")])
def test_other_colmap_models_use_their_parameter_order(tmp_path: Path, model: str, bent: str) -> None:
    focal = "64 64" if model == "PINHOLE" else "64"
    (pp.write_scene(tmp_path) / "iphone/colmap/cameras.txt").write_text(f"1 {model} 64 48 {focal} 32 24{bent}\n")
    np.testing.assert_allclose(dataset(tmp_path).frames(pp.SCENE, 1)[0].intrinsics, CAMERA)


def test_check_of_a_complete_scene_finds_nothing(tmp_path: Path) -> None:
    pp.write_scene(tmp_path)
    data = dataset(tmp_path)
    assert list(data.scenes()) == [pp.SCENE] and data.groups() == {"nvs_sem_val": (pp.SCENE,)}
    assert data.status(pp.SCENE) == "3 frames, ground truth"
    assert dataset(tmp_path, poses="tracking").status(pp.SCENE) == "frames with the phone's poses, ground truth"
    found = inspect(data, pp.SCENE)
    assert [finding for finding in found.findings if finding.severity == "error"] == []
    assert found.truth[0].variant == "scannetpp" and found.truth[0].n_classes == 3
    surface = data.surface(pp.SCENE)
    assert surface.segments is not None and len(np.unique(surface.segments)) == 4
    assert len(data.files(pp.SCENE)) == len(set(data.files(pp.SCENE))) == 2 + 6 + 4 + 3


def test_digest_depends_on_options_and_only_on_files_that_are_read(tmp_path: Path) -> None:
    folder = pp.write_scene(tmp_path)
    first = dataset(tmp_path).digest(pp.SCENE)
    (folder / "iphone/exif.json").write_text("{}")
    assert dataset(tmp_path).digest(pp.SCENE) == first != dataset(tmp_path, width=32).digest(pp.SCENE)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("data/036bce3393/scans/mesh_aligned_0.05_mask.txt", "vertices excluded by the benchmark would be scored"),
        (
            "metadata/semantic_benchmark/top100.txt",
            "lists top100.txt, top100_instance.txt, map_benchmark.csv are missing",
        ),
    ],
)
def test_missing_ground_truth_file_is_named_and_frames_still_work(tmp_path: Path, name: str, line: str) -> None:
    pp.write_scene(tmp_path)
    (tmp_path / name).unlink()
    data = dataset(tmp_path)
    with pytest.raises(GroundTruthMissing, match=f"^{pp.WHERE}: no ground truth, .*{line}"):
        data.ground_truth(pp.SCENE, "scannetpp")
    assert len(data.frames(pp.SCENE, 1)) == 3 and list(data.problems(pp.SCENE)) == []


def test_both_releases_and_a_link_are_found_once(tmp_path: Path) -> None:
    pp.write_scene(tmp_path / "scannetpp")
    (tmp_path / "data").symlink_to(tmp_path / "scannetpp/data")
    data = dataset(tmp_path)
    assert list(data.scenes()) == [pp.SCENE] and len(data.places()) == 1
    assert sum(path.name == "top100.txt" for path in data.files(pp.SCENE)) == 1
