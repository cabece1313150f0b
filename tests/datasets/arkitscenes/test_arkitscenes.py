"""ARKitScenes and the OpenSUN3D challenge's files: frames by time, the query and its ground truth, each fault once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import arkitscenes_scene as ark
import numpy as np
import pytest
from recording_files import HEIGHT_M, write_files

from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing
from su3d_bench.datasets.arkitscenes.challenge import DEVELOPMENT_SCENES
from su3d_bench.datasets.arkitscenes.dataset import ArkitScenes
from su3d_bench.datasets.arkitscenes.frames import Trajectory


def opened(root: Path, **options: Any) -> ArkitScenes:
    return ArkitScenes(root, ArkitScenes.Options(**options))


@pytest.mark.parametrize("is_3dod", [False, True])
def test_frames_have_pose_depth_and_camera_of_their_time(is_3dod: bool, tmp_path: Path) -> None:
    ark.write_scene(tmp_path, is_3dod=is_3dod)
    dataset = opened(tmp_path)
    assert dataset.scenes() == (ark.SCENE,)
    frames = list(dataset.frames(ark.SCENE, 1))
    assert [f"{frame.timestamp_s:.3f}" for frame in frames] == list(ark.TIMES)
    for frame, expected in zip(frames, ark.POSES, strict=True):
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-12)
        assert frame.rgb.shape[1::-1] == ark.SIZE and frame.intrinsics[0].tolist() == [ark.SIZE[0], 0, ark.SIZE[0] / 2]
        assert frame.depth_m[0, 0] == 0 and set(np.unique(frame.depth_m[1:])) == {np.float32(HEIGHT_M)}
    assert list(dataset.problems(ark.SCENE)) == []
    assert [frame.index for frame in dataset.frames(ark.SCENE, 2)] == [0, 2]


def test_nearest_pose_is_within_300_ms_and_ties_go_to_the_later() -> None:
    found = Trajectory(np.array([1.0, 2.0, 2.5]), np.tile(np.eye(4), (3, 1, 1)))
    times = np.array([0.69, 0.71, 1.25, 1.29, 1.5, 2.25, 2.79, 2.81])
    assert found.nearest(times).tolist() == [-1, 0, 0, 0, -1, 2, 2, -1]


def test_camera_file_may_be_1_ms_off_and_images_without_one_are_excluded(tmp_path: Path) -> None:
    cameras = ark.write_scene(tmp_path) / "lowres_wide_intrinsics"
    (cameras / f"{ark.SCENE}_{ark.TIMES[0]}.pincam").rename(cameras / f"{ark.SCENE}_99.999.pincam")
    (cameras / f"{ark.SCENE}_{ark.TIMES[2]}.pincam").rename(cameras / f"{ark.SCENE}_100.205.pincam")
    dataset = opened(tmp_path)
    assert [frame.timestamp_s for frame in dataset.frames(ark.SCENE, 1)] == [100.0, 100.1]
    (line,) = dataset.problems(ark.SCENE)
    what = f"1 images have no matching image or camera file (the first: {ark.SCENE}_100.200)"
    assert line == f"{ark.WHERE}: {what}; excluded, 2 frames are used"


def test_depth_of_low_confidence_is_dropped_on_request(tmp_path: Path) -> None:
    folder = ark.write_scene(tmp_path)
    sure, all_of_it = (opened(tmp_path, min_confidence=least).frames(ark.SCENE, 1)[0].depth_m for least in (2, 1))
    assert not sure[:, :4].any() and (sure[:, 4:] == all_of_it[:, 4:]).all() and all_of_it[1:, :4].all()
    for path in (folder / "confidence").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="option min_confidence needs confidence/, which is missing"):
        opened(tmp_path, min_confidence=1).frames(ark.SCENE, 1)


def test_wide_camera_uses_scanner_or_phone_depth_and_is_downsized(tmp_path: Path) -> None:
    folder = ark.write_scene(tmp_path)
    ark.write_images(folder, "wide", "highres_depth", (128, 96))
    (folder / "highres_depth" / f"{ark.SCENE}_{ark.TIMES[1]}.png").unlink()
    frames = list(opened(tmp_path, images="wide", width=32).frames(ark.SCENE, 1))
    assert all(frame.rgb.shape == (24, 32, 3) and frame.depth_m.shape == (24, 32) for frame in frames)
    assert frames[1].intrinsics.tolist() == [[32, 0, 15.625], [0, 32, 11.625], [0, 0, 1]]
    assert len(frames) == 3 and all(frame.depth_m.max() == np.float32(HEIGHT_M) for frame in frames)


def test_query_and_its_objects_come_from_the_challenge_files(tmp_path: Path) -> None:
    ark.write_scene(tmp_path)
    dataset = opened(tmp_path)
    assert dataset.asked_text(ark.SCENE) == ark.QUERY
    (query,) = dataset.queries(ark.SCENE)
    assert (query.text, query.answers) == (ark.QUERY, (1, 2))
    truth = dataset.ground_truth(ark.SCENE, "query-vertices")
    assert truth.instance.tolist() == [0, 0, 0, 0, 1, 1, 2, 0]  # 2000 is not an object, 1002 is number 2
    np.testing.assert_array_equal(truth.points, dataset.surface(ark.SCENE).vertices)
    assert dataset.groups()["opensun3d-development"] == (ark.SCENE,)
    (tmp_path / ark.TRUTH).write_text("1000\n" * 3 + "1\n" * 5)  # 1000 is an object in the challenge's script
    assert opened(tmp_path).ground_truth(ark.SCENE, "query-vertices").instance.tolist() == [1] * 3 + [2] * 5


def test_challenge_may_be_elsewhere_and_its_scenes_are_known_without_it(tmp_path: Path) -> None:
    ark.write_scene(tmp_path / "data")
    (tmp_path / "data/challenge_track_1").rename(tmp_path / "challenge_track_1")
    dataset = opened(tmp_path / "data")
    assert dataset.groups() == {"opensun3d-development": DEVELOPMENT_SCENES}
    with pytest.raises(GroundTruthMissing, match=r"no query in .*; clone https://.* --set arkitscenes.challenge=path"):
        dataset.asked_text(ark.SCENE)
    with pytest.raises(GroundTruthMissing, match=rf"{ark.SCENE}.txt is missing; the challenge publishes that of its 5"):
        dataset.ground_truth(ark.SCENE, "query-vertices")
    assert list(dataset.problems(ark.SCENE)) == []
    named = opened(tmp_path / "data", challenge=tmp_path)
    assert named.asked_text(ark.SCENE) == ark.QUERY and named.digest(ark.SCENE) != dataset.digest(ark.SCENE)
    with pytest.raises(DataError, match=r"option challenge: .*/data has no challenge_track_1/benchmark_file_lists"):
        opened(tmp_path, challenge=tmp_path / "data").groups()


def test_scene_without_images_is_reported(tmp_path: Path) -> None:
    write_files(tmp_path / "raw/Training" / ark.SCENE, {"lowres_wide.traj": ""})
    with pytest.raises(FramesMissing, match=r"no files of the scene in lowres_wide and lowres_depth and "):
        opened(tmp_path).info(ark.SCENE, 1)
