"""ARKitScenes and the OpenSUN3D challenge's files: frames by their times, the query and its truth, one line a fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arkitscenes_scene import (
    POSES,
    QUERIES,
    QUERY,
    SCENE,
    SIZE,
    TIMES,
    TRUTH,
    WHERE,
    write_images,
    write_scene,
)
from recording_files import HEIGHT_M

from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing, ScenesMissing
from su3d_bench.datasets.arkitscenes.challenge import DEVELOPMENT_SCENES
from su3d_bench.datasets.arkitscenes.dataset import ArkitScenes
from su3d_bench.datasets.arkitscenes.frames import Trajectory

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 3429978\n"


def opened(root: Path, **options: Any) -> ArkitScenes:
    return ArkitScenes(root, ArkitScenes.Options(**options))


@pytest.mark.parametrize("is_3dod", [False, True])
def test_frames_have_the_pose_the_depth_and_the_camera_of_their_time(is_3dod: bool, tmp_path: Path) -> None:
    write_scene(tmp_path, is_3dod=is_3dod)
    dataset = opened(tmp_path)
    assert dataset.scenes() == (SCENE,)
    frames = list(dataset.frames(SCENE, 1))
    assert [f"{frame.timestamp_s:.3f}" for frame in frames] == list(TIMES)
    for frame, expected in zip(frames, POSES, strict=True):
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-12)
        assert frame.rgb.shape[1::-1] == SIZE and frame.intrinsics[0].tolist() == [SIZE[0], 0, SIZE[0] / 2]
        assert frame.depth_m[0, 0] == 0 and set(np.unique(frame.depth_m[1:])) == {np.float32(HEIGHT_M)}
    assert list(dataset.problems(SCENE)) == []
    assert [frame.index for frame in dataset.frames(SCENE, 2)] == [0, 2]


def test_the_nearest_pose_is_nearer_than_three_tenths_of_a_second_and_the_later_of_equals() -> None:
    found = Trajectory(np.array([1.0, 2.0, 2.5]), np.tile(np.eye(4), (3, 1, 1)))
    times = np.array([0.69, 0.71, 1.25, 1.29, 1.5, 2.25, 2.79, 2.81])
    assert found.nearest(times).tolist() == [-1, 0, 0, 0, -1, 2, 2, -1]


def test_a_camera_file_may_be_a_millisecond_off_and_images_without_one_are_left_out(tmp_path: Path) -> None:
    cameras = write_scene(tmp_path) / "lowres_wide_intrinsics"
    (cameras / f"{SCENE}_{TIMES[0]}.pincam").rename(cameras / f"{SCENE}_99.999.pincam")
    (cameras / f"{SCENE}_{TIMES[2]}.pincam").rename(cameras / f"{SCENE}_100.205.pincam")
    dataset = opened(tmp_path)
    assert [frame.timestamp_s for frame in dataset.frames(SCENE, 1)] == [100.0, 100.1]
    assert list(dataset.problems(SCENE)) == [
        f"{WHERE}: 1 images lack another image or a camera file of their time (the first: {SCENE}_100.200); left out, "
        "2 frames are used"
    ]


def test_depth_of_less_confidence_is_left_out_where_it_is_asked(tmp_path: Path) -> None:
    folder = write_scene(tmp_path)
    sure, all_of_it = (opened(tmp_path, least_confidence=least).frames(SCENE, 1)[0].depth_m for least in (2, 1))
    assert not sure[:, :4].any() and (sure[:, 4:] == all_of_it[:, 4:]).all() and all_of_it[1:, :4].all()
    for path in (folder / "confidence").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="confidence/ is missing, which option least_confidence needs"):
        opened(tmp_path, least_confidence=1).frames(SCENE, 1)


def test_the_wide_camera_takes_the_scanners_depth_or_the_phones_and_is_made_smaller(tmp_path: Path) -> None:
    folder = write_scene(tmp_path)
    write_images(folder, "wide", "highres_depth", (128, 96))
    (folder / "highres_depth" / f"{SCENE}_{TIMES[1]}.png").unlink()
    frames = list(opened(tmp_path, images="wide", width=32).frames(SCENE, 1))
    assert all(frame.rgb.shape == (24, 32, 3) and frame.depth_m.shape == (24, 32) for frame in frames)
    assert frames[1].intrinsics.tolist() == [[32, 0, 15.625], [0, 32, 11.625], [0, 0, 1]]
    assert len(frames) == 3 and all(frame.depth_m.max() == np.float32(HEIGHT_M) for frame in frames)


def test_the_query_and_its_objects_are_those_of_the_challenges_files(tmp_path: Path) -> None:
    write_scene(tmp_path)
    dataset = opened(tmp_path)
    assert dataset.asked_text(SCENE) == QUERY
    (query,) = dataset.queries(SCENE)
    assert (query.text, query.answers) == (QUERY, (1, 2))
    truth = dataset.ground_truth(SCENE, "query-vertices")
    assert truth.instance.tolist() == [0, 0, 0, 0, 1, 1, 2, 0]  # 2000 is no object, 1002 is number 2
    np.testing.assert_array_equal(truth.points, dataset.surface(SCENE).vertices)
    assert dataset.groups()["opensun3d-development"] == (SCENE,)
    (tmp_path / TRUTH).write_text("1000\n" * 3 + "1\n" * 5)  # 1000 is one to the challenge's script
    assert opened(tmp_path).ground_truth(SCENE, "query-vertices").instance.tolist() == [1] * 3 + [2] * 5


def test_the_challenge_may_lie_elsewhere_and_its_scenes_are_known_without_it(tmp_path: Path) -> None:
    write_scene(tmp_path / "data")
    (tmp_path / "data/challenge_track_1").rename(tmp_path / "challenge_track_1")
    dataset = opened(tmp_path / "data")
    assert dataset.groups() == {"opensun3d-development": DEVELOPMENT_SCENES}
    with pytest.raises(GroundTruthMissing, match=r"no query in .*; clone https://.* --set arkitscenes.challenge=path"):
        dataset.asked_text(SCENE)
    with pytest.raises(GroundTruthMissing, match=rf"{SCENE}.txt is missing; the challenge publishes that of its 5"):
        dataset.ground_truth(SCENE, "query-vertices")
    assert list(dataset.problems(SCENE)) == []
    named = opened(tmp_path / "data", challenge=tmp_path)
    assert named.asked_text(SCENE) == QUERY and named.digest(SCENE) != dataset.digest(SCENE)
    with pytest.raises(DataError, match=r"option challenge: .*/data has no challenge_track_1/benchmark_file_lists"):
        opened(tmp_path, challenge=tmp_path / "data").groups()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (TRUTH, POINTER, f"{SCENE}.txt: is a pointer of Git LFS, not the file; run git lfs pull in its repository"),
        (TRUTH, "0\n1\n", f"{SCENE}.txt has 2 lines, the mesh has 8 vertices; both must be of one scene"),
        (QUERIES, "video_id,visit_id,query\n1,2,a\n", "row 2: expected video_id,visit_id,query, the video of eight"),
        (QUERIES, f"video_id,visit_id,query\n{SCENE},2,a\n{SCENE},2,b\n", f"row 3: scene {SCENE} has two queries"),
    ],
)
def test_a_fault_in_the_challenges_files_is_one_line(name: str, content: str, message: str, tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / name).write_text(content)
    (line,) = opened(tmp_path).problems(SCENE)
    assert message in line and "\n" not in line


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("lowres_wide.traj", "1 2 3\n", "lowres_wide.traj line 1: has 3 values; expected time, axis-angle and transl"),
        ("lowres_wide.traj", "900 0 0 0 0 0 0\n", "3 images have no pose nearer than 0.3 s in lowres_wide.traj"),
        (
            f"lowres_wide_intrinsics/{SCENE}_{TIMES[0]}.pincam",
            "64 48 60\n",
            "pincam: has 3 values; expected one line",
        ),
        (
            f"lowres_wide_intrinsics/{SCENE}_{TIMES[0]}.pincam",
            "32 24 60 60 1 1\n",
            "is 64x48; expected 32x24, as its",
        ),
    ],
)
def test_a_fault_in_the_recording_is_one_line(name: str, content: str, message: str, tmp_path: Path) -> None:
    (write_scene(tmp_path) / name).write_text(content)
    with pytest.raises(DataError) as raised:
        list(opened(tmp_path).frames(SCENE, 1))
    assert message in str(raised.value) and "\n" not in str(raised.value)


def test_without_scenes_or_images_it_is_said_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ScenesMissing, match=r"ChallengeDevelopmentSet"):
        opened(tmp_path).scenes()
    (tmp_path / "raw/Training" / SCENE).mkdir(parents=True)
    (tmp_path / "raw/Training" / SCENE / "lowres_wide.traj").write_text("")
    with pytest.raises(FramesMissing, match=r"has no images in .*lowres_wide and none in lowres_depth"):
        opened(tmp_path).info(SCENE, 1)
    with pytest.raises(DataError, match=r"no scene '42445174'; did you mean '42445173'"):
        opened(tmp_path).surface("42445174")
