"""Real recordings, if available: how the datasets read sensor data not written by this project.

``$SU3D_RECORDINGS`` has the folders ``label_fusion`` (frames of wkentaro/label-fusion), ``open3d_rgbd`` (Open3D's
example RGB-D frames), ``tum_fr1desk_9`` (nine frames of TUM's fr1/desk with its complete lists) and ``hololens_94``
(every fourth frame of a sequence of ardaduz/deep-video-mvs).
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from su3d_bench.cli.main import main
from su3d_bench.core.config import write_toml
from su3d_bench.core.geometry import back_project
from su3d_bench.core.maps import Instances
from su3d_bench.datasets.recordings.pose_convention import judge_scene
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.tum.dataset import Tum
from su3d_bench.store.predictions import read_prediction

pytestmark = pytest.mark.recordings
REAL_RECORDINGS = Path(os.environ.get("SU3D_RECORDINGS") or "no-recordings")
FRAME_FILES = {
    "colour": "frame-{index}.color.png",
    "depth": "frame-{index}.depth.png",
    "pose": "frame-{index}.pose.txt",
    "intrinsics_file": "camera-intrinsics.color.txt",
    "depth_unit_m": 1e-4,
    "depth_rotated_bits": 3,
}
SCENES = {
    "shelf": {"folder": "label_fusion/labels", **FRAME_FILES},
    "basket": {"folder": "label_fusion/masks", **FRAME_FILES},
    "chair": {
        "folder": "open3d_rgbd",
        "colour": "color/{index}.jpg",
        "depth": "depth/{index}.png",
        "trajectory": "trajectory.log",
        "intrinsics_file": "camera_primesense.json",
        "depth_unit_m": 1e-3,
    },
    "walk": {
        "folder": "hololens_94",
        "colour": "images/{index}.png",
        "depth": "depth/{index}.png",
        "trajectory": "poses.txt",
        "trajectory_format": "matrix",
        "intrinsics_file": "K.txt",
        "depth_unit_m": 1e-3,
    },
}


@pytest.fixture(autouse=True)
def _recordings() -> None:
    if not REAL_RECORDINGS.is_dir():
        pytest.fail("SU3D_RECORDINGS is not a folder of real recordings (see the docstring)", pytrace=False)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data root whose descriptions refer to the recordings in place."""
    for scene, keys in SCENES.items():
        folder = tmp_path / "data" / "rgbd" / scene
        folder.mkdir(parents=True)
        place = os.path.relpath(REAL_RECORDINGS.resolve() / str(keys["folder"]), folder)
        leaves = [((key,), value, "") for key, value in {**keys, "folder": place}.items()]
        (folder / "rgbd.toml").write_text(write_toml(leaves))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "data"


def run(scene: str, *words: str) -> Instances:
    """The map that the command line creates from every frame of ``scene``."""
    words = ("run", "--scenes", scene, "--stride", "1", "--out", "out", "--quiet", *words)
    assert main(list(words)) == 0
    prediction = read_prediction(next(Path("out").glob("scenes/*/opensu3d/prediction.npz")))
    assert isinstance(prediction, Instances)
    return prediction


def test_fifteen_labelled_frames_give_exactly_the_two_objects_never_swapped(root: Path) -> None:
    (root / "names.toml").write_text('48 = "parcel"\n132 = "carton"\n')
    stored = {"folder": REAL_RECORDINGS.resolve() / "label_fusion/labels", "images": "frame-{index}.segm.png"}
    words = [f"perception.stored.{key}={value}" for key, value in (stored | {"names": root / "names.toml"}).items()]
    found = run("rgbd/shelf", "--profile", "stored", "--set", *words)
    assert sorted(found.names) == ["carton", "parcel"]
    # Values ascend, so detection 0 of every image is the region 48 and detection 1 the region 132.
    views = [found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist() for k in range(2)]
    parcel = found.names.index("parcel")
    assert views[parcel] == [[frame, 0] for frame in range(15)]
    assert views[1 - parcel] == [[frame, 1] for frame in range(15)]
    trees = [cKDTree(found.points[found.mask(k)]) for k in (parcel, 1 - parcel)]
    for frame in Rgbd(root).frames("shelf", 1):
        image = REAL_RECORDINGS / f"label_fusion/labels/frame-{frame.index:06d}.segm.png"
        labels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        for own, value in enumerate((48, 132)):
            pixels = (labels == value) & (frame.depth_m > 0)
            points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
            nearer = trees[own].query(points)[0] < trees[1 - own].query(points)[0]
            assert nearer.mean() > 0.75, (frame.index, value)


@pytest.mark.parametrize(
    ("scene", "data", "extent_m"),
    [("tum/tum_fr1desk_9", REAL_RECORDINGS, (2.6, 1.6, 1.3)), ("rgbd/chair", None, (1.5, 1.6, 2.6))],
)
def test_recordings_run_unscored_with_the_embedded_segmenter(
    root: Path,
    scene: str,
    data: Path | None,
    extent_m: tuple[float, float, float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if data is not None:
        monkeypatch.setenv("SU3D_DATA", str(data.resolve()))
    found = run(scene)
    assert "no protocol applies to these scenes" in capsys.readouterr().out
    assert len(found) > 5 and len(found.points) > 10_000
    # A few frames of a room's corner: what the colour images show is one to three metres wide.
    np.testing.assert_allclose(np.ptp(found.points, axis=0), extent_m, atol=0.3)


def test_poses_of_every_recording_agree_with_its_depth(root: Path) -> None:
    for scene in SCENES:
        assert judge_scene(Rgbd(root), scene) is None
    tum = Tum(REAL_RECORDINGS.resolve())
    assert judge_scene(tum, "tum_fr1desk_9") is None


def test_tum_reports_missing_images(caplog: pytest.LogCaptureFixture) -> None:
    tum = Tum(REAL_RECORDINGS.resolve())
    frames = tum.frames("tum_fr1desk_9", 1)
    assert [frame.index for frame in frames] == list(range(9))
    assert len(list(tum.problems("tum_fr1desk_9"))) == 1
    assert "associate.txt: 1128 listed images are missing (the first: rgb/1305031453.659600.png)" in caplog.text
    assert frames[0].intrinsics[0, 0] == 517.3


def test_images_of_other_cameras_follow_their_formats(root: Path) -> None:
    """One frame each as stored by NYU, SUN and TUM; PGM is big-endian."""
    from su3d_bench.formats.images import decode_colour, decode_depth

    folder = REAL_RECORDINGS / "open3d_rgbd/other_formats"
    for colour, depth in (("NYU_color.ppm", "NYU_depth.pgm"), ("SUN_color.jpg", "SUN_depth.png"),
                          ("TUM_color.png", "TUM_depth.png")):  # fmt: skip
        assert decode_colour((folder / colour).read_bytes(), colour).shape == (480, 640, 3)
        assert (decode_depth((folder / depth).read_bytes(), depth) > 0).mean() > 0.3
