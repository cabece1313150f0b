"""Predictions with their own points: files of the programs are read, and malicious files have no effect."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import prediction_files as made
import pytest
from painted import Painted, WordEncoder
from places import SCENES

from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.formats.pcd import write_pcd_points
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.predictions.base import ScenePrediction
from su3d_bench.predictions.formats import READERS, recognise


def read(path: Path, scene: str = "room0", format: str | None = None) -> ScenePrediction:
    return recognise(path, format).read(path, scene)


def instances(prediction: ScenePrediction) -> Instances:
    assert isinstance(prediction.content, Instances)
    return prediction.content


# ---- every format


@pytest.mark.parametrize("format", made.WITH_POINTS)
def test_each_cloud_format_is_recognized_uniquely_at_every_level(tmp_path: Path, format: str) -> None:
    folder = made.write_small(tmp_path, format)
    for path in (folder, folder / "room0"):
        assert [name for name in READERS if READERS[name].recognise(path) is not None] == [format]
        assert list(READERS[format].scenes(path)) == ["room0"]
        prediction = read(path)
        assert (prediction.scene, prediction.format) == ("room0", format)
        assert all(remark == remark.strip() and "\n" not in remark for remark in prediction.remarks)


@pytest.mark.parametrize("format", [name for name in made.WITH_POINTS if name != "esam"])  # which has no names
def test_ground_truth_in_each_format_scores_perfectly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    truth = Painted(tmp_path, Painted.Options()).ground_truth("a", "mesh-vertices")
    row = truth.instance - 1
    names = [entry.name for entry in load_protocol("rooms-semantic").classes]
    encoder = WordEncoder()
    features = encoder.encode_texts([truth.labels.name_of(int(truth.semantic[row == k][0])) for k in range(4)])
    scene = tmp_path / "maps/a"
    if format == "conceptgraphs":
        objects = [made.an_object(1, [0], pcd_np=truth.points[row == k], clip_ft=features[k]) for k in range(4)]
        made.write_map(scene / "pcd_saves/full_pcd_x.pkl.gz", {"objects": objects, "bg_objects": None})
    elif format == "gradslam":
        made.write_gradslam(scene / "saved-map/pointclouds", truth.points, features[row])
    elif format == "hovsg":
        made.write_hovsg(scene, {k: truth.points[row == k] for k in range(4)}, features)
    elif format == "ovo":
        made.write_ovo(scene, truth.points, row + 3, {k + 3: features[k] for k in range(4)})
    elif format == "rayfronts":
        made.write_torch(scene / "map.pt", made.tensors({"feats_xyz": truth.points, "feats_feats": features[row]}))
    elif format == "onlineanyseg":
        made.write_onlineanyseg(scene, truth.points, [row == k for k in range(4)], list(features))
    else:
        made.write_openlex(scene, truth.points, row, features)
    np.savez(tmp_path / "texts.npz", names=np.array(names), features=encoder.encode_texts(names))
    request = Request(
        (tmp_path / "maps",),
        dataset=f"{SCENES}/painted.py:Painted",
        protocols=("rooms-semantic",),
        scenes=("a",),
        text_features=tmp_path / "texts.npz",
    )
    found = evaluate(request).to_json()["protocols"]["rooms-semantic"]["metrics"]
    assert found == {"macc": 1.0, "miou": 1.0, "fmiou": 1.0}


# ---- ConceptGraphs


def settings(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Settings as ConceptGraphs stores them: an object of omegaconf's class, with a path in it."""
    module = ModuleType("omegaconf.dictconfig")

    class DictConfig:
        pass

    DictConfig.__module__, DictConfig.__qualname__ = module.__name__, "DictConfig"
    module.DictConfig = DictConfig  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "omegaconf", ModuleType("omegaconf"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    made = DictConfig()
    vars(made).update(_content={"dataset_root": Path("/data/Replica"), "stride": 5}, _parent=None, ref_type=dict)
    return made


@pytest.mark.parametrize("protocol", range(2, 6))  # ConceptGraphs writes 4; before 2 objects had another format
def test_map_survives_a_round_trip_object_by_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int
) -> None:
    value = made.a_map(cfg=settings(monkeypatch))
    made.write_map(tmp_path / "room0/pcd_saves/full_pcd_none_x.pkl.gz", value, protocol)
    prediction = read(tmp_path)
    found = instances(prediction)
    background = value["bg_objects"][0]
    assert len(found) == 4 and found.labels == ("", "", "", "wall")
    for k, one in enumerate([*value["objects"], background]):
        np.testing.assert_array_equal(found.points[found.mask(k)], one["pcd_np"].astype(np.float32))
    np.testing.assert_array_equal(found.features, np.stack([one["clip_ft"] for one in [*value["objects"], background]]))
    assert found.scores.tolist() == [1, 1, 1, 1]
    assert found.names == ("couch", "lamp", "couch", "wall")  # the lowest on ties
    np.testing.assert_array_equal(found.boxes[0, 1], value["objects"][0]["pcd_np"].astype(np.float32).max(axis=0))
    assert not found.boxes[1].any() and not found.centroids[1].any()
    assert any("1 for every object" in remark for remark in prediction.remarks)
    assert any(
        "1 background objects (wall) have their own names as labels" in printed for printed in prediction.remarks
    )


def test_the_streamlined_variant_is_read(tmp_path: Path) -> None:
    one = made.an_object(
        3, [1, 1], class_name="lamp", consolidated_caption="a lamp\non a desk", captions=["x"], id="u-1"
    )
    del one["text_ft"], one["class_id"]
    value = {
        "objects": [one],
        "cfg": {"stride": 10},
        "class_names": made.CLASSES,
        "class_colors": {},
        "edges": [(0, 1, "on")],
    }
    made.write_map(tmp_path / "room0/exps/rerun/pcd_rerun.pkl.gz", value)
    for path in (tmp_path, tmp_path / "room0", tmp_path / "room0/exps", tmp_path / "room0/exps/rerun/pcd_rerun.pkl.gz"):
        found = instances(read(path))
        assert (found.names, found.captions) == (("lamp",), ("a lamp on a desk",))
    made.write_map(tmp_path / "room0/exps/again/pcd_again.pkl.gz", value)
    message = made.refused(tmp_path, "room0", "conceptgraphs")
    assert "both of scene 'room0'" in message and "exps/again" in message and "exps/rerun" in message


def test_names_of_detections_are_the_classes_without_features(tmp_path: Path) -> None:
    objects = [made.an_object(3, [1]), made.an_object(2, [0])]
    for one in objects:
        del one["clip_ft"]
    prediction = read(
        made.write_map(tmp_path / "pcd_x.pkl.gz", {"objects": objects, "class_names": made.CLASSES}), "pcd_x"
    )
    found = instances(prediction)
    assert found.features is None and found.labels == ("lamp", "couch")
    assert any("the names of their detections decide" in remark for remark in prediction.remarks)


def test_map_after_the_last_merging_is_read_of_two(tmp_path: Path) -> None:
    folder = tmp_path / "room0/pcd_saves"
    made.write_map(folder / "full_pcd_a.pkl.gz", made.a_map())
    made.write_map(folder / "full_pcd_a_post.pkl.gz", made.a_map(objects=[made.an_object(2, [0])]))
    prediction = read(tmp_path)
    assert len(instances(prediction)) == 2 and prediction.path.name == "full_pcd_a_post.pkl.gz"
    assert any("'full_pcd_a_post.pkl.gz' is read" in remark for remark in prediction.remarks)
    assert len(instances(read(folder / "full_pcd_a.pkl.gz"))) == 4
    made.write_map(folder / "full_pcd_a_post2.pkl.gz", made.a_map())
    message = made.refused(tmp_path, "room0", "conceptgraphs")
    assert "contains 3 maps (full_pcd_a.pkl.gz, full_pcd_a_post.pkl.gz, full_pcd_a_post2.pkl.gz)" in message


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1, 2], "holds a list without a list of 'objects'"),
        ({"objects": [5]}, "object 0: is 5 without 'pcd_np'"),
        ({"objects": [{"pcd_np": np.zeros((3, 2))}]}, "object 0: the points are an array of shape (3, 2) float64"),
        ({"objects": [{"pcd_np": np.array([[0, 0, 0], [0, np.nan, 0]])}]}, "object 0: point 1 is at [0.0, nan, 0.0]"),
        ({"objects": [{"pcd_np": np.full((1, 3), 1e300)}]}, "point 0 is at [1e+300, 1e+300, 1e+300]"),
        (
            {"objects": [made.an_object(1, [0]), made.an_object(1, [0], clip_ft=None)]},
            "object 1: 'clip_ft' is a NoneType",
        ),
        (
            {"objects": [made.an_object(1, [0]), made.an_object(1, [0], clip_ft=np.ones(3))]},
            "object 1: 'clip_ft' is an array of shape (3,) float64; expected a list of 16 numbers",
        ),
        ({"objects": [], "bg_objects": 5}, "'bg_objects' is 5; expected a list"),
    ],
)
def test_each_invalid_conceptgraphs_map_is_one_line(tmp_path: Path, value: object, message: str) -> None:
    path = made.write_map(tmp_path / "pcd_x.pkl.gz", value)
    text = made.refused(path, "pcd_x", "conceptgraphs")
    assert text.startswith(f"{path}: ") and message in text


# ---- gradslam


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_dense_map_survives_a_round_trip(tmp_path: Path, kind: Any) -> None:
    points, features = made.RNG.normal(size=(50, 3)).astype(np.float32), made.RNG.normal(size=(50, 8)).astype(kind)
    features[[3, 7]] = 0
    made.write_gradslam(tmp_path / "room0/saved-map/pointclouds", points, features)
    prediction = read(tmp_path)
    assert isinstance(prediction.content, DenseFeatures)
    np.testing.assert_array_equal(prediction.content.points, points)
    np.testing.assert_array_equal(prediction.content.features, features.astype(np.float16))
    assert any("2 of 50 points have no feature" in remark for remark in prediction.remarks)
    assert any("first camera" in remark and "first_pose.txt" in remark for remark in prediction.remarks)


def test_first_pose_next_to_the_points_transforms_them_to_the_world(tmp_path: Path) -> None:
    made.write_gradslam(tmp_path / "room0", np.array([[1, 2, 3]], np.float32), np.ones((1, 4), np.float16))
    pose = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]], float)
    (tmp_path / "room0/traj.txt").write_text(" ".join(map(repr, pose.reshape(-1).tolist())) + "\nnext pose\n")
    prediction = read(tmp_path)
    assert prediction.content.points.tolist() == [[8, 21, 33]]  # type: ignore[union-attr]
    assert prediction.remarks == ("points were transformed to the world with the first pose of traj.txt",)
    (tmp_path / "room0/first_pose.txt").write_text("1 2 3\n")
    assert "first_pose.txt line 1 has 3 values; expected 16" in made.refused(tmp_path, "room0", "gradslam")


def test_rows_outside_the_float16_range_have_no_feature(tmp_path: Path) -> None:
    features = np.ones((4, 2), np.float32)
    features[0, 0], features[1, 1], features[2, 0] = np.nan, np.inf, 1e6
    made.write_gradslam(tmp_path / "room0", np.zeros((4, 3), np.float32), features)
    prediction = read(tmp_path)
    assert prediction.content.features.tolist() == [[0, 0], [0, 0], [0, 0], [1, 1]]  # type: ignore[union-attr]
    assert any("3 of 4 points have no feature" in remark for remark in prediction.remarks)


@pytest.mark.parametrize(
    ("points", "features", "message"),
    [
        (np.full((4, 3), np.nan), np.ones((4, 2)), "pc_points.h5: point 0 is at [nan, nan, nan]"),
        (np.zeros((4, 2)), np.ones((4, 2)), "pc_points.h5: has the shape (4, 2); expected (N, 3)"),
        (np.zeros((4, 3)), np.ones((5, 2)), "pc_embeddings.h5: has other rows than pc_points.h5 (4)"),
        (np.zeros((4, 3)), np.ones(4), "pc_embeddings.h5: has the shape (4,); expected (N, D)"),
        (np.zeros((4, 3)), np.ones((4, 2), int), "pc_embeddings.h5: contains values of type int64"),
    ],
)
def test_each_invalid_dense_map_is_one_line(tmp_path: Path, points: Any, features: Any, message: str) -> None:
    made.write_gradslam(tmp_path / "room0", points, features)
    assert message in made.refused(tmp_path, "room0", "gradslam")


# ---- HOV-SG


def test_objects_have_the_feature_row_of_their_number(tmp_path: Path) -> None:
    clouds = {k: made.RNG.normal(size=(k % 3 + 1, 3)) for k in range(12)}
    features = made.RNG.normal(size=(12, 8))  # doubles, as saved by HOV-SG
    made.write_hovsg(tmp_path / "room0", clouds, features)
    found = instances(read(tmp_path))
    assert found.ids.tolist() == list(range(12))  # 10 and 11 are not sorted as strings
    np.testing.assert_array_equal(found.features, features.astype(np.float32))
    for k, cloud in clouds.items():
        np.testing.assert_array_equal(found.points[found.mask(k)], cloud.astype(np.float32))


def test_missing_numbers_skip_their_rows_and_lose_no_object(tmp_path: Path) -> None:
    features = made.RNG.normal(size=(6, 4)).astype(np.float16)
    made.write_hovsg(tmp_path / "room0", {k: np.full((1, 3), k) for k in (0, 2, 5)}, features)
    write_pcd_points(tmp_path / "room0/objects/pcd_3.pcd", np.full((2, 3), 3, np.float32))
    (tmp_path / "room0/objects/pcd_04.ply").write_text("not counted")
    prediction = read(tmp_path)
    found = instances(prediction)
    assert found.ids.tolist() == [0, 2, 3, 5] and found.centroids[:, 0].tolist() == [0, 2, 3, 5]
    np.testing.assert_array_equal(found.features, features[[0, 2, 3, 5]].astype(np.float32))
    assert "2 rows of mask_feats.pt have no object file and are not used (1, 4)" in prediction.remarks
    assert "the original's loader would not read the last 1 objects (5)" in prediction.remarks


def test_each_invalid_hovsg_map_is_one_line(tmp_path: Path) -> None:
    scene = tmp_path / "room0"
    made.write_hovsg(scene, {0: np.zeros((2, 3)), 4: np.zeros((1, 3))}, np.ones((3, 4), np.float32))
    assert "pcd_4.ply: object 4 has no feature, mask_feats.pt has 3 rows" in made.refused(tmp_path, "room0", "hovsg")
    (scene / "objects/pcd_4.ply").unlink()
    write_pcd_points(scene / "objects/pcd_0.pcd", np.zeros((1, 3), np.float32))
    assert "object 0 exists as .ply and .pcd" in made.refused(tmp_path, "room0", "hovsg")
    (scene / "objects/pcd_0.pcd").unlink()
    made.write_object(scene / "objects/pcd_0.ply", [[0, 0, np.inf]])
    assert "pcd_0.ply: point 0 is at [0.0, 0.0, inf]" in made.refused(tmp_path, "room0", "hovsg")
    write_ply(scene / "objects/pcd_0.ply", [PlyElement("vertex", 1, {"x": np.zeros(1), "y": np.zeros(1)})])
    assert "pcd_0.ply: its vertices have no x, y and z" in made.refused(tmp_path, "room0", "hovsg")
    made.write_torch(scene / "mask_feats.pt", made.Tensor(np.ones(3, np.float32)))
    assert "mask_feats.pt: contains an array of shape (3,)" in made.refused(tmp_path, "room0", "hovsg")


# ---- OpenLex3D


@pytest.mark.parametrize("cloud", ["point_cloud.pcd", "point_cloud.ply", "input.ply"])
def test_three_openlex3d_files_are_read_as_a_partition(tmp_path: Path, cloud: str) -> None:
    points, index, features = (
        made.RNG.normal(size=(9, 3)).astype(np.float32),
        np.arange(9) % 3,
        made.RNG.normal(size=(4, 8)),
    )
    made.write_openlex(tmp_path / "replica/room0", points, index, features, cloud)
    prediction = read(tmp_path, "replica/room0")
    assert isinstance(prediction.content, Partition) and prediction.remarks == ()
    np.testing.assert_array_equal(prediction.content.points, points)
    np.testing.assert_array_equal(prediction.content.instance, index)
    np.testing.assert_array_equal(prediction.content.features, features.astype(np.float32))


def test_cloud_that_the_original_reads_is_used_of_several(tmp_path: Path) -> None:
    made.write_openlex(tmp_path / "room0", np.zeros((2, 3)), np.zeros(2, int), np.zeros((1, 4)), "input.ply")
    made.write_openlex(tmp_path / "room0", np.ones((2, 3)), np.zeros(2, int), np.zeros((1, 4)))
    prediction = read(tmp_path)
    assert prediction.content.points.all()  # type: ignore[union-attr]
    assert prediction.remarks[0] == "point_cloud.pcd is read, as in the original, and not input.ply"
    assert prediction.remarks[1] == "1 objects have no feature (a row of zeros or NaN)"


@pytest.mark.parametrize(
    ("index", "features", "message"),
    [
        (np.array([0, -1]), np.ones((2, 4)), "index.npy: point 1 is of object -1, embeddings.npy has 2 rows"),
        (np.array([0, 2**63], np.uint64), np.ones((2, 4)), "point 1 is of object 9223372036854775808"),
        (np.array([0, 1, 1]), np.ones((2, 4)), "expected one integer for each of the 2 points of point_cloud.pcd"),
        (np.array([0.0, 1.0]), np.ones((2, 4)), "holds an array of shape (2,) float64"),
        (np.array([0, 1]), np.ones(4), "embeddings.npy: contains an array of shape (4,)"),
        (np.array([0, 1]), np.array([[{}]]), "embeddings.npy: not a complete .npy array"),
    ],
)
def test_each_invalid_openlex3d_file_is_one_line(tmp_path: Path, index: Any, features: Any, message: str) -> None:
    made.write_openlex(tmp_path / "room0", np.zeros((2, 3)), index, features)
    assert message in made.refused(tmp_path, "room0", "openlex3d")
