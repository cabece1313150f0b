"""HM3DSem walks: frames and ground truth as written by HOV-SG's tools, and one line per damaged file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hm3dsem_walk import CHAIR, POSES, ROOM, SCENE, WALL, WIDTH, write_graph, write_walk

from su3d_bench.cli.main import main
from su3d_bench.core.errors import GroundTruthMissing, PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.datasets.hm3dsem.dataset import Hm3dSem
from su3d_bench.datasets.hm3dsem.truth import label_set
from su3d_bench.predictions.formats import READERS, recognise


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return write_walk(tmp_path)


def test_frames_have_opencv_poses_millimetres_and_a_90_degree_camera(walk: Path, tmp_path: Path) -> None:
    first, second = Hm3dSem(tmp_path).frames(SCENE, 1)
    assert first.camera_to_world.tolist() == np.diag([1.0, -1, -1, 1]).tolist()
    np.testing.assert_array_equal(second.camera_to_world, POSES[1] @ np.diag([1.0, -1, -1, 1]))
    assert first.depth_m[0, :3].tolist() == pytest.approx([0.0, 0.05, 0.1])
    assert second.rgb[0, 0].tolist() == [10, 20, 30]
    assert first.intrinsics.tolist() == [[WIDTH / 2, 0, 4], [0, WIDTH / 2, 3], [0, 0, 1]]
    assert (first.index, second.index, len(Hm3dSem(tmp_path).frames(SCENE, 2))) == (0, 1, 1)


def test_ground_truth_has_objects_in_file_order_with_floors_rooms_and_boxes(walk: Path, tmp_path: Path) -> None:
    truth = Hm3dSem(tmp_path).ground_truth(SCENE, "hovsg-objects")
    np.testing.assert_allclose(truth.points, np.concatenate([CHAIR, WALL]), rtol=1e-6)
    assert truth.instance.tolist() == [1] * 6 + [2] * 6
    assert [truth.labels.name_of(truth.semantic[k]) for k in (0, 6)] == ["chair", "wall"]
    assert truth.places is not None
    (floor,), (room,) = truth.places.floors, truth.places.rooms
    assert (floor.lowest_m, floor.highest_m, room.middle_m, room.category) == (0.0, 2.4, 1.0, "office")
    np.testing.assert_array_equal(room.points, ROOM)
    np.testing.assert_allclose(truth.places.object_boxes[1][1], np.ptp(CHAIR, axis=0) + 0.02)


def test_scenes_groups_and_status(walk: Path, tmp_path: Path) -> None:
    dataset = Hm3dSem(tmp_path)
    assert (dataset.scenes(), dataset.status(SCENE)) == ((SCENE,), "2 frames, ground truth")
    assert {name: len(scenes) for name, scenes in dataset.groups().items()} == {"hovsg": 8, "walks": 10}
    assert len(dataset.files(SCENE)) == 2 * 3 + 1 + 2 + 1 and len(dataset.digest(SCENE)) == 64
    assert dataset.up(SCENE).axis == "y" and list(dataset.problems(SCENE)) == []


def test_walk_without_ground_truth_has_frames_and_reports_it(walk: Path, tmp_path: Path) -> None:
    before = Hm3dSem(tmp_path).digest(SCENE)
    (walk / "scene_info.json").unlink()
    dataset = Hm3dSem(tmp_path)
    assert dataset.status(SCENE) == "2 frames, no ground truth (scene_info.json is missing)"
    assert list(dataset.problems(SCENE)) == [] and dataset.digest(SCENE) != before
    for ask in (lambda: dataset.ground_truth(SCENE, "hovsg-objects"), lambda: dataset.instance_mesh(SCENE)):
        with pytest.raises(GroundTruthMissing):
            ask()


def test_scene_graph_is_read_with_floors_rooms_features_and_names_as_captions(tmp_path: Path) -> None:
    write_graph(tmp_path / "runs" / SCENE / "graph")
    reader = recognise(tmp_path / "runs")
    assert reader.name == "hovsg-graph" and list(reader.scenes(tmp_path / "runs")) == [SCENE]
    found = reader.read(tmp_path / "runs", SCENE).content
    assert isinstance(found, Instances) and found.features is not None and found.places is not None
    assert (found.captions, found.labels, found.names) == (("chair", "wall"), None, ("object 0_0_0", "object 0_0_1"))
    assert found.features.tolist() == np.eye(4)[:2].tolist() and found.sizes.tolist() == [6, 6]
    (floor,), (room,) = found.places.floors, found.places.rooms
    assert (floor.lowest_m, floor.highest_m) == (0.0, 2.4)
    assert (room.lowest_m, room.highest_m, room.middle_m, room.category) == (0.0, 2.4, 1.2, "office")


def test_objects_are_sorted_by_file_name_as_in_the_original(tmp_path: Path) -> None:
    graph = write_graph(tmp_path / "graph")
    for ending in ("ply", "json"):
        (graph / f"objects/0_0_1.{ending}").rename(graph / f"objects/0_0_10.{ending}")
        (graph / f"objects/0_0_2.{ending}").write_bytes((graph / f"objects/0_0_0.{ending}").read_bytes())
    found = READERS["hovsg-graph"].read(graph, tmp_path.name).content
    assert isinstance(found, Instances) and found.names == ("object 0_0_0", "object 0_0_10", "object 0_0_2")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("floors/0.json", "[]", "should be an object"),
        ("rooms/0_0.json", '{"room_height": [1], "room_zero_level": 0}', "room_height: "),
        ("objects/0_0_0.json", None, "has no .json next to it"),
    ],
)
def test_damaged_scene_graph_is_one_line(tmp_path: Path, name: str, content: str | None, words: str) -> None:
    graph = write_graph(tmp_path / "graph")
    (graph / name).unlink() if content is None else (graph / name).write_text(content)
    with pytest.raises(PredictionError) as error:
        READERS["hovsg-graph"].read(graph, tmp_path.name)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_scene_graph_files_are_evaluated_under_both_protocols(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    write_graph(tmp_path / "runs" / SCENE / "graph")
    names = [text for name in label_set().names for text in (name, f"There is the {name} in the scene.")]
    features = np.zeros((len(names), 4), np.float32)
    features[:, 2] = 1
    for row, name in enumerate(("chair", "wall")):
        for k, text in enumerate(names):
            if text in (name, f"There is the {name} in the scene."):
                features[k] = np.eye(4)[row]
    np.savez(tmp_path / "texts.npz", names=np.array(names), features=features)
    words = ["evaluate", str(tmp_path / "runs"), "--dataset", "hm3dsem", "--text-features", str(tmp_path / "texts.npz")]
    assert main([*words, "--all-protocols", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["protocols"]
    assert found["hm3dsem-objects"]["metrics"]["top_5"] == found["hm3dsem-places"]["metrics"]["room recall"] == 1.0
